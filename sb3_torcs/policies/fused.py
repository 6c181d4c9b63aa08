"""The networks' forward and backward passes by hand, as functions of PyTorch.

The passes themselves are in :mod:`sb3_torcs.policies.kernels`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from torch.autograd.function import once_differentiable

from sb3_torcs.policies import kernels

__all__ = ["FusedActor", "FusedValues", "array", "empty", "give", "take"]

UNUSED = {kind: np.empty((0, 0), kind) for kind in (np.float32, np.float64)}
UNUSED_EACH = {kind: np.empty((0, 0, 0), kind) for kind in (np.float32, np.float64)}
"""In place of gradients that nobody needs."""


def array(tensor: th.Tensor) -> np.ndarray:
    """
    Look at a tensor.

    :param tensor: on the CPU
    :return: its numbers, contiguous; a view where they are already
    """
    return np.ascontiguousarray(tensor.detach().numpy())


def empty(*size: int, dtype: Any) -> np.ndarray:
    """
    Make an array as PyTorch places it: it begins at a cache line, which NumPy's need not.

    Products of matrices that begin elsewhere take up to 5 % longer.

    :param size: of the array
    :param dtype: of its numbers
    :return: the array, uninitialised
    """
    return th.empty(size, dtype=th.from_numpy(np.empty(0, dtype)).dtype).numpy()


_spare: dict[tuple[Any, ...], list[np.ndarray]] = {}


def take(*size: int, dtype: Any) -> np.ndarray:
    """
    Take a work space for a pass.

    :param size: of the array
    :param dtype: of its numbers
    :return: the array, uninitialised
    """
    free = _spare.get((*size, dtype))
    return free.pop() if free else empty(*size, dtype=dtype)


def give(work: np.ndarray) -> None:
    """
    Give back the work space of a pass, for the next one.

    :param work: that is not read any more
    """
    _spare.setdefault((*work.shape, work.dtype), []).append(work)


class FusedActor:
    """
    An actor.

    :param sizes: of the input, of each hidden layer, of the output
    :param norm: with layer norms
    :param gain: (actuators,) before the output function
    """

    def __init__(self, sizes: tuple[int, ...], norm: bool, gain: np.ndarray) -> None:
        self.sizes, self.norm, self.gain = sizes, norm, gain

    def __call__(self, flat: th.Tensor, features: th.Tensor) -> th.Tensor:
        """
        Decide.

        :param flat: the weights
        :param features: (batch, features_dim)
        :return: (batch, actuators) in [-1, 1]
        """
        if th.is_grad_enabled():
            found: th.Tensor = _Actor.apply(self, flat, features)
            return found
        actions, work = self.forward(array(flat), array(features))
        give(work)
        return th.from_numpy(actions)

    def forward(self, weights: np.ndarray, features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Decide.

        :param weights: of the actor
        :param features: (batch, features_dim)
        :return: (batch, actuators) in [-1, 1], and what the gradient needs
        """
        size = kernels.stack_work(self.sizes, len(features))
        work = take(size, dtype=weights.dtype)
        actions = np.empty((len(features), self.sizes[-1]), weights.dtype)
        gain = self.gain.astype(weights.dtype, copy=False)
        kernels.actor_forward(weights, self.sizes, self.norm, features, gain, work, actions)
        return actions, work

    def backward(
        self, weights: np.ndarray, features: np.ndarray, work: np.ndarray, actions: np.ndarray,
        slope: np.ndarray, gradient: np.ndarray, d_features: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """
        Find the gradient of the weights.

        :param weights: of the actor
        :param features: (batch, features_dim)
        :param work: from ``forward``; it is given back
        :param actions: from ``forward``
        :param slope: gradient of the actions; overwritten
        :param gradient: of the weights, written
        :param d_features: gradient of the features, written if anywhere
        """
        kernels.actor_backward(
            weights, self.sizes, self.norm, features, self.gain.astype(weights.dtype, copy=False),
            work, actions, slope, gradient,
            UNUSED[weights.dtype.type] if d_features is None else d_features,
        )  # fmt: skip
        give(work)


class FusedValues:
    """
    Value functions of the same sizes that pass together.

    :param sizes: of the features, of the actions, of the first and of the second layer
    :param norm: with layer norms
    """

    def __init__(self, sizes: tuple[int, int, int, int], norm: bool) -> None:
        self.sizes, self.norm = sizes, norm

    def __call__(
        self, vectors: th.Tensor, features: th.Tensor, actions: th.Tensor
    ) -> tuple[th.Tensor, ...]:
        """
        Value the actions by each network.

        :param vectors: the weights, (networks, parameters)
        :param features: (batch, features_dim)
        :param actions: (batch, action_dim) in [-1, 1]
        :return: one (batch, 1) per network
        """
        if th.is_grad_enabled():
            found: tuple[th.Tensor, ...] = _Values.apply(self, vectors, features, actions)
            return found
        values, work = self.forward(array(vectors), array(features), array(actions))
        give(work)
        return th.from_numpy(values).unbind()

    def first(self, vectors: th.Tensor, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Value the actions by the first network, with a gradient for them alone.

        :param vectors: the weights, (networks, parameters)
        :param features: (batch, features_dim)
        :param actions: (batch, action_dim) in [-1, 1]
        :return: (batch, 1)
        """
        found: th.Tensor = _First.apply(self, vectors.detach(), features, actions)
        return found

    def forward(
        self, weights: np.ndarray, features: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Value the actions.

        :param weights: (networks, parameters)
        :param features: (batch, features_dim)
        :param actions: (batch, action_dim) in [-1, 1]
        :return: (networks, batch, 1), and what the gradient needs
        """
        size = kernels.values_work(self.sizes, len(features))
        work = take(len(weights), size, dtype=weights.dtype)
        values = np.empty((len(weights), len(features), 1), weights.dtype)
        kernels.values_forward(weights, self.sizes, self.norm, features, actions, work, values)
        return values, work

    def backward(
        self, weights: np.ndarray, features: np.ndarray, actions: np.ndarray, work: np.ndarray,
        slope: np.ndarray, gradient: np.ndarray, d_features: np.ndarray | None = None,
        d_actions: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """
        Find the gradient of the weights.

        :param weights: (networks, parameters)
        :param features: (batch, features_dim)
        :param actions: (batch, action_dim)
        :param work: from ``forward``; it is given back
        :param slope: gradient of the values, (networks, batch, 1)
        :param gradient: of the weights, written
        :param d_features: gradient of the features by each network, written if anywhere
        :param d_actions: gradient of the actions by each network, written if anywhere
        """
        unused = UNUSED_EACH[weights.dtype.type]
        kernels.values_backward(
            weights, self.sizes, self.norm, features, actions, work, slope, gradient,
            unused if d_features is None else d_features,
            unused if d_actions is None else d_actions,
        )  # fmt: skip
        give(work)

    def backward_to_actions(
        self, weights: np.ndarray, work: np.ndarray, slope: np.ndarray
    ) -> np.ndarray:
        """
        Find the gradient of the actions alone, by the first network.

        :param weights: (networks, parameters)
        :param work: from ``forward``; it is given back
        :param slope: gradient of its values, (batch, 1)
        :return: (batch, action_dim)
        """
        found = np.empty((len(slope), self.sizes[1]), weights.dtype)
        kernels.values_backward_to_actions(weights, self.sizes, self.norm, work, slope, found)
        give(work)
        return found


class _Actor(th.autograd.Function):
    """The actions, with a gradient for the weights and the features."""

    @staticmethod
    def forward(ctx: Any, network: FusedActor, flat: th.Tensor, features: th.Tensor) -> th.Tensor:
        actions, ctx.work = network.forward(array(flat), array(features))
        ctx.network, found = network, th.from_numpy(actions)
        ctx.save_for_backward(flat, features, found)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: th.Tensor) -> tuple[Any, ...]:
        weights, features, actions = map(array, ctx.saved_tensors)
        work, ctx.work = ctx.work, None
        if work is None:  # a second time: the first one gave it back
            work = ctx.network.forward(weights, features)[1]
        gradient = th.empty(weights.shape, dtype=slope.dtype)
        d_features = np.empty_like(features) if ctx.needs_input_grad[2] else None
        ctx.network.backward(
            weights, features, work, actions, array(slope.clone()), gradient.numpy(), d_features
        )
        return None, gradient, None if d_features is None else th.from_numpy(d_features)


class _Values(th.autograd.Function):
    """Values of all networks, with a gradient for the weights, the features and the actions."""

    @staticmethod
    def forward(
        ctx: Any, network: FusedValues, vectors: th.Tensor, features: th.Tensor, actions: th.Tensor
    ) -> tuple[th.Tensor, ...]:
        values, ctx.work = network.forward(array(vectors), array(features), array(actions))
        ctx.network = network
        ctx.save_for_backward(vectors, features, actions)
        return th.from_numpy(values).unbind()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: th.Tensor) -> tuple[Any, ...]:
        weights, features, actions = map(array, ctx.saved_tensors)
        work, ctx.work = ctx.work, None
        if work is None:  # a second time: the first one gave it back
            work = ctx.network.forward(weights, features, actions)[1]
        gradient = th.empty(weights.shape, dtype=slopes[0].dtype)
        inputs = [
            np.empty((len(weights), *of.shape), of.dtype) if needed else None
            for of, needed in zip((features, actions), ctx.needs_input_grad[2:], strict=True)
        ]
        ctx.network.backward(
            weights, features, actions, work, array(th.stack(slopes)), gradient.numpy(), *inputs
        )
        return None, gradient, *(None if d is None else th.from_numpy(d.sum(0)) for d in inputs)


class _First(th.autograd.Function):
    """The first network's values, with a gradient for the actions alone."""

    @staticmethod
    def forward(
        ctx: Any, network: FusedValues, vectors: th.Tensor, features: th.Tensor, actions: th.Tensor
    ) -> th.Tensor:
        values, ctx.work = network.forward(array(vectors[:1]), array(features), array(actions))
        ctx.network = network
        ctx.save_for_backward(vectors, features, actions)
        return th.from_numpy(values[0])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: th.Tensor) -> tuple[Any, ...]:
        weights, features, actions = map(array, ctx.saved_tensors)
        work, ctx.work = ctx.work, None
        if work is None:  # a second time: the first one gave it back
            work = ctx.network.forward(weights[:1], features, actions)[1]
        found = ctx.network.backward_to_actions(weights[:1], work, array(slope))
        return None, None, None, th.from_numpy(found)
