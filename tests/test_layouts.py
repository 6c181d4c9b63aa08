"""What knows the actions of an agent has to know every layout of them, or refuse it by name."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DDPG, PPO

from sb3_torcs.actions import ACTIONS, action_layout
from sb3_torcs.agents.models import load_driver
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.callbacks import DrivingMetricsCallback, NoiseCallback
from sb3_torcs.callbacks.replay import MirrorCallback
from sb3_torcs.errors import InvalidOption
from sb3_torcs.evaluation.protocol import race_environment
from sb3_torcs.policies import SplitHeadPolicy

HEADS = {
    "pedals": ("tanh", "sigmoid", "sigmoid"),
    "pedal": ("tanh", "tanh"),
    "manual": ("tanh", "sigmoid", "sigmoid", "tanh", "sigmoid"),
}


def lite(action, **options):
    return gym.make("TorcsLite-v0", action=action, max_episode_steps=10, **options)


def test_an_evaluation_drives_with_layout_and_gearbox_of_the_training():
    kwargs = {"action": "pedal", "gearbox": "road_speed", "start": "random"}
    env = race_environment("TorcsLite-v0", kwargs)
    assert env.spec.kwargs == {"action": "pedal", "gearbox": "road_speed", "laps": 3}
    assert env.action_space.shape == (2,)


def test_the_scripted_driver_drives_the_same_with_a_signed_pedal():
    seen = []
    for action in ("pedals", "pedal"):
        env = gym.make("TorcsLite-v0", action=action)
        driver = load_driver("scripted", env)
        answers = [env.reset(seed=0)[0]]
        for _ in range(80):
            answers.append(env.step(driver.predict(answers[-1])[0])[0])
        seen.append(answers)
    np.testing.assert_array_equal(*seen)


def test_the_scripted_driver_does_not_shift_by_hand():
    with pytest.raises(InvalidOption, match="no action 'manual'; expected 'pedals' or 'pedal'"):
        load_driver("scripted", lite("manual"))
    with pytest.raises(InvalidOption, match="no action 'manual'"):
        ScriptedDriver("manual")


@pytest.mark.parametrize("action", ACTIONS)
def test_split_heads_mirrors_and_metrics_fit_every_layout(action):
    callbacks = [MirrorCallback(), DrivingMetricsCallback(line=False)]
    model = DDPG(
        SplitHeadPolicy, lite(action), learning_starts=8, batch_size=4, buffer_size=100,
        policy_kwargs={"net_arch": [8, 8], "symmetric": True}, seed=0,
    )  # fmt: skip
    assert model.policy.own_kwargs["heads"] == HEADS[action]
    model.learn(16, callback=callbacks)
    recorded = callbacks[1]._window
    assert recorded.names == action_layout(action).names
    assert recorded.count + callbacks[1]._pending.count == 16
    action, _ = model.predict(np.zeros(29, np.float32), deterministic=True)
    assert model.action_space.contains(action)


def test_the_brake_of_a_signed_pedal_is_what_is_below_0():
    metrics = DrivingMetricsCallback(line=False)
    model = PPO("MlpPolicy", lite("pedal"), n_steps=8, batch_size=8, device="cpu", seed=0)
    model.learn(8, callback=metrics)
    braked = model.rollout_buffer.actions[:, 1] < -0.05
    assert 0 < metrics._pending.braking == braked.sum()


@pytest.mark.parametrize("action", ["pedal", "manual"])
def test_our_noises_are_for_throttle_and_brake(action):
    model = DDPG("MlpPolicy", lite(action), buffer_size=10)
    with pytest.raises(InvalidOption, match="make the environment with action='pedals'"):
        model.learn(1, callback=NoiseCallback())


@pytest.mark.usefixtures("game")
@pytest.mark.parametrize("action", ACTIONS)
def test_races_on_threads_read_every_layout(action):
    seen = []
    for mode in ({}, {"vectorization_mode": "sync"}):
        envs = gym.make_vec("Torcs-v0", num_envs=2, action=action, **mode)
        envs.reset(seed=0)
        envs.action_space.seed(0)
        seen.append([envs.step(envs.action_space.sample())[0] for _ in range(20)])
        envs.close()
    np.testing.assert_array_equal(*seen)
