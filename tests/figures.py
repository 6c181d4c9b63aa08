"""What must be the same on every machine, as one digest each. Run as a program, it prints them."""

from __future__ import annotations

import hashlib
import json

import gymnasium as gym
import numpy as np
import stable_baselines3

from sb3_torcs.agents.models import AGENTS, training_record
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.sensors import GROUPS, NEEDS_CAR, NEEDS_RACE
from sb3_torcs.tracks.catalogue import load_track
from sb3_torcs.tracks.generator import random_track
from sb3_torcs.tracks.racing_line import driven, racing_line

ROADS = ("aalborg", "alpine-1", "corkscrew", "g-track-1")
SEEN = [name for name in GROUPS if name not in NEEDS_CAR | NEEDS_RACE]
DRIVERS = ("ppo-aalborg", "ddpg-aalborg")


def digest(*arrays):
    """Of the bits of arrays."""
    told = hashlib.sha256()
    for array in arrays:
        told.update(np.ascontiguousarray(array).tobytes())
    return told.hexdigest()[:16]


def random_roads():
    return [random_track(np.random.default_rng(seed)) for seed in range(20)]


def lines(tracks):
    return digest(*(part for t in tracks for part in (racing_line(t.profile).table, *driven(t))))


def drives(track, driver=None):
    """
    Observations, terms of rewards and states of short drives from random starts.

    Not the rewards themselves: Python sums terms more precisely from 3.12 on.
    """
    options = {"sensors": SEEN, "reward": "blog", "aids": ["catch_slides", "unstick"]}
    options["ends"] = {"runoff": 50.0}
    env = gym.make("sb3_torcs:TorcsLite-v0", track=track, start="random", **options)
    told, rng = [], np.random.default_rng(7)
    for seed in range(4):
        seen, _ = env.reset(seed=seed)
        over, steps = False, 0
        while not over and steps < 60:
            action = rng.uniform(env.action_space.low, env.action_space.high) * (1.0, 1.0, 0.2)
            action = driver.predict(seen)[0] if driver else action.astype(np.float32)
            seen, _, *ends, info = env.step(action)
            numbers = [part for part in env.unwrapped.car if not isinstance(part, np.ndarray)]
            told += [seen, [*info["reward_terms"].values()], np.array(numbers, np.float64)]
            over, steps = any(ends), steps + 1
    env.close()
    return digest(*told)


def actions(name):
    """What an agent answers to random observations."""
    file = AGENTS / name / "best_model.zip"
    model = getattr(stable_baselines3, training_record(file).algo.upper()).load(file)
    rng = np.random.default_rng(3)
    seen = rng.uniform(-1.0, 1.0, (300, *model.observation_space.shape)).astype(np.float32)
    return digest(model.predict(seen, deterministic=True)[0])


def figures():
    """Compute all."""
    tracks = [load_track(name) for name in ROADS]
    roads = random_roads()
    return {
        "roads": digest(*(track.table for track in tracks)),
        "lines": lines(tracks),
        "random roads": digest(*(road.table for road in roads)),
        "lines of random roads": lines(roads[:4]),
        **{f"drives on {name}": drives(name) for name in ROADS[:2]},
        "drives on random roads": drives("random"),
        "drives of the scripted driver": drives("corkscrew", ScriptedDriver()),
        **{f"actions of {name}": actions(name) for name in DRIVERS},
    }


if __name__ == "__main__":
    print(json.dumps(figures(), indent=2))
