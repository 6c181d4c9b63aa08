"""Races of several drivers, robots and agents, and what many of them say about who is better."""
