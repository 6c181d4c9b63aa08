"""Faster updates of DDPG and TD3 without PyTorch's record of operations, equal but for rounding.

The steps are those of ``TD3.train``: sample a batch, let the critics learn from the targets'
values, let the actor learn from the first critic's, and let the targets follow.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn

from sb3_torcs.policies import kernels
from sb3_torcs.policies.layers import compiled
from sb3_torcs.policies.networks import ActorAverage, LateActionCritic, SplitHeads
from sb3_torcs.policies.optimizers import adam_factors, adam_state, is_usual
from sb3_torcs.policies.split_head import SplitHeadPolicy
from sb3_torcs.policies.stock import has_hooks, has_own_methods
from sb3_torcs.policies.threads import Helper, two_threads
from sb3_torcs.policies.vectors import Vector, array

__all__ = ["LeanUpdates", "is_for"]

NETWORKS = ("actor", "actor_target", "critic", "critic_target")


class _Learner:
    """
    A network that learns, its target and what Adam keeps, each as one vector.

    :param network: whose parameters learn
    :param target: that follows it
    :param optimizer: Adam of the network
    """

    def __init__(
        self, network: nn.Module, target: nn.Module, optimizer: th.optim.Optimizer
    ) -> None:
        self.own = list(network.parameters())
        self.optimizer = optimizer
        states = self._states()
        self.weights = Vector(self.own)
        self.target = Vector(target.parameters())
        self.mean = Vector(state["exp_avg"] for state in states)
        self.square = Vector(state["exp_avg_sq"] for state in states)
        self.gradient = np.empty_like(self.weights.numbers)
        self.count = int(states[0]["step"].item())  # steps of Adam

    def _states(self) -> list[dict[str, th.Tensor]]:
        return [adam_state(self.optimizer, own) for own in self.own]

    def vectors(self) -> tuple[Vector, ...]:
        """Return the vectors of whose parts others hold views."""
        return self.weights, self.target, self.mean, self.square

    def is_whole(self) -> bool:
        """Return whether nobody has replaced a part."""
        states = self._states()
        held = zip(self.mean.tensors, self.square.tensors, states, strict=True)
        return (
            all(vector.is_whole() for vector in self.vectors())
            and all(m is s["exp_avg"] and q is s["exp_avg_sq"] for m, q, s in held)
            and self.count == int(states[0]["step"].item())
        )

    def networks(self, number: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Return the weights, those of the targets and the gradient.

        :param number: of value functions: each array is (number, parameters)
        """
        every = self.weights.numbers, self.target.numbers, self.gradient
        return cast(Any, tuple(each.reshape(number, -1) for each in every))

    def begin_step(self) -> tuple[Any, ...]:
        """Count an update; return what the kernel of Adam takes after weights and gradient."""
        (group,) = self.optimizer.param_groups
        self.count += 1
        averages = self.mean.numbers, self.square.numbers
        return *averages, *adam_factors(group, self.count, self.gradient.dtype.type)

    def write_count(self) -> None:
        """Write the number of updates to where PyTorch keeps it, once per parameter."""
        for state in self._states():
            state["step"].fill_(self.count)


class _LeanActor:
    """
    Decides in place of the layers of :class:`SplitHeads`. Copies of those decide by themselves.

    :param heads: of the actor
    :param weights: of the heads
    """

    def __init__(self, heads: SplitHeads, weights: Vector) -> None:
        self._weights = weights
        self._shape = _actor_shape(heads)
        self._rooms: dict[int, np.ndarray] = {}

    def __call__(self, features: th.Tensor) -> th.Tensor | None:
        if not self._weights.is_whole():
            return None
        sizes, norm, gain = self._shape
        seen = array(features)
        if len(seen) not in self._rooms:
            self._rooms[len(seen)] = _room(kernels.stack_work(sizes, len(seen)))
        actions, room = np.empty((len(seen), len(gain)), np.float32), self._rooms[len(seen)]
        kernels.actor_forward(self._weights.numbers, sizes, norm, seen, gain, room, actions)
        return th.from_numpy(actions)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(None), ()


def _actor_shape(heads: SplitHeads) -> tuple[tuple[int, ...], bool, np.ndarray]:
    """Return the sizes of the actor's layers, whether it has norms, and its gain."""
    layers: list[Any] = [*heads.hidden, heads.heads]
    sizes = (layers[0].in_features, *(layer.out_features for layer in layers))
    return sizes, layers[0].norm is not None, array(heads.gain)


def _room(*size: int) -> np.ndarray:
    """
    Make a work space that begins at a cache line, as PyTorch places it.

    Products of matrices that begin elsewhere take up to 5 % longer.
    """
    return th.empty(size).numpy()


