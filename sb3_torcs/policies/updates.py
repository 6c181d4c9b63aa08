"""Faster updates of DDPG and TD3 without PyTorch's record of operations, equal but for rounding."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_torcs.policies import kernels
from sb3_torcs.policies.fused import FusedActor, FusedValues, array, empty, give, take
from sb3_torcs.policies.layers import compiled
from sb3_torcs.policies.networks import ActorAverage
from sb3_torcs.policies.optimizers import LeanAdam, is_usual
from sb3_torcs.policies.split_head import SplitHeadPolicy

__all__ = ["LeanUpdates", "is_for"]


class LeanUpdates:
    """
    Updates a model instead of its ``train``.

    :param model: for which :func:`is_for` is true
    """

    def __init__(self, model: TD3) -> None:
        self.model, policy = model, cast(Any, model.policy)
        actor, critic = policy.actor.mu, policy.critic
        self.actor: th.Tensor = actor.flat
        self.critic: th.Tensor = critic.flat
        weights, target = array(actor.flat), array(policy.actor_target.mu.flat)
        dtype = weights.dtype
        passes: FusedActor = actor.fused
        self.actor_shape = passes.sizes, passes.norm, passes.gain.astype(dtype)
        self.actors = weights, target, empty(*weights.shape, dtype=dtype)
        weights, target = (
            array(flat).reshape(critic.n_critics, -1)
            for flat in (critic.flat, policy.critic_target.flat)
        )
        values: FusedValues = critic.fused
        self.critic_shape = values.sizes, values.norm
        self.critics = weights, target, empty(*weights.shape, dtype=dtype)
        self.average: ActorAverage | None = policy.average
        if self.average is None:
            self.averages = np.empty(0, dtype), np.zeros((), np.int64)
        else:
            self.averages = array(policy.driver.mu.flat), self.average.n_averaged.numpy()

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """
        Update the networks as ``TD3.train`` does, in its order.

        :param gradient_steps: number of updates
        :param batch_size: transitions per update
        """
        model = self.model
        model.policy.set_training_mode(True)
        model._update_learning_rate([model.actor.optimizer, model.critic.optimizer])
        actor_losses, critic_losses = [], []
        assert model.replay_buffer is not None
        rooms = self._rooms(batch_size)
        for _ in range(gradient_steps):
            model._n_updates += 1
            batch = model.replay_buffer.sample(batch_size, env=model._vec_normalize_env)
            both = model._n_updates % model.policy_delay == 0
            # The actor's update does not read the critics' targets: these follow before it.
            critic_losses.append(self._update_critic(batch, rooms, model.tau if both else 0.0))
            if both:
                actor_losses.append(self._update_actor(batch, rooms))
        for room in rooms:
            give(room)
        model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")
        if actor_losses:
            model.logger.record("train/actor_loss", np.mean(actor_losses))
        model.logger.record("train/critic_loss", np.mean(critic_losses))

    def _rooms(self, batch_size: int) -> tuple[np.ndarray, np.ndarray]:
        """Take work spaces for the passes of the actor and of the critics."""
        networks, dtype = len(self.critics[0]), self.critics[0].dtype
        return (
            take(kernels.stack_work(self.actor_shape[0], batch_size), dtype=dtype),
            take(networks, kernels.values_work(self.critic_shape[0], batch_size), dtype=dtype),
        )

    def _update_critic(
        self, batch: ReplayBufferSamples, rooms: tuple[np.ndarray, np.ndarray], tau: float
    ) -> float:
        """Learn from the targets' values, which follow by a share; return the loss."""
        model, arrays = self.model, tuple(map(array, batch[:5]))
        given = batch.discounts
        discounts = np.full_like(arrays[4], model.gamma) if given is None else array(given)
        # Drawn even if it is clipped to 0, so that later random numbers are the same.
        noise = th.empty(arrays[1].shape).normal_(0, model.target_policy_noise).numpy()
        adam = cast(LeanAdam, model.critic.optimizer).begin_step(self.critic)
        loss: float = _update_critic(
            self.critic_shape, self.critics, self.actor_shape, self.actors[1], arrays, discounts,
            noise, model.target_noise_clip, rooms, adam, tau,
        )  # fmt: skip
        return loss

    def _update_actor(
        self, batch: ReplayBufferSamples, rooms: tuple[np.ndarray, np.ndarray]
    ) -> float:
        """Learn from the first critic's values; return the loss."""
        adam = cast(LeanAdam, self.model.actor.optimizer).begin_step(self.actor)
        decay = 0.0 if self.average is None else self.average.decay
        loss: float = _update_actor(
            self.critic_shape, self.critics[0][:1], self.actor_shape, self.actors,
            array(batch.observations), rooms, adam, self.averages, decay, self.model.tau,
        )  # fmt: skip
        return loss


