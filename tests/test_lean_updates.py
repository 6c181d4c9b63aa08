"""Lean updates follow what other callbacks change in mid-training, or leave it to the algorithm."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG, PPO, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from torch import nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters
from toy import ToyRace

from sb3_torcs.callbacks import LeanUpdatesCallback
from sb3_torcs.policies import ppo, updates

ROLLOUT = 20  # [timesteps] of PPO, and between two changes


def make(algorithm, env=None, **policy_kwargs):
    env = env or DummyVecEnv([ToyRace])
    if algorithm is PPO:
        kwargs = {"n_steps": ROLLOUT, "batch_size": 10, "n_epochs": 2, "learning_rate": 0.01}
        policy, sizes = "MlpPolicy", {"net_arch": [8], "activation_fn": nn.ReLU}
    else:
        kwargs = {"learning_starts": 5, "batch_size": 8, "buffer_size": 500}
        policy, sizes = "SplitHeadPolicy", {"net_arch": [16, 24]}
    policy_kwargs = {**sizes, **policy_kwargs}
    model = algorithm(policy, env, policy_kwargs=policy_kwargs, seed=0, device="cpu", **kwargs)
    model.set_logger(Logger(None, []))
    return model


class Change(BaseCallback):
    """
    Changes the model once.

    :param change: of the model
    :param moment: method of the callback, called at each timestep or each rollout
    """

    def __init__(self, change, moment="_on_rollout_end"):
        super().__init__()
        self.change, self.done = change, False
        setattr(self, moment, self._act)

    def _on_step(self):
        return True

    def _act(self):
        if not self.done and self.num_timesteps >= 1.5 * ROLLOUT:
            self.done = True
            self.change(self.model)
        return True


def learned(algorithm, change, moment, lean, **policy_kwargs):
    """Train with a change; return parameters, the log and whether lean updates fit at the end."""
    model = make(algorithm, **policy_kwargs)
    model.set_random_seed(1)
    callbacks = [Change(change, moment), *([LeanUpdatesCallback()] if lean else [])]
    model.learn(4 * ROLLOUT, callback=callbacks)
    assert callbacks[0].done
    fits = ppo.is_for(model) if algorithm is PPO else updates.is_for(model)
    return dict(model.policy.state_dict()), dict(model.logger.name_to_value), fits


def networks(model):
    """Return the parts that have an optimizer each."""
    return [model.policy] if isinstance(model, PPO) else [model.actor, model.critic]


def replace_data(model):
    for own in model.policy.parameters():
        own.data = own.data * 0.5


def change_within_data(model):
    for own in model.policy.parameters():
        own.data.mul_(0.5)


def load_a_vector(model):
    parameters = list(model.policy.parameters())
    vector_to_parameters(parameters_to_vector(parameters) * 0.5, parameters)


def convert_twice(model):
    model.policy.double().float()


def maximize(model):
    for network in networks(model):
        network.optimizer.param_groups[0]["maximize"] = True


def freeze(model):
    model.policy.log_std.requires_grad_(False)


def new_sgd(model):
    for network in networks(model):
        network.optimizer = th.optim.SGD(network.parameters(), lr=0.01)


def hook_gradients(model):
    for own in model.policy.parameters():
        own.register_hook(lambda gradient: gradient.clamp(-1e-3, 1e-3))


def hook_a_module(model):
    def halve(module, inputs, output):
        return tuple(own * 0.5 for own in output) if isinstance(output, tuple) else output * 0.5

    network = model.policy.mlp_extractor if isinstance(model, PPO) else model.critic
    network.register_forward_hook(halve)


def hook_the_optimizer(model):
    for network in networks(model):
        network.optimizer.register_step_post_hook(
            lambda own, *_: [p.data.mul_(0.99) for g in own.param_groups for p in g["params"]]
        )


def learn_twice(model):
    train = model.train
    model.train = lambda *args, **kwargs: [train(*args, **kwargs) for _ in range(2)]


FOLLOWED = [replace_data, change_within_data, load_a_vector, convert_twice]
LEFT = [
    maximize, freeze, new_sgd, hook_gradients, hook_a_module, hook_the_optimizer, learn_twice,
]  # fmt: skip


@pytest.mark.parametrize("moment", ["_on_step", "_on_rollout_end"])
@pytest.mark.parametrize(
    ("algorithm", "change"),
    [
        (algorithm, change)
        for algorithm in (PPO, TD3)
        for change in FOLLOWED + LEFT
        if algorithm is PPO or change is not freeze  # their networks are one vector each
    ],
)
def test_a_change_in_mid_training_is_learned_from_as_stock_does(algorithm, change, moment):
    """Tolerance: single precision, summed in another order."""
    stock, stock_log, _ = learned(algorithm, change, moment, lean=False)
    lean, log, fits = learned(algorithm, change, moment, lean=True)
    th.testing.assert_close(stock, lean, rtol=2e-4, atol=2e-4)
    assert log == pytest.approx(stock_log, rel=1e-2, abs=1e-4)
    assert fits is (change in FOLLOWED)


@pytest.mark.parametrize("name", ["clip_range_vf", "target_kl"])
def test_ppo_begins_to_clip_or_to_stop_early_when_it_is_told(name):
    def limit(model):
        setattr(model, name, (lambda _: 1e-3) if name == "clip_range_vf" else 1e-9)

    stock, stock_log, _ = learned(PPO, limit, "_on_rollout_end", lean=False)
    lean, log, fits = learned(PPO, limit, "_on_rollout_end", lean=True)
    th.testing.assert_close(stock, lean, rtol=2e-4, atol=2e-4)
    assert log["train/n_updates"] == stock_log["train/n_updates"]
    assert not fits


def test_an_average_follows_a_moved_actor():
    """The average, too, is looked at for each update."""
    stock, _, _ = learned(DDPG, replace_data, "_on_step", lean=False, ema_decay=0.9)
    lean, _, _ = learned(DDPG, replace_data, "_on_step", lean=True, ema_decay=0.9)
    th.testing.assert_close(stock, lean, rtol=2e-4, atol=2e-4)


def test_a_forward_of_somebody_else_decides_and_stays():
    """As ``torch.compile`` sets it."""
    model, calls = make(PPO), []
    forward = model.policy.forward

    def compiled(*args, **kwargs):
        calls.append(args)
        return forward(*args, **kwargs)

    model.policy.forward = compiled
    model.learn(2 * ROLLOUT, callback=LeanUpdatesCallback())
    assert model.policy.forward is compiled
    assert len(calls) == 2 * ROLLOUT


@pytest.mark.parametrize("algorithm", [PPO, DDPG, TD3])
def test_parameters_that_processes_share_learn(algorithm):
    """PyTorch moves the parameters, and frees the place where they lay."""

    def share(model):
        model.policy.share_memory()
        np.zeros(1 << 20, np.float32)[:] = 1.7e9  # takes the place that was freed

    stock, _, _ = learned(algorithm, share, "_on_rollout_end", lean=False)
    lean, _, fits = learned(algorithm, share, "_on_rollout_end", lean=True)
    th.testing.assert_close(stock, lean, rtol=2e-4, atol=2e-4)
    assert fits


class Opponent(gym.Wrapper):
    """Takes the weights of an opponent, as environments of self-play do."""

    def set_opponent(self, state):
        self.opponent = state
        return sum(float(own.double().sum()) for own in state.values())


@pytest.mark.parametrize("algorithm", [PPO, DDPG, TD3])
def test_weights_go_to_worker_processes_while_they_learn(algorithm):
    """The worker receives what the model has learned so far."""
    received = []

    class SelfPlay(BaseCallback):
        def _on_step(self):
            state = self.model.policy.state_dict()
            (total,) = self.training_env.env_method("set_opponent", state)
            expected = sum(float(own.double().sum()) for own in state.values())
            received.append(total == expected)
            return True

    env = SubprocVecEnv([lambda: Opponent(ToyRace())])
    try:
        model = make(algorithm, env)
        model.learn(2 * ROLLOUT, callback=[SelfPlay(), LeanUpdatesCallback()])
    finally:
        env.close()
    assert received == [True] * 2 * ROLLOUT
    assert all(own.isfinite().all() for own in model.policy.parameters())


def test_a_train_of_somebody_else_is_given_back():
    model = make(DDPG)
    train, calls = model.train, []
    model.train = own = lambda *args, **kwargs: calls.append(train(*args, **kwargs))
    model.learn(ROLLOUT, callback=LeanUpdatesCallback())
    assert model.train is own
    assert len(calls) == ROLLOUT - 5
