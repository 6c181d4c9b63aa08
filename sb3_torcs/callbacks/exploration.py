"""Callbacks for exploration: the action noise, its decay, and the stochastic brake."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_torcs.car import check_count, checked_choice, is_number
from sb3_torcs.errors import InvalidOption
from sb3_torcs.noise import (
    BLOG,
    ActuatorNoise,
    OUNoise,
    OUParameters,
    SetPointNoise,
    StochasticBrake,
    bind,
    checked_dt,
    noises_of,
    parameters_of,
)

__all__ = [
    "NoiseCallback",
    "NoiseDecayCallback",
    "StochasticBrakeCallback",
]

Parameters = Sequence[float] | Mapping[str, float]
"""``[mu, theta, sigma]``, or a mapping with these names, in the environment's units."""

KINDS: dict[str, type[ActuatorNoise]] = {"set_point": SetPointNoise, "ou": OUNoise}


class NoiseCallback(BaseCallback):
    """
    Give the model a noise of :mod:`sb3_torcs.noise`, one stream per parallel environment.

    Use it with DDPG and TD3, which explore by noise alone.

    A model that was saved with such a noise continues with its generator, count and scale.

    :param kind: ``"set_point"`` (as in the original code) or ``"ou"``
    :param steering: ``[mu, theta, sigma]`` in environment units
    :param throttle: ``[mu, theta, sigma]`` in environment units
    :param brake: ``[mu, theta, sigma]`` in environment units
    :param dt: duration of one timestep in the unit of 1/theta, for ``"ou"``
    :param seed: of a new noise; by default the model's own
    :param verbose: as in ``BaseCallback``
    """

    def __init__(
        self,
        *,
        kind: str = "set_point",
        steering: Parameters = BLOG[0],
        throttle: Parameters = BLOG[1],
        brake: Parameters = BLOG[2],
        dt: float = 1.0,
        seed: int | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        self.kind = checked_choice("kind", kind, KINDS)
        self.parameters = parameters_of(steering, throttle, brake)
        self.dt = checked_dt(dt)
        if seed is not None:
            check_count("seed", seed, least=0)
        self.seed = seed

    def _on_training_start(self) -> None:
        model = _with_noise(self)
        saved = noises_of(model)
        n_envs = model.n_envs
        if len(saved) != n_envs or type(saved[0]) is not KINDS[self.kind]:
            noise = self._continued(saved[0]) if saved else self._new()
            model.action_noise = noise if n_envs == 1 else VectorizedActionNoise(noise, n_envs)
        for noise in bind(model):
            noise.parameters = self.parameters
            noise.stochastic_brake = None  # of a training that an error has ended
            if isinstance(noise, OUNoise):
                noise.dt = self.dt

    def _new(self) -> ActuatorNoise:
        seed = self.model.seed if self.seed is None else self.seed
        return KINDS[self.kind](seed=seed)

    def _continued(self, saved: ActuatorNoise) -> ActuatorNoise:
        # Another number of environments continues the noise, another kind only its count.
        if type(saved) is KINDS[self.kind]:
            return saved
        saved.release()
        noise = self._new()
        noise.timesteps, noise.scale = saved.timesteps, saved.scale
        return noise

    def _on_step(self) -> bool:
        return True


def _with_noise(callback: BaseCallback) -> OffPolicyAlgorithm:
    """Return the algorithm of a callback, which has to add a noise to its actions."""
    if not isinstance(callback.model, OffPolicyAlgorithm):
        raise InvalidOption(
            f"{type(callback.model).__name__} takes no action noise; use "
            f"{type(callback).__name__} with DDPG, TD3 or SAC"
        )
    return callback.model


class _NoiseUser(BaseCallback):
    """Base of callbacks that change the noise, which they find before the first timestep."""

    noises: Sequence[ActuatorNoise] = ()

    def _on_training_start(self) -> None:
        _with_noise(self)
        self.noises = ()

    def _on_rollout_start(self) -> None:
        # Not at the training's start: NoiseCallback may come later in the list.
        if self.noises:
            return
        self.noises = noises_of(self.model)
        if not self.noises:
            raise InvalidOption(
                f"{type(self).__name__} changes a noise of sb3_torcs, but the model's action_noise "
                f"is {getattr(self.model, 'action_noise', None)!r}; add NoiseCallback to the "
                "callbacks"
            )
        for noise in self.noises:
            noise.n_envs = len(self.noises)
        self._apply()

    def _apply(self) -> None:
        """Change the noise, before the first timestep of a training."""

    def _on_step(self) -> bool:
        return True


class NoiseDecayCallback(_NoiseUser):
    """
    Reduce the noise linearly. Its timesteps are counted across resumes.

    Use it with :class:`NoiseCallback`, so that the agent drives more and more as it will race.

    :param timesteps: after which the floor is reached, of all environments together
    :param floor: share of the noise that remains
    :param verbose: as in ``BaseCallback``
    """

    def __init__(self, *, timesteps: int = 100_000, floor: float = 0.0, verbose: int = 0) -> None:
        super().__init__(verbose)
        check_count("timesteps", timesteps)
        if not is_number(floor) or not 0.0 <= floor <= 1.0:
            raise InvalidOption(f"floor is {floor!r}; expected a share from 0 to 1")
        self.timesteps = timesteps
        self.floor = floor

    def _apply(self) -> None:
        done = min(self.noises[0].timesteps / self.timesteps, 1.0)
        scale = 1.0 - (1.0 - self.floor) * done
        for noise in self.noises:
            noise.scale = scale
        self.logger.record("noise/scale", scale)
        self.logger.record("noise/timesteps", self.noises[0].timesteps)

    def _on_step(self) -> bool:
        self._apply()
        return True


class StochasticBrakeCallback(_NoiseUser):
    """
    Give the brake other parameters in some of the timesteps, so that braking is explored at all.

    Use it when an agent with separate pedals never learns to brake, as in the original post.

    :param probability: share of the timesteps
    :param mu: of the brake in these timesteps, in [0, 1]
    :param theta: of the brake in these timesteps
    :param sigma: of the brake in these timesteps
    :param verbose: as in ``BaseCallback``
    """

    def __init__(
        self,
        *,
        probability: float = 0.1,
        mu: float = 0.2,
        theta: float = 1.0,
        sigma: float = 0.1,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        if not is_number(probability) or not 0.0 <= probability <= 1.0:
            raise InvalidOption(
                f"probability={probability!r}: pass a share of the timesteps in [0, 1]"
            )
        if not is_number(mu) or not 0.0 <= mu <= 1.0:
            raise InvalidOption(f"mu is {mu!r}; expected how far to brake, from 0 to 1")
        self.brake = StochasticBrake(probability, OUParameters.of((mu, theta, sigma), "brake"))

    def _apply(self) -> None:
        for noise in self.noises:
            noise.stochastic_brake = self.brake

    def _on_training_end(self) -> None:
        # The model may be trained further without this callback.
        for noise in self.noises:
            noise.stochastic_brake = None
