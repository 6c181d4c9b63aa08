"""What every random circuit promises, over many seeds."""

from __future__ import annotations

import dataclasses
import math

import gymnasium as gym
import numpy as np
import pytest
from stadium import stadium

import sb3_torcs  # noqa: F401  registers the environments
from sb3_torcs.errors import InvalidOption, OutputNotWritable
from sb3_torcs.tracks.catalogue import load_track
from sb3_torcs.tracks.generator import SPARE, random_track
from sb3_torcs.tracks.torcs_xml_writer import write_track_xml
from sb3_torcs.tracks.track import Grid, X, Y, closing_gap

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


# ---- As files of TORCS ----------------------------------------------------------------------


def test_a_file_of_torcs_holds_the_same_road(circuits, tmp_path):
    """A bend is written by radius and arc, from which its length comes back rounded."""
    for number, track in enumerate(circuits[:20]):
        write_track_xml(track, tmp_path / f"road-{number}.xml")
        back = load_track(tmp_path / f"road-{number}.xml")
        moved = back.table.copy()
        moved[:, [X, Y]] -= moved[0, [X, Y]]  # the game moves a road's corner to its origin
        np.testing.assert_allclose(moved, track.table, rtol=1e-9, atol=1e-6)
        assert [segment[8:] for segment in back.segments] == [s[8:] for s in track.segments]
        assert back.grid.distance == track.grid.distance
        assert back.grid.offset * track.grid.offset > 0.0


@pytest.mark.parametrize("share", [0.0, 1 / 6, 1 / 4, -3 / 10])
def test_a_grid_that_the_game_knows_comes_back(circuits, tmp_path, share):
    """Slots stand beside each other at equal distances, one to four of them."""
    width = circuits[0].segments[0].width_start
    grid = Grid(12.0, share * width)
    write_track_xml(dataclasses.replace(circuits[0], grid=grid), tmp_path / "road.xml")
    back = load_track(tmp_path / "road.xml").grid
    assert back == pytest.approx(grid)


def test_the_real_game_drives_it(circuits, tmp_path, game):
    """The road that the game has laid is held to the file's each time that a race is loaded."""
    path = tmp_path / "road.xml"
    write_track_xml(circuits[0], path)
    env = gym.make("Torcs-v0", track=str(path))
    env.reset(seed=0)
    for _ in range(30):
        *_, info = env.step(np.array([0.0, 1.0, 0.0], np.float32))
    assert info["distance"] > 20.0
    env.close()


def test_what_torcs_cannot_write_is_refused(circuits, tmp_path):
    with pytest.raises(InvalidOption, match=r"is 10 to 12 m wide, .* has one width"):
        write_track_xml(stadium(0.02), tmp_path / "road.xml")
    with pytest.raises(InvalidOption, match=r"choose one that ends in \.xml"):
        write_track_xml(circuits[0], tmp_path / "road.csv")
    with pytest.raises(OutputNotWritable):
        write_track_xml(circuits[0], tmp_path / "nowhere" / "road.xml")
    assert not list(tmp_path.iterdir())
