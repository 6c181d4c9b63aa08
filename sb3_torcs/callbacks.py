"""Callbacks for stock SB3 and for the hyperparameter files of rl_zoo3: plain values only.

They go by their dotted path, e.g. ``sb3_torcs.callbacks.NoiseCallback: {kind: ou}``.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import (
    BaseCallback,
    EvalCallback,
)
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_torcs.car import checked_start, checked_start_speed, is_count, is_number
from sb3_torcs.driving_metrics import DrivingMetricsCallback, callbacks_in
from sb3_torcs.errors import InvalidOption, near_miss
from sb3_torcs.mirror import mirror_half
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
)
from sb3_torcs.rewards import Reward
from sb3_torcs.sensors import look_both_ways

__all__ = [
    "DrivingMetricsCallback",
    "GradientStepsCallback",
    "MirrorCallback",
    "NoiseCallback",
    "NoiseDecayCallback",
    "RandomStartCallback",
    "RewardCallback",
    "StochasticBrakeCallback",
]

Parameters = Sequence[float] | Mapping[str, float]
"""``[mu, theta, sigma]``, or a mapping with these names, in the environment's units."""

KINDS: dict[str, type[ActuatorNoise]] = {"set_point": SetPointNoise, "ou": OUNoise}


class NoiseCallback(BaseCallback):
    """
    Give the model a noise of :mod:`sb3_torcs.noise`, one stream per parallel environment.

    A model that was saved with such a noise goes on with it: its generator, frames and scale.

    :param kind: ``"set_point"`` (as in the original code) or ``"ou"``
    :param steering: ``[mu, theta, sigma]`` in environment units
    :param throttle: ``[mu, theta, sigma]`` in environment units
    :param brake: ``[mu, theta, sigma]`` in environment units
    :param dt: duration of one decision in the unit of 1/theta, for ``"ou"``
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
        if not isinstance(kind, str) or kind not in KINDS:
            raise InvalidOption(
                f"kind is {kind!r}{near_miss(str(kind), KINDS)} pass 'set_point' or 'ou'"
            )
        self.kind = kind
        self.parameters = tuple(OUParameters.of(value) for value in (steering, throttle, brake))
        self.dt = checked_dt(dt)
        self.seed = seed

    def _on_training_start(self) -> None:
        if not isinstance(self.model, OffPolicyAlgorithm):
            raise InvalidOption(
                f"{type(self.model).__name__} takes no action noise; use NoiseCallback with DDPG, "
                "TD3 or SAC"
            )
        saved = noises_of(self.model)
        if len(saved) != self.model.n_envs or type(saved[0]) is not KINDS[self.kind]:
            noise = self._continued(saved[0]) if saved else self._new()
            n_envs = self.model.n_envs
            self.model.action_noise = noise if n_envs == 1 else VectorizedActionNoise(noise, n_envs)
        for noise in bind(self.model):
            noise.parameters = self.parameters
            if isinstance(noise, OUNoise):
                noise.dt = self.dt

    def _new(self) -> ActuatorNoise:
        seed = self.model.seed if self.seed is None else self.seed
        return KINDS[self.kind](seed=seed)

    def _continued(self, saved: ActuatorNoise) -> ActuatorNoise:
        # Another number of environments goes on with the noise itself, another kind with its count.
        if type(saved) is KINDS[self.kind]:
            return saved
        saved.release()
        noise = self._new()
        noise.frames, noise.scale = saved.frames, saved.scale
        return noise

    def _on_step(self) -> bool:
        return True


class _NoiseUser(BaseCallback):
    """Base of callbacks that steer the noise: finds it before the first step."""

    noises: Sequence[ActuatorNoise] = ()

    def _on_training_start(self) -> None:
        self.noises = ()

    def _on_rollout_start(self) -> None:
        # Only now has every callback's training start been called, whatever their order.
        if self.noises:
            return
        self.noises = noises_of(self.model)
        if not self.noises:
            raise InvalidOption(
                f"{type(self).__name__} steers a noise of sb3_torcs, but the model's action_noise "
                f"is {getattr(self.model, 'action_noise', None)!r}; add NoiseCallback to the "
                "callbacks"
            )
        for noise in self.noises:
            noise.n_envs = len(self.noises)
        self._apply()

    def _apply(self) -> None:
        """Set what does not change during the training."""

    def _on_step(self) -> bool:
        return True


class NoiseDecayCallback(_NoiseUser):
    """
    Let the noise fade linearly. Its frames are counted across resumes.

    :param frames: environment steps until the floor is reached
    :param floor: share of the noise that stays for ever
    :param verbose: as in ``BaseCallback``
    """

    def __init__(self, *, frames: int = 100_000, floor: float = 0.0, verbose: int = 0) -> None:
        super().__init__(verbose)
        if not is_count(frames) or not is_number(floor) or not 0.0 <= floor <= 1.0:
            raise InvalidOption(
                f"frames={frames!r}, floor={floor!r}: pass a whole number of at least 1 frame, and "
                "a floor in [0, 1]"
            )
        self.frames = frames
        self.floor = floor

    def _apply(self) -> None:
        done = min(self.noises[0].frames / self.frames, 1.0)
        scale = 1.0 - (1.0 - self.floor) * done
        for noise in self.noises:
            noise.scale = scale
        self.logger.record("noise/scale", scale)
        self.logger.record("noise/frames", self.noises[0].frames)

    def _on_step(self) -> bool:
        self._apply()
        return True


class StochasticBrakeCallback(_NoiseUser):
    """
    Give the brake other parameters in some of the steps, so that braking is explored at all.

    :param probability: share of the steps
    :param mu: of the brake in these steps, in [0, 1]
    :param theta: of the brake in these steps
    :param sigma: of the brake in these steps
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
            raise InvalidOption(f"probability={probability!r}: pass a share of the steps in [0, 1]")
        self.brake = StochasticBrake(probability, OUParameters.of((mu, theta, sigma)))

    def _apply(self) -> None:
        for noise in self.noises:
            noise.stochastic_brake = self.brake

    def _on_training_end(self) -> None:
        # The model may be trained on without this callback.
        for noise in self.noises:
            noise.stochastic_brake = None


