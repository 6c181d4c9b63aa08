"""Exploration noises whose parameters are in the environment's own units, per actuator.

Steering is in [-1, 1], throttle and brake in [0, 1]. SB3 adds noise to actions scaled to [-1, 1]
and stores those; the conversion is done here. A noise has its own seeded generator, is saved with
the model, and goes on after a resume with its count of timesteps.
"""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_torcs.actions import ACTION_HIGH, ACTION_LOW
from sb3_torcs.car import FloatArray, is_number
from sb3_torcs.errors import InvalidOption, NoiseNotBound

__all__ = [
    "BLOG",
    "ActuatorNoise",
    "OUNoise",
    "OUParameters",
    "SetPointNoise",
    "StochasticBrake",
    "bind",
    "checked_dt",
    "noises_of",
    "parameters_of",
]

LOW, HIGH = np.array(ACTION_LOW), np.array(ACTION_HIGH)  # [-] steering, throttle, brake
GAIN = 2.0 / (HIGH - LOW)  # [-] SB3's scaled action per environment unit

BRAKE = 2  # index of the actuator


class OUParameters(NamedTuple):
    """The noise of one actuator."""

    mu: float  # [actuator's unit] where the noise pulls: an action or an offset, see the noises
    theta: float  # [1/timestep], or [1/s] with a dt in seconds: how strongly
    sigma: float  # [actuator's unit per root of theta's time] how much chance

    @classmethod
    def of(
        cls,
        value: OUParameters | Sequence[float] | Mapping[str, float],
        actuator: str = "a noise",
    ) -> OUParameters:
        """
        Read the parameters from what a hyperparameter file can hold.

        :param value: ``[mu, theta, sigma]``, or a mapping with these names
        :param actuator: whose noise it is, for the error
        :return: the parameters, checked
        """
        try:
            found = cls(**value) if isinstance(value, Mapping) else cls(*value)
            found = cls(*(float(number) for number in found))
        except (TypeError, ValueError):
            found = cls(np.nan, np.nan, np.nan)
        if not np.isfinite(found).all() or found.theta < 0.0 or found.sigma < 0.0:
            raise InvalidOption(
                f"{actuator} is {value!r}; expected [mu, theta, sigma], or a mapping with these "
                "names: finite numbers, theta and sigma not negative, e.g. [0.0, 0.6, 0.3]"
            )
        return found


def parameters_of(steering: Any, throttle: Any, brake: Any) -> tuple[OUParameters, ...]:
    """
    Read the parameters of all actuators.

    :param steering: as of :meth:`OUParameters.of`
    :param throttle: the same
    :param brake: the same
    :return: of steering, throttle and brake, checked
    """
    values = {"steering": steering, "throttle": throttle, "brake": brake}
    return tuple(OUParameters.of(value, name) for name, value in values.items())


BLOG = (
    OUParameters(mu=0.0, theta=0.6, sigma=0.3),
    OUParameters(mu=0.5, theta=1.0, sigma=0.1),
    OUParameters(mu=-0.1, theta=1.0, sigma=0.05),
)
"""The table of the original post: steering, throttle, brake."""


class StochasticBrake(NamedTuple):
    """Other parameters of the brake's noise, in a share of the timesteps."""

    probability: float  # [-] share of the timesteps
    parameters: OUParameters


class _PolicyWatch:
    """Keeps the last action of a model's actor, by a hook on its forward pass."""

    def __init__(self, model: OffPolicyAlgorithm) -> None:
        self.model = model
        self.last: th.Tensor | None = None
        actor: Any = model.policy.actor
        self.handle = actor.register_forward_hook(self._keep)

    def _keep(self, _module: th.nn.Module, _inputs: Any, output: th.Tensor) -> None:
        # Gradient steps call the actor, too, but with gradients.
        if not th.is_grad_enabled():
            self.last = output

    def warming_up(self) -> bool:
        """Whether SB3 chooses random actions at present, before ``learning_starts``."""
        return self.model.num_timesteps < self.model.learning_starts

    def action(self, index: int) -> FloatArray | None:
        """
        Return the policy's action of the present timestep.

        :param index: which of the parallel environments
        :return: (3,) in environment units, ``None`` before the first timestep
        """
        if self.last is None or index >= len(self.last):
            return None
        scaled = self.last[index].detach().cpu().numpy().astype(np.float64)
        return LOW + (scaled + 1.0) / GAIN


