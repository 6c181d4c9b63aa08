"""Drivers that remember: what they keep from one timestep to the next is theirs in every drive."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib import RecurrentPPO
from scr_loopback import Loopback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_torcs  # noqa: F401  (registers the environments)
from sb3_torcs.agents import remote as driving
from sb3_torcs.agents.models import ModelDriver, load_driver
from sb3_torcs.callbacks.driven_line import drive_lap
from sb3_torcs.evaluation.protocol import evaluate
from sb3_torcs.scr.protocol import RESTART


class Counting:
    """Remembers how many timesteps its episode has, and writes down what it was asked."""

    def __init__(self):
        self.asked = []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert deterministic
        self.asked.append((state, np.asarray(episode_start).tolist()))
        action = np.tile(np.array([0.0, 1.0, 0.0], np.float32), (*np.shape(observation)[:-1], 1))
        return action, 1 if state is None else state + 1


def lite(**options):
    return gym.make("TorcsLite-v0", **options)


@pytest.fixture(scope="module")
def recurrent():
    """An untrained model that presses the throttle and steers by what it remembers."""
    env = DummyVecEnv([lambda: lite(max_episode_steps=60)])
    model = RecurrentPPO("MlpLstmPolicy", env, n_steps=8, seed=0, device="cpu")
    with th.no_grad():
        model.policy.action_net.weight *= 100.0
        model.policy.action_net.bias += th.tensor([0.0, 1.0, 0.0])
    yield model
    env.close()


def test_each_episode_of_an_evaluation_begins_with_an_empty_mind():
    with lite(max_episode_steps=3) as env:
        driver = Counting()
        evaluate(env, driver, episodes=2)
    once = [(None, [True]), (1, [False]), (2, [False])]
    assert driver.asked == once * 2


def test_an_evaluation_is_that_of_stable_baselines(recurrent):
    """And another one than that of a model whose state is dropped."""
    with lite(max_episode_steps=60) as env:
        races = evaluate(env, recurrent, episodes=2)
    expected, _ = evaluate_policy(
        recurrent, recurrent.get_env(), 2, return_episode_rewards=True, warn=False
    )
    assert [race.episode_return for race in races] == pytest.approx(expected, rel=1e-6)  # float32

    class Forgetful:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return recurrent.predict(observation, deterministic=deterministic)

    with lite(max_episode_steps=60) as env:
        (forgotten,) = evaluate(env, Forgetful())
    assert forgotten.episode_return != races[0].episode_return


def test_a_saved_recurrent_model_drives_as_before(recurrent, tmp_path):
    recurrent.save(tmp_path / "m.zip")
    with lite(max_episode_steps=60) as env:
        (expected,) = evaluate(env, recurrent)
        assert evaluate(env, load_driver(tmp_path / "m.zip", env, "ppo_lstm", trust=True)) == [
            expected
        ]


def test_normalized_observations_leave_the_state_alone(recurrent):
    statistics = VecNormalize(DummyVecEnv([lite]))
    driver = ModelDriver(recurrent, statistics)
    observation = np.full(29, 0.5, np.float32)
    _, state = recurrent.predict(statistics.normalize_obs(observation))
    for start in ([False], [True]):
        expected = recurrent.predict(statistics.normalize_obs(observation), state, start, True)
        found = driver.predict(observation, state, start, deterministic=True)
        for one, other in zip((found[0], *found[1]), (expected[0], *expected[1]), strict=True):
            np.testing.assert_array_equal(one, other)
    statistics.close()


def test_a_driven_line_remembers_each_car_of_the_vector():
    """The second car's episode ends while the first one's line is still driven."""
    env = DummyVecEnv([lambda limit=limit: lite(max_episode_steps=limit) for limit in (4, 2)])
    driver = Counting()
    drive_lap(driver, env)
    starts = [[True, True], [False, False], [False, True], [False, False]]
    assert driver.asked == list(zip((None, 1, 2, 3), starts, strict=True))
    env.close()


class Anew(Loopback):
    """A race that begins anew once."""

    restarts = 1

    def say(self, message):
        if self.tick == 20 and self.restarts:
            self.restarts, message = 0, RESTART
        super().say(message)


def test_in_somebody_elses_race_each_race_begins_with_an_empty_mind(monkeypatch):
    driver = Counting()
    monkeypatch.setattr(driving, "load_driver", lambda *_: driver)
    with Anew(ticks=50) as server:
        agent = driving.Agent("scripted", {"scr": server.address})
        driver.asked.clear()
        agent.drive()
    begun = [number for number, (state, _) in enumerate(driver.asked) if state is None]
    assert len(begun) == 2
    for first, last in zip(begun, (*begun[1:], len(driver.asked)), strict=True):
        race = driver.asked[first:last]
        assert race[0] == (None, [True])
        assert race[1:] == [(number, [False]) for number in range(1, last - first)]
