"""The track as highway-env's lanes, and the car on them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from stadium import stadium, state

from sb3_torcs.rendering.highway import (
    RaceCar,
    Road,
    RoadNetwork,
    lane_index,
    road_network,
    to_highway,
)
from sb3_torcs.tracks.catalogue import load_track


@pytest.mark.parametrize("track", [stadium(0.02), stadium(-0.02), load_track("aalborg")], ids=str)
def test_lanes_lie_exactly_where_the_track_does(track):
    lanes = road_network(track)
    for index, s in enumerate(track.segments):
        lane = lanes.get_lane(lane_index(index, len(track.segments)))
        assert lane.length == pytest.approx(s.length, abs=1e-9)
        for along in (0.0, 0.3 * s.length, s.length):
            for offset in (-4.0, 0.0, 5.5):
                place = track.pose_on(index, along, offset)
                expected = to_highway(place.x, place.y)
                # Another formula for the same arc: rounding of coordinates of hundreds of metres.
                np.testing.assert_allclose(lane.position(along, -offset), expected, atol=1e-9)
                turn = lane.heading_at(along) + place.heading
                assert math.remainder(turn, math.tau) == pytest.approx(0.0, abs=1e-9)


def test_lanes_know_where_a_place_is():
    track = stadium(0.02)
    lane = road_network(track).get_lane(lane_index(1, 4))
    place = track.pose_on(1, 40.0, 3.0)
    along, across = lane.local_coordinates(to_highway(place.x, place.y))
    assert (along, across) == pytest.approx((40.0, -3.0), abs=1e-9)


def test_lanes_are_as_wide_as_the_road():
    lanes = road_network(stadium(0.02))
    widths = [lanes.get_lane(lane_index(0, 4)).width_at(along) for along in (0.0, 100.0, 200.0)]
    assert widths == [10.0, 11.0, 12.0]
    assert lanes.get_lane(lane_index(1, 4)).width_at(7.0) == 12.0


def test_lanes_form_one_ring():
    lanes = road_network(stadium(0.02))
    index = lane_index(0, 4)
    visited = []
    for _ in range(4):
        visited.append(index)
        lane = lanes.get_lane(index)
        index = lanes.next_lane(index, position=lane.position(lane.length, 0.0))
    assert visited == [("0", "1", 0), ("1", "2", 0), ("2", "3", 0), ("3", "0", 0)]
    assert index == visited[0]


def test_a_network_survives_being_written_as_a_config():
    lanes = road_network(stadium(0.02))
    again = RoadNetwork.from_config(lanes.to_config())
    assert again.to_config() == lanes.to_config()


def test_left_is_left_on_a_screen_whose_y_points_down():
    lane = road_network(stadium(0.02)).get_lane(lane_index(1, 4))
    assert not lane.clockwise
    assert lane.heading_at(10.0) < lane.heading_at(0.0)


def car_on(track, car_state):
    return RaceCar(Road(road_network(track)), track, car_state)


def test_the_car_is_where_its_state_says():
    track = stadium(0.02)
    there = state(track, 250.0, offset=2.0, heading_error=0.1)
    car = car_on(track, there)
    assert car.position.tolist() == [there.x, -there.y]
    assert car.heading == -there.yaw
    assert car.speed == 30.0


@pytest.mark.parametrize(("distance", "expected"), [(0.0, 0), (199.0, 0), (200.0, 1), (520.0, 2)])
def test_the_car_finds_its_lane_as_highway_env_would(distance, expected):
    track = stadium(0.02)
    car = car_on(track, state(track, 0.0))
    car.pose(state(track, distance, offset=1.0))
    assert car.lane_index == lane_index(expected, 4)
    assert car.lane is car.road.network.get_lane(car.lane_index)
    # On a joint both lanes are equally near, so highway-env's answer is asked for just after it.
    after = to_highway(*track.pose(distance + 0.1, 1.0)[:2])
    assert car.road.network.get_closest_lane_index(after, car.heading) == car.lane_index


def test_a_step_of_highway_env_does_not_move_the_car():
    track = stadium(0.02)
    car = car_on(track, state(track, 100.0))
    before = car.position.copy()
    car.act({"steering": 0.5, "acceleration": 5.0})
    car.road.vehicles.append(car)
    car.road.step(1.0)
    assert car.position.tolist() == before.tolist()
    assert car.speed == 30.0


def test_the_velocity_holds_the_sliding():
    track = stadium(0.02)
    car = car_on(track, state(track, 0.0, speed=(3.0, 4.0)))
    along = np.array([math.cos(car.heading), math.sin(car.heading)])
    left = np.array([along[1], -along[0]])  # on a screen whose y points down
    np.testing.assert_allclose(car.velocity, 3.0 * along + 4.0 * left, atol=1e-12)