class ActuatorNoise(ActionNoise):
    """
    Base of the two noises.

    ``scale`` multiplies the noise, ``timesteps`` counts those of all parallel environments, and
    ``stochastic_brake`` is :class:`StochasticBrake` or ``None``.

    :param steering: ``[mu, theta, sigma]`` in environment units
    :param throttle: ``[mu, theta, sigma]`` in environment units
    :param brake: ``[mu, theta, sigma]`` in environment units
    :param seed: seed of the noise's own generator; ``None`` is different each time
    """

    def __init__(
        self,
        *,
        steering: OUParameters | Sequence[float] | Mapping[str, float] = BLOG[0],
        throttle: OUParameters | Sequence[float] | Mapping[str, float] = BLOG[1],
        brake: OUParameters | Sequence[float] | Mapping[str, float] = BLOG[2],
        seed: int | None = None,
    ) -> None:
        super().__init__()
        self.parameters = parameters_of(steering, throttle, brake)
        self.scale = 1.0
        self.timesteps = 0
        self.n_envs = 1
        self.stochastic_brake: StochasticBrake | None = None
        self._rng = np.random.default_rng(seed)
        self._watch: _PolicyWatch | None = None
        self._index = 0

    def __call__(self) -> npt.NDArray[np.float32]:
        """
        Draw the noise of one timestep.

        :return: (3,) to add to SB3's scaled action; zeros while SB3 chooses random actions
        """
        self.timesteps += self.n_envs
        if self._watch is not None and self._watch.warming_up():
            return np.zeros(len(GAIN), np.float32)
        mu, theta, sigma = np.array(self._parameters_of_timestep()).T
        noise = self._draw(mu, theta, sigma, self._rng.standard_normal(len(GAIN)))
        return (self.scale * noise * GAIN).astype(np.float32)

    @abstractmethod
    def _draw(
        self, mu: FloatArray, theta: FloatArray, sigma: FloatArray, chance: FloatArray
    ) -> FloatArray:
        """Return the noise (3,) in environment units, from standard normal numbers."""

    def _parameters_of_timestep(self) -> tuple[OUParameters, ...]:
        other = self.stochastic_brake
        if other is None or self._rng.random() >= other.probability:
            return self.parameters
        return (*self.parameters[:BRAKE], other.parameters)

    def attach(self, watch: _PolicyWatch, index: int, n_envs: int) -> None:
        """
        Connect the noise to the policy that it perturbs. Called by :func:`bind`.

        :param watch: sees the policy's actions
        :param index: which of the parallel environments is perturbed
        :param n_envs: number of parallel environments
        """
        self._watch, self._index, self.n_envs = watch, index, n_envs

    def release(self) -> None:
        """Disconnect the noise from the policy."""
        if self._watch is not None:
            self._watch.handle.remove()
        self._watch = None

    def __getstate__(self) -> dict[str, Any]:
        # These belong to the callbacks of one training.
        return {**self.__dict__, "_watch": None, "stochastic_brake": None}

    def __deepcopy__(self, memo: dict[int, Any]) -> ActuatorNoise:
        # SB3 makes the noises of parallel environments by deep copies: each needs a stream of
        # its own. Pickles continue the same stream.
        twin = copy.copy(self)
        memo[id(self)] = twin
        twin._rng = self._rng.spawn(1)[0]
        return twin

    def __repr__(self) -> str:
        counted = f"scale={self.scale}, timesteps={self.timesteps}"
        return f"{type(self).__name__}{self.parameters}, {counted}"


