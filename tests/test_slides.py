"""A car that slides steers against it and leaves the pedals alone, whatever is asked."""

from __future__ import annotations

import math
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from conftest import held_with
from vectors import assert_they_see_the_same, both_kinds

from sb3_torcs.car import STEER_LOCK, Controls

ASKED = np.array([0.3, 0.0, 0.4], np.float32)
AS_ASKED = Controls(*map(float, ASKED))


ENDS = {"runoff": 50.0, "recovery": 20.0}

held = partial(held_with, "catch_slides", asked=ASKED)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_front_wheels_point_where_the_car_goes(oval, side):
    slip = 0.35
    state = {"speed_x": 20.0 * math.cos(slip), "speed_y": side * 20.0 * math.sin(slip)}
    controls = held(oval, **state)
    assert controls.steering == pytest.approx(side * slip / STEER_LOCK)
    assert (controls.throttle, controls.brake) == (0.0, 0.0)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_they_turn_no_further_than_they_can(oval, side):
    assert held(oval, speed_x=15.0, speed_y=side * 15.0).steering == side


@pytest.mark.parametrize(
    "state",
    [
        {"speed_x": 30.0},
        {"speed_x": 30.0, "speed_y": 8.0},  # 0.26 rad
        {"speed_x": 5.0, "speed_y": 5.0},  # slow
        {"speed_x": 0.0, "speed_y": 20.0},  # too late
        {"speed_x": -20.0, "speed_y": 10.0},
        {"speed_x": 20.0, "speed_y": 10.0, "gear": -1},
    ],
)
def test_a_car_that_does_not_slide_does_what_is_asked(oval, state):
    assert held(oval, **state) == AS_ASKED


def worst_slide(env, side):
    """Brake in a bend, then ask for nothing; return the greatest sideslip [rad]."""
    env.reset(seed=0, options={"distance": 1200.0, "speed": 45.0})
    worst = 0.0
    for step in range(50):
        asked = [0.3 * side, 0.0, 0.15] if step < 10 else [0.0, 0.0, 0.0]
        car = env.step(np.array(asked, np.float32))[4]["car"]
        if math.hypot(car.speed_x, car.speed_y) > 5.0:
            worst = max(worst, abs(math.atan2(car.speed_y, car.speed_x)))
    return worst


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_car_that_would_spin_does_not(game, side):
    make = partial(gym.make, "Torcs-v0", track="b-speedway", ends=ENDS)
    with make() as spins, make(aids=["catch_slides"]) as caught:
        assert worst_slide(spins, side) > 2.0
        assert worst_slide(caught, side) < 1.0


@pytest.mark.parametrize("env_id", ["TorcsLite-v0", "Torcs-v0"])
def test_races_driven_at_once_catch_slides_as_single_ones_do(request, env_id):
    if env_id == "Torcs-v0":
        request.getfixturevalue("game")
    options = {"aids": ["catch_slides"], "ends": {"runoff": 50.0}}
    with both_kinds(env_id, track="b-speedway", **options) as (ours, theirs):
        for envs in (ours, theirs):
            envs.set_options({"distance": 1200.0, "speed": 60.0})
        ours.action_space.low[2] = theirs.action_space.low[2] = 0.2
        assert_they_see_the_same(ours, theirs)
