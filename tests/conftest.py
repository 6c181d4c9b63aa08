"""Shared pieces: a world that obeys a script, and small tracks."""

from __future__ import annotations

import math
import signal
import tempfile

import numpy as np
import pytest

# The first optimizer imports this, and with it triton, whose library crashed the interpreter in
# some orders of tests, when it was loaded after everything else. Loaded first it does no harm.
import torch._dynamo  # noqa: F401

from sb3_torcs.car import CONTROL_TICK, CarState
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.errors import BackendUnavailable
from sb3_torcs.sensors import SENSORS
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.tracks.track import Grid, Segment, Surface, Track

ASPHALT = Surface("asphalt", 1.2, 0.001, 0.5, 10.0)
GRASS = Surface("grass", 0.4, 0.01, 0.5, 10.0)
WALL = Surface("wall", 0.1, 0.001, 0.5, 10.0)

# `nohup make test &` ignores these, and so would every process that a test starts and signals.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)


def segment(length, curvature=0.0, width=10.0, side=5.0):
    """A stretch of asphalt between grass and walls."""
    return Segment(
        length, curvature, width, width, side, side, side, side, ASPHALT, GRASS, GRASS, WALL, WALL
    )


@pytest.fixture(scope="session")
def game():
    """The installed game. Tests that need it fail without it: a skip would hide a failure."""
    try:
        return find_game()
    except BackendUnavailable as error:
        pytest.fail(f"this test needs the game: {error}")


@pytest.fixture
def nothing_is_left(tmp_path, monkeypatch):
    """Whatever happens, the private folders of the game are gone afterwards."""
    private = tmp_path / "private"
    private.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(private))
    yield
    assert list(private.iterdir()) == []


@pytest.fixture
def oval():
    """Two straights of 300 m and two left half circles of 50 m radius."""
    turn = segment(math.pi * 50.0, 1.0 / 50.0)
    straight = segment(300.0)
    return Track("oval", "oval", (straight, turn, straight, turn), grid=Grid(10.0, 0.0))


def car_state(**changes):
    """A car rolling down the middle of a straight."""
    values = {
        "time": 0.0, "x": 0.0, "y": 0.0, "yaw": 0.0, "yaw_rate": 0.0,
        "speed_x": 20.0, "speed_y": 0.0, "speed_z": 0.0, "height": 0.25,
        "heading_error": 0.0, "distance_from_axis": 0.0, "track_width": 10.0,
        "distance_from_start": 100.0, "distance_raced": 0.0, "engine_speed": 500.0, "gear": 2,
        "fuel": 94.0, "damage": 0.0, "laps": 0, "lap_time": 0.0, "last_lap_time": 0.0,
        "best_lap_time": 0.0, "race_position": 1, "wheel_speeds": np.full(4, 60.0),
        "range_finders": np.full(19, 50.0), "opponents": np.full(36, 200.0),
    }  # fmt: skip
    return CarState(**{**values, **changes})


class ScriptedBackend:
    """A world whose next states are given: what the loop makes of them is what is tested."""

    car = "car1-trb1"
    range_finder_angles = np.radians(np.arange(-90.0, 91.0, 10.0))

    def __init__(self, track, *states):
        self.track = track
        self.states = list(states)
        self.calls = []
        self.closed = 0

    def reset(self, rng, start):
        self.calls.append(("reset", start))
        self.time = 0.0
        return car_state()

    def step(self, controls, ticks):
        self.calls.append(("step", controls, ticks))
        self.time += ticks * CONTROL_TICK
        changes = self.states.pop(0) if self.states else {}
        return car_state(**{"time": self.time, **changes})

    def close(self):
        self.closed += 1


def held_with(aid, oval, asked, **state):
    """What a car with a driver aid holds in the timestep after the one that ends with a state."""
    env = RacingEnv(ScriptedBackend(oval, state, {}), ends={"recovery": 10.0}, aids=[aid])
    env.reset(seed=0)
    env.step(asked)
    env.step(asked)
    return env.controls


def plainly_encoded(car):
    """Encode sensor by sensor, as the table's docstring says it."""
    columns = [
        np.clip(np.asarray(getattr(car, s.name)) * s.scale, s.low * s.scale, s.high * s.scale)
        for s in SENSORS
    ]
    return np.hstack(columns).astype(np.float32)
