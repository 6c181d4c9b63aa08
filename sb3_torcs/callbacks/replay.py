"""What the shipped entries of DDPG and TD3 change: gradient steps, and mirrored batches."""

from __future__ import annotations

from functools import partial
from typing import Any

from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_torcs.callbacks.learning import WhileLearning, end_changes
from sb3_torcs.callbacks.tree import require_method
from sb3_torcs.car import check_count
from sb3_torcs.errors import InvalidOption
from sb3_torcs.policies.mirror import check_angles, mirror_image
from sb3_torcs.policies.mirrored_replay import sample_mirrored

__all__ = ["GradientStepsCallback", "MirrorCallback"]


class GradientStepsCallback(WhileLearning):
    """
    Take more gradient steps at the beginning of a training, when there are few timesteps.

    A resumed training with its replay buffer counts as past its beginning. Models that callbacks
    save keep their own ``gradient_steps``.

    :param gradient_steps: replace the model's own at the beginning
    :param timesteps: length of the beginning, of all environments together
    :param verbose: as in ``BaseCallback``
    """

    def __init__(self, *, gradient_steps: int, timesteps: int, verbose: int = 0) -> None:
        super().__init__(verbose)
        check_count("gradient_steps", gradient_steps)
        check_count("timesteps", timesteps)
        self.gradient_steps = gradient_steps
        self.timesteps = timesteps

    def _on_training_start(self) -> None:
        if not isinstance(self.model, OffPolicyAlgorithm):
            raise InvalidOption(
                f"{type(self).__name__} sets the gradient steps of off-policy algorithms, but the "
                f"model learns by {type(self.model).__name__}; take it out of the callbacks"
            )
        end_changes(self.model)  # of a training that an error has ended
        self._algorithm, self._own = self.model, self.model.gradient_steps

    def _on_rollout_end(self) -> None:
        super()._on_rollout_end()
        # At once: the algorithm reads it before it calls `train`.
        buffer = self._algorithm.replay_buffer
        remembered = 0 if buffer is None else buffer.size() * buffer.n_envs
        if max(self.num_timesteps, remembered) <= self.timesteps:
            self._algorithm.gradient_steps = self.gradient_steps

    def _change(self) -> None:
        """Do nothing: the steps were changed at the end of the rollout."""

    def _undo(self) -> None:
        self._algorithm.gradient_steps = self._own


class MirrorCallback(WhileLearning):
    """
    Mirror half of each batch from left to right, so that its bends go the other way.

    The replay buffer holds the transitions as they were driven, and saved files are those of SB3.

    :param verbose: as in ``BaseCallback``
    """

    def __init__(self, *, verbose: int = 0) -> None:
        super().__init__(verbose)

    def _on_training_start(self) -> None:
        buffer = getattr(self.model, "replay_buffer", None)
        if not isinstance(buffer, ReplayBuffer):
            raise InvalidOption(
                f"{type(self).__name__} mirrors samples of a replay buffer, but "
                f"{type(self.model).__name__} has none; take it out of the callbacks"
            )
        normalizer = self.model.get_vec_normalize_env()
        if normalizer is not None and normalizer.norm_obs:
            raise InvalidOption(
                f"{type(self).__name__} needs observations whose middle is 0, which VecNormalize "
                "moves; take 'normalize' away: the observations are scaled already"
            )
        require_method(self.training_env, "range_finder_angles")
        for angles in self.training_env.get_attr("range_finder_angles"):
            check_angles(angles, type(self).__name__)
        try:
            mirror_image(buffer.observation_space)
        except InvalidOption as error:
            raise InvalidOption(f"{type(self).__name__}: {error}") from error
        self._buffer = buffer

    def _change(self) -> None:
        self._buffer.sample = _MirroredSample(self._buffer)  # type: ignore[method-assign]

    def _undo(self) -> None:
        vars(self._buffer).pop("sample", None)


class _MirroredSample:
    """Replaces the ``sample`` of a replay buffer."""

    def __init__(self, buffer: ReplayBuffer) -> None:
        self._buffer = buffer

    def __call__(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        return sample_mirrored(self._buffer, batch_size, env)

    def __reduce__(self) -> tuple[Any, ...]:
        # After Ctrl-C the buffer may be saved while it is replaced: pickle its own method.
        return partial, (type(self._buffer).sample, self._buffer)