class SetPointNoise(ActuatorNoise):
    """
    The noise of the original code: ``scale * (theta * (mu - a) + sigma * N(0, 1))``.

    It is a function of the policy's present action ``a`` alone: at scale 1 and theta 1
    the car does what ``mu`` says, whatever the policy says. It needs the policy, to which
    :class:`~sb3_torcs.callbacks.NoiseCallback` binds it.
    """

    def _draw(
        self, mu: FloatArray, theta: FloatArray, sigma: FloatArray, chance: FloatArray
    ) -> FloatArray:
        action = None if self._watch is None else self._watch.action(self._index)
        if action is None:
            raise NoiseNotBound(
                "SetPointNoise needs the policy's action, but is not bound to a policy; train with "
                "callback=NoiseCallback(kind='set_point') of sb3_torcs.callbacks, or call "
                "sb3_torcs.noise.bind(model) before learn()"
            )
        return theta * (mu - action) + sigma * chance


class OUNoise(ActuatorNoise):
    """
    The Ornstein-Uhlenbeck process dx = theta (mu - x) dt + sigma dW, added to the policy's action.

    Discretised exactly (Gillespie 1996, doi 10.1103/PhysRevE.54.2084), so that its stationary mean
    ``mu`` and variance ``sigma^2 / (2 theta)`` do not depend on the timestep. ``mu`` is an offset
    here: 0 keeps the actions centred on the policy's. Each episode starts at ``mu``.

    :param dt: duration of one timestep in the unit of 1/theta: 1 timestep, or its seconds
    :param kwargs: as in :class:`ActuatorNoise`
    """

    def __init__(self, *, dt: float = 1.0, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.dt = checked_dt(dt)
        self._state: FloatArray | None = None

    def reset(self) -> None:
        """Begin an episode. Called by SB3."""
        self._state = None

    def _draw(
        self, mu: FloatArray, theta: FloatArray, sigma: FloatArray, chance: FloatArray
    ) -> FloatArray:
        if self._state is None:
            self._state = np.array([parameters.mu for parameters in self.parameters])
        rate = np.maximum(theta, 1e-12)  # a random walk is the limit for theta = 0
        spread = sigma * np.sqrt(-np.expm1(-2.0 * rate * self.dt) / (2.0 * rate))
        self._state = mu + (self._state - mu) * np.exp(-rate * self.dt) + spread * chance
        return self._state


def checked_dt(dt: float) -> float:
    """
    Check the duration of a timestep.

    :param dt: duration of one timestep
    :return: the same
    """
    if not is_number(dt) or dt <= 0.0:
        raise InvalidOption(f"dt={dt!r}: pass a duration above 0, e.g. dt=1.0 (one timestep)")
    return float(dt)


def noises_of(model: Any) -> list[ActuatorNoise]:
    """
    Find the noises of this module in a model.

    :param model: an off-policy algorithm of SB3
    :return: one per parallel environment; none if it has no noise, or one of another kind
    """
    noise = getattr(model, "action_noise", None)
    parts = noise.noises if isinstance(noise, VectorizedActionNoise) else [noise]
    return [part for part in parts if isinstance(part, ActuatorNoise)]


def bind(model: OffPolicyAlgorithm) -> list[ActuatorNoise]:
    """
    Bind a model's noises to its policy. A second call does nothing more.

    :param model: a DDPG, TD3 or SAC whose ``action_noise`` is of this module
    :return: its noises, one per parallel environment
    """
    space = model.action_space
    if not (
        isinstance(space, spaces.Box)
        and np.array_equal(space.low, LOW)
        and np.array_equal(space.high, HIGH)
    ):
        raise InvalidOption(
            f"the noises of sb3_torcs perturb steering, throttle and brake, not {space}; make the "
            "environment with action='pedals', or take a noise of stable_baselines3.common.noise"
        )
    noises = noises_of(model)
    for noise in noises:
        noise.release()
    if noises:
        watch = _PolicyWatch(model)
        for index, noise in enumerate(noises):
            noise.attach(watch, index, len(noises))
    return noises