class _SwitchUser(BaseCallback):
    """Base of callbacks that change settings of environments, and give them back at the end."""

    _switches: Sequence[_Switch] = ()

    def _on_training_end(self) -> None:
        for switch in self._switches:
            switch.undo()


class RewardCallback(_SwitchUser):
    """
    Let the training environments give another reward, and log the mean of each of its terms.

    :param reward: name of a reward, or a mapping of terms to weights
    :param also_eval: also in the environments of an ``EvalCallback``, whose score it changes
    :param verbose: as in ``BaseCallback``
    """

    def __init__(
        self, *, reward: str | Mapping[str, float], also_eval: bool = False, verbose: int = 0
    ) -> None:
        super().__init__(verbose)
        Reward(reward)  # or a worker process would have to say what is wrong
        self.reward = reward
        self.also_eval = also_eval

    def _on_training_start(self) -> None:
        envs = [self.training_env]
        if self.also_eval:
            others = callbacks_in(self.locals["callback"])
            envs += [other.eval_env for other in others if isinstance(other, EvalCallback)]
        self._switches = [_Switch(env, "set_reward", self.reward) for env in envs]

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            for term, value in info.get("reward_terms", {}).items():
                self.logger.record_mean(f"reward/{term}", value)
        return True


class RandomStartCallback(_SwitchUser):
    """
    Let training episodes start elsewhere; evaluation keeps its own start.

    The first episode has begun before any callback is called, and keeps the environment's start.

    :param start: ``"random"`` or ``"grid"``
    :param speed: that random starts do not exceed [m/s]; by default the environment's own
    :param verbose: as in ``BaseCallback``
    """

    def __init__(
        self, *, start: str = "random", speed: float | None = None, verbose: int = 0
    ) -> None:
        super().__init__(verbose)
        self.start = checked_start(start)
        self.speed = None if speed is None else checked_start_speed(speed)

    def _on_training_start(self) -> None:
        settings: list[tuple[str, Any]] = [("set_start", self.start)]
        if self.speed is not None:
            settings.append(("set_random_speed", self.speed))
        self._switches = [_Switch(self.training_env, *setting) for setting in settings]

    def _on_step(self) -> bool:
        return True


class _WhileLearning(BaseCallback):
    """
    Base of callbacks that change the algorithm only while it learns.

    That is from the end of a rollout to the beginning of the next: what callbacks save in between
    is unchanged.
    """

    def _on_step(self) -> bool:
        return True

    @abstractmethod
    def _undo(self) -> None:
        """Take back what ``_on_rollout_end`` has changed, if anything."""

    def _on_rollout_start(self) -> None:
        self._undo()

    def _on_training_end(self) -> None:
        self._undo()


