"""Mirror images of drives, with left and right exchanged.

A car is the same on both sides, so the mirror image of a drive is a possible drive on the mirrored
road. Learning from both gives twice the experience, with every bend in both directions.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_torcs.actions import layout_of_width
from sb3_torcs.car import look_both_ways
from sb3_torcs.errors import InvalidOption
from sb3_torcs.sensors import GROUPS, Sensor, view_of

__all__ = [
    "MirrorImage",
    "check_angles",
    "check_symmetric",
    "mirror_actions",
    "mirror_half",
    "mirror_image",
    "mirror_observations",
    "sensors_of",
]

OTHER_WHEEL = (1, 0, 3, 2)
"""Front right and left, rear right and left change places."""


def _order(sensor: Sensor) -> list[int]:
    """Return the index among a sensor's numbers of each number of its mirror image."""
    order = list(range(sensor.size))
    if sensor.mirror == "reversed":
        return order[::-1]
    return list(OTHER_WHEEL) if sensor.mirror == "sides" else order


def check_angles(angles: Any, what: str) -> None:
    """
    Make sure that observations have a mirror image.

    :param angles: (19,) of the range finders [rad]
    :param what: needs it
    :raises InvalidOption: if they do not look equally far to both sides
    """
    if not look_both_ways(angles):
        raise InvalidOption(
            f"{what} needs range finders that look equally far to both sides, not "
            f"{np.degrees(angles).round(3).tolist()}; pass 'scr' or 'narrow'"
        )


def check_symmetric(
    symmetric: bool, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
) -> None:
    """
    Make sure that what a symmetric policy sees and does has a mirror image.

    :param symmetric: whether the policy is
    :param observation_space: of the policy
    :param action_space: of the policy
    :raises InvalidOption: if it has none
    """
    ours = sensors_of(observation_space) and layout_of_width(get_action_dim(action_space))
    if symmetric and not ours:
        raise InvalidOption(
            "symmetric=True mirrors the sensors and actuators of Torcs-v0 and TorcsLite-v0, and "
            f"these observations, of shape {observation_space.shape}, or these actions, of shape "
            f"{action_space.shape}, are others; pass symmetric=False"
        )


class MirrorImage(NamedTuple):
    """What becomes of an observation if left and right change places."""

    order: th.Tensor  # (size,) the index in an observation of each number of the image
    signs: th.Tensor  # (size,) of each number there


def sensors_of(space: Any) -> tuple[Sensor, ...]:
    """
    Find the sensors of observations by their space.

    :param space: of the observations, a ``Box``; or a :class:`~sb3_torcs.sensors.View`
    :return: rows of the sensor table; empty if the space is of no choice of groups
    """
    view = view_of(space)
    return () if view is None else tuple(chain(*(GROUPS[name] for name in view.sensors)))


def mirror_image(space: Any) -> MirrorImage:
    """
    Describe the mirror image of observations.

    :param space: of the observations, by which their sensors are known; see :func:`sensors_of`
    :return: order and signs
    :raises InvalidOption: if the sensors cannot be known
    """
    rows = sensors_of(space)
    if not rows:
        raise InvalidOption(
            "only observations of Torcs-v0 and TorcsLite-v0 have a known mirror image, and these, "
            f"of shape {getattr(space, 'shape', None)}, are none; take out what changes their "
            "bounds or size, as frame stacks do"
        )
    return _image(rows)


@lru_cache
def _image(rows: tuple[Sensor, ...]) -> MirrorImage:
    order: list[int] = []
    signs: list[float] = []
    for sensor in rows:
        order += [len(order) + index for index in _order(sensor)]
        signs += [-1.0 if sensor.mirror == "opposite" else 1.0] * sensor.size
    return MirrorImage(th.tensor(order), th.tensor(signs, dtype=th.float32))


def mirror_observations(observations: th.Tensor, image: MirrorImage) -> th.Tensor:
    """
    Mirror observations. Mirroring twice gives the same observations.

    :param observations: (n, size) with range finders that look equally far to both sides
    :param image: of their space
    :return: (n, size)
    """
    order, signs = (part.to(observations.device) for part in image)
    return observations[:, order] * signs


def mirror_actions(actions: th.Tensor) -> th.Tensor:
    """
    Steer to the other side. Steering comes first in every layout of the action.

    :param actions: (n, actuators), in the environment's units or scaled to [-1, 1]
    :return: (n, actuators)
    """
    return th.cat((-actions[..., :1], actions[..., 1:]), dim=-1)


def mirror_half(batch: ReplayBufferSamples, image: MirrorImage) -> ReplayBufferSamples:
    """
    Mirror the first half of a batch, whose order is random.

    :param batch: of a replay buffer; left as it is
    :param image: of the space of its observations
    :return: as many transitions
    """
    half = len(batch.actions) // 2

    def seen(whole: th.Tensor) -> th.Tensor:
        return th.cat((mirror_observations(whole[:half], image), whole[half:]))

    return batch._replace(
        observations=seen(batch.observations),
        actions=th.cat((mirror_actions(batch.actions[:half]), batch.actions[half:])),
        next_observations=seen(batch.next_observations),
    )
