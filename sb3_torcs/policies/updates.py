"""Faster updates of DDPG and TD3 without PyTorch's record of operations, equal but for rounding."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_torcs.policies import kernels
from sb3_torcs.policies.flat import FlatParameters
from sb3_torcs.policies.fused import FusedActor, FusedValues, array, give, take
from sb3_torcs.policies.layers import compiled
from sb3_torcs.policies.networks import ActorAverage
from sb3_torcs.policies.optimizers import LeanAdam, is_usual
from sb3_torcs.policies.split_head import SplitHeadPolicy
from sb3_torcs.policies.stock import has_hooks, has_own_methods
from sb3_torcs.policies.threads import Helper, two_threads

__all__ = ["LeanUpdates", "is_for"]

NETWORKS = ("actor", "actor_target", "critic", "critic_target")


class LeanUpdates:
    """
    Updates a model instead of its ``train``.

    :param model: for which :func:`is_for` is true
    """

    def __init__(self, model: TD3) -> None:
        self.model = model

    def _look(self) -> None:
        """
        Look at the parameters of the networks.

        The views hold for one call of ``train``. Between two calls PyTorch may move the parameters,
        e.g. when they are sent to another process, and callbacks may replace their ``data``.
        """
        policy = cast(Any, self.model.policy)
        actor, critic = policy.actor.mu, policy.critic
        self.actor: th.Tensor = actor.flat
        self.critic: th.Tensor = critic.flat
        weights, target = array(actor.flat), array(policy.actor_target.mu.flat)
        dtype = weights.dtype
        passes: FusedActor = actor.fused
        self.actor_shape = passes.sizes, passes.norm, passes.gain.astype(dtype)
        self.actors = weights, target, take(*weights.shape, dtype=dtype)
        weights, target = (
            array(flat).reshape(critic.n_critics, -1)
            for flat in (critic.flat, policy.critic_target.flat)
        )
        values: FusedValues = critic.fused
        self.critic_shape = values.sizes, values.norm
        self.critics = weights, target, take(*weights.shape, dtype=dtype)
        self.average: ActorAverage | None = policy.average
        if self.average is None:
            self.averages = np.empty(0, dtype), np.zeros((), np.int64)
        else:
            self.averages = array(self.average.module.mu.flat), self.average.n_averaged.numpy()

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """
        Update the networks as ``TD3.train`` does, in its order.

        :param gradient_steps: number of updates
        :param batch_size: transitions per update
        """
        model = self.model
        self._look()
        model.policy.set_training_mode(True)
        model._update_learning_rate([model.actor.optimizer, model.critic.optimizer])
        actor_losses, critic_losses = [], []
        assert model.replay_buffer is not None
        rooms = self._rooms(batch_size)
        with two_threads() as other:
            for _ in range(gradient_steps):
                model._n_updates += 1
                batch = model.replay_buffer.sample(batch_size, env=model._vec_normalize_env)
                both = model._n_updates % model.policy_delay == 0
                # The actor's update does not read the critics' targets: these follow before it.
                tau = model.tau if both else 0.0
                critic_losses.append(self._update_critics(batch, rooms, tau, other))
                if both:
                    actor_losses.append(self._update_actor(batch, rooms))
        for work in (*rooms, self.actors[2], self.critics[2]):
            give(work)
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

    def _update_critics(
        self, batch: ReplayBufferSamples, rooms: tuple[np.ndarray, np.ndarray], tau: float,
        other: Helper,
    ) -> float:  # fmt: skip
        """
        Learn from the targets' values, which follow by a share; return the loss.

        The first critic learns here. The others do so on the second thread, and may still learn
        when this returns: the actor's update reads the first one only.
        """
        model, shape, weights = self.model, self.critic_shape, self.critics[0]
        arrays, room = tuple(map(array, batch[:5])), rooms[1]
        given = batch.discounts
        discounts = np.full_like(arrays[4], model.gamma) if given is None else array(given)
        # Drawn even if it is clipped to 0, so that later random numbers are the same.
        noise = th.empty(arrays[1].shape).normal_(0, model.target_policy_noise).numpy()
        mean, square, *factors = cast(LeanAdam, model.critic.optimizer).begin_step(self.critic)
        averages = mean.reshape(weights.shape), square.reshape(weights.shape)
        next_actions = _next_actions(
            self.actor_shape, self.actors[1], arrays[2], noise, model.target_noise_clip, rooms[0]
        )
        values, following, slope = np.empty((3, len(weights), len(noise), 1), weights.dtype)

        def value(own: slice) -> None:
            networks = [network[own] for network in self.critics]
            _value(
                shape, *networks[:2], arrays, next_actions, room[own], values[own], following[own]
            )

        def learn(own: slice) -> None:
            networks = tuple(network[own] for network in self.critics)
            adam = *(average[own].reshape(-1) for average in averages), *factors
            _learn_values(shape, networks, arrays, room[own], slope[own], adam, tau)

        def share(task: Callable[[slice], None]) -> None:
            other.wait()
            if len(weights) > 1:
                other.begin(partial(task, slice(1, None)))
            task(slice(1))

        share(value)
        other.wait()
        loss: float = kernels.difference(values, following, arrays[4], arrays[3], discounts, slope)
        share(learn)
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
def _next_actions(
    shape: Any, weights: Any, following: Any, noise: Any, clip: float, room: Any
) -> Any:
    """
    Let the target actor decide.

    :param shape: sizes of the actor's layers, whether it has norms, its gain
    :param weights: of the target
    :param following: (batch, features)
    :param noise: (batch, actuators)
    :param clip: its limit
    :param room: work space of the actor
    :return: (batch, actuators) in [-1, 1]
    """
    sizes, norm, gain = shape
    actions = np.empty_like(noise)
    kernels.actor_forward(weights, sizes, norm, following, gain, room, actions)
    if clip:
        actions[:] = np.clip(actions + np.clip(noise, -clip, clip), -1, 1)
    return actions


@compiled
def _value(
    shape: Any, weights: Any, target: Any, batch: Any, next_actions: Any, room: Any, values: Any,
    following: Any,
) -> None:  # fmt: skip
    """
    Value what was done, and by the targets what followed.

    :param shape: sizes of the critics' layers, and whether they have norms
    :param weights: (networks, parameters)
    :param target: the same of the targets
    :param batch: observations, actions, what followed, ...
    :param next_actions: in what followed
    :param room: work spaces of the networks
    :param values: (networks, batch, 1), written
    :param following: the same of what followed, written
    """
    sizes, norm = shape
    kernels.values_forward(target, sizes, norm, batch[2], next_actions, room, following)
    kernels.values_forward(weights, sizes, norm, batch[0], batch[1], room, values)


@compiled
def _learn_values(
    shape: Any, networks: Any, batch: Any, room: Any, slope: Any, adam: Any, tau: float
) -> None:
    """
    Learn from the gradient of the values.

    :param shape: sizes of the critics' layers, and whether they have norms
    :param networks: weights, those of the targets and their gradient, each (networks, parameters)
    :param batch: observations, actions, ...
    :param room: from ``_value``
    :param slope: gradient of the values, (networks, batch, 1)
    :param adam: from ``LeanAdam.begin_step``
    :param tau: how far the targets follow, 0 to 1
    """
    sizes, norm = shape
    weights, target, gradient = networks
    unused = np.empty((0, 0, 0), weights.dtype)
    kernels.values_backward(
        weights, sizes, norm, batch[0], batch[1], room, slope, gradient, unused, unused
    )
    kernels.adam(weights.reshape(-1), gradient.reshape(-1), *adam)
    if tau:
        kernels.follow(target.reshape(-1), weights.reshape(-1), weights.dtype.type(tau))


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
    policy: Any = model.policy
    return (
        type(model).train is TD3.train
        and not has_own_methods(model)
        and isinstance(policy, SplitHeadPolicy)
        and isinstance(model.observation_space, spaces.Box)
        and len(model.observation_space.shape) == 1
        and model.observation_space.dtype == np.float32
        and policy.fuses
        and type(policy.actor.features_extractor) is FlattenExtractor
        and all(getattr(model, name) is getattr(policy, name) for name in NETWORKS)
        and all(map(_is_known, _vectors(policy)))
        # Noises read the output of the actor as a whole by a hook.
        and _learns_all(policy.actor.mu, policy.actor.optimizer, policy.average is not None)
        and _learns_all(policy.critic, policy.critic.optimizer)
    )


def _vectors(policy: Any) -> list[FlatParameters]:
    """Return the networks, each of whose parameters are one vector."""
    average = [] if policy.average is None else [policy.average.module.mu]
    return [policy.actor.mu, policy.actor_target.mu, policy.critic, policy.critic_target, *average]


def _is_known(network: FlatParameters) -> bool:
    """Whether the kernels can read and write the parameters: a callback may replace their data."""
    vector = network.flat
    return (
        vector.dtype == th.float32
        and vector.is_cpu
        and vector.is_contiguous()
        and vector.shape == (network.size,)
    )


def _learns_all(network: Any, optimizer: Any, is_averaged: bool = False) -> bool:
    """Whether an optimizer of the usual kind, and nothing else, changes a network's vector."""
    vector = network.flat
    return (
        isinstance(optimizer, LeanAdam)
        and is_usual(optimizer)
        and vector.requires_grad
        and any(vector is own for group in optimizer.param_groups for own in group["params"])
        and not has_hooks(network.modules(), optimizer, own_hooks=int(is_averaged))
    )
