"""Callbacks that change how a training learns: more gradient steps, mirrored samples."""

from __future__ import annotations

from abc import abstractmethod
from functools import partial
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_torcs.callbacks.switches import require_method
from sb3_torcs.car import is_count
from sb3_torcs.errors import InvalidOption, renamed
from sb3_torcs.policies.mirror import mirror_half
from sb3_torcs.sensors import look_both_ways

__all__ = ["GradientStepsCallback", "MirrorCallback"]


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
    Learn more from each timestep at the beginning of a training, when there are few.

    A training that goes on with its replay buffer is not at its beginning. Models that callbacks
    save keep their own ``gradient_steps``.

    :param gradient_steps: instead of the model's own, for the first timesteps
    :param timesteps: number of these timesteps, of all environments together
    :param verbose: as in ``BaseCallback``
    """

    @renamed(frames="timesteps")
    def __init__(self, *, gradient_steps: int, timesteps: int, verbose: int = 0) -> None:
        super().__init__(verbose)
        if not is_count(gradient_steps) or not is_count(timesteps):
            raise InvalidOption(
                f"gradient_steps={gradient_steps!r}, timesteps={timesteps!r}: pass whole "
                "numbers of at least 1"
            )
        self.gradient_steps = gradient_steps
        self.timesteps = timesteps

    def _on_training_start(self) -> None:
        if not isinstance(self.model, OffPolicyAlgorithm):
            raise InvalidOption(
                f"{type(self).__name__} sets the gradient steps of off-policy algorithms, but the "
                f"model is a {type(self.model).__name__}; take it out of the callbacks"
            )
        self._algorithm, self._own = self.model, self.model.gradient_steps

    def _on_rollout_end(self) -> None:
        buffer = self._algorithm.replay_buffer
        remembered = 0 if buffer is None else buffer.size() * buffer.n_envs
        if max(self.num_timesteps, remembered) <= self.timesteps:
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
        require_method(self.training_env, "range_finder_angles")
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
