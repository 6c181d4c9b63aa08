"""The installed game: its folders, its files, and its process."""
