"""The racing line that leads past slower cars, as an agent sees it."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from vectors import assert_they_see_the_same, both_kinds

from sb3_torcs.car import NO_RACE, RIVALS
from sb3_torcs.errors import InvalidOption
from sb3_torcs.rivals import PASSING_ROOM, TO_EDGE, lead_past
from sb3_torcs.sensors import View, choice_within, feature_slices

PLACES = np.arange(0.0, 100.0, 10.0)
LONG, WIDE = 4.5, 2.0
APART = WIDE + PASSING_ROOM
HALF_ROAD = 6.0


def moved(*rivals, line=0.0, offset=0.0):
    """How far to the left a straight line is moved, of a car on a road of 12 m."""
    race = NO_RACE.copy()
    table = race[5:].reshape(6, RIVALS)
    for number, (along, across, faster) in enumerate(rivals):
        table[:, number] = along, across, faster, 0.0, LONG, WIDE
    lines = np.full(len(PLACES), line)
    lead_past(race, offset, HALF_ROAD, PLACES, lines)
    assert len(set(lines)) == 1
    return lines[0] - line


@pytest.mark.parametrize("rival", [
    (8.0, 0.0, -5.0),  # far
    (4.0, 0.0, 6.0),  # draws away
    (6.0, 2.6, -5.0),  # beside the line
    (-7.0, 0.0, -5.0),  # has been passed
])  # fmt: skip
def test_who_is_not_in_the_way_leaves_the_line(rival):
    assert moved(rival) == 0.0


def test_nobody_leaves_the_line():
    assert moved() == 0.0


def test_the_line_moves_the_more_the_nearer_a_slower_car_is():
    ways = [moved((along, -1.0, -20.0)) for along in (14.0, 9.0, 4.0, 1.0, 0.0)]
    assert ways == sorted(ways)
    assert ways[0] == 0.0
    assert ways[-2] == ways[-1] == APART - 1.0


def test_who_comes_faster_pulls_out_earlier():
    assert 0.0 == moved((7.0, -1.0, -1.0)) < moved((7.0, -1.0, -10.0))


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_car_passes_where_it_is_already(side):
    assert side * moved((LONG, -side, -5.0), offset=side * 2.0) > 0.0


@pytest.mark.parametrize("offset", [-2.0, 2.0])
def test_a_car_straight_ahead_is_passed_where_the_road_is_free(offset):
    assert offset * moved((LONG, 0.0, -5.0), offset=offset) < 0.0


def test_on_a_full_side_it_passes_on_the_other_one():
    # The other car is a metre to the right, and 3 m from the axis: there is no room to its left.
    assert moved((6.0, -1.0, -5.0), offset=4.0) < 0.0


def test_without_room_it_stays_behind():
    race = NO_RACE.copy()
    race[5:].reshape(6, RIVALS)[:, 0] = 6.0, 0.0, -5.0, 0.0, LONG, WIDE
    line = np.zeros(len(PLACES))
    lead_past(race, 0.0, 3.5, PLACES, line)
    assert not line.any()


def test_the_line_stays_on_the_road():
    # Beside a car there is no choice left, and the line goes as far as it can.
    assert moved((0.0, -1.0, -20.0), offset=4.0, line=-0.5) == 0.5 + HALF_ROAD - TO_EDGE - 4.0


def test_the_nearest_car_in_the_way_counts():
    first, second = (5.0, 1.0, -5.0), (5.5, -1.0, -5.0)
    assert moved(first, second) == moved(first) != moved(second)
    assert moved((5.0, 2.6, -5.0), second) == moved(second)  # the first one is not in the way


def test_left_and_right_are_alike():
    for along, across, offset in [(6.0, 1.0, 0.5), (5.0, 0.3, -2.0), (2.0, -1.5, 3.0)]:
        left = moved((along, across, -4.0), offset=offset, line=0.4)
        assert moved((along, -across, -4.0), offset=-offset, line=-0.4) == -left


@pytest.mark.usefixtures("game")
def test_who_is_alone_sees_the_racing_line():
    sensors = ("base", "line", "passing_line")
    parts = feature_slices(sensors)
    with gym.make("Torcs-v0", sensors=sensors, max_episode_steps=99) as env:
        env.reset(seed=0)
        for _ in range(50):
            seen, *_ = env.step([0.05, 1.0, 0.0])
            for row in ("offsets", "bends", "margins"):
                np.testing.assert_array_equal(
                    seen[parts[f"passing_line_{row}"]], seen[parts[f"line_{row}"]]
                )


@pytest.mark.usefixtures("game")
def test_who_comes_behind_a_robot_sees_it_moved():
    sensors = ("base", "line", "passing_line")
    parts = feature_slices(sensors)
    moves = 0
    with gym.make("Torcs-v0", car="car1-ow1", opponents=("lliaw",), sensors=sensors) as env:
        _, info = env.reset(seed=0)
        for _ in range(50):
            across = info["car"].race[5 + RIVALS]  # of the nearest one
            seen, _, _, _, info = env.step([info["car"].heading_error + 0.05 * across, 1.0, 0.0])
            usual, ours = (seen[parts[f"{line}_offsets"]] for line in ("line", "passing_line"))
            moves += not np.array_equal(usual, ours)
            np.testing.assert_array_equal(
                seen[parts["passing_line_margins"]], seen[parts["line_margins"]]
            )
    assert moves > 0


@pytest.mark.usefixtures("game")
def test_races_driven_at_once_see_it():
    options = {"opponents": ("bt", "inferno"), "max_episode_steps": 50}
    with both_kinds("Torcs-v0", sensors=("base", "passing_line"), **options) as (ours, theirs):
        assert_they_see_the_same(ours, theirs)


@pytest.mark.parametrize(("env_id", "options"), [
    ("TorcsLite-v0", {}), ("Torcs-v0", {"backend": "scr"}),
])  # fmt: skip
def test_a_world_without_other_cars_refuses(game, env_id, options):
    del game
    with pytest.raises(InvalidOption, match="passing_line"):
        gym.make(env_id, sensors=("base", "passing_line"), **options)


def test_a_space_tells_which_line_it_has():
    for sensors in (("base", "line", "rivals"), ("base", "passing_line", "rivals")):
        view = View(sensors)
        assert choice_within(view.low, view.high).sensors == sensors
