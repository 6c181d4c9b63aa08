"""Mirror images of drives, with left and right exchanged.

A car is the same on both sides, so the mirror image of a drive is a possible drive on the mirrored
road. Learning from both gives twice the experience, with every bend in both directions.
"""

from __future__ import annotations

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_torcs.sensors import OBSERVATION_SIZE, feature_slices

__all__ = [
    "MIRROR_ORDER",
    "MIRROR_SIGNS",
    "mirror_actions",
    "mirror_half",
    "mirror_observations",
]

SIDED = ("heading_error", "track_position", "speed_y")
"""Sensors that are positive on one side."""

OTHER_WHEEL = (1, 0, 3, 2)
"""Front right and left, rear right and left change places."""


def _order() -> th.Tensor:
    """Return the index in an observation of each number of its mirror image."""
    order, where = np.arange(OBSERVATION_SIZE), feature_slices()
    beams, wheels = where["range_finders"], where["wheel_speeds"]
    order[beams] = order[beams][::-1]
    order[wheels] = order[wheels][list(OTHER_WHEEL)]
    return th.from_numpy(order)


def _signs() -> th.Tensor:
    """Return the sign of each number of a mirrored observation."""
    signs, where = np.ones(OBSERVATION_SIZE, np.float32), feature_slices()
    for name in SIDED:
        signs[where[name]] = -1.0
    return th.from_numpy(signs)


MIRROR_ORDER, MIRROR_SIGNS = _order(), _signs()


def mirror_observations(observations: th.Tensor) -> th.Tensor:
    """
    Mirror observations. Mirroring twice gives the same observations.

    :param observations: (n, 29) with range finders that look equally far to both sides
    :return: (n, 29)
    """
    device = observations.device
    return observations[:, MIRROR_ORDER.to(device)] * MIRROR_SIGNS.to(device)


def mirror_actions(actions: th.Tensor) -> th.Tensor:
    """
    Steer to the other side. Steering comes first in every layout of the action.

    :param actions: (n, actuators), in the environment's units or scaled to [-1, 1]
    :return: (n, actuators)
    """
    return th.cat((-actions[..., :1], actions[..., 1:]), dim=-1)


def mirror_half(batch: ReplayBufferSamples) -> ReplayBufferSamples:
    """
    Mirror the first half of a batch, whose order is random.

    :param batch: of a replay buffer; left as it is
    :return: as many transitions
    """
    half = len(batch.actions) // 2

    def joined(images: th.Tensor, whole: th.Tensor) -> th.Tensor:
        return th.cat((images, whole[half:]))

    return batch._replace(
        observations=joined(mirror_observations(batch.observations[:half]), batch.observations),
        actions=joined(mirror_actions(batch.actions[:half]), batch.actions),
        next_observations=joined(
            mirror_observations(batch.next_observations[:half]), batch.next_observations
        ),
    )
