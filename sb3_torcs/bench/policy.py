"""Updates per second of the policy, compared with plain networks of the same form."""

from __future__ import annotations

import time
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.td3.policies import Actor, TD3Policy

from sb3_torcs.policies.networks import LateActionQ
from sb3_torcs.policies.split_head import SplitHeadPolicy
from sb3_torcs.policies.threads import one_thread
from sb3_torcs.sensors import View

__all__ = ["PlainSplitHeadPolicy", "SpacesOnly", "fill", "measure", "updater"]

UPDATES_PER_TURN = 10
"""Updates between two readings of the clock; short, so that all variants meet the same machine."""

TRANSITIONS = 2000
"""Random transitions to learn from."""


class PlainCritic(ContinuousCritic):
    """
    SB3's critic with plain value functions, and its gradients as they are.

    :param n_critics: number of value functions
    :param layer_norm: normalise their hidden layers
    :param kwargs: what SB3's ``ContinuousCritic`` takes
    """

    def __init__(self, *, n_critics: int, layer_norm: bool, **kwargs: Any) -> None:
        super().__init__(n_critics=0, **kwargs)
        sizes = kwargs["features_dim"], get_action_dim(self.action_space), kwargs["net_arch"]
        for index in range(n_critics):
            network = LateActionQ(*sizes, kwargs["activation_fn"], layer_norm)
            self.q_networks.append(network)
            self.add_module(f"qf{index}", network)

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """
        Value the actions by each value function.

        :param obs: (batch, observation)
        :param actions: (batch, action_dim) in [-1, 1]
        :return: one (batch, 1) per value function
        """
        features = self.extract_features(obs, self.features_extractor)
        return tuple(network(features, actions) for network in self.q_networks)

    def q1_forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Value the actions by the first value function, as SB3's own critic does.

        :param obs: (batch, observation)
        :param actions: (batch, action_dim) in [-1, 1]
        :return: (batch, 1)
        """
        with th.no_grad():
            features = self.extract_features(obs, self.features_extractor)
        value: th.Tensor = self.q_networks[0](features, actions)
        return value


class PlainSplitHeadPolicy(SplitHeadPolicy):
    """
    The same networks without optimizations, which the fast ones have to equal.

    :param args: as in ``SplitHeadPolicy``
    :param kwargs: as in ``SplitHeadPolicy``; the optimizer stays as PyTorch makes it
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        options = {"fused": False, **(kwargs.pop("optimizer_kwargs", None) or {})}
        super().__init__(*args, optimizer_kwargs=options, **kwargs)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """
        Make an actor. Called by ``TD3Policy`` for the actor and for its target.

        :param features_extractor: the one to share, or ``None`` for one of its own
        :return: the actor, on the policy's device
        """
        actor = super().make_actor(features_extractor)
        actor.mu = actor.mu.plain()  # type: ignore[operator]
        return actor.to(self.device)

    def make_critic(
        self, features_extractor: BaseFeaturesExtractor | None = None
    ) -> ContinuousCritic:
        """
        Make a critic. Called by ``TD3Policy`` for the critic and for its target.

        :param features_extractor: the one to share, or ``None`` for one of its own
        :return: the critic, on the policy's device
        """
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        layer_norm = self.own_kwargs["layer_norm"]
        return PlainCritic(layer_norm=layer_norm, **kwargs).to(self.device)

    def set_training_mode(self, mode: bool) -> None:
        """
        Switch between training and prediction as SB3 does.

        :param mode: ``True`` to train
        """
        TD3Policy.set_training_mode(self, mode)


class SpacesOnly(gym.Env[np.ndarray, np.ndarray]):
    """The spaces of a racing environment, and nothing behind them."""

    observation_space = spaces.Box(View().low, View().high)
    action_space = spaces.Box(
        np.array([-1, 0, 0], np.float32), np.array([1, 1, 1], np.float32), dtype=np.float32
    )


def updater(
    policy: type[TD3Policy], batch_size: int, algorithm: type[TD3] = DDPG, **policy_kwargs: Any
) -> TD3:
    """
    Make a DDPG that is ready to update: random transitions in its replay buffer, no output.

    :param policy: class of the policy
    :param batch_size: transitions per update
    :param algorithm: or TD3
    :param policy_kwargs: arguments of the policy
    :return: the model; the same twice for the same arguments
    """
    model = algorithm(
        policy,
        SpacesOnly(),
        buffer_size=TRANSITIONS,
        batch_size=batch_size,
        policy_kwargs=policy_kwargs,
        seed=0,
        device="cpu",
    )
    fill(model)
    return model


def fill(model: TD3) -> None:
    """
    Let a model of one environment be ready to update: random transitions, and no output.

    :param model: with an empty replay buffer
    """
    model.set_logger(Logger(None, []))
    rng = np.random.default_rng(0)
    assert model.replay_buffer is not None
    for _ in range(TRANSITIONS):
        obs, next_obs = rng.uniform(-1, 1, (2, 1, 29))
        action, reward = rng.uniform(-1, 1, (1, 3)), rng.uniform(-1, 1, 1)
        model.replay_buffer.add(obs, next_obs, action, reward, np.zeros(1), [{}])


def measure(batch_size: int = 64, seconds: float = 10.0) -> dict[str, float | None]:
    """
    Measure the updates per second of processor time, on one thread.

    :param batch_size: transitions per update
    :param seconds: [s] processor time to spend in all, at least
    :return: ``policy_updates_per_s`` and ``policy_plain_updates_per_s``
    """
    with one_thread():
        models = {
            "policy_updates_per_s": updater(SplitHeadPolicy, batch_size),
            "policy_plain_updates_per_s": updater(PlainSplitHeadPolicy, batch_size),
        }
        spent = dict.fromkeys(models, 0.0)
        for model in models.values():
            _turn(model)
        turns = 0
        while sum(spent.values()) < seconds:
            for name, model in models.items():
                spent[name] += _turn(model)
            turns += 1
    return {name: turns * UPDATES_PER_TURN / time_spent for name, time_spent in spent.items()}


def _turn(model: TD3) -> float:
    begin = time.process_time()
    model.train(gradient_steps=UPDATES_PER_TURN, batch_size=model.batch_size)
    return time.process_time() - begin
