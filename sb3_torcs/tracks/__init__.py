"""Tracks of straights and arcs: find, read, generate and draw them."""

from sb3_torcs.tracks.catalogue import available_tracks, load_track
from sb3_torcs.tracks.track import Grid, Segment, Surface, Track

__all__ = ["Grid", "Segment", "Surface", "Track", "available_tracks", "load_track"]
