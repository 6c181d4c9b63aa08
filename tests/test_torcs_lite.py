"""``TorcsLite-v0`` as people make it: names, tracks, refusals."""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import sb3_torcs
from sb3_torcs.errors import InvalidOption, TrackNotFound, UnknownRewardTerm
from sb3_torcs.tracks.catalogue import load_track
from sb3_torcs.tracks.compact import write_track_file


def track_of(env):
    return env.unwrapped.backend.track


def test_a_random_track_is_drawn_from_the_seed_for_every_episode():
    def lengths(seed):
        env = gym.make("TorcsLite-v0", track="random")
        env.reset(seed=seed)
        drawn = [track_of(env).length]
        for _ in range(3):
            env.reset()
            drawn.append(track_of(env).length)
        return drawn

    assert lengths(1) == lengths(1)
    assert len(set(lengths(1))) == 4
    assert lengths(1) != lengths(2)


@pytest.mark.parametrize("track", ["random", ["g-track-1", "random"]])
def test_an_episode_depends_on_its_seed_and_not_on_the_track_before(track):
    """The start is one of the track that is drawn, and not of the one before."""
    env = gym.make("TorcsLite-v0", track=track, start="random")
    for seed in range(8):
        first, _ = env.reset(seed=seed)
        assert 0.0 <= env.unwrapped.car.distance_from_start < track_of(env).length
        env.reset(seed=seed + 1000)
        env.reset()
        again, _ = env.reset(seed=seed)
        np.testing.assert_array_equal(again, first)


def test_a_chosen_start_wraps_on_the_random_track_that_is_drawn():
    env = gym.make("TorcsLite-v0", track="random")
    for before in range(3):
        env.reset(seed=before)
        _, info = env.reset(seed=7, options={"distance": 5000.0})
        wanted = 5000.0 % track_of(env).length
        assert info["car"].distance_from_start == pytest.approx(wanted, abs=1e-6)


def test_nobody_remembers_places_of_a_random_track():
    """It never comes again, and the next one has the same name."""
    env = gym.make("TorcsLite-v0", track="random", start="random")
    env.reset(seed=0)
    ended = False
    while not ended:
        ended = env.step([1.0, 1.0, 0.0])[2]
    assert env.unwrapped.mishaps() == {}


def test_places_of_files_with_one_name_are_told_apart(tmp_path):
    tracks = []
    for number, name in enumerate(("aalborg", "corkscrew")):
        tracks.append(str(tmp_path / f"{number}.csv"))
        write_track_file(replace(load_track(name), name="random"), tracks[-1])
    env = gym.make("TorcsLite-v0", track=tracks, start="random")
    for seed in range(8):
        env.reset(seed=seed)
        while not env.step([1.0, 1.0, 0.0])[2]:
            pass
    assert set(env.unwrapped.mishaps()) == set(tracks)


def test_an_argument_of_something_else_is_told():
    with pytest.raises(
        TypeError, match="unexpected keyword argument 'frame_skip'; it is called 'action_repeat'"
    ):
        gym.make("TorcsLite-v0", frame_skip=4)


def test_a_start_can_be_chosen_to_the_metre():
    env = gym.make("TorcsLite-v0")
    options = {"distance": 1000.0, "track_position": -0.5, "heading_error": 0.1, "speed": 25.0}
    _, info = env.reset(seed=0, options=options)
    car = info["car"]
    assert car.distance_from_start == pytest.approx(1000.0, abs=1e-6)
    assert car.track_position == pytest.approx(-0.5, abs=1e-9)
    assert car.heading_error == pytest.approx(0.1, abs=1e-9)
    assert car.speed_x == pytest.approx(25.0, abs=1e-9)


def test_the_grid_is_behind_the_line_standing():
    _, info = gym.make("TorcsLite-v0").reset(seed=0)
    car = info["car"]
    assert car.speed_x == 0.0
    assert car.distance_from_start > 2500.0
    assert car.gear == 1


def test_the_narrow_range_finders_see_further_ahead():
    scr, narrow = (
        gym.make("TorcsLite-v0", range_finders=choice).reset(seed=0)[1]["car"].range_finders
        for choice in ("scr", "narrow")
    )
    assert narrow.min() > scr.min()
    assert narrow[9] == scr[9]  # straight ahead is straight ahead


def test_the_time_limit_is_the_registrations():
    assert gym.spec("TorcsLite-v0").max_episode_steps == sb3_torcs.MAX_EPISODE_STEPS


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"track": "alborg"}, TrackNotFound, "no track 'alborg'; did you mean 'aalborg'?"),
        ({"track": "nowhere.xml"}, TrackNotFound, "no track file"),
        ({"track": None}, InvalidOption, "track is None; expected a name"),
        ({"reward": "speed"}, UnknownRewardTerm, "no reward 'speed'"),
        ({"range_finders": "wide"}, InvalidOption, "range_finders is 'wide'"),
        ({"car": "ferrari"}, InvalidOption, "car is 'ferrari'"),
    ],
)
def test_what_does_not_exist_is_refused_with_what_does(options, error, message):
    with pytest.raises(error, match=message):
        gym.make("TorcsLite-v0", **options)
