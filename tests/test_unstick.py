"""Cars that are stuck across the road or beside it free themselves, however they are driven."""

from __future__ import annotations

import math
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from conftest import held_with
from vectors import assert_they_see_the_same, both_kinds

from sb3_torcs.car import Controls

ASKED = np.array([0.3, 0.9, 0.0], np.float32)
ENDS = {"recovery": 15.0, "runoff": 8.0}
FREELY = {"aids": ["unstick"], "ends": ENDS}
HEADINGS = [-3.1, -2.4, -1.6, -0.8, 0.8, 1.6, 2.4, 3.1]


@pytest.fixture(params=["TorcsLite-v0", "Torcs-v0", "Torcs-v0 over SCR"])
def make(request):
    name, *other = request.param.split(" over ")
    if name == "Torcs-v0":
        request.getfixturevalue("game")
    return partial(gym.make, name, **({"backend": "scr"} if other else {}))


held = partial(held_with, "unstick", asked=ASKED)


@pytest.mark.parametrize(
    ("state", "steering", "gear"),
    [
        ({"heading_error": 1.0, "distance_from_axis": 3.0}, 1.0, 1),
        ({"heading_error": 1.0, "distance_from_axis": -3.0}, -1.0, -1),
        ({"heading_error": -2.5, "distance_from_axis": -3.0}, -1.0, 1),
        ({"heading_error": -2.5, "distance_from_axis": 3.0}, 1.0, -1),
        ({"heading_error": 1.0, "distance_from_axis": 2.0, "gear": -1}, -1.0, -1),  # goes on
    ],
)
def test_a_stuck_car_goes_where_its_nose_or_its_tail_has_room(oval, state, steering, gear):
    """Forward where the nose points to the axis, else backward; it turns to the road both ways."""
    controls = held(oval, speed_x=0.0, **state)
    assert (controls.steering, controls.gear) == (steering, gear)
    assert controls.throttle > 0.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_car_that_stands_beside_the_road_comes_back_to_it(oval, side):
    """Which is 10 m wide: it turns to the axis, and no further than it needs."""
    along = held(oval, speed_x=0.0, distance_from_axis=side * 7.0)
    assert along == Controls(-side * 0.7, 1.0, 0.0, 1)
    slanting = held(oval, speed_x=0.0, distance_from_axis=side * 7.0, heading_error=side * 0.35)
    assert slanting.steering == 0.0


@pytest.mark.parametrize(
    "state",
    [
        {"heading_error": 0.5, "speed_x": 0.0},
        {"heading_error": 2.0, "speed_x": 20.0},
        {"heading_error": 2.0, "speed_x": 0.0, "speed_y": 6.0},
    ],
)
def test_a_car_that_points_along_the_road_or_still_slides_does_what_is_asked(oval, state):
    assert held(oval, **state) == Controls(*map(float, ASKED))


def test_a_car_that_rolls_the_other_way_brakes_first(oval):
    controls = held(oval, heading_error=1.0, distance_from_axis=-3.0, speed_x=4.0)
    assert controls.throttle == 0.0
    assert controls.brake > 0.0


@pytest.mark.parametrize("track", ["aalborg", "g-track-1"])
@pytest.mark.parametrize("heading", HEADINGS)
def test_it_comes_free_and_points_along_the_road(make, track, heading):
    """Between the walls of aalborg, too."""
    env = make(track=track, **FREELY)
    for place in (-0.7, 0.0, 0.7):
        start = {"distance": 330.0, "track_position": place, "heading_error": heading}
        env.reset(seed=0, options=start)
        car = env.unwrapped.car
        for _ in range(200):
            if abs(car.heading_error) < math.pi / 6.0:
                break
            *_, info = env.step(ASKED)
            car = info["car"]
            assert info["end"] == ""
        else:
            pytest.fail(f"from {place} it still points {car.heading_error:.1f} rad away")
    env.close()


@pytest.mark.parametrize("env_id", ["TorcsLite-v0", "Torcs-v0"])
def test_races_driven_at_once_free_their_cars_as_single_ones_do(request, env_id):
    if env_id == "Torcs-v0":
        request.getfixturevalue("game")
    with both_kinds(env_id, **FREELY) as (ours, theirs):
        for envs in (ours, theirs):
            envs.set_options({"distance": 330.0, "heading_error": 2.4})
        assert_they_see_the_same(ours, theirs)
        gears = {controls.gear for controls in theirs.get_attr("controls")}
        assert gears <= {-1, 1}  # not None, which leaves it to the gearbox


def test_who_has_not_asked_for_it_drives_on(make):
    env = make(ends=ENDS)
    env.reset(seed=0, options={"heading_error": 2.0})
    for _ in range(5):
        env.step(ASKED)
    controls = env.unwrapped.controls
    assert controls == Controls(*map(float, ASKED))
    env.close()
