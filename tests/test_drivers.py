"""The scripted driver: the yardstick laps whatever is bundled, without leaving the road."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import sb3_torcs  # noqa: F401
from sb3_torcs.drivers import ScriptedDriver
from sb3_torcs.errors import InvalidOption
from sb3_torcs.evaluation import evaluate

BUNDLED = ["aalborg", "alpine-1", "corkscrew", "g-track-1"]


@pytest.mark.parametrize("action_repeat", [1, 5])
@pytest.mark.parametrize("track", BUNDLED)
def test_it_laps_without_leaving_the_road(track, action_repeat):
    env = gym.make(
        "TorcsLite-v0", track=track, laps=2, action_repeat=action_repeat, max_episode_steps=50_000
    )
    (episode,) = evaluate(env, ScriptedDriver())
    assert (episode.end, episode.laps, episode.damage) == ("laps", 2, 0.0)
    assert episode.lap_times[1] < episode.lap_times[0]  # the second begins at speed


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
