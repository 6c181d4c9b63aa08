"""What every random circuit promises, over many seeds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sb3_torcs.tracks.generator import SPARE, random_track
from sb3_torcs.tracks.track import closing_gap

SEEDS = range(60)


@pytest.fixture(scope="module")
def circuits():
    return [random_track(np.random.default_rng(seed)) for seed in SEEDS]


def axis(track, step=4.0):
    places = np.arange(0.0, track.length, step)
    return places, np.array([complex(*track.pose(place)[:2]) for place in places])


def test_the_same_generator_gives_the_same_track(circuits):
    for seed, track in zip(SEEDS, circuits, strict=True):
        again = random_track(np.random.default_rng(seed))
        np.testing.assert_array_equal(again.table, track.table)
        assert again.grid == track.grid


def test_other_generators_give_other_tracks(circuits):
    assert len({track.length for track in circuits}) == len(circuits)


def test_one_generator_goes_on_to_another_track():
    rng = np.random.default_rng(0)
    assert random_track(rng).length != random_track(rng).length


def test_the_lap_closes_to_a_nanometre(circuits):
    for track in circuits:
        assert max(abs(value) for value in closing_gap(track.segments)) <= 1e-9
        turned = math.fsum(s.length * s.curvature for s in track.segments)
        assert abs(turned) == pytest.approx(math.tau, abs=1e-9)


def test_the_figures_are_those_of_a_drivable_road(circuits):
    for track in circuits:
        assert 1500.0 <= track.length <= 4000.0
        assert 10.0 <= track.width <= 15.0
        assert track.tightest_radius >= 15.0
        assert min(s.length for s in track.segments) > 0.0


def test_the_walls_inside_the_tightest_bend_do_not_cross(circuits):
    for track in circuits:
        for s in track.segments:
            inner = 0.5 * s.width_start + max(s.left_start, s.right_start)
            assert inner * abs(s.curvature) < 1.0


def test_straights_and_bends_alternate_and_the_start_is_on_a_straight(circuits):
    for track in circuits:
        bends = [s.curvature != 0.0 for s in track.segments]
        assert bends == [i % 2 == 1 for i in range(len(bends))]
        assert track.segments[-1].length > track.grid.distance


def test_there_are_bends_to_both_sides_and_circuits_of_both_directions(circuits):
    both = [
        len({math.copysign(1.0, s.curvature) for s in t.segments if s.curvature}) for t in circuits
    ]
    assert np.mean(np.array(both) == 2) > 0.8
    directions = [sum(s.length * s.curvature for s in t.segments) > 0.0 for t in circuits]
    assert {True, False} == set(directions)


def test_no_part_of_the_road_touches_another(circuits):
    for track in circuits:
        first = track.segments[0]
        needed = first.width_start + first.left_start + first.right_start
        places, points = axis(track)
        apart = np.abs(places[:, None] - places[None, :])
        apart = np.minimum(apart, track.length - apart)
        far = apart > 0.5 * math.pi * (needed + SPARE)
        assert np.abs(points[:, None] - points[None, :])[far].min() >= needed


def test_the_grid_is_on_the_side_of_the_first_bend(circuits):
    for track in circuits:
        bend = next(s.curvature for s in track.segments if s.curvature)
        assert track.grid.offset * bend > 0.0
        assert abs(track.grid.offset) == pytest.approx(track.width / 6.0)
