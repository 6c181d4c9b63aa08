"""The sensor table: spaces, scales and order follow from it."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import pytest
from conftest import car_state, plainly_encoded

from sb3_torcs.car import REST_HEIGHT, CarState, range_finder_angles
from sb3_torcs.errors import InvalidOption
from sb3_torcs.sensors import (
    OBSERVATION_HIGH,
    OBSERVATION_LOW,
    OBSERVATION_SIZE,
    SENSORS,
    View,
    encode,
    feature_slices,
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


def test_the_compiled_encoder_equals_the_plain_one_to_the_bit():
    rng = np.random.default_rng(0)
    for spread in (1.0, 1.0, 30.0, 1000.0):
        for _ in range(100):
            car = car_state(
                heading_error=rng.normal(0.0, spread),
                range_finders=rng.normal(50.0, spread, 19),
                distance_from_axis=rng.normal(0.0, spread),
                speed_x=rng.normal(20.0, spread),
                speed_y=rng.normal(0.0, spread),
                speed_z=rng.normal(0.0, spread),
                wheel_speeds=rng.normal(60.0, spread, 4),
                engine_speed=rng.normal(500.0, spread),
            )
            assert encode(car).tobytes() == plainly_encoded(car).tobytes(), car


def test_an_observation_is_a_new_array_each_time():
    car = car_state()
    first = encode(car)
    assert first.dtype == np.float32
    assert first.flags.writeable
    assert not np.shares_memory(first, encode(car))


def test_nan_is_not_hidden_by_clipping():
    observation = encode(car_state(speed_x=math.nan, wheel_speeds=np.full(4, math.nan)))
    assert np.flatnonzero(np.isnan(observation)).tolist() == [21, 24, 25, 26, 27]


def test_whole_numbers_and_single_precision_are_numbers_too():
    car = car_state(speed_x=30, range_finders=np.arange(19), wheel_speeds=np.ones(4, np.float32))
    assert encode(car).tobytes() == plainly_encoded(car).tobytes()


@pytest.mark.parametrize(("name", "size"), [("range_finders", 18), ("wheel_speeds", 5)])
def test_a_sensor_of_another_size_is_refused(name, size):
    """The compiled encoder would otherwise write beside the observation."""
    with pytest.raises(ValueError, match=rf"\({size},\)"):
        encode(car_state(**{name: np.zeros(size)}))


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


def test_motion_tells_how_fast_the_car_turns_and_how_high_it_is():
    view = View(("base", "motion"))
    light = car_state(yaw_rate=-0.5, height=REST_HEIGHT + 0.1)
    np.testing.assert_allclose(view.encode(light, None)[OBSERVATION_SIZE:], [-0.5, 1.0])
    thrown = car_state(yaw_rate=90.0, height=-3.0)
    assert view.encode(thrown, None)[OBSERVATION_SIZE:].tolist() == [5.0, -5.0]


def test_a_car_in_the_air_is_seen_to_be_there(game):
    """On g-track-3 a fast car jumps; standing, it is as high as usual."""
    env = gym.make("sb3_torcs:Torcs-v0", track="g-track-3", sensors=("base", "motion"))
    lift = feature_slices(("base", "motion"))["lift"]
    standing, _ = env.reset(seed=0)
    assert abs(standing[lift]) < 0.1
    env.reset(options={"distance": 2000.0, "speed": 55.0})
    flown = [env.step(np.array([0.0, 0.0, 0.0], np.float32))[0][lift].item() for _ in range(25)]
    env.close()
    assert max(flown) > 0.5, flown
