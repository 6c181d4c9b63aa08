"""Pictures: the drawing from above, the game's own camera, and videos of both."""
