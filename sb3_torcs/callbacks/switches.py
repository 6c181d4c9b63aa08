"""Callbacks that change the training environments: the reward, and how episodes begin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any
from weakref import WeakKeyDictionary

from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_torcs.callbacks.tree import callbacks_in, require_method
from sb3_torcs.car import (
    StartName,
    check_count,
    checked_choice,
    checked_delay,
    checked_factor,
    checked_hard_starts,
    checked_start,
    checked_start_speed,
)
from sb3_torcs.rewards import Reward, RewardChoice

__all__ = ["RandomStartCallback", "RewardCallback"]

CONDITIONS = ("delay", "grip", "mass")

_originals: WeakKeyDictionary[VecEnv, dict[str, list[Any]]] = WeakKeyDictionary()
"""What environments had before any switch, by setter. All callbacks share it: one that looked for
itself would take what another has set for the environments' own."""


class _SwitchUser(BaseCallback):
    """Base of callbacks that change settings of environments, and restore them at the end."""

    _switches: Sequence[_Switch] = ()

    def _on_training_start(self) -> None:
        self._on_training_end()  # SB3 does not call it for a training that an exception ended

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        for switch in reversed(self._switches):
            switch.undo()


class RewardCallback(_SwitchUser):
    """
    Use another reward in the training environments, from the beginning or from a later timestep on.

    Use it when an agent shall learn to drive first and to take care later, or to compare rewards
    without another environment.

    :param reward: name of a reward, or a mapping of terms to weights
    :param also_eval: also use it in the environments of an ``EvalCallback``, changing its score
    :param timesteps: after which the reward changes, of all environments together
    :param verbose: as in ``BaseCallback``
    :raises InvalidOption: if there is no such reward, or ``timesteps`` is no whole number
    """

    def __init__(
        self,
        *,
        reward: RewardChoice,
        also_eval: bool = False,
        timesteps: int = 0,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        Reward(reward)  # checked here, for a message of this process and not of a worker
        check_count("timesteps", timesteps, least=0)
        self.reward = reward
        self.also_eval = also_eval
        self.timesteps = timesteps

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._switches = ()
        if self.num_timesteps >= self.timesteps:
            self._change()

    def _on_rollout_start(self) -> None:
        if not self._switches and self.num_timesteps >= self.timesteps:
            self._change()

    def _change(self) -> None:
        envs = [self.training_env]
        if self.also_eval:
            others = callbacks_in(self.locals["callback"])
            envs += [other.eval_env for other in others if isinstance(other, EvalCallback)]
        self._switches = [_Switch(env, "set_reward", self.reward) for env in envs]


class RandomStartCallback(_SwitchUser):
    """
    Change how training episodes begin; evaluations keep theirs.

    Use it in every training, so that each corner is practised from the beginning, and not only
    those that the car reaches from the grid.

    The first episode begins before any callback is called, so it keeps the environment's start.

    :param start: ``"random"`` or ``"grid"``
    :param speed: highest speed of random starts [m/s]; by default the environment's own
    :param hard: share of random starts that lie before places where episodes ended badly, at a
        speed that can be lost on the way there, 0 to 1; see
        :meth:`~sb3_torcs.envs.racing.RacingEnv.set_hard_starts`
    :param conditions: ``delay``, ``grip`` and ``mass`` of episodes, each a value or a pair between
        which each episode draws; e.g. ``{"grip": [0.9, 1.1]}``
    :param verbose: as in ``BaseCallback``
    """

    def __init__(
        self,
        *,
        start: StartName = "random",
        speed: float | None = None,
        hard: float = 0.0,
        conditions: Mapping[str, Any] = MappingProxyType({}),
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        for name, choice in conditions.items():
            # checked here, for a message of this process and not of a worker
            if checked_choice("conditions", name, CONDITIONS) == "delay":
                checked_delay(choice)
            else:
                checked_factor(name, choice)
        self.conditions = dict(conditions)
        self.hard = checked_hard_starts(hard)
        self.start = checked_start(start)
        self.speed = None if speed is None else checked_start_speed(speed)

    def _on_training_start(self) -> None:
        super()._on_training_start()
        settings: list[tuple[str, Any]] = [("set_start", self.start)]
        if self.speed is not None:
            settings.append(("set_random_speed", self.speed))
        if self.hard:
            settings.append(("set_hard_starts", self.hard))
        if self.conditions:
            settings.append(("set_conditions", self.conditions))
        self._switches = [_Switch(self.training_env, *setting) for setting in settings]


class _Switch:
    """A setting of all environments of a vector, which can be undone once."""

    def __init__(self, env: VecEnv, setter: str, value: Any) -> None:
        require_method(env, setter)
        self.env = env.unwrapped  # the same one below other wrappers
        self.setter = setter
        previous = env.env_method(setter, value)
        self.original: list[Any] = self._known().setdefault(setter, previous)

    def _known(self) -> dict[str, list[Any]]:
        return _originals.setdefault(self.env, {})

    def undo(self) -> None:
        """Restore the original value of every environment, unless another switch has done so."""
        known = self._known()
        # A later training may have made switches of its own, which stay.
        if known.get(self.setter) is not self.original:
            return
        for index, value in enumerate(known.pop(self.setter)):
            self.env.env_method(self.setter, value, indices=[index])
