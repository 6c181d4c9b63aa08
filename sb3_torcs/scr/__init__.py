"""The SCR protocol: its messages, a client, and the game as a server."""
