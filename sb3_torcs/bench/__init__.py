"""What ``sb3-torcs bench`` measures."""
