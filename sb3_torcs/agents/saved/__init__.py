"""Models in files: what they hold, how they were trained, and who drives with them."""
