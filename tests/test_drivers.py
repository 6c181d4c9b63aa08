"""The scripted driver: the yardstick laps asphalt and dirt, without leaving the road."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from conftest import car_state

import sb3_torcs  # noqa: F401
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.errors import InvalidOption
from sb3_torcs.evaluation.protocol import evaluate
from sb3_torcs.sensors import encode

BUNDLED = ["aalborg", "alpine-1", "corkscrew", "g-track-1"]
OF_THE_GAME = ["wheel-1", "dirt-3", "dirt-6", "mixed-1", "mixed-2"]  # loose, or hairpins of 10 m
REAL = ["aalborg", "corkscrew", "wheel-1", "g-speedway", "dirt-4", "dirt-6", "mixed-1"]


@pytest.mark.parametrize("action_repeat", [1, 5])
@pytest.mark.parametrize("track", BUNDLED)
def test_it_laps_without_leaving_the_road(track, action_repeat):
    env = gym.make(
        "TorcsLite-v0", track=track, laps=2, action_repeat=action_repeat, max_episode_steps=50_000
    )
    (episode,) = evaluate(env, ScriptedDriver())
    assert (episode.end, episode.laps, episode.damage) == ("laps", 2, 0.0)
    assert episode.lap_times[1] < episode.lap_times[0]  # the second begins at speed


@pytest.mark.parametrize("track", OF_THE_GAME)
def test_it_laps_what_the_game_brings(game, track):
    env = gym.make("TorcsLite-v0", track=track, laps=1, max_episode_steps=5000)
    (episode,) = evaluate(env, ScriptedDriver())
    assert (episode.end, episode.laps) == ("laps", 1)


@pytest.mark.parametrize("track", REAL)
def test_it_laps_the_real_game(game, track):
    env = gym.make("Torcs-v0", track=track, laps=2, max_episode_steps=10_000)
    (episode,) = evaluate(env, ScriptedDriver())
    env.close()
    assert (episode.end, episode.laps) == ("laps", 2)


def _decide(**changes):
    action, _ = ScriptedDriver().predict(encode(car_state(**changes)))
    return action


def test_a_swinging_tail_is_caught():
    """The right front wheel is the faster one: the car turns left, more than any bend asks for."""
    turning = np.array([66.0, 54.0, 60.0, 60.0])
    road = np.where(np.arange(19) == 9, 200.0, 10.0)  # straight on
    caught = _decide(range_finders=road, wheel_speeds=turning)[0]
    assert caught < _decide(range_finders=road)[0] == 0.0


def test_spinning_wheels_and_a_slide_cost_throttle():
    view = np.full(19, 200.0)
    full = _decide(range_finders=view)[1]
    spinning = _decide(range_finders=view, wheel_speeds=np.array([60.0, 60.0, 90.0, 90.0]))[1]
    sliding = _decide(range_finders=view, speed_y=5.0)[1]
    assert (full, spinning) == (1.0, 0.0)
    assert 0.0 < sliding < full


@pytest.mark.parametrize("seed", range(4))
def test_it_laps_tracks_that_nobody_has_seen(seed):
    env = gym.make("TorcsLite-v0", track="random", laps=1, max_episode_steps=50_000)
    (episode,) = evaluate(env, ScriptedDriver(), seed=seed)
    assert episode.end == "laps"


def test_many_observations_are_driven_as_one_by_one():
    env = gym.make("TorcsLite-v0", start="random")
    observations = np.stack([env.reset(seed=seed)[0] for seed in range(5)])
    together, _ = ScriptedDriver().predict(observations)
    for observation, action in zip(observations, together, strict=True):
        np.testing.assert_array_equal(ScriptedDriver().predict(observation)[0], action)


def test_another_observation_is_refused():
    with pytest.raises(InvalidOption, match=r"shape \(30,\); expected \(29,\)"):
        ScriptedDriver().predict(np.zeros(30, np.float32))
