"""A Gaussian policy whose mean cannot leave the action space."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import A2C, PPO
from toy import ToyRace

from sb3_torcs.errors import InvalidOption
from sb3_torcs.policies import BoundedPolicy


def make(**policy_kwargs):
    return PPO(BoundedPolicy, ToyRace(), policy_kwargs={"net_arch": [8], **policy_kwargs}, seed=0)


def test_means_lie_within_the_action_space():
    """They reach its bounds, however large the outputs of the layer before are."""
    policy = make().policy
    low, high = policy.action_space.low, policy.action_space.high
    observations = np.random.default_rng(0).uniform(-1, 1, (50, 29)).astype(np.float32)
    near, _ = policy.predict(observations, deterministic=True)
    with th.no_grad():
        policy.action_net.linear.weight *= 1e5
    far, _ = policy.predict(observations, deterministic=True)
    np.testing.assert_allclose(near, np.broadcast_to((low + high) / 2, (50, 3)), atol=0.05)
    assert np.all((far >= low) & (far <= high))
    assert set(far[:, 1].round(3)) == {0.0, 1.0}


def test_each_actuator_may_have_a_deviation_of_its_own():
    assert make(log_std_init=-1.0).policy.log_std.tolist() == [-1.0] * 3
    assert make(log_std_init=[-2.0, 0.0, 0.5]).policy.log_std.tolist() == [-2.0, 0.0, 0.5]
    with pytest.raises(InvalidOption, match="log_std_init has 2 numbers; expected one, or 3"):
        make(log_std_init=[-2.0, 0.0])


def test_a_saved_model_decides_as_before(tmp_path):
    model = make(log_std_init=[-2.0, 0.0, 0.5])
    model.save(tmp_path / "model.zip")
    model.policy.save(tmp_path / "policy.pth")
    loaded = PPO.load(tmp_path / "model.zip")
    assert BoundedPolicy.load(tmp_path / "policy.pth").log_std_init == [-2.0, 0.0, 0.5]
    observation = np.full(29, 0.3, np.float32)
    for deterministic in (True, False):
        actions = []
        for each in (model, loaded):
            th.manual_seed(0)
            actions.append(each.predict(observation, deterministic=deterministic)[0])
        np.testing.assert_array_equal(*actions)


def test_other_algorithms_of_its_kind_take_it():
    A2C(BoundedPolicy, ToyRace(), seed=0).learn(20)


def test_what_it_cannot_bound_is_refused():
    with pytest.raises(InvalidOption, match="use MlpPolicy"):
        PPO(BoundedPolicy, gym.make("CartPole-v1"))
    with pytest.raises(InvalidOption, match="has no use_sde"):
        PPO(BoundedPolicy, ToyRace(), use_sde=True)
