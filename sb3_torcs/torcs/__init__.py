"""The installed game: where it is, what it reads and writes, and a process of it."""
