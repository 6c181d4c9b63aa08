"""A policy for PPO and A2C whose mean action always lies within the action space.

SB3's own mean has no bounds, and an action beyond them is clipped. So a mean can drift to where
every draw is full throttle: then no draw brakes, and PPO never learns that it should.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    FlattenExtractor,
    MlpExtractor,
)
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_torcs.car import checked_flag
from sb3_torcs.errors import InvalidOption
from sb3_torcs.policies.exact import ExactDriver, ExactPolicy, check_sizes, checked_decay
from sb3_torcs.policies.inputs import SensorInputs, checked_scale
from sb3_torcs.policies.mirror import (
    check_symmetric,
    mirror_actions,
    mirror_image,
    mirror_observations,
)
from sb3_torcs.policies.networks import ActorAverage
from sb3_torcs.sensors import SensorsName, checked_sensors

__all__ = ["BothWays", "BoundedHead", "BoundedPolicy", "MeanOfBoth"]

LARGEST_LOG_STD = 20

PARTS_ELSEWHERE = ("actor", "lstm_actor")
"""Parts that the policies of other algorithms have, which ask for them first."""


class _WrongAlgorithm(InvalidOption, AttributeError):
    """Also an AttributeError, so that ``hasattr`` may ask."""

    def __init__(self) -> None:
        super().__init__(
            "BoundedPolicy is a policy of PPO and A2C; give DDPG and TD3 SplitHeadPolicy, SAC, "
            'TQC and CrossQ their own "MlpPolicy", and RecurrentPPO "MlpLstmPolicy"'
        )


class BothWays(BaseFeaturesExtractor):
    """
    Extracts the features of an observation, and those of its mirror image.

    :param extractor: of features
    :param space: of observations that have a mirror image
    """

    def __init__(self, extractor: BaseFeaturesExtractor, space: spaces.Space[Any]) -> None:
        super().__init__(space, extractor.features_dim)
        self.extractor = extractor
        self._image = mirror_image(space)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        Extract.

        :param observations: (batch, numbers)
        :return: (batch, 2, features)
        """
        ways = observations, mirror_observations(observations, self._image)
        return th.stack([self.extractor(way) for way in ways], dim=1)


class MeanOfBoth(nn.Module):
    """Takes the mean of what became of an observation, and of its mirror image."""

    def forward(self, latent: th.Tensor) -> th.Tensor:
        """
        Take the mean.

        :param latent: (batch, 2, units)
        :return: (batch, units)
        """
        return latent.mean(dim=1)


class BoundedHead(nn.Module):
    """
    A layer whose outputs lie within bounds: middle + half of the range × tanh.

    :param linear: the layer before tanh
    :param space: of actions, with finite bounds
    :param symmetric: give the mean of the action, and of the mirror image of that of the mirrored
        drive
    """

    middle: th.Tensor
    reach: th.Tensor

    def __init__(self, linear: nn.Linear, space: spaces.Box, *, symmetric: bool = False) -> None:
        super().__init__()
        self.linear, self.symmetric = linear, symmetric
        for name, value in (
            ("middle", 0.5 * (space.high + space.low)),
            ("reach", 0.5 * (space.high - space.low)),
        ):
            flat = th.from_numpy(value.reshape(-1).astype(np.float32))
            self.register_buffer(name, flat, persistent=False)

    def forward(self, latent: th.Tensor) -> th.Tensor:
        """
        Compute mean actions.

        :param latent: (batch, inputs of the layer), or if symmetric (batch, 2, inputs)
        :return: (batch, actuators), within the bounds
        """
        actions = self.middle + self.reach * th.tanh(self.linear(latent))
        if not self.symmetric:
            return actions
        return 0.5 * (actions[:, 0] + mirror_actions(actions[:, 1]))


