"""The racing line: where it lies, how fast it may be driven, and how a car sees it."""

from __future__ import annotations

import contextlib

import gymnasium as gym
import numpy as np
import pytest
from conftest import ScriptedBackend, car_state

import sb3_torcs  # noqa: F401  # registers the ids
from sb3_torcs.sensors import View, feature_slices
from sb3_torcs.tracks.catalogue import available_tracks, load_track
from sb3_torcs.tracks.profile import road_profile
from sb3_torcs.tracks.racing_line import (
    EDGE,
    HALF_WIDTH,
    LINE_DISTANCES,
    LINE_PLACES,
    OFFSET,
    SLOWING,
    SPEED,
    TURN,
    driven,
    look_along,
    racing_line,
)

OFFSETS, BENDS, MARGINS = range(3)
SENSORS = ("base", "line")


def ring(radius=100.0, width=10.0, climbs=(0.0, 0.0), friction=1.1, banking=0.0, side=1.0):
    """A circle, to the left by default, in two halves that may climb and fall."""
    half = np.pi * radius
    rows = [half] * 2, [side / radius] * 2, [width] * 2, climbs, [friction] * 2, [banking] * 2
    return road_profile(*(np.array(row, np.float64) for row in rows))


def square(side=1.0, width=10.0):
    """Four straights of 200 m and four quarters of a circle of 20 m radius."""
    bend, straight = (10.0 * np.pi, side / 20.0), (200.0, 0.0)
    lengths, curvatures = np.array([straight, bend] * 4).T
    same = np.ones(8)
    return road_profile(lengths, curvatures, width * same, 0 * same, 1.1 * same, 0 * same)


def seen(line, distance, track_position=0.0, speed=0.0):
    """What a car sees of the line: offsets, bends, margins."""
    numbers = np.empty((3, LINE_PLACES))
    look_along(line.table, line.step, distance, track_position, speed, numbers)
    return numbers


# ---------------------------------------------------------------------------------- where it lies


def test_a_circle_is_driven_on_its_inside():
    """Its line could lie anywhere, and is the shortest there."""
    table = racing_line(ring()).table
    np.testing.assert_allclose(table[:, OFFSET], 5.0 - EDGE, atol=1e-6)
    np.testing.assert_allclose(np.diff(table[:, TURN]), 2.0 * np.pi / (len(table) - 1), rtol=1e-3)


def test_a_bend_between_straights_is_driven_outside_inside_outside():
    """And so with a larger radius than its axis has."""
    line = racing_line(square())
    bend = 10.0 * np.pi
    places = (170.0, 200.0 + bend / 2, 230.0 + bend)
    before, apex, after = (seen(line, d)[OFFSETS, 0] for d in places)
    assert before < -2.0
    assert after < -2.0
    assert apex == pytest.approx(5.0 - EDGE, abs=0.1)
    assert line.table[:, SPEED].min() > 1.3 * 1.4 * 9.81 * 20.0


def test_the_mirror_image_of_a_road_has_the_mirror_image_of_its_line():
    """To the last bit."""
    left, right = racing_line(square()).table, racing_line(square(side=-1.0)).table
    np.testing.assert_array_equal(left[:, OFFSET], -right[:, OFFSET])
    np.testing.assert_allclose(left[:, SPEED], right[:, SPEED], rtol=1e-9)


def test_a_line_stays_on_every_road_and_ends_where_it_begins():
    """Of the tracks that come with the package."""
    for name in (track.name for track in available_tracks() if track.source == "bundled"):
        road = load_track(name).profile
        table = racing_line(road).table
        assert np.all(np.abs(table[:, OFFSET]) <= np.maximum(table[:, HALF_WIDTH] - EDGE, 0.0))
        np.testing.assert_array_equal(np.delete(table[0], TURN), np.delete(table[-1], TURN))
        whole = round((table[-1, TURN] - table[0, TURN]) / (2.0 * np.pi))
        assert abs(whole) == 1
        assert np.abs(np.diff(table[:, OFFSET])).max() < 1.0
        assert np.abs(np.diff(table[:, TURN])).max() < 0.5


def test_a_road_that_is_narrower_than_a_car_has_its_line_in_the_middle():
    assert not racing_line(ring(width=2.0)).table[:, OFFSET].any()


def test_a_line_is_found_once():
    road = ring()
    assert racing_line(road) is racing_line(road)
    assert not racing_line(road).table.flags.writeable


# -------------------------------------------------------------------------- how fast it may be


def slowest(road):
    """The square of the lowest speed that a line allows."""
    return racing_line(road).table[:, SPEED].min()


def test_speed_goes_with_the_surface_and_the_banking():
    """On a circle of 96.5 m; tyres hold 1.4 times the load on usual asphalt."""
    bend = 1.0 / 96.5
    flat = 1.4 * 9.81 / (bend - 1.4 * 0.003)
    assert slowest(ring()) == pytest.approx(flat, rel=1e-3)
    slippery = 0.7 * 9.81 / (bend - 0.7 * 0.003)
    assert slowest(ring(friction=0.55)) == pytest.approx(slippery, rel=1e-3)
    falls_to_the_left = slowest(ring(banking=-0.2))
    assert falls_to_the_left == pytest.approx(flat * 1.6 / 1.4, rel=1e-3)
    assert slowest(ring(banking=0.2)) == pytest.approx(flat * 1.2 / 1.4, rel=1e-3)
    assert slowest(ring(banking=0.2, side=-1.0)) == pytest.approx(falls_to_the_left, rel=1e-3)


