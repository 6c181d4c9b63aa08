"""PPO learns from its last rollouts, not from the newest one alone."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_torcs.callbacks.learning import WhileLearning
from sb3_torcs.car import check_count
from sb3_torcs.errors import InvalidOption

__all__ = ["ReuseRolloutsCallback"]

Floats = npt.NDArray[np.float32]


class _Rollout(NamedTuple):
    """What was driven; arrays are (timesteps, cars, …)."""

    observations: Floats
    actions: Floats
    rewards: Floats
    episode_starts: Floats
    log_probs: Floats  # of the policy that drove
    last_observations: Floats  # (cars, …) after it
    last_dones: npt.NDArray[np.bool_]  # (cars,) whether an episode ended with it


class _Learned(NamedTuple):
    """What PPO learns from a rollout; arrays are (timesteps, cars)."""

    values: Floats
    log_probs: Floats  # of today's policy
    advantages: Floats
    returns: Floats


class ReuseRolloutsCallback(WhileLearning):
    """
    Let PPO learn from its last rollouts at once, for trainings of few timesteps.

    The actions of older rollouts are those of another policy. So they count by how probable they
    are today, at most once, in returns (V-trace: Espeholt et al., 2018, arXiv:1802.01561,
    equation 1) and in the objective, whose ratio is clipped about today's policy (Queeney et al.,
    2021, arXiv:2111.00072). Values are those of today's value function. What the newest rollout
    tells is what it tells PPO without this callback.

    An epoch passes over all of these rollouts: take fewer epochs or larger batches. Saved models do
    not hold rollouts: a resumed training begins with none. A study goes on with them.

    :param rollouts: number of them, the newest included, 1 or more
    :param verbose: as in ``BaseCallback``
    :raises InvalidOption: if the number is another, or the model is not PPO with a ``Box`` of
        observations and one of actions
    """

    def __init__(self, *, rollouts: int = 4, verbose: int = 0) -> None:
        super().__init__(verbose)
        check_count("rollouts", rollouts)
        self.rollouts = rollouts
        self._restored: list[_Rollout] = []

    def arrays(self) -> dict[str, Any]:
        """Return the rollouts that are kept, one after the other: each array is (rollouts, …)."""
        return {
            name: np.stack([getattr(rollout, name) for rollout in self._kept])
            for name in _Rollout._fields
        }

    def restore(self, arrays: Mapping[str, Any]) -> None:
        """
        Let the next training begin with rollouts.

        :param arrays: that ``arrays`` returned
        """
        parts = (arrays[name] for name in _Rollout._fields)
        self._restored = [_Rollout(*rollout) for rollout in zip(*parts, strict=True)]

    def _on_training_start(self) -> None:
        model = self.model
        if not isinstance(model, PPO):
            raise InvalidOption(
                f"{type(self).__name__} keeps rollouts of PPO, but the model learns by "
                f"{type(model).__name__}; take it out of the callbacks"
            )
        for what, space in (
            ("observations", model.observation_space),
            ("actions", model.action_space),
        ):
            if not isinstance(space, spaces.Box):
                raise InvalidOption(
                    f"{type(self).__name__} needs a Box of {what}, not {space}; take it out of "
                    "the callbacks"
                )
        self._ppo, self._own = model, model.rollout_buffer
        self._kept = deque(self._restored, maxlen=self.rollouts)
        self._restored = []

    def _change(self) -> None:
        newest = self._own
        self._kept.append(_taken(newest, self.locals))
        learned = [_learn_again(self._ppo, old) for old in list(self._kept)[:-1]]
        learned.append(_Learned(newest.values, newest.log_probs, newest.advantages, newest.returns))
        self._ppo.rollout_buffer = self._joined(learned)

    def _joined(self, learned: list[_Learned]) -> RolloutBuffer:
        """Make a buffer in which each car of each rollout is a car."""
        model, first = self._ppo, self._own
        joined = RolloutBuffer(
            first.buffer_size, first.observation_space, first.action_space, model.device,
            first.gae_lambda, first.gamma, first.n_envs * len(self._kept),
        )  # fmt: skip
        driven = ("observations", "actions")
        parts = {name: [getattr(each, name) for each in self._kept] for name in driven}
        parts |= {name: [getattr(each, name) for each in learned] for name in _Learned._fields}
        for name, arrays in parts.items():
            np.concatenate(arrays, axis=1, out=getattr(joined, name))
        joined.full = True
        return joined

    def _undo(self) -> None:
        self._ppo.rollout_buffer = self._own


def _taken(buffer: RolloutBuffer, local: Mapping[str, Any]) -> _Rollout:
    """
    Copy a rollout, whose arrays PPO changes as it learns.

    :param buffer: that is full
    :param local: of ``collect_rollouts``
    :return: the copy
    """
    arrays = (
        buffer.observations, buffer.actions, buffer.rewards, buffer.episode_starts,
        buffer.log_probs, local["new_obs"], local["dones"],
    )  # fmt: skip
    return _Rollout(*(array.copy() for array in arrays))


@th.no_grad()
def _learn_again(model: PPO, old: _Rollout) -> _Learned:
    """
    Find what an older rollout tells today's policy and value function.

    :param model: that learns
    :param old: rollout of an earlier policy
    :return: where today's policy is the old one, what SB3 computes for its newest rollout
    """
    policy, device = model.policy, model.device
    seen, acted, last = (
        th.tensor(array, device=device)  # aligned alike each time, on which rounding depends
        for array in (
            old.observations.reshape(-1, *old.observations.shape[2:]),
            old.actions.reshape(-1, old.actions.shape[2]),
            old.last_observations,
        )
    )
    values, log_probs = (
        tensor.cpu().numpy().reshape(old.rewards.shape)
        for tensor in policy.evaluate_actions(seen, acted)[:2]
    )
    following = policy.predict_values(last).cpu().numpy().reshape(-1)
    counts = np.exp(np.minimum(log_probs - old.log_probs, np.float32(0.0)))
    advantages = counts * _advantages(old, values, following, counts, model)
    return _Learned(values, log_probs, advantages, values + advantages)


def _advantages(
    old: _Rollout, values: Floats, following: Floats, counts: Floats, model: PPO
) -> Floats:
    """
    Estimate advantages as GAE does, of which an action that follows takes part by its count.

    :param old: rollout
    :param values: of its observations, (timesteps, cars)
    :param following: of the observations after it, (cars,)
    :param counts: of its actions, 0 to 1, (timesteps, cars)
    :param model: whose ``gamma`` and ``gae_lambda`` are taken
    :return: (timesteps, cars), before each action's own count
    """
    goes_on = 1.0 - np.vstack((old.episode_starts[1:], old.last_dones)).astype(np.float32)
    next_values = np.vstack((values[1:], following))
    errors = old.rewards + model.gamma * goes_on * next_values - values
    advantages = np.empty_like(values)
    after: Any = 0.0
    for step in reversed(range(len(values))):
        advantages[step] = errors[step] + model.gamma * model.gae_lambda * goes_on[step] * after
        after = counts[step] * advantages[step]
    return advantages
