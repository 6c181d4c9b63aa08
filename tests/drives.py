"""Drives of the engine, to the bit."""

from __future__ import annotations

import hashlib

import numpy as np

from sb3_torcs.backends.native import make_engine
from sb3_torcs.torcs.installation import find_game


def drive(track, entries, seed, ticks=300):
    """Press at random; return a digest of all that could be read of the race."""
    engine = make_engine(find_game(), track, entries, session="race" if entries[1:] else "practice")
    rng, digest = np.random.default_rng(seed), hashlib.sha256()
    engine.start_at(rng.uniform(0, 1000), 0.0, 0.0, 30.0) if seed % 2 else engine.start()
    for _ in range(ticks // 5):
        steering, throttle, brake = rng.uniform([-0.2, 0, 0], [0.2, 1, 0.3])
        engine.step(steering, throttle, brake, None, 5)
        for car in range(len(entries)):
            for value in engine.read(car):
                digest.update(np.float64(value).tobytes())
    engine.close()
    return digest.hexdigest()
