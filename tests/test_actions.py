"""Actions: what an agent may hand over, and what the car is told."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sb3_torcs.actions import ACTIONS, action_layout, controls_from_action
from sb3_torcs.car import Controls
from sb3_torcs.errors import InvalidAction, InvalidOption


@pytest.mark.parametrize(
    "action",
    [
        np.array([0.5, 0.25, 0.0], np.float32),
        np.array([0.5, 0.25, 0.0], np.float64),
        np.array([0.5, 0.25, 0.0], np.float16),
        np.array([0.5, 0.25, 0.0], np.longdouble),
        np.array([0.5, 0.25, 0.0], object),
        np.array([[0.5, 9.0], [0.25, 9.0], [0.0, 9.0]])[:, 0],
        [0.5, 0.25, 0],
        (np.float32(0.5), 0.25, 0),
    ],
    ids=lambda action: f"{type(action).__name__}-{getattr(action, 'dtype', '')}",
)
def test_three_numbers_of_any_kind_are_an_action(action):
    controls = controls_from_action(action)
    assert controls == Controls(0.5, 0.25, 0.0)
    assert type(controls) is Controls
    assert controls.gear is None
    assert [type(value) for value in controls[:3]] == [float] * 3


def test_whole_numbers_become_floats():
    """The compiled worlds would be compiled anew for them."""
    controls = controls_from_action(np.array([-1, 1, 0]))
    assert [type(value) for value in controls[:3]] == [float] * 3


@pytest.mark.parametrize(
    ("action", "controls"),
    [
        ([9.0, 5.0, -3.0], Controls(1.0, 1.0, 0.0)),
        ([-9.0, -5.0, 3.0], Controls(-1.0, 0.0, 1.0)),
        ([math.inf, math.inf, -math.inf], Controls(1.0, 1.0, 0.0)),
        ([1.0000001, 1.0, 1.0], Controls(1.0, 1.0, 1.0)),
    ],
)
def test_what_lies_outside_is_clipped(action, controls):
    assert controls_from_action(np.array(action)) == controls


@pytest.mark.parametrize("dtype", [np.float32, np.float64, object])
@pytest.mark.parametrize(("place", "name"), [*enumerate(["steering", "throttle", "brake"])])
def test_nan_is_refused_by_name(place, name, dtype):
    action = np.zeros(3, dtype)
    action[place] = math.nan
    with pytest.raises(InvalidAction, match=f"{name} is nan, expected a number in its range"):
        controls_from_action(action)


@pytest.mark.parametrize(
    "action",
    [np.zeros(2), np.zeros((1, 3)), np.float32(0.0), [], [0.0] * 4, None, 3, [[1, 2], 3, 4]],
)
def test_another_shape_is_refused(action):
    with pytest.raises(InvalidAction, match=r"expected \(3,\): steering, throttle, brake"):
        controls_from_action(action)


@pytest.mark.parametrize(
    "action",
    [["a", "b", "c"], ["0", "1", "0"], [None] * 3, np.array(["a", "b", "c"]), (0, 10**400, 0)],
)
def test_what_is_no_number_is_refused(action):
    with pytest.raises(InvalidAction, match="expected three numbers: steering, throttle, brake"):
        controls_from_action(action)


@pytest.mark.parametrize(
    ("pedal", "controls"),
    [
        (1.0, Controls(0.5, 1.0, 0.0)),
        (0.25, Controls(0.5, 0.25, 0.0)),
        (0.0, Controls(0.5, 0.0, 0.0)),
        (-0.25, Controls(0.5, 0.0, 0.25)),
        (-7.0, Controls(0.5, 0.0, 1.0)),
    ],
)
def test_a_signed_pedal_is_throttle_above_0_and_brake_below(pedal, controls):
    assert controls_from_action(np.array([0.5, pedal]), action_layout("pedal")) == controls


@pytest.mark.parametrize(
    ("number", "gear"),
    [(-9.0, -1), (-0.6, -1), (-0.5, 0), (0.4, 0), (0.5, 1), (1.5, 2), (5.4, 5), (5.5, 6), (99, 6)],
)
def test_a_gear_is_the_nearest_whole_number(number, gear):
    """Halves go up, so that each gear between has the same share of the range."""
    action = np.array([0.0, 0.5, 0.0, number, 0.75])
    controls = controls_from_action(action, action_layout("manual", gears=6))
    assert controls == Controls(0.0, 0.5, 0.0, gear, 0.75)
    assert type(controls.gear) is int


@pytest.mark.parametrize("action", ACTIONS)
def test_each_layout_names_its_numbers_where_one_is_wrong(action):
    layout = action_layout(action)
    with pytest.raises(InvalidAction, match=rf"expected \({len(layout.names)},\): steering, "):
        controls_from_action(np.zeros(4), layout)
    for place, name in enumerate(layout.names):
        numbers = np.zeros(len(layout.names))
        numbers[place] = math.nan
        with pytest.raises(InvalidAction, match=f"^{name} is nan"):
            controls_from_action(numbers, layout)


@pytest.mark.parametrize("action", ["pedal ", "peddal", None, 3, ["pedal"]])
def test_another_layout_is_refused(action):
    with pytest.raises(InvalidOption, match="expected one of 'pedals', 'pedal', 'manual'"):
        action_layout(action)
