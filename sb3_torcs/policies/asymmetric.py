"""Actors that see less than their critics.

Only the actor drives, so a critic may see what the driver must not know: an asymmetric actor-critic
(Pinto et al., 2018, arXiv:1710.06542).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_torcs.errors import InvalidOption
from sb3_torcs.sensors import GROUPS, SensorsName, checked_sensors, feature_slices, view_of

__all__ = ["ActorSensors", "columns_of"]


class ActorSensors(BaseFeaturesExtractor):
    """
    Takes the numbers of some groups of sensors out of an observation.

    :param observation_space: of ``Torcs-v0`` or ``TorcsLite-v0``
    :param sensors: names of groups, ``"base"`` among them
    :raises InvalidOption: if observations have no such groups
    """

    columns: th.Tensor

    def __init__(
        self, observation_space: spaces.Space[Any], sensors: Sequence[SensorsName]
    ) -> None:
        columns = columns_of(observation_space, sensors)
        super().__init__(observation_space, len(columns))
        self.register_buffer("columns", th.tensor(columns), persistent=False)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        Leave out the other groups.

        :param observations: (batch, numbers of all groups)
        :return: (batch, numbers of the chosen groups)
        """
        return observations[:, self.columns]


def columns_of(observation_space: spaces.Space[Any], sensors: Sequence[SensorsName]) -> list[int]:
    """
    Find where the numbers of groups of sensors stand in an observation.

    :param observation_space: of ``Torcs-v0`` or ``TorcsLite-v0``
    :param sensors: names of groups, ``"base"`` among them
    :return: their indices
    :raises InvalidOption: if observations have no such groups
    """
    wanted = checked_sensors(sensors)
    view = view_of(observation_space)
    if view is None:
        raise InvalidOption(
            f"actor_sensors={list(wanted)!r}: these observations, of shape "
            f"{observation_space.shape}, are none of Torcs-v0 and TorcsLite-v0; take out what "
            "changes their bounds or size, as frame stacks do, or leave actor_sensors out"
        )
    absent = [name for name in wanted if name not in view.sensors]
    if absent:
        raise InvalidOption(
            f"actor_sensors={list(wanted)!r}: the environment gives {list(view.sensors)!r}; "
            f"give it {', '.join(map(repr, absent))}, too, or leave it out here"
        )
    where = feature_slices(view.sensors)
    chosen = [where[sensor.name] for name in wanted for sensor in GROUPS[name]]
    columns: list[int] = np.r_[tuple(chosen)].tolist()
    return columns
