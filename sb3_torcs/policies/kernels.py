"""Passes of the actor and of value functions, forward and backward, compiled by numba.

They compute what the plain networks compute, but for rounding. They cost little more than the
matrix products, because numba compiles the loops between these.

Each network's parameters are one vector, in PyTorch's order: each matrix is (outputs, inputs),
followed by its bias and, with a layer norm, by the norm's weight and bias. A backward pass reads
what the forward pass wrote to ``work``, a vector per network.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from sb3_torcs.policies.blas import product
from sb3_torcs.policies.layers import (
    compiled,
    hidden,
    hidden_backward,
    join,
    join_backward,
    layer,
    matrix,
    outputs,
    outputs_backward,
)

__all__ = [
    "actor_backward",
    "actor_forward",
    "adam",
    "difference",
    "follow",
    "stack_backward",
    "stack_forward",
    "stack_work",
    "values_backward",
    "values_backward_to_actions",
    "values_forward",
    "values_work",
]

# ------------------------------------------------------------- stacks of layers, actors


@compiled
def stack_work(sizes: Any, batch: int) -> int:
    """
    Count the numbers that a pass writes.

    :param sizes: of the input, of each hidden layer, of the output
    :param batch: number of rows
    :return: the length of ``work``
    """
    return batch * (3 * sum(sizes[1:-1]) + len(sizes) - 2)


@compiled
def stack_forward(
    weights: Any, sizes: Any, norm: bool, features: Any, work: Any, results: Any
) -> None:
    """
    Pass through hidden layers and a layer of few outputs.

    :param weights: of all layers
    :param sizes: of the input, of each hidden layer, of the output
    :param norm: with layer norms
    :param features: (batch, features_dim)
    :param work: written, for ``stack_backward``
    :param results: (batch, outputs), written
    """
    start, at, x = 0, 0, features
    for number in range(1, len(sizes) - 1):
        units = sizes[number]
        weight, bias = matrix(weights, start, units, sizes[number - 1])
        products, y, _, deviation, at = layer(work, at, len(features), units)
        product(x, False, weight, True, products)
        hidden(weights[bias:], norm, products, y, deviation)
        start, x = bias + units * (3 if norm else 1), y
    outputs(weights[start:], x, results)


@compiled
def stack_backward(
    weights: Any, sizes: Any, norm: bool, features: Any, work: Any, slope: Any, gradient: Any
) -> None:
    """
    Find the gradient of the weights.

    :param weights: as in ``stack_forward``
    :param sizes: as in ``stack_forward``
    :param norm: as in ``stack_forward``
    :param features: as in ``stack_forward``
    :param work: from ``stack_forward``
    :param slope: gradient of the results
    :param gradient: of the weights, written
    """
    batch, last = len(features), len(sizes) - 2
    start = weights.size - sizes[-1] * (sizes[last] + 1)
    at = stack_work(sizes, batch) - batch * (3 * sizes[last] + 1)
    products, y, d, deviation, _ = layer(work, at, batch, sizes[last])
    outputs_backward(weights[start:], slope, y, d, gradient[start:])
    for number in range(last, 0, -1):
        inputs, units = sizes[number - 1], sizes[number]
        start -= units * (inputs + (3 if norm else 1))
        weight, bias = matrix(weights, start, units, inputs)
        hidden_backward(weights[bias:], norm, d, products, y, deviation, gradient[bias:])
        d_weight, _ = matrix(gradient, start, units, inputs)
        if number > 1:
            at -= batch * (3 * inputs + 1)
            products, y, below, deviation, _ = layer(work, at, batch, inputs)
            product(d, True, y, False, d_weight)
            product(d, False, weight, False, below)
            d = below
        else:
            _gradient_of_first(features, d, d_weight)


@compiled
def _gradient_of_first(features: Any, slope: Any, gradient: Any) -> None:
    """Find the gradient of a first layer: with few inputs the turned product is faster."""
    turned = np.empty((features.shape[1], slope.shape[1]), features.dtype)
    product(features, True, slope, False, turned)
    gradient[:] = turned.T


@compiled
def actor_forward(
    weights: Any, sizes: Any, norm: bool, features: Any, gain: Any, work: Any, actions: Any
) -> None:
    """
    Decide.

    :param weights: of the actor
    :param sizes: of the input, of each hidden layer, of the output
    :param norm: with layer norms
    :param features: (batch, features_dim)
    :param gain: (actuators,) before the output function
    :param work: written, for ``actor_backward``
    :param actions: (batch, actuators) in [-1, 1], written
    """
    stack_forward(weights, sizes, norm, features, work, actions)
    for j in range(len(actions)):
        for o in range(len(gain)):
            actions[j, o] = np.tanh(actions[j, o] * gain[o])


@compiled
def actor_backward(
    weights: Any, sizes: Any, norm: bool, features: Any, gain: Any, work: Any, actions: Any,
    slope: Any, gradient: Any,
) -> None:  # fmt: skip
    """
    Find the gradient of the weights.

    :param weights: as in ``actor_forward``
    :param sizes: as in ``actor_forward``
    :param norm: as in ``actor_forward``
    :param features: as in ``actor_forward``
    :param gain: as in ``actor_forward``
    :param work: from ``actor_forward``
    :param actions: from ``actor_forward``
    :param slope: gradient of the actions; overwritten
    :param gradient: of the weights, written
    """
    one = weights.dtype.type(1)
    for j in range(len(features)):
        for o in range(len(gain)):
            slope[j, o] *= (one - actions[j, o] * actions[j, o]) * gain[o]
    stack_backward(weights, sizes, norm, features, work, slope, gradient)


# ----------------------------------------------------------------------------- critics


@compiled
def _places(sizes: Any, norm: bool) -> Any:
    """Where the three matrices and the last layer begin."""
    features, actions, first, second = sizes
    own = 3 if norm else 1
    state2 = (features + own) * first
    joint3 = state2 + (first + 2 + actions) * second
    return 0, state2, joint3, joint3 + (second + own) * second


@compiled
def values_work(sizes: Any, batch: int) -> int:
    """
    Count the numbers that a pass of one network writes.

    :param sizes: of the features, of the actions, of the first and of the second layer
    :param batch: number of rows
    :return: the length of its ``work``
    """
    return batch * (3 * sizes[2] + 5 * sizes[3] + 2)


@compiled
def _rooms(work: Any, sizes: Any, batch: int) -> Any:
    """View the work space of the first, the third and the second layer."""
    first, second = sizes[2], sizes[3]
    x1, y1, d1, deviation1, at = layer(work, 0, batch, first)
    x3, y3, d3, deviation3, at = layer(work, at, batch, second)
    x2, at = matrix(work, at, batch, second)
    d2, at = matrix(work, at, batch, second)
    return (x1, y1, d1, deviation1), (x3, y3, d3, deviation3), x2, d2


@compiled
def values_forward(
    weights: Any, sizes: Any, norm: bool, features: Any, actions: Any, work: Any, values: Any
) -> None:
    """
    Value the actions.

    :param weights: (networks, parameters)
    :param sizes: of the features, of the actions, of the first and of the second layer
    :param norm: with layer norms
    :param features: (batch, features)
    :param actions: (batch, actuators) in [-1, 1]
    :param work: (networks, ...), written, for a backward pass
    :param values: (networks, batch, 1), written
    """
    n_features, _, first, second = sizes
    state1, state2, joint3, value = _places(sizes, norm)
    for k in range(len(weights)):
        own = weights[k]
        (x1, y1, _, deviation1), (x3, y3, _, deviation3), x2, _ = _rooms(
            work[k], sizes, len(features)
        )
        weight, bias = matrix(own, state1, first, n_features)
        product(features, False, weight, True, x1)
        hidden(own[bias:], norm, x1, y1, deviation1)
        weight, bias = matrix(own, state2, second, first)
        product(y1, False, weight, True, x2)
        join(own[bias:], actions, x2)
        weight, bias = matrix(own, joint3, second, second)
        product(x2, False, weight, True, x3)
        hidden(own[bias:], norm, x3, y3, deviation3)
        outputs(own[value:], y3, values[k])


@compiled
def values_backward(
    weights: Any, sizes: Any, norm: bool, features: Any, actions: Any, work: Any, slope: Any,
    gradient: Any,
) -> None:  # fmt: skip
    """
    Find the gradient of the weights.

    :param weights: as in ``values_forward``
    :param sizes: as in ``values_forward``
    :param norm: as in ``values_forward``
    :param features: as in ``values_forward``
    :param actions: as in ``values_forward``
    :param work: from ``values_forward``
    :param slope: gradient of the values, (networks, batch, 1)
    :param gradient: of the weights, written
    """
    n_features, _, first, second = sizes
    state1, state2, joint3, value = _places(sizes, norm)
    for k in range(len(weights)):
        own, d_own = weights[k], gradient[k]
        (x1, y1, d1, deviation1), (x3, y3, d3, deviation3), x2, d2 = _rooms(
            work[k], sizes, len(features)
        )
        outputs_backward(own[value:], slope[k], y3, d3, d_own[value:])
        weight, bias = matrix(own, joint3, second, second)
        hidden_backward(own[bias:], norm, d3, x3, y3, deviation3, d_own[bias:])
        product(d3, False, weight, False, d2)
        product(d3, True, x2, False, matrix(d_own, joint3, second, second)[0])
        weight, bias = matrix(own, state2, second, first)
        join_backward(d2, actions, d_own[bias:])
        product(d2, False, weight, False, d1)
        product(d2, True, y1, False, matrix(d_own, state2, second, first)[0])
        weight, bias = matrix(own, state1, first, n_features)
        hidden_backward(own[bias:], norm, d1, x1, y1, deviation1, d_own[bias:])
        _gradient_of_first(features, d1, matrix(d_own, state1, first, n_features)[0])


@compiled
def values_backward_to_actions(
    weights: Any, sizes: Any, norm: bool, work: Any, slope: Any, d_actions: Any
) -> None:
    """
    Find the gradient of the actions alone, by the first network.

    :param weights: as in ``values_forward``
    :param sizes: as in ``values_forward``
    :param norm: as in ``values_forward``
    :param work: from ``values_forward``
    :param slope: gradient of the values, (batch, 1)
    :param d_actions: (batch, actuators), written
    """
    _, n_actions, first, second = sizes
    _, state2, joint3, value = _places(sizes, norm)
    own = weights[0]
    _, (x3, y3, d3, deviation3), _, _ = _rooms(work[0], sizes, len(slope))
    unused = np.empty(3 * second + 1, own.dtype)
    outputs_backward(own[value:], slope, y3, d3, unused)
    weight, bias = matrix(own, joint3, second, second)
    hidden_backward(own[bias:], norm, d3, x3, y3, deviation3, unused)
    # Two matrices follow the actions: multiply them first, since their product is small.
    action2, _ = matrix(own, state2 + (first + 1) * second, second, n_actions)
    both = np.empty((n_actions, second), own.dtype)
    product(action2, True, weight, True, both)
    product(d3, False, both, True, d_actions)


# ----------------------------------------------------------------------------- updates


@njit(cache=True, error_model="numpy")
def difference(
    values: Any, following: Any, rewards: Any, dones: Any, discounts: Any, slope: Any
) -> float:
    """
    Compare values with the rewards and the values of what followed.

    :param values: (networks, batch, 1)
    :param following: values of what followed, by the target network
    :param rewards: (batch, 1)
    :param dones: (batch, 1)
    :param discounts: (batch, 1)
    :param slope: gradient of the loss, written
    :return: the loss: sum of the mean squared errors
    """
    networks, batch, _ = values.shape
    real = values.dtype.type
    loss = 0.0
    for j in range(batch):
        least = following[0, j, 0]
        for k in range(1, networks):
            least = min(least, following[k, j, 0])
        target = rewards[j, 0] + (real(1) - dones[j, 0]) * discounts[j, 0] * least
        for k in range(networks):
            error = values[k, j, 0] - target
            slope[k, j, 0] = real(2) / real(batch) * error
            loss += error * error
    return loss / batch


@compiled
def adam(
    weights: Any, gradient: Any, mean: Any, square: Any, betas: Any, rate: Any, scale: Any,
    epsilon: Any, decay: Any,
) -> None:  # fmt: skip
    """
    Make a step of Adam (Kingma and Ba, 2015), in the order of the operations of PyTorch.

    :param weights: overwritten
    :param gradient: of the loss
    :param mean: running average of the gradient; overwritten
    :param square: running average of its square; overwritten
    :param betas: shares of both averages that a step keeps
    :param rate: learning rate, divided by 1 - beta1 ** step
    :param scale: 1 / sqrt(1 - beta2 ** step)
    :param epsilon: added to the root
    :param decay: share of each weight that is added to its gradient
    """
    beta1, beta2 = betas
    one = weights.dtype.type(1)
    for i in range(weights.size):
        g = gradient[i] + decay * weights[i]
        m = mean[i] + (one - beta1) * (g - mean[i])
        v = beta2 * square[i] + (one - beta2) * g * g
        mean[i], square[i] = m, v
        weights[i] -= rate * m / (np.sqrt(v) * scale + epsilon)


@compiled
def follow(target: Any, weights: Any, share: Any) -> None:
    """
    Move a target network, or a running average, towards the weights.

    :param target: overwritten
    :param weights: of the network
    :param share: how far, 0 to 1
    """
    rest = weights.dtype.type(1) - share
    for i in range(weights.size):
        target[i] = rest * target[i] + share * weights[i]