class BoundedPolicy(ExactPolicy, ActorCriticPolicy):
    """
    SB3's ``ActorCriticPolicy`` for a Gaussian whose mean has the bounds of the action space.

    :param observation_space: as in ``ActorCriticPolicy``
    :param action_space: a ``Box`` with finite bounds
    :param lr_schedule: as in ``ActorCriticPolicy``
    :param log_std_init: as in ``ActorCriticPolicy``, or one number per actuator, -20 to 20
    :param actor_sensors: groups of sensors that the actor sees, ``"base"`` among them, while the
        value function sees all that the environment gives; ``None`` is all for both
    :param input_scale: factors on the numbers of sensors before both networks see them, by the
        sensor's name (:class:`~sb3_torcs.sensors.Sensor`), e.g. ``{"wheel_speeds": 0.3}``; sensors
        that are not named, or not seen, stay as they are. Adam changes each weight by about as
        much, so large numbers are learned from fast and coarsely, and small ones slowly
    :param symmetric: drive and learn left and right bends alike: the mean of the Gaussian is that
        of an observation and of its mirror image, turned back, and so is the value. It needs
        observations whose middle is 0 (no ``VecNormalize``), and range finders with the same angles
        on both sides
    :param ema_decay: if given, a running average of the actor's weights drives in its place
        whenever ``predict`` is ``deterministic``, as in evaluations; each update keeps this share
        of the average, e.g. 0.999. Training is the same to the bit without it
    :param kwargs: the other arguments of ``ActorCriticPolicy``, but for ``use_sde``
    :raises InvalidOption: if the action space has no bounds, if ``net_arch``, ``log_std_init``,
        ``input_scale`` or ``ema_decay`` has other numbers, if observations lack one of
        ``actor_sensors``, or a mirror image that ``symmetric`` needs, with ``use_sde``, with
        ``features_extractor_class`` beside ``actor_sensors`` or ``input_scale``, or if the
        algorithm is neither PPO nor A2C
    """

    action_net: BoundedHead

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        log_std_init: float | Sequence[float] = 0.0,
        actor_sensors: Sequence[SensorsName] | None = None,
        input_scale: Mapping[str, float] | None = None,
        symmetric: bool = False,
        ema_decay: float | None = None,
        **kwargs: Any,
    ) -> None:
        if "n_critics" in kwargs:  # DDPG gives it
            raise _WrongAlgorithm
        if not isinstance(action_space, spaces.Box) or not action_space.is_bounded():
            raise InvalidOption(
                f"BoundedPolicy needs a Box of actions with finite bounds, not {action_space}; "
                "use MlpPolicy"
            )
        if kwargs.get("use_sde"):
            raise InvalidOption("BoundedPolicy has no use_sde; leave it out, or use MlpPolicy")
        check_sizes([] if kwargs.get("net_arch") is None else kwargs["net_arch"])
        self._first_log_std = _log_std(log_std_init, get_action_dim(action_space))
        self.symmetric = checked_flag("symmetric", symmetric)
        check_symmetric(self.symmetric, observation_space, action_space)
        self.ema_decay = checked_decay(ema_decay)
        self.input_scale = checked_scale(input_scale)
        self.actor_sensors = None
        if actor_sensors is not None:
            self.actor_sensors = checked_sensors(actor_sensors, "actor_sensors")
            kwargs["share_features_extractor"] = False
        _check_extractor(kwargs, actor_sensors=actor_sensors, input_scale=input_scale)
        super().__init__(observation_space, action_space, lr_schedule, **kwargs)
        self.log_std_init = self._first_log_std  # type: ignore[assignment]  # for copies of it

    def _build(self, lr_schedule: Schedule) -> None:
        """Make the networks as SB3 does, and bound the mean."""
        super()._build(lr_schedule)
        with th.no_grad():
            self.log_std.copy_(th.as_tensor(self._first_log_std))
        assert isinstance(self.action_space, spaces.Box)
        linear: Any = self.action_net
        self.action_net = BoundedHead(linear, self.action_space, symmetric=self.symmetric)
        self.average: ActorAverage | None = None
        if self.ema_decay is not None:
            self.average = ActorAverage(self._actor(), self.ema_decay)
            self.average.follow(self._actor(), self.optimizer)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Become a copy, whose average follows it."""
        super().__setstate__(state)
        if self.average is not None:
            self.average.follow(self._actor(), self.optimizer)

    def _actor(self) -> nn.Sequential:
        """Return the layers of the actor that learns."""
        return nn.Sequential(self.mlp_extractor.policy_net, self.action_net)

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """Make what extracts features as SB3 does, or scales them; both ways if symmetric."""
        if self.input_scale is None:
            return self._both_ways(super().make_features_extractor())
        return self._both_ways(SensorInputs(self.observation_space, scale=self.input_scale))

    def _both_ways(self, extractor: BaseFeaturesExtractor) -> BaseFeaturesExtractor:
        return BothWays(extractor, self.observation_space) if self.symmetric else extractor

    def _build_mlp_extractor(self) -> None:
        """Make the hidden layers as SB3 does, those of the actor for what it sees."""
        super()._build_mlp_extractor()
        if self.actor_sensors is not None:
            seen = SensorInputs(self.observation_space, self.actor_sensors, self.input_scale)
            self.pi_features_extractor = self._both_ways(seen)
            actor = MlpExtractor(
                seen.features_dim,
                self.net_arch,
                self.activation_fn,
                self.device,
            )
            self.mlp_extractor.policy_net = actor.policy_net
            self.mlp_extractor.latent_dim_pi = actor.latent_dim_pi
        if self.symmetric:
            self.mlp_extractor.value_net.append(MeanOfBoth())

    def __getattr__(self, name: str) -> Any:
        """Find a part as PyTorch does, and tell an algorithm that this policy is not for it."""
        if name in PARTS_ELSEWHERE:
            raise _WrongAlgorithm
        return super().__getattr__(name)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        names = ("actor_sensors", "input_scale", "symmetric", "ema_decay")
        own = {name: getattr(self, name) for name in names}
        return {**super()._get_constructor_parameters(), **own}

    def exact_driver(self) -> ExactDriver:
        """Return a copy of what gives the mean action, which drives if it is deterministic."""
        actor: Any = self._actor()
        if self.average is not None and self.average.has_begun:
            actor = self.average.module
        return ExactDriver(self, self.pi_features_extractor, copy.deepcopy(actor))


def _check_extractor(kwargs: Mapping[str, Any], **chosen: Any) -> None:
    """Check that no extractor of one's own meets options that choose and scale the numbers."""
    extractor = kwargs.get("features_extractor_class", FlattenExtractor)
    taken = [name for name, option in chosen.items() if option is not None]
    if taken and extractor is not FlattenExtractor:
        options = " and ".join(taken)
        raise InvalidOption(
            f"features_extractor_class={extractor!r} with {options}: leave out "
            f"features_extractor_class, or {options}, which would replace it"
        )


def _log_std(given: Any, actuators: int) -> float | list[float]:
    """Check the logarithms of standard deviations, and return them as plain numbers."""
    try:
        numbers = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    if numbers.size not in (1, actuators) or numbers.ndim > 1:
        raise InvalidOption(
            f"log_std_init has shape {numbers.shape}; expected one number, or ({actuators},), one "
            "per actuator"
        )
    if not (np.abs(numbers) <= LARGEST_LOG_STD).all():
        raise InvalidOption(
            f"log_std_init is {given!r}; expected numbers from {-LARGEST_LOG_STD} to "
            f"{LARGEST_LOG_STD}, e.g. -1.0"
        )
    plain: float | list[float] = numbers.tolist()
    return plain


BoundedPolicy.__module__ = "sb3_torcs.policies"  # which hyperparameter files name