class GradientStepsCallback(_WhileLearning):
    """
    Learn more from each decision at the beginning of a training, when there are few.

    A training that goes on with its memory is not at its beginning. Models that callbacks save keep
    their own ``gradient_steps``.

    :param gradient_steps: instead of the model's own, for the first decisions
    :param frames: number of these decisions, of all environments together
    :param verbose: as in ``BaseCallback``
    """

    def __init__(self, *, gradient_steps: int, frames: int, verbose: int = 0) -> None:
        super().__init__(verbose)
        if not is_count(gradient_steps) or not is_count(frames):
            raise InvalidOption(
                f"gradient_steps={gradient_steps!r}, frames={frames!r}: pass whole numbers of at "
                "least 1"
            )
        self.gradient_steps = gradient_steps
        self.frames = frames

    def _on_training_start(self) -> None:
        if not isinstance(self.model, OffPolicyAlgorithm):
            raise InvalidOption(
                f"{type(self).__name__} sets the gradient steps of off-policy algorithms, but the "
                f"model is a {type(self.model).__name__}; take it out of the callbacks"
            )
        self._algorithm, self._own = self.model, self.model.gradient_steps

    def _on_rollout_end(self) -> None:
        memory = self._algorithm.replay_buffer
        remembered = 0 if memory is None else memory.size() * memory.n_envs
        if max(self.num_timesteps, remembered) <= self.frames:
            self._algorithm.gradient_steps = self.gradient_steps

    def _undo(self) -> None:
        self._algorithm.gradient_steps = self._own


class MirrorCallback(_WhileLearning):
    """
    Learn from half of each batch as seen in a mirror, where every bend goes the other way.

    The replay buffer holds what was driven, and is the stock one wherever it is saved.

    :param verbose: as in ``BaseCallback``
    """

    def __init__(self, *, verbose: int = 0) -> None:
        super().__init__(verbose)

    def _on_training_start(self) -> None:
        buffer = getattr(self.model, "replay_buffer", None)
        if not isinstance(buffer, ReplayBuffer):
            raise InvalidOption(
                f"{type(self).__name__} mirrors what a replay buffer holds, and "
                f"{type(self.model).__name__} has none; take it out of the callbacks"
            )
        if self.model.get_vec_normalize_env() is not None:
            raise InvalidOption(
                f"{type(self).__name__} needs observations whose middle is 0, which VecNormalize "
                "moves; take 'normalize' away: the observations are scaled already"
            )
        _require(self.training_env, "range_finder_angles")
        for angles in self.training_env.get_attr("range_finder_angles"):
            if not look_both_ways(angles):
                raise InvalidOption(
                    f"{type(self).__name__} needs range finders that look equally far to both "
                    f"sides, not {np.degrees(angles).round(3).tolist()}; pass 'scr' or 'narrow'"
                )
        self._buffer = buffer

    def _on_rollout_end(self) -> None:
        self._buffer.sample = _MirroredSample(self._buffer)  # type: ignore[method-assign]

    def _undo(self) -> None:
        vars(self._buffer).pop("sample", None)


class _MirroredSample:
    """What a replay buffer's ``sample`` is replaced with."""

    def __init__(self, buffer: ReplayBuffer) -> None:
        self._buffer = buffer

    def __call__(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        return mirror_half(type(self._buffer).sample(self._buffer, batch_size, env))

    def __reduce__(self) -> tuple[Any, ...]:
        # Ctrl-C comes while the algorithm learns; then the buffer is saved, with its own method.
        return partial, (type(self._buffer).sample, self._buffer)


def _require(env: VecEnv, name: str) -> None:
    """Make sure of an attribute. A worker process that lacks it would die of it."""
    if not env.has_attr(name):
        raise InvalidOption(
            f"the environment has no {name}; use Torcs-v0, TorcsLite-v0 or another RacingEnv of "
            "sb3_torcs"
        )


class _Switch:
    """A setting of all environments of a vector, which can be undone once."""

    def __init__(self, env: VecEnv, setter: str, value: Any) -> None:
        _require(env, setter)
        self.env = env
        self.setter = setter
        self.previous: list[Any] = env.env_method(setter, value)

    def undo(self) -> None:
        """Give every environment its own previous value back."""
        for index, value in enumerate(self.previous):
            self.env.env_method(self.setter, value, indices=[index])
        self.previous = []
