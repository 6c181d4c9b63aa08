"""Every other car of a vector environment drives on the mirror image of its road."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, unwrap_vec_wrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_torcs.actions import action_rows
from sb3_torcs.errors import InvalidOption
from sb3_torcs.policies.mirror import check_angles, mirror_image

__all__ = ["MirrorVecEnv"]


class MirrorVecEnv(VecEnvWrapper):
    """
    Every other car sees the mirror image of its road, and steers in it.

    So an agent meets each bend in both directions, and learns twice as many roads. What the cars do
    is as real as ever: a mirrored steering angle is turned back before the car gets it. ``info``
    describes the real road; only its ``terminal_observation`` is mirrored.

    In a file of hyperparameters: ``vec_env_wrapper: sb3_torcs.vec_env.MirrorVecEnv``.

    :param venv: of Torcs-v0 or TorcsLite-v0; the first car is not mirrored, the second is
    :raises InvalidOption: if it is no vector environment, if the range finders look further to one
        side than to the other, or if observations are stacked or normalized already
    """

    def __init__(self, venv: VecEnv) -> None:
        if not isinstance(venv, VecEnv):
            raise InvalidOption(
                f"venv is {venv!r}; expected a vector environment, e.g. TorcsVecEnv(races=8)"
            )
        super().__init__(venv)
        normalized = unwrap_vec_wrapper(venv, VecNormalize)
        if normalized is not None and normalized.norm_obs:
            raise InvalidOption(
                "MirrorVecEnv is around VecNormalize, whose statistics differ between left and "
                "right; put it inside: VecNormalize(MirrorVecEnv(venv))"
            )
        order, signs = mirror_image(venv.observation_space)
        for angles in venv.get_attr("range_finder_angles"):
            check_angles(angles, "MirrorVecEnv")
        self._order, self._signs = order.numpy(), signs.numpy()

    def reset(self) -> VecEnvObs:
        """
        Begin an episode in each environment.

        :return: observations
        """
        return self._as_seen(self.venv.reset())

    def step_async(self, actions: npt.NDArray[np.float32]) -> None:
        """
        Take actions for the next timestep.

        :param actions: (n, actuators), steering first
        :raises InvalidAction: if there is not one action per environment, or one is invalid
        """
        rows = action_rows(actions, (self.num_envs, *(self.action_space.shape or ())))
        rows[1::2, 0] *= -1.0
        self.venv.step_async(rows)

    def step_wait(self) -> VecEnvStepReturn:
        """
        Hold the actions.

        :return: observations, rewards, dones and infos
        """
        observations, rewards, dones, infos = self.venv.step_wait()
        for i in np.flatnonzero(dones[1::2]) * 2 + 1:
            infos[i]["terminal_observation"] = self._image(infos[i]["terminal_observation"])
        return self._as_seen(observations), rewards, dones, infos

    def _as_seen(self, observations: VecEnvObs) -> VecEnvObs:
        seen = np.array(observations)
        seen[1::2] = self._image(seen[1::2])
        return seen

    def _image(self, observations: Any) -> Any:
        return observations[..., self._order] * self._signs
