"""The sensor table: spaces, scales and order follow from it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from conftest import car_state

from sb3_torcs.car import CarState
from sb3_torcs.errors import InvalidOption
from sb3_torcs.sensors import (
    OBSERVATION_HIGH,
    OBSERVATION_LOW,
    OBSERVATION_SIZE,
    SENSORS,
    encode,
    feature_slices,
    range_finder_angles,
)


def test_the_observation_is_the_29_numbers_of_the_post_in_its_order():
    assert OBSERVATION_SIZE == 29
    assert [sensor.key for sensor in SENSORS] == [
        "angle", "track", "trackPos", "speedX", "speedY", "speedZ", "wheelSpinVel", "rpm",
    ]  # fmt: skip


def test_a_known_car_gives_known_numbers():
    car = car_state(
        heading_error=math.pi / 2.0,
        range_finders=np.arange(19.0) * 10.0,
        distance_from_axis=2.5,
        speed_x=300.0 / 3.6,
        speed_y=-30.0 / 3.6,
        wheel_speeds=np.array([10.0, 20.0, 30.0, 40.0]),
        engine_speed=900.0,
    )
    expected = [0.5, *np.arange(19) / 20.0, 0.5, 1.0, -0.1, 0.0, 0.1, 0.2, 0.3, 0.4, 0.9]
    np.testing.assert_allclose(encode(car), np.array(expected, np.float32), rtol=1e-7)


def test_what_lies_outside_the_bounds_is_clipped_to_them():
    wild = encode(car_state(speed_x=1e6, speed_y=-1e6, distance_from_axis=1e6))
    assert np.all(wild >= OBSERVATION_LOW)
    assert np.all(wild <= OBSERVATION_HIGH)


def test_off_the_road_the_range_finders_say_minus_one():
    observation = encode(car_state(range_finders=np.full(19, -1.0)))
    np.testing.assert_array_equal(
        observation[feature_slices()["range_finders"]], np.float32(-1.0 / 200.0)
    )


def test_every_sensor_is_a_field_of_the_car():
    for sensor in SENSORS:
        assert hasattr(CarState, sensor.name), sensor.name


def test_the_bounds_are_finite_and_ordered():
    assert np.all(np.isfinite(OBSERVATION_LOW))
    assert np.all(np.isfinite(OBSERVATION_HIGH))
    assert np.all(OBSERVATION_LOW < OBSERVATION_HIGH)


def test_the_usual_range_finders_look_every_ten_degrees_from_left_to_right():
    usual = np.radians(np.arange(-90.0, 91.0, 10.0))
    np.testing.assert_array_equal(range_finder_angles("scr"), usual)
    narrow = np.degrees(range_finder_angles("narrow"))
    assert narrow[0] == pytest.approx(-45.0)
    assert np.all(np.diff(narrow) > 0.0)


@pytest.mark.parametrize("choice", ["wide", [0.0] * 18, [91.0] * 19, [math.nan] * 19, 5, "a" * 19])
def test_other_range_finders_are_refused(choice):
    with pytest.raises(InvalidOption, match="expected"):
        range_finder_angles(choice)
