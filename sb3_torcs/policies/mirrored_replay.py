"""Batches of a stock replay buffer with half of each mirrored, drawn in one pass.

The numbers drawn and the batches are those of Stable-Baselines3, followed by
:func:`~sb3_torcs.policies.mirror.mirror_half`, to the bit.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch as th
from numba import njit
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_torcs.policies.mirror import mirror_half, mirror_image

__all__ = ["sample_mirrored"]


def sample_mirrored(
    buffer: ReplayBuffer, batch_size: int, env: VecNormalize | None = None
) -> ReplayBufferSamples:
    """
    Draw a batch and mirror its first half.

    :param buffer: of Stable-Baselines3
    :param batch_size: number of transitions
    :param env: as in ``ReplayBuffer.sample``
    :return: the batch
    """
    if env is not None or not _is_stock(buffer):
        image = mirror_image(buffer.observation_space)
        return mirror_half(type(buffer).sample(buffer, batch_size, env), image)
    order, signs = _image_arrays(buffer)
    of_steps = buffer if isinstance(buffer, NStepReplayBuffer) else None
    n_steps, gamma = (1, 1.0) if of_steps is None else (of_steps.n_steps, of_steps.gamma)
    upper = buffer.buffer_size if buffer.full else buffer.pos
    rows = np.random.randint(0, upper, size=batch_size)  # noqa: NPY002  as SB3 draws
    columns = np.random.randint(0, buffer.n_envs, size=batch_size)  # noqa: NPY002
    widths = (order.size, buffer.action_dim, order.size, 1, 1, 1)
    batch = tuple(np.empty((batch_size, width), np.float32) for width in widths)
    _fill(
        batch, rows, columns, batch_size // 2, order, signs,
        (buffer.pos - 1) % buffer.buffer_size,
        _discounts(gamma, n_steps),
        (buffer.observations, buffer.actions, buffer.next_observations),
        (buffer.dones, buffer.timeouts, buffer.rewards),
    )  # fmt: skip
    seen, actions, then, dones, returns, factors = map(th.from_numpy, batch)
    return ReplayBufferSamples(
        seen, actions, then, dones, returns, None if of_steps is None else factors
    )


def _is_stock(buffer: ReplayBuffer) -> bool:
    """Whether the arrays of the buffer are as SB3 makes them of our spaces."""
    return (
        type(buffer) in (ReplayBuffer, NStepReplayBuffer)
        and not buffer.optimize_memory_usage
        and th.device(buffer.device).type == "cpu"
        and buffer.observations.dtype == buffer.actions.dtype == np.float32
    )


_images: WeakKeyDictionary[ReplayBuffer, tuple[np.ndarray, ...]] = WeakKeyDictionary()


def _image_arrays(buffer: ReplayBuffer) -> tuple[np.ndarray, ...]:
    """Describe the mirror image of a buffer's observations; found once, as that takes a while."""
    if buffer not in _images:
        image = mirror_image(buffer.observation_space)
        _images[buffer] = tuple(part.numpy() for part in image)
    return _images[buffer]


@lru_cache
def _discounts(gamma: float, n_steps: int) -> np.ndarray:
    """Find the discount of each timestep of a return, and of what follows it."""
    return gamma ** np.arange(n_steps + 1, dtype=np.float32)


@njit(cache=True)
def _fill(
    batch: Any, rows: Any, columns: Any, half: int, order: Any, signs: Any, newest: int,
    discounts: Any, seen: Any, scalars: Any,
) -> None:  # fmt: skip
    """Write transitions and their returns; the first half mirrored."""
    observations, actions, next_observations, ended, returns, factors = batch
    dones, timeouts, rewards = scalars
    size, n_steps = dones.shape[0], discounts.size - 1
    for j in range(rows.size):
        row, column = rows[j], columns[j]
        total, steps, last = np.float32(0), 0, row
        for step in range(n_steps):
            last = (row + step) % size
            total += rewards[last, column] * discounts[step]
            steps += 1
            # After these follows another episode, or the oldest transition.
            if dones[last, column] or timeouts[last, column] or last == newest:
                break
        returns[j, 0], factors[j, 0] = total, discounts[steps]
        ended[j, 0] = dones[last, column] * (np.float32(1) - timeouts[last, column])
        actions[j] = seen[1][row, column]
        for i in range(order.size):
            k = order[i] if j < half else i
            sign = signs[i] if j < half else np.float32(1)
            observations[j, i] = seen[0][row, column, k] * sign
            next_observations[j, i] = seen[2][last, column, k] * sign
        if j < half:
            actions[j, 0] = -actions[j, 0]