@compiled
def _update_critic(
    shape: Any, critics: Any, actor_shape: Any, actor: Any, batch: Any, discounts: Any, noise: Any,
    clip: float, rooms: Any, adam: Any, tau: float,
) -> float:  # fmt: skip
    """
    Learn from the targets' values.

    :param shape: sizes of the critics' layers, and whether they have norms
    :param critics: weights, those of the targets and their gradient, each (networks, parameters)
    :param actor_shape: sizes of the actor's layers, whether it has norms, its gain
    :param actor: weights of the target
    :param batch: observations, actions, what followed, whether it was an end, rewards
    :param discounts: (batch, 1)
    :param noise: of the target's actions
    :param clip: its limit
    :param rooms: work spaces of the actor and of the critics
    :param adam: from ``LeanAdam.begin_step``
    :param tau: how far the targets follow, 0 to 1
    :return: the loss
    """
    sizes, norm = shape
    weights, target, gradient = critics
    observations, actions, following, dones, rewards = batch
    next_actions = np.empty_like(actions)
    actor_sizes, actor_norm, gain = actor_shape
    kernels.actor_forward(actor, actor_sizes, actor_norm, following, gain, rooms[0], next_actions)
    if clip:
        next_actions[:] = np.clip(next_actions + np.clip(noise, -clip, clip), -1, 1)
    values = np.empty((len(weights), len(actions), 1), weights.dtype)
    next_values, slope = np.empty_like(values), np.empty_like(values)
    kernels.values_forward(target, sizes, norm, following, next_actions, rooms[1], next_values)
    kernels.values_forward(weights, sizes, norm, observations, actions, rooms[1], values)
    loss = kernels.difference(values, next_values, rewards, dones, discounts, slope)
    unused = np.empty((0, 0, 0), weights.dtype)
    kernels.values_backward(
        weights, sizes, norm, observations, actions, rooms[1], slope, gradient, unused, unused
    )
    kernels.adam(weights.reshape(-1), gradient.reshape(-1), *adam)
    if tau:
        kernels.follow(target.reshape(-1), weights.reshape(-1), weights.dtype.type(tau))
    return loss


@compiled
def _update_actor(
    critic_shape: Any, first: Any, shape: Any, actors: Any, observations: Any, rooms: Any,
    adam: Any, averages: Any, decay: float, tau: float,
) -> float:  # fmt: skip
    """
    Learn from the first critic's values.

    :param critic_shape: sizes of the critics' layers, and whether they have norms
    :param first: weights of the first critic, (1, parameters)
    :param shape: sizes of the actor's layers, whether it has norms, its gain
    :param actors: weights, those of the target and their gradient
    :param observations: (batch, features)
    :param rooms: work spaces of the actor and of the critics
    :param adam: from ``LeanAdam.begin_step``
    :param averages: weights of the average that drives, of size 0 if there is none, and the
        number of updates that it has followed
    :param decay: share of the average that an update keeps
    :param tau: how far the target follows, 0 to 1
    :return: the loss
    """
    sizes, norm, gain = shape
    weights, target, gradient = actors
    batch, real = len(observations), weights.dtype.type
    actions = np.empty((batch, len(gain)), weights.dtype)
    kernels.actor_forward(weights, sizes, norm, observations, gain, rooms[0], actions)
    critic_sizes, critic_norm = critic_shape
    values, slope = np.empty((1, batch, 1), weights.dtype), np.empty_like(actions)
    kernels.values_forward(
        first, critic_sizes, critic_norm, observations, actions, rooms[1][:1], values
    )
    share = np.full((batch, 1), real(-1) / real(batch))
    kernels.values_backward_to_actions(first, critic_sizes, critic_norm, rooms[1], share, slope)
    kernels.actor_backward(
        weights, sizes, norm, observations, gain, rooms[0], actions, slope, gradient,
        np.empty((0, 0), weights.dtype),
    )  # fmt: skip
    kernels.adam(weights, gradient, *adam)
    kernels.follow(target, weights, real(tau))
    average, count = averages
    if average.size:
        # The average begins with the actor of the first update.
        kernels.follow(average, weights, real(1 - decay) if count[()] > 0 else real(1))
        count[()] += 1
    return -values.mean()


def is_for(model: TD3) -> bool:
    """
    Say whether lean updates are equal to those of a model.

    :param model: DDPG or TD3 with a :class:`~sb3_torcs.policies.SplitHeadPolicy`
    :return: false on a GPU, or if a part is not the default
    """
    policy = cast(SplitHeadPolicy, model.policy)
    optimizers = policy.actor.optimizer, policy.critic.optimizer
    return (
        type(model).train is TD3.train
        and policy.fuses
        and type(policy.actor.features_extractor) is FlattenExtractor
        and all(isinstance(own, LeanAdam) and is_usual(own) for own in optimizers)
    )
