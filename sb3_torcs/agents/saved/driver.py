"""A saved model that drives."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_torcs.errors import InvalidAction

__all__ = ["ModelDriver"]

NO_NUMBERS = "to satisfy the constraint"  # in what PyTorch says of a distribution's parameters


class ModelDriver:
    """
    A saved model that drives, with the statistics of its training's observations.

    :param model: an algorithm or a policy of Stable-Baselines3
    :param statistics: something with VecNormalize's ``normalize_obs``; ``None`` if the model
        learned from the observations as they are
    :param frames: newest observations that it sees at once, as behind ``VecFrameStack``; ``None``
        if it sees one as it is
    """

    def __init__(self, model: Any, statistics: Any = None, frames: int | None = None) -> None:
        self.model = model
        self.statistics = statistics
        self.frames = frames

    def predict(
        self,
        observation: npt.NDArray[np.float32],
        state: Any = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """
        Choose an action.

        :param observation: as the environment gives it
        :param state: as the call before returned it; ``None`` begins
        :param episode_start: (1,) whether an episode begins here
        :param deterministic: whether to choose without randomness
        :return: the action, and the state for the next call
        :raises InvalidAction: if the model computes no numbers
        """
        if self.statistics is not None:
            observation = self.statistics.normalize_obs(observation)
        if self.frames is None:
            return self._ask(observation, state, episode_start, deterministic)
        stack, state = (None, None) if state is None else state
        stack = self._stack(observation, stack, episode_start)
        action, state = self._ask(stack, state, episode_start, deterministic)
        return action, (stack, state)

    def _ask(self, observation: Any, *how: Any) -> tuple[npt.NDArray[np.float32], Any]:
        """Ask the model, whose distribution refuses what is no number."""
        from sb3_torcs.policies.threads import one_thread

        try:
            with one_thread():
                return self.model.predict(observation, *how)
        except ValueError as error:
            if NO_NUMBERS not in str(error):
                raise
            raise InvalidAction(
                "the model computes no numbers; take one that was saved before its training went "
                "astray"
            ) from error

    def _stack(
        self,
        observation: npt.NDArray[np.float32],
        before: npt.NDArray[np.float32] | None,
        episode_start: npt.NDArray[np.bool_] | None,
    ) -> npt.NDArray[np.float32]:
        """Put the newest observation behind those before it, which are 0 before an episode."""
        assert self.frames is not None
        size = observation.shape[-1]
        if before is None:
            before = np.zeros((*observation.shape[:-1], self.frames * size), observation.dtype)
        elif episode_start is not None:
            before = np.where(np.reshape(episode_start, (*before.shape[:-1], 1)), 0.0, before)
        return np.concatenate([before[..., size:], observation], axis=-1, dtype=observation.dtype)
