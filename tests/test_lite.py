"""The fallback world: physics and range finders with known answers."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import segment

from sb3_torcs.backends.lite import car as figures
from sb3_torcs.backends.lite import physics
from sb3_torcs.backends.lite.backend import LiteBackend
from sb3_torcs.backends.lite.rays import RANGE, cast, road_edges
from sb3_torcs.car import REST_HEIGHT, Controls, Start
from sb3_torcs.errors import CarLost, InvalidOption
from sb3_torcs.tracks.track import Grid, Track

RNG = np.random.default_rng(0)
GAS, COAST, BRAKE = Controls(0.0, 1.0, 0.0), Controls(0.0, 0.0, 0.0), Controls(0.0, 0.0, 1.0)


@pytest.fixture
def world(oval):
    return LiteBackend(oval)


def drive(world, controls, ticks, start=None):
    """Hold the controls; return the car after every tick."""
    world.reset(RNG, start)
    return [world.step(controls, 1) for _ in range(ticks)]


def test_a_car_that_is_left_alone_stands(world):
    car = drive(world, COAST, 100)[-1]
    assert abs(car.speed_x) < 0.5  # the idling engine creeps in first gear until it is braked
    still = drive(world, BRAKE, 100)[-1]
    assert abs(still.speed_x) < 1e-3


def test_straight_ahead_stays_exactly_in_the_middle(world):
    car = drive(world, GAS, 200, Start(20.0, 0.0, 0.0, 10.0))[-1]
    assert car.distance_from_axis == 0.0
    assert car.yaw == 0.0


def test_left_and_right_are_mirror_images(oval):
    start = Start(20.0, 0.0, 0.0, 25.0)
    left = drive(LiteBackend(oval), Controls(0.2, 0.3, 0.0), 30, start)[-1]
    right = drive(LiteBackend(oval), Controls(-0.2, 0.3, 0.0), 30, start)[-1]
    assert left.distance_from_axis > 0.0
    # Not exactly: forces are summed over the wheels from right to left in both.
    assert left.distance_from_axis == pytest.approx(-right.distance_from_axis, rel=1e-9)
    assert left.speed_x == pytest.approx(right.speed_x, rel=1e-9)


def test_steering_left_turns_left(world):
    car = drive(world, Controls(0.3, 0.3, 0.0), 25, Start(20.0, 0.0, 0.0, 20.0))[-1]
    assert car.yaw_rate > 0.0
    assert car.yaw > 0.0
    assert car.heading_error == -car.yaw


def test_the_steering_turns_no_faster_than_its_rate(world):
    drive(world, Controls(1.0, 0.0, 0.0), 1, Start(20.0, 0.0, 0.0, 20.0))
    assert world._state[physics.STEER] == pytest.approx(figures.STEER_RATE * 0.02, rel=1e-12)


@pytest.mark.parametrize(
    ("engine_speed_rpm", "torque"), [(1000, 160.0), (5000, 405.0), (7500, 474.0), (9000, 415.0)]
)
def test_the_engine_gives_the_torque_of_its_curve(engine_speed_rpm, torque):
    assert figures.motor_torque(engine_speed_rpm * figures.RPM, 1.0) == pytest.approx(torque)


def test_the_engine_gives_nothing_above_the_limiter_and_brakes_below():
    assert figures.motor_torque(9200.0 * figures.RPM, 1.0) == 0.0
    assert figures.motor_torque(6000.0 * figures.RPM, 0.0) < 0.0


def test_a_tyre_saturates():
    """Grip rises to a peak, and twice the load gives less than twice the grip."""
    grip = [figures.tyre_grip(slip, 3000.0, 3600.0) for slip in (0.02, 0.1, 0.25)]
    assert grip == sorted(grip)
    assert grip[1] < 5.0 * grip[0]
    assert figures.tyre_grip(0.1, 6000.0, 3600.0) < 2.0 * figures.tyre_grip(0.1, 3000.0, 3600.0)


def test_combined_slip_takes_braking_from_cornering(world):
    start = Start(20.0, 0.0, 0.0, 40.0)
    cornering = drive(world, Controls(0.5, 0.0, 0.0), 20, start)[-1]
    both = drive(world, Controls(0.5, 0.0, 1.0), 20, start)[-1]
    assert both.yaw_rate < cornering.yaw_rate


def test_downforce_presses_the_body_into_its_springs(world):
    cars = drive(world, GAS, 150, Start(20.0, 0.0, 0.0, 30.0))
    assert cars[-1].height < cars[0].height < REST_HEIGHT
    assert cars[-1].speed_z < 0.0
    sunk = REST_HEIGHT - cars[-1].height
    assert sunk == pytest.approx(0.001, abs=0.001)  # [m] stiff springs: a millimetre


def test_the_gearbox_shifts_up_through_all_gears_and_pauses_the_drive(oval):
    straight = Track("drag", "road", (segment(5000.0), segment(5000.0)), grid=Grid(10.0, 0.0))
    cars = drive(LiteBackend(straight), GAS, 2000)
    gears = [car.gear for car in cars]
    assert sorted(set(gears)) == [1, 2, 3, 4, 5, 6]
    assert gears == sorted(gears)
    shift = gears.index(2)
    gained = [b.speed_x - a.speed_x for a, b in itertools.pairwise(cars)]
    assert max(gained[shift : shift + 6]) < 0.0 < gained[shift - 2]
    assert 75.0 < cars[-1].speed_x < 95.0  # [m/s] the limiter in sixth is at 91


def test_full_brakes_stop_from_100_km_h_as_a_racing_car_does(world):
    cars = drive(world, BRAKE, 200, Start(20.0, 0.0, 0.0, 100.0 / 3.6))
    stop = next(car for car in cars if car.speed_x < 0.1)
    assert 15.0 < stop.distance_raced < 35.0


def test_grass_is_slower_than_road(oval):
    start = Start(20.0, 0.0, 0.0, 20.0)
    wide = Track("grass", "road", tuple(s._replace(road=s.left) for s in oval.segments))
    assert (
        drive(LiteBackend(wide), BRAKE, 25, start)[-1].speed_x
        > drive(LiteBackend(oval), BRAKE, 25, start)[-1].speed_x
    )


def test_a_wall_stops_the_car_and_damages_it(world):
    cars = drive(world, COAST, 300, Start(20.0, 0.0, -0.8, 30.0))
    assert cars[-1].damage > 0.0
    assert max(abs(car.distance_from_axis) for car in cars) < 10.0


def test_a_lap_counts_from_line_to_line(oval):
    world = LiteBackend(oval)
    world.reset(RNG, Start(oval.length - 30.0, 0.0, 0.0, 30.0))
    laps, distances = [], []
    for _ in range(5000):
        car = world.step(_follow(world), 1)
        laps.append(car.laps)
        distances.append(car.distance_raced)
        if car.laps == 2:
            break
    assert laps == sorted(laps)
    assert car.laps == 2
    first = laps.index(1)
    assert distances[first] == pytest.approx(oval.length + 30.0, abs=2.0)  # the way to the line
    assert car.last_lap_time == pytest.approx((laps.index(2) - first) * 0.02, abs=0.02)
    assert car.best_lap_time == min(car.last_lap_time, car.best_lap_time)


def test_a_start_on_the_line_begins_the_lap(oval):
    world = LiteBackend(oval)
    world.reset(RNG, Start(0.0, 0.0, 0.0, 25.0))
    cars = [world.step(_follow(world), 1) for _ in range(2200)]
    first = next(car for car in cars if car.laps == 1)
    assert first.distance_raced == pytest.approx(oval.length, abs=1.0)
    assert first.last_lap_time == pytest.approx(first.time, abs=0.02)


def test_crossing_the_line_back_and_forth_counts_no_lap(oval):
    world = LiteBackend(oval)
    world.reset(RNG, Start(oval.length - 2.0, 0.0, 0.0, 10.0))
    for controls in [COAST] * 40 + [Controls(0.0, 0.0, 1.0)] * 60:
        car = world.step(controls, 1)
    for gear, ticks in ((-1, 400), (1, 300)):
        for _ in range(ticks):
            car = world.step(Controls(0.0, 0.5, 0.0, gear), 1)
    assert car.laps == 0
    assert car.lap_time == pytest.approx(car.time, abs=0.5), "its clock runs since the first time"


def test_the_first_lap_from_the_grid_counts_from_the_start(oval):
    world = LiteBackend(oval)
    world.reset(RNG, None)
    cars = [world.step(_follow(world), 1) for _ in range(300)]
    car = next(car for car in cars if car.distance_raced > 11.0)
    assert car.lap_time == car.time > 0.0
    assert car.laps == 0


def _follow(world):
    """Hold about 25 m/s on the axis."""
    state = world._state
    angle = math.remainder(state[physics.TANGENT] - state[physics.YAW], math.tau)
    curvature = world.track.segments[int(state[physics.SEGMENT])].curvature
    steering = 8.0 * curvature + 2.0 * angle - 0.1 * state[physics.OFFSET]
    speed = math.hypot(state[physics.VX], state[physics.VY])
    return Controls(max(min(steering, 1.0), -1.0), 0.6 if speed < 25.0 else 0.0, 0.0)


def measure(track, distance, offset=0.0, turn=0.0, angles=(-90.0, 0.0, 90.0)):
    """Range finders at a place, in degrees left negative."""
    edges = road_edges(track)
    x, y, heading = track.pose(distance, offset)
    beams = np.empty(len(angles))
    cast(*edges, track.find(distance)[0], (x, y, heading + turn), np.radians(angles), beams)
    return beams


def test_on_a_straight_the_beams_are_known_from_trigonometry(oval):
    angles = (-90.0, -60.0, -30.0, 30.0, 90.0)
    expected = [4.0, 4.0 / math.sin(math.radians(60)), 8.0, 12.0, 6.0]
    beams = measure(oval, 150.0, 1.0, 0.0, angles)
    np.testing.assert_allclose(beams, expected, rtol=1e-12)


def test_in_a_bend_the_beams_are_known_from_circles(oval):
    middle = 300.0 + 0.5 * math.pi * 50.0
    beams = measure(oval, middle)
    ahead = math.sqrt(55.0**2 - 50.0**2)  # a tangent of the axis reaches the outer edge
    np.testing.assert_allclose(beams, [5.0, ahead, 5.0], rtol=1e-9)


def test_nothing_in_reach_gives_the_range(oval):
    assert measure(oval, 10.0)[1] == RANGE


def test_no_beam_slips_between_two_segments(oval):
    for distance in np.linspace(0.0, oval.length, 97):
        beams = measure(oval, float(distance), 4.9, 0.0, tuple(np.linspace(-90, 90, 361)))
        assert beams.max() <= RANGE
        assert beams[0] == pytest.approx(0.1, abs=1e-6)


def test_beams_agree_with_a_slow_and_obvious_ray_march():
    """The oracle: walk along the beam in steps of 1 cm until the road is left."""
    from sb3_torcs.tracks.catalogue import load_track

    track = load_track("aalborg")
    rng = np.random.default_rng(3)
    for _ in range(12):
        distance, offset = rng.uniform(0.0, track.length), rng.uniform(-4.0, 4.0)
        angle = rng.uniform(-80.0, 80.0)
        beam = measure(track, distance, offset, 0.0, (angle,))[0]
        x, y, heading = track.pose(distance, offset)
        state = physics.place(x, y, heading, 0.0, track.find(distance)[0], track.table)
        walked = 0.0
        while walked < RANGE and abs(state[physics.OFFSET]) <= 5.0:
            walked += 0.01
            state[physics.X] = x + walked * math.cos(heading - math.radians(angle))
            state[physics.Y] = y + walked * math.sin(heading - math.radians(angle))
            physics.locate(state, track.table)
        assert beam == pytest.approx(min(walked, RANGE), abs=0.02)


def test_a_road_that_holds_too_well_loses_the_car(oval):
    """The tyres shake it apart; so the episode ends, as on the real game, and no NaN is learned."""
    glue = [s._replace(road=s.road._replace(friction=1e3)) for s in oval.segments]
    world = LiteBackend(replace(oval, segments=tuple(glue)))
    world.reset(np.random.default_rng(0), Start(0.0, 0.0, 0.3, 60.0))
    with pytest.raises(CarLost, match="see the surfaces of that track"):
        world.step(Controls(1.0, 1.0, 0.0), 1000)


def test_a_car_it_does_not_have_is_refused(oval):
    with pytest.raises(InvalidOption, match="car is 'f1'; TorcsLite-v0 has car1-trb1"):
        LiteBackend(oval, car="f1")
