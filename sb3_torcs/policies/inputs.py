"""What the networks of a policy see of an observation, and how large its numbers are there.

Only the actor drives, so a critic may see what the driver must not know: an asymmetric actor-critic
(Pinto et al., 2018, arXiv:1710.06542).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_torcs.car import is_number
from sb3_torcs.errors import InvalidOption, near_miss
from sb3_torcs.sensors import GROUPS, SensorsName, View, checked_sensors, feature_slices, view_of

__all__ = ["SensorInputs", "checked_scale", "columns_of"]


class SensorInputs(BaseFeaturesExtractor):
    """
    Takes the numbers of some groups of sensors out of an observation, and scales them.

    :param observation_space: of ``Torcs-v0`` or ``TorcsLite-v0``
    :param sensors: names of groups, ``"base"`` among them; ``None`` takes all that there are
    :param scale: factors on the numbers of sensors, by the sensor's name, as
        :func:`checked_scale` returns them; sensors that the observation lacks do not matter
    :raises InvalidOption: if observations have no such groups
    """

    columns: th.Tensor
    factors: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        sensors: Sequence[SensorsName] | None = None,
        scale: Mapping[str, float] | None = None,
    ) -> None:
        option = "input_scale" if sensors is None else f"actor_sensors={list(sensors)!r}"
        view = _view(observation_space, option)
        columns = columns_of(observation_space, view.sensors if sensors is None else sensors)
        super().__init__(observation_space, len(columns))
        factors = th.ones(view.size)
        for name, where in feature_slices(view.sensors).items():
            factors[where] = (scale or {}).get(name, 1.0)
        self.register_buffer("columns", th.tensor(columns), persistent=False)
        self.register_buffer("factors", factors[columns], persistent=False)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        Leave out the other groups, and scale.

        :param observations: (batch, numbers of all groups)
        :return: (batch, numbers of the chosen groups)
        """
        return observations[:, self.columns] * self.factors


def checked_scale(given: Any) -> dict[str, float] | None:
    """
    Check factors on the numbers of sensors.

    :param given: factors above 0, by the sensor's name in the table; ``None`` for none
    :return: the same as plain numbers
    :raises InvalidOption: if a name is unknown, or a factor no positive number
    """
    if given is None:
        return None
    example = 'pass factors by the names of sensors, e.g. input_scale={"wheel_speeds": 0.3}'
    if not isinstance(given, Mapping):
        raise InvalidOption(f"input_scale={given!r}; {example}")
    known = [sensor.name for rows in GROUPS.values() for sensor in rows]
    for name, factor in given.items():
        if name not in known:
            raise InvalidOption(f"input_scale names {name!r}{near_miss(name, known, example)}")
        if not (is_number(factor) and 0.0 < factor < np.inf):
            raise InvalidOption(
                f"input_scale={{{name!r}: {factor!r}}}: a factor is a number above 0; {example}"
            )
    return {name: float(factor) for name, factor in given.items()}


def columns_of(observation_space: spaces.Space[Any], sensors: Sequence[SensorsName]) -> list[int]:
    """
    Find where the numbers of groups of sensors stand in an observation.

    :param observation_space: of ``Torcs-v0`` or ``TorcsLite-v0``
    :param sensors: names of groups, ``"base"`` among them
    :return: their indices
    :raises InvalidOption: if observations have no such groups
    """
    wanted = checked_sensors(sensors)
    view = _view(observation_space, f"actor_sensors={list(wanted)!r}")
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


def _view(observation_space: spaces.Space[Any], option: str) -> View:
    """Find which groups of sensors observations have, for an option that needs to know it."""
    view = view_of(observation_space)
    if view is None:
        name = option.partition("=")[0]
        raise InvalidOption(
            f"{option}: these observations, of shape {observation_space.shape}, are none of "
            "Torcs-v0 and TorcsLite-v0; take out what changes their bounds or size, as frame "
            f"stacks do, or leave {name} out"
        )
    return view
