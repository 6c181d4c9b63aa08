"""Trainings of several cars drive on threads, and learn what they would without."""

import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_torcs.training.build import build
from sb3_torcs.vec_env import TorcsVecEnv

ENTRY = {
    "n_timesteps": 96,
    "n_envs": 3,
    "policy": "MlpPolicy",
    "policy_kwargs": {"net_arch": [8]},
    "n_steps": 16,
    "batch_size": 16,
    "env_kwargs": {"track": "aalborg", "start": "random"},
}


def learned(world, **changes):
    """What a training comes to, and in which environments it drives."""
    model, callbacks = build("ppo", world, {**ENTRY, **changes}, seed=3)
    envs = model.get_env()
    model.learn(96, callback=callbacks)
    envs.close()
    return type(envs), [weights.tolist() for weights in model.policy.parameters()]


@pytest.mark.parametrize("world", ["Torcs-v0", "TorcsLite-v0"])
def test_the_same_is_learned_on_threads_and_one_car_after_the_other(world, monkeypatch):
    kind, on_threads = learned(world)
    monkeypatch.setattr("sb3_torcs.training.build.TorcsVecEnv", DummyVecEnv)
    other, in_turn = learned(world)
    assert (kind, other) == (TorcsVecEnv, DummyVecEnv)
    assert on_threads == in_turn


@pytest.mark.parametrize(
    "changes",
    [{"n_envs": 1}, {"env_wrapper": "gymnasium.wrappers.NormalizeReward"}],
    ids=["one car", "a wrapper"],
)
def test_what_threads_cannot_drive_or_need_not_drives_as_before(changes):
    model, *_ = build("ppo", "TorcsLite-v0", {**ENTRY, **changes})
    assert type(model.get_env()) is DummyVecEnv
    model.get_env().close()
