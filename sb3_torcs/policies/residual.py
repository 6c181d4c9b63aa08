"""A policy for PPO that drives as a given driver, and otherwise only near other cars.

"Residual Policy Learning" (Silver et al., arXiv:1812.06298) adds what is learned to a controller
that stays as it is. Here a gate multiplies what is added: a driver of laps that becomes a racer
drives as before wherever it is alone, so that learning to race cannot cost it pace.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_torcs.car import is_count
from sb3_torcs.errors import InvalidOption
from sb3_torcs.policies.bounded import BoundedPolicy

__all__ = ["GatedSum", "ResidualPolicy"]

STEEPNESS = 5.0  # [-] of the gate: it is half open where its features' sizes add up to 0.11


class GatedSum(nn.Module):
    """
    The outputs of a driver, which does not learn, and of a correction behind a gate.

    The gate is tanh(5 · Σ|f|) of its features f: shut where all of them are 0, open from 0.5 on.

    :param driver: from the first features to outputs
    :param correction: from all features to as many outputs
    :param gate_features: number of last features, which open the gate
    """

    def __init__(
        self, driver: nn.Sequential, correction: nn.Sequential, gate_features: int
    ) -> None:
        super().__init__()
        self.driver = driver.requires_grad_(False)
        self.correction = correction
        self.gate_features = gate_features

    def forward(self, features: th.Tensor) -> th.Tensor:
        """
        Compute the sum. It equals the driver's outputs, to the bit, where the gate is shut.

        :param features: (batch, features)
        :return: (batch, outputs)
        """
        of_driver = features.shape[1] - self.gate_features
        seen, opening = features.split([of_driver, self.gate_features], dim=1)
        gate = th.tanh(STEEPNESS * opening.abs().sum(dim=1, keepdim=True))
        outputs: th.Tensor = self.driver(seen) + gate * self.correction(features)
        return outputs


class ResidualPolicy(BoundedPolicy):
    """
    A ``BoundedPolicy`` whose mean is middle + half of the range × tanh(driver + gate · correction).

    The driver does not see the last features, and does not learn. These features open the gate; see
    :class:`GatedSum`. The correction begins with 0 for its outputs. ``net_arch`` describes its
    hidden layers, and those of the value function.

    :param observation_space: as in ``BoundedPolicy``
    :param action_space: as in ``BoundedPolicy``
    :param lr_schedule: as in ``BoundedPolicy``
    :param log_std_init: as in ``BoundedPolicy``
    :param gate_features: number of last features, at least 1: 24 for the sensors ``rivals``
    :param driver_arch: units of the driver's hidden layers, with ``activation_fn`` in between
    :param kwargs: the other arguments of ``BoundedPolicy``
    :raises InvalidOption: if ``gate_features`` is not a number of features
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        log_std_init: float | Sequence[float] = 0.0,
        gate_features: int = 24,
        driver_arch: Sequence[int] = (128, 128),
        **kwargs: Any,
    ) -> None:
        features = spaces.flatdim(observation_space)
        if not is_count(gate_features) or gate_features >= features:
            raise InvalidOption(
                f"gate_features is {gate_features!r}; expected a whole number from 1 to "
                f"{features - 1}, of {features} features"
            )
        self._gate_features, self._driver_arch = gate_features, list(driver_arch)
        super().__init__(observation_space, action_space, lr_schedule, log_std_init, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        """Put the sum in the place of the policy's layers."""
        super()._build(lr_schedule)
        outputs, seen = self.action_net.linear.out_features, self.features_dim - self._gate_features
        correction = nn.Sequential(*self.mlp_extractor.policy_net, self.action_net.linear)
        for own in self.action_net.linear.parameters():
            nn.init.zeros_(own)
        driver = nn.Sequential(*create_mlp(seen, outputs, self._driver_arch, self.activation_fn))
        summed = GatedSum(driver, correction, self._gate_features)
        self.mlp_extractor.policy_net = summed  # type: ignore[assignment]
        self.action_net.linear = nn.Identity()  # type: ignore[assignment]
        learning = [own for own in self.parameters() if own.requires_grad]
        self.optimizer = self.optimizer_class(learning, lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {"gate_features": self._gate_features, "driver_arch": self._driver_arch}
        return {**super()._get_constructor_parameters(), **own}

    def follow(self, policy: BoundedPolicy) -> None:
        """
        Take over a driver.

        :param policy: that drives, with layers as ``driver_arch`` and ``activation_fn`` describe
        :raises InvalidOption: if its layers are others
        """
        given = nn.Sequential(*policy.mlp_extractor.policy_net, policy.action_net.linear)
        driver = cast(GatedSum, self.mlp_extractor.policy_net).driver
        if str(given) != str(driver):
            raise InvalidOption(
                f"the driver is a {given}, but this policy is made for a {driver}; change "
                "driver_arch, activation_fn or gate_features"
            )
        driver.load_state_dict(given.state_dict())


ResidualPolicy.__module__ = "sb3_torcs.policies"  # which model files name
