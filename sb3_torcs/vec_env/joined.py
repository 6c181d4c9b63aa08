"""Several vector environments as one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from itertools import accumulate
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import (
    VecEnvIndices,
    VecEnvObs,
    VecEnvStepReturn,
)

from sb3_torcs.actions import action_rows
from sb3_torcs.errors import InvalidOption

__all__ = ["JoinedVecEnv"]


class JoinedVecEnv(VecEnv):
    """
    Several vector environments as one, so that an agent learns different things at a time.

    For instance to race, and to be fast alone: races of several cars, with other rewards than those
    of cars that are alone. The environments of the first part come first.

    :param parts: vector environments with equal spaces; closed with this one
    :raises InvalidOption: if there is no list of them, if one is there twice, or if their spaces
        differ
    """

    def __init__(self, parts: Iterable[VecEnv]) -> None:
        if isinstance(parts, VecEnv) or not isinstance(parts, Iterable):
            raise InvalidOption(f"parts is {parts!r}; expected a list of vector environments")
        parts = tuple(parts)
        if not parts:
            raise InvalidOption("parts is empty; expected at least one vector environment")
        for place, part in enumerate(parts):
            if not isinstance(part, VecEnv) or part in parts[:place]:
                raise InvalidOption(
                    f"parts[{place}] is {part!r}; expected a vector environment of its own, e.g. "
                    "TorcsVecEnv(races=8)"
                )
        for name in ("observation_space", "action_space"):
            spaces = [getattr(part, name) for part in parts]
            for place, space in enumerate(spaces):
                if space != spaces[0]:
                    raise InvalidOption(
                        f"parts[{place}] has the {name} {space}, and parts[0] {spaces[0]}; make "
                        "all parts with the same sensors and action"
                    )
        self.parts = parts
        self._seats = [(part, i) for part in parts for i in range(part.num_envs)]
        ends = accumulate(part.num_envs for part in parts)
        self._places = [
            slice(end - part.num_envs, end) for part, end in zip(parts, ends, strict=True)
        ]
        super().__init__(len(self._seats), parts[0].observation_space, parts[0].action_space)

    def reset(self) -> VecEnvObs:
        """
        Begin an episode in each environment.

        :return: observations
        """
        seen = np.concatenate([part.reset() for part in self.parts])
        self._gather_reset_infos()
        self._reset_seeds()
        self._reset_options()
        return seen

    def step_async(self, actions: npt.NDArray[np.float32]) -> None:
        """
        Take actions for the next timestep.

        :param actions: (n, actuators), steering first
        :raises InvalidAction: if there is not one action per environment, or one is invalid; then
            no car has been driven
        """
        rows = action_rows(actions, (self.num_envs, *(self.action_space.shape or ())))
        for part, places in zip(self.parts, self._places, strict=True):
            part.step_async(rows[places])

    def step_wait(self) -> VecEnvStepReturn:
        """
        Hold the actions.

        :return: observations, rewards, dones and infos
        """
        answers, errors = [], []
        for part in self.parts:
            try:
                answers.append(part.step_wait())
            except (
                Exception
            ) as error:  # the others have set out, too, and answer before it is raised
                errors.append(error)
        if errors:
            raise errors[0]
        observations, rewards, dones, infos = zip(*answers, strict=True)
        self._gather_reset_infos()
        return (
            np.concatenate(observations),
            np.concatenate(rewards),
            np.concatenate(dones),
            [info for part in infos for info in part],
        )

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """
        Seed the next reset of each environment.

        :param seed: of the first environment; the others have those that follow
        :return: the seeds
        """
        seeds = list(super().seed(seed))
        for part, places in zip(self.parts, self._places, strict=True):
            part.seed(seeds[places.start])
        return seeds

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """
        Give options to the next reset of each environment.

        :param options: the same for all, or one dict for each
        """
        super().set_options(options)
        for part, places in zip(self.parts, self._places, strict=True):
            part.set_options(self._options[places])

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        Read an attribute of environments.

        :param attr_name: its name
        :param indices: of the environments; by default all
        :return: its values
        """
        return [part.get_attr(attr_name, i)[0] for part, i in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        Set an attribute of environments.

        :param attr_name: its name
        :param value: the same for all
        :param indices: of the environments; by default all
        """
        for part, i in self._chosen(indices):
            part.set_attr(attr_name, value, i)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """
        Call a method of environments.

        :param method_name: its name
        :param method_args: given to it
        :param indices: of the environments; by default all
        :param method_kwargs: given to it
        :return: what it returned
        """
        return [
            part.env_method(method_name, *method_args, indices=i, **method_kwargs)[0]
            for part, i in self._chosen(indices)
        ]

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """
        Tell whether environments have a wrapper.

        :param wrapper_class: of the wrapper
        :param indices: of the environments; by default all
        :return: for each of them
        """
        return [part.env_is_wrapped(wrapper_class, i)[0] for part, i in self._chosen(indices)]

    def get_images(self) -> Sequence[Any]:
        """Draw each environment."""
        return [image for part in self.parts for image in part.get_images()]

    def close(self) -> None:
        """Close all parts, also those after one that fails to."""
        with ExitStack() as closing:
            for part in reversed(self.parts):
                closing.callback(part.close)

    def _gather_reset_infos(self) -> None:
        self.reset_infos = [info for part in self.parts for info in part.reset_infos]

    def _chosen(self, indices: VecEnvIndices) -> Iterator[tuple[VecEnv, int]]:
        """Yield the part of each environment, and its index there."""
        return (self._seats[i] for i in self._get_indices(indices))