def test_a_crest_is_slower_than_a_dip_and_brakes_do_more_uphill():
    """The road climbs by 20 m in its first half, and falls in its second."""
    table = racing_line(ring(climbs=(20.0, -20.0))).table
    middle = (len(table) - 1) // 2
    level = slowest(ring())
    assert table[middle, SPEED] < 0.9 * level < 1.1 * level < table[0, SPEED]
    slope = 20.0 / (np.pi * 100.0)
    assert table[middle // 2, SLOWING] == pytest.approx(12.0 + 9.81 * slope, rel=1e-6)
    assert table[middle + middle // 2, SLOWING] == pytest.approx(12.0 - 9.81 * slope, rel=1e-6)


def test_the_line_of_a_track_is_drawn_as_fast_as_brakes_allow(oval):
    """Never faster than a place allows, and slower only on the way to a slower one."""
    places, speeds = driven(oval)
    line = racing_line(oval.profile)
    assert np.all(speeds**2 <= line.table[:, SPEED] + 1e-9)
    slowed = np.diff(speeds**2)
    assert slowed.min() >= -2.0 * line.table[:, SLOWING].max() * line.step - 1e-9
    np.testing.assert_allclose(places[0], places[-1], atol=1e-6)
    within = np.abs(line.table[:, OFFSET]) <= line.table[:, HALF_WIDTH]
    assert within.all()


# ---------------------------------------------------------------------------- how a car sees it


def test_offsets_are_told_from_the_car():
    """Half the way to the left edge of 10 m is 2.5 m."""
    line = racing_line(square())
    middle, left = seen(line, 100.0), seen(line, 100.0, track_position=0.5)
    np.testing.assert_allclose(left[OFFSETS], middle[OFFSETS] - 2.5)
    np.testing.assert_array_equal(left[BENDS:], middle[BENDS:])


def test_margins_tell_how_much_faster_the_car_may_be_now():
    """Braking by 12 m/s² from here to the slowest place of an interval."""
    line = racing_line(square())
    standing = seen(line, 50.0)[MARGINS]
    np.testing.assert_allclose(seen(line, 50.0, speed=20.0)[MARGINS], standing - 20.0)
    limits = np.sqrt(line.table[:, SPEED])
    first = 50.0 + np.array(LINE_DISTANCES)
    for i in range(LINE_PLACES):
        where = np.arange(len(limits)) * line.step
        within = (where > first[i] - line.step) & (where <= first[i + 1] - line.step)
        if first[i + 1] < 900.0:
            ahead = np.maximum(where[within] - 50.0, 0.0)
            expected = np.sqrt(np.min(limits[within] ** 2 + 24.0 * ahead, initial=1e4))
            assert standing[i] == pytest.approx(expected)


def test_the_view_goes_on_across_the_start_line():
    """For as many laps as one likes, and also if the road is shorter than the view is far."""
    line = racing_line(square())
    length = line.step * (len(line.table) - 1)
    np.testing.assert_allclose(seen(line, 500.0), seen(line, 500.0 + 2.0 * length), atol=1e-9)
    short = racing_line(ring(radius=20.0))
    np.testing.assert_allclose(seen(short, 60.0)[BENDS], 1.0 / 20.0, rtol=0.01)


def test_the_view_changes_smoothly_while_the_car_moves_on():
    """By little every 10 cm, also on a road with sharp bends."""
    road = load_track("aalborg").profile
    line = racing_line(road)
    rows = np.array([seen(line, d)[:2] for d in np.arange(0.0, 2587.0, 0.1)])
    assert np.abs(np.diff(rows[:, OFFSETS], axis=0)).max() < 0.06
    assert np.abs(np.diff(rows[:, BENDS], axis=0)).max() < 0.003


def test_an_observation_holds_the_line(oval):
    """Metres in steps of 5, bends by their radius, m/s in steps of 20."""
    state = car_state(distance_from_start=350.0, speed_x=20.0)
    shown = View(SENSORS).encode(state, ScriptedBackend(oval))
    offsets, bends, margins = seen(racing_line(oval.profile), 350.0, speed=20.0)
    parts = feature_slices(SENSORS)
    for name, expected in (
        ("line_offsets", offsets / 5.0),
        ("line_bends", bends / (np.abs(bends) + 0.02)),
        ("line_margins", np.clip(margins / 20.0, -2.0, 2.0)),
    ):
        np.testing.assert_allclose(shown[parts[name]], expected, rtol=1e-6)


def test_the_game_and_the_fallback_see_the_same_line(game):
    """On a road without hills; the game's has them, and another limit there."""
    del game
    views = []
    for env_id in ("Torcs-v0", "TorcsLite-v0"):
        with contextlib.closing(gym.make(env_id, track="g-track-1", sensors=SENSORS)) as env:
            views.append(env.reset(seed=0, options={"distance": 700.0})[0])
    parts = feature_slices(SENSORS)
    for name in ("line_offsets", "line_bends"):
        np.testing.assert_allclose(views[0][parts[name]], views[1][parts[name]], atol=0.01)
