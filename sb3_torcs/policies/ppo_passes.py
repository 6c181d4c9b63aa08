"""Passes of PPO's policy and value function, forward and backward, compiled by numba.

A symmetric policy has two rows per observation, the second of which is its mirror image.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sb3_torcs.policies import kernels
from sb3_torcs.policies.layers import compiled

__all__ = ["decide", "find_policy_gradient", "find_value_gradient"]

"""In place of their gradient, which nobody needs."""

LOG_ROOT_TAU = np.float32(math.log(math.sqrt(math.tau)))


@compiled
def bound(means: Any, bounds: Any) -> None:
    """
    Do what :class:`~sb3_torcs.policies.bounded.BoundedHead` does after its layer.

    :param means: (batch, actuators), overwritten
    :param bounds: middle and half of the range of each; both empty for means without bounds
    """
    middle, half = bounds
    if half.size:
        for j in range(len(means)):
            for o in range(half.size):
                means[j, o] = middle[o] + half[o] * np.tanh(means[j, o])


@compiled
def turned_back(x: Any, row: int, ways: int, actuator: int) -> Any:
    """
    Turn what belongs to an actuator back, if its row is a mirror image. Steering comes first.

    :param x: an action, or its gradient
    :param row: of the observation
    :param ways: rows per observation
    :param actuator: number of it
    :return: the same, with the other sign for the steering in the mirror
    """
    return -x if row % ways == 1 and actuator == 0 else x


@compiled
def find_means(
    weights: Any, sizes: Any, bounds: Any, seen: Any, work: Any, each: Any, means: Any
) -> None:
    """
    Find the means of the actions; those of a symmetric policy are of both its rows.

    :param weights: of the means
    :param sizes: of the policy's layers
    :param bounds: of the means, as of ``bound``
    :param seen: (rows, features); one row per action, or two, the latter in the mirror
    :param work: as of ``stack_forward``
    :param each: (rows, actuators) what each row alone would give, written
    :param means: (batch, actuators), written
    """
    kernels.stack_forward(weights, sizes, False, seen, work, each)
    bound(each, bounds)
    ways = len(each) // len(means)
    number = means.dtype.type(ways)
    means[:] = 0
    for row in range(len(each)):
        for o in range(each.shape[1]):
            means[row // ways, o] += turned_back(each[row, o], row, ways, o) / number


@compiled
def share_slopes(slope: Any, bounds: Any, each: Any) -> None:
    """
    Find the gradients before the bounds, of each row, from those of the means.

    :param slope: (batch, actuators) gradients of the means
    :param bounds: of the means, as of ``bound``
    :param each: of ``find_means``; overwritten by the gradients
    """
    (middle, half), real = bounds, slope.dtype.type
    ways = len(each) // len(slope)
    for row in range(len(each)):
        for o in range(each.shape[1]):
            share = turned_back(slope[row // ways, o], row, ways, o) / real(ways)
            if half.size:
                tanh = (each[row, o] - middle[o]) / half[o]
                share *= half[o] * (real(1) - tanh * tanh)
            each[row, o] = share


@compiled
def decide(
    parameters: Any, actor_sizes: Any, critic_sizes: Any, bounds: Any, given: Any, rooms: Any,
    actions: Any, values: Any, chances: Any,
) -> None:  # fmt: skip
    """
    Draw actions and value observations.

    :param parameters: weights of the means, logarithms of the standard deviations, and weights of
        the value function
    :param actor_sizes: of the policy's layers
    :param critic_sizes: of the value function's layers
    :param bounds: of the means, as of ``bound``
    :param given: what the policy and what the value function sees, (rows, features), and noise,
        (batch, actuators)
    :param rooms: as ``work`` of ``stack_forward``, of each network
    :param actions: (batch, actuators), written
    :param values: (batch,), written
    :param chances: (batch,) logarithms of the actions' probabilities, written
    """
    actor, log_std, critic = parameters
    for_actor, for_critic, noise = given
    each = np.empty((len(for_actor), log_std.size), actions.dtype)
    find_means(actor, actor_sizes, bounds, for_actor, rooms[0], each, actions)
    find_values(critic, critic_sizes, for_critic, rooms[1], values)
    deviations, two = np.exp(log_std), actions.dtype.type(2)
    chances[:] = 0
    for j in range(len(actions)):
        for o in range(log_std.size):
            z = noise[j, o]
            actions[j, o] += z * deviations[o]
            chances[j] -= z * z / two + log_std[o] + LOG_ROOT_TAU


@compiled
def find_policy_gradient(
    weights: Any, log_std: Any, sizes: Any, bounds: Any, clip: Any, seen: Any, kept: Any,
    work: Any, gradient: Any, d_log_std: Any,
) -> Any:  # fmt: skip
    """
    Find the gradient of PPO's clipped objective (Schulman et al., 2017, equation 7).

    :param weights: of the policy's means
    :param log_std: (actuators,) logarithms of the standard deviations
    :param sizes: of the policy's layers
    :param bounds: of the means, as of ``bound``
    :param clip: range of the ratio of probabilities about 1
    :param seen: observations, (rows, features), and actions, (batch, actuators)
    :param kept: (batch,) logarithms of the actions' probabilities in the rollout; advantages
    :param work: as of ``stack_forward``
    :param gradient: of the weights, written
    :param d_log_std: gradient of ``log_std``, written
    :return: the loss, the share of clipped ratios, and the approximate divergence
    """
    observations, actions = seen
    chances, advantages = kept
    batch, real = len(actions), weights.dtype.type
    one, inverse = real(1), np.exp(-log_std)
    slope = np.empty(actions.shape, weights.dtype)
    each = np.empty((len(observations), log_std.size), weights.dtype)
    find_means(weights, sizes, bounds, observations, work, each, slope)
    d_log_std[:] = 0
    loss, clipped, divergence = 0.0, 0, 0.0
    for j in range(batch):
        now = real(0)
        for o in range(log_std.size):
            z = (actions[j, o] - slope[j, o]) * inverse[o]
            slope[j, o] = z
            now -= z * z / real(2) + log_std[o] + LOG_ROOT_TAU
        change = now - chances[j]
        ratio = np.exp(change)
        within = min(max(ratio, one - clip), one + clip)
        gain, limited = advantages[j] * ratio, advantages[j] * within
        loss -= min(gain, limited)
        clipped += abs(ratio - one) > clip
        divergence += ratio - one - change
        share = -gain / real(batch) if gain <= limited else real(0)
        for o in range(log_std.size):
            z = slope[j, o]
            slope[j, o] = share * z * inverse[o]
            d_log_std[o] += share * (z * z - one)
    share_slopes(slope, bounds, each)
    kernels.stack_backward(weights, sizes, False, observations, work, each, gradient)
    return loss / batch, clipped / batch, divergence / batch


@compiled
def find_values(weights: Any, sizes: Any, seen: Any, work: Any, values: Any) -> None:
    """
    Find values; those of a symmetric policy are the means of both rows.

    :param weights: of the value function
    :param sizes: of its layers
    :param seen: (rows, features)
    :param work: as of ``stack_forward``
    :param values: (batch,), written
    """
    each = np.empty((len(seen), 1), weights.dtype)
    kernels.stack_forward(weights, sizes, False, seen, work, each)
    ways = len(seen) // len(values)
    number = values.dtype.type(ways)
    values[:] = 0
    for row in range(len(seen)):
        values[row // ways] += each[row, 0] / number


@compiled
def find_value_gradient(
    weights: Any, sizes: Any, coefficient: Any, observations: Any, returns: Any, work: Any,
    gradient: Any,
) -> float:  # fmt: skip
    """
    Find the gradient of the mean squared error of the values.

    :param weights: of the value function
    :param sizes: of its layers
    :param coefficient: by which the error is multiplied in the loss
    :param observations: (rows, features)
    :param returns: (batch,)
    :param work: as of ``stack_forward``
    :param gradient: of the weights, written
    :return: the error
    """
    batch, rows, real = len(returns), len(observations), weights.dtype.type
    ways = rows // batch
    values = np.empty(batch, weights.dtype)
    find_values(weights, sizes, observations, work, values)
    slope, loss = np.empty((rows, 1), weights.dtype), 0.0
    for j in range(batch):
        values[j] -= returns[j]
        loss += values[j] * values[j]
    for row in range(rows):
        slope[row, 0] = coefficient * real(2) / real(rows) * values[row // ways]
    kernels.stack_backward(weights, sizes, False, observations, work, slope, gradient)
    return loss / batch