class LeanUpdates:
    """
    Updates a model instead of its ``train``.

    It makes the parameters, and what the optimizers keep of them, views of a few vectors, until
    they are released.

    :param model: for which :func:`is_for` is true
    """

    def __init__(self, model: TD3) -> None:
        self.model = model
        policy: Any = model.policy
        actor, critic, first = policy.actor.mu, policy.critic, policy.critic.networks[0]
        self.actor = _Learner(actor, policy.actor_target.mu, policy.actor.optimizer)
        self.critic = _Learner(critic, policy.critic_target, policy.critic.optimizer)
        self.actor_shape = _actor_shape(actor)
        sizes = (
            first.state1.in_features, first.action2.in_features, first.state1.out_features,
            first.state2.out_features,
        )  # fmt: skip
        self.critic_shape = sizes, first.state1.norm is not None
        self.actors = tuple(each[0] for each in self.actor.networks())
        self.critics = self.critic.networks(critic.n_critics)
        self.average: ActorAverage | None = policy.average
        self.averages: tuple[np.ndarray, np.ndarray] = np.empty(0, np.float32), np.zeros((), int)
        self._averaged: Vector | None = None
        if self.average is not None:
            self._averaged = Vector(self.average.module.mu.parameters())
            self.averages = self._averaged.numbers, self.average.n_averaged.numpy()
        self._rooms: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        actor.lean = _LeanActor(actor, self.actor.weights)

    def is_whole(self) -> bool:
        """Return whether the parameters are where they were put, and learn by the same Adam."""
        policy: Any = self.model.policy
        optimizers = policy.actor.optimizer, policy.critic.optimizer
        if optimizers != (self.actor.optimizer, self.critic.optimizer):
            return False
        averaged = self._averaged is None or self._averaged.is_whole()
        return averaged and self.actor.is_whole() and self.critic.is_whole()

    def release(self) -> None:
        """Give the parameters back to the networks."""
        cast(Any, self.model.policy).actor.mu.lean = None
        for vector in self._vectors():
            if vector.is_whole():
                vector.release()

    def _vectors(self) -> Iterator[Vector]:
        yield from self.actor.vectors()
        yield from self.critic.vectors()
        if self._averaged is not None:
            yield self._averaged

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
        rooms = self._work_space(batch_size)
        try:
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
        finally:
            self.actor.write_count()
            self.critic.write_count()
        model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")
        if actor_losses:
            model.logger.record("train/actor_loss", np.mean(actor_losses))
        model.logger.record("train/critic_loss", np.mean(critic_losses))

    def _work_space(self, batch_size: int) -> tuple[np.ndarray, np.ndarray]:
        """Return work spaces for the passes of the actor and of the critics."""
        if batch_size not in self._rooms:
            self._rooms[batch_size] = (
                _room(kernels.stack_work(self.actor_shape[0], batch_size)),
                _room(len(self.critics[0]), kernels.values_work(self.critic_shape[0], batch_size)),
            )
        return self._rooms[batch_size]

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
        mean, square, *factors = self.critic.begin_step()
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
        adam = self.actor.begin_step()
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
    kernels.values_backward(weights, sizes, norm, batch[0], batch[1], room, slope, gradient)
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
        weights, sizes, norm, observations, gain, rooms[0], actions, slope, gradient
    )
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
        and type(policy.actor.features_extractor) is FlattenExtractor
        and all(getattr(model, name) is getattr(policy, name) for name in NETWORKS)
        and isinstance(policy.actor.mu.activation, nn.ReLU)
        and isinstance(policy.critic, LateActionCritic)
        and all(isinstance(network.activation, nn.ReLU) for network in policy.critic.networks)
        # Noises read the output of the actor as a whole by a hook.
        and _learns_all(policy.actor.mu, policy.actor.optimizer, policy.average is not None)
        and _learns_all(policy.critic, policy.critic.optimizer)
    )


def _is_known(parameter: nn.Parameter) -> bool:
    """Whether the kernels can read and write a parameter."""
    return parameter.dtype == th.float32 and parameter.is_cpu


def _learns_all(network: Any, optimizer: Any, is_averaged: bool = False) -> bool:
    """Whether Adam, and nothing else, changes all parameters of a network."""
    own = list(network.parameters())
    return (
        is_usual(optimizer)
        and all(parameter.requires_grad and _is_known(parameter) for parameter in own)
        and [list(map(id, group["params"])) for group in optimizer.param_groups]
        == [list(map(id, own))]
        and not has_hooks(network.modules(), optimizer, own_hooks=int(is_averaged))
    )
