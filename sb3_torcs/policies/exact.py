"""Deterministic actions that are the same on all processors.

Processors round sums differently, and a car that is steered slightly differently is elsewhere after
a lap. Actions in double precision, rounded to single, are the same on all of them.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_torcs.car import is_count, is_number
from sb3_torcs.errors import InvalidOption
from sb3_torcs.policies.mirror import mirror_actions, mirror_image, mirror_observations

__all__ = ["ExactDriver", "ExactPolicy", "check_sizes", "checked_decay"]


def check_sizes(net_arch: Any) -> None:
    """
    Check the numbers of hidden units of a policy.

    :param net_arch: as of SB3's policies: a list of sizes, or a mapping to such lists
    :raises InvalidOption: if it is none, or a size is no whole number of at least 1
    """
    # SB3 still takes its older form, a list of one mapping.
    nested = isinstance(net_arch, list) and len(net_arch) == 1 and isinstance(net_arch[0], Mapping)
    said = net_arch[0] if nested else net_arch
    for sizes in said.values() if isinstance(said, Mapping) else [said]:
        if not isinstance(sizes, list | tuple):
            raise InvalidOption(
                f"net_arch={net_arch!r}: {sizes!r} is no list of layer sizes; pass e.g. "
                "net_arch=[300, 600]"
            )
        for size in sizes:
            if not is_count(size):
                raise InvalidOption(
                    f"net_arch={net_arch!r}: {size!r} is no layer size; pass whole numbers >= 1, "
                    "e.g. net_arch=[300, 600]"
                )


def checked_decay(ema_decay: Any) -> float | None:
    """
    Check the share of the average of the weights that an update keeps.

    :param ema_decay: the share, or ``None`` for no average
    :return: the same as a plain number
    :raises InvalidOption: if it is no share
    """
    if ema_decay is not None and not (is_number(ema_decay) and 0.0 <= ema_decay < 1.0):
        raise InvalidOption(
            f"ema_decay={ema_decay!r}: pass a share in [0, 1), e.g. ema_decay=0.9995, or None"
        )
    return None if ema_decay is None else float(ema_decay)


class ExactDriver(nn.Module):
    """
    A copy of the part of a policy that drives, in double precision.

    :param policy: whose spaces it has
    :param features_extractor: of the policy; copied
    :param network: from features to actions; taken over
    :param symmetric: drive the mean of the action and the mirror image of the action in the
        mirrored drive
    """

    def __init__(
        self,
        policy: BasePolicy,
        features_extractor: nn.Module,
        network: nn.Module,
        *,
        symmetric: bool = False,
    ) -> None:
        super().__init__()
        self.observation_space = policy.observation_space
        self.normalize_images = policy.normalize_images
        self.features_extractor = copy.deepcopy(features_extractor)
        self.network = network.double()
        self._image = mirror_image(self.observation_space) if symmetric else None

    def forward(self, observation: PyTorchObs) -> th.Tensor:
        """
        Decide.

        :param observation: (batch, observation)
        :return: (batch, actuators), as the policy scales them
        """
        seen = cast(
            th.Tensor, preprocess_obs(observation, self.observation_space, self.normalize_images)
        )
        actions = self._drive(seen)
        if self._image is not None:
            image = mirror_observations(seen, self._image)
            actions = 0.5 * (actions + mirror_actions(self._drive(image)))
        return actions.float()

    def _drive(self, seen: th.Tensor) -> th.Tensor:
        actions: th.Tensor = self.network(self.features_extractor(seen).double())
        return actions


class ExactPolicy(BasePolicy):
    """
    A policy that drives exactly whenever ``predict`` is ``deterministic``.

    It keeps the copy that drives until a parameter changes. PyTorch does not tell of changes within
    ``parameter.data``: after them call ``set_training_mode(True)``.
    """

    _exact: tuple[list[int], ExactDriver] | None = None

    @property
    def driver(self) -> nn.Module:
        """The part of the policy that drives when ``predict`` is deterministic."""
        return self

    def exact_driver(self) -> ExactDriver:
        """Return a copy of what drives when ``predict`` is deterministic."""
        raise NotImplementedError

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        if not deterministic:
            return super()._predict(observation, deterministic)  # type: ignore[safe-super]
        versions = [
            number
            for own in self.driver.parameters()
            for number in (id(own), own.data_ptr(), own._version)
        ]
        if self._exact is None or self._exact[0] != versions:
            self._exact = (versions, self.exact_driver())
        actions: th.Tensor = self._exact[1](observation)
        return actions

    def load_from_vector(self, vector: np.ndarray) -> None:
        """
        Set all parameters.

        :param vector: as of SB3's ``parameters_to_vector``
        """
        super().load_from_vector(vector)
        self._exact = None  # new values may lie where older ones lay

    def set_training_mode(self, mode: bool) -> None:
        """
        Switch between training and prediction; visit the modules only if something changes.

        :param mode: ``True`` to train
        """
        if mode:
            self._exact = None  # lean updates leave the versions as they were
        if mode != self.training:
            super().set_training_mode(mode)
