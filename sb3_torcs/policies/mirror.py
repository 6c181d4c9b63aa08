"""Mirror images of drives, with left and right exchanged.

A car is the same on both sides, so the mirror image of a drive is a possible drive on the mirrored
road. Learning from both gives twice the experience, with every bend in both directions.
"""

from __future__ import annotations

from functools import lru_cache

import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_torcs.sensors import Sensor, sensors_of_size

__all__ = [
    "mirror_actions",
    "mirror_half",
    "mirror_image",
    "mirror_observations",
]

OTHER_WHEEL = (1, 0, 3, 2)
"""Front right and left, rear right and left change places."""


def _order(sensor: Sensor) -> list[int]:
    """Return the index among a sensor's numbers of each number of its mirror image."""
    order = list(range(sensor.size))
    if sensor.mirror == "reversed":
        return order[::-1]
    return list(OTHER_WHEEL) if sensor.mirror == "sides" else order


@lru_cache
def mirror_image(size: int) -> tuple[th.Tensor, th.Tensor]:
    """
    Describe the mirror image of observations.

    :param size: of one, by which its sensors are known
    :return: the index in an observation of each number of the image, and its sign there
    """
    order: list[int] = []
    signs: list[float] = []
    for sensor in sensors_of_size(size):
        order += [len(order) + index for index in _order(sensor)]
        signs += [-1.0 if sensor.mirror == "opposite" else 1.0] * sensor.size
    return th.tensor(order), th.tensor(signs, dtype=th.float32)


def mirror_observations(observations: th.Tensor) -> th.Tensor:
    """
    Mirror observations. Mirroring twice gives the same observations.

    :param observations: (n, size) with range finders that look equally far to both sides
    :return: (n, size)
    """
    order, signs = (part.to(observations.device) for part in mirror_image(observations.shape[1]))
    return observations[:, order] * signs


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
