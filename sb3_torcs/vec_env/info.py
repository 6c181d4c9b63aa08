"""The ``info`` of each timestep of a ``TorcsVecEnv``, computed when it is read."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, MutableMapping
from typing import Any, Self

from sb3_torcs.envs.batch import Outcome
from sb3_torcs.envs.info import RacingInfo

__all__ = ["TRUNCATED", "LazyInfo", "glance"]

TRUNCATED = "TimeLimit.truncated"
"""Of SB3: whether a time limit ended the episode."""


class LazyInfo(MutableMapping[str, Any]):
    """
    The ``info`` of an episode that goes on. It computes its values when one is first read.

    :param timestep: the outcome of a timestep of all environments
    :param index: of the environment
    """

    __slots__ = ("_index", "_timestep", "_values")

    def __init__(self, timestep: Outcome, index: int) -> None:
        self._timestep, self._index = timestep, index
        self._values: dict[str, Any] | None = None

    def get(self, name: str, default: Any = None) -> Any:
        """Look a value up; see :class:`dict`."""
        if self._values is None:
            if name == "lap_time":  # asked of each in each timestep, to show progress
                return self.glance()[1]
            if name not in RacingInfo.__annotations__:
                return False if name == TRUNCATED else default
        return self._made().get(name, default)

    def glance(self) -> tuple[float, float, dict[str, float]]:
        """Look up what :func:`glance` returns, without computing the rest."""
        if self._values is not None:
            return _glance(self._values)
        return self._timestep.glance(self._index)

    def copy(self) -> dict[str, Any]:
        """Make a dict of it."""
        return self._made().copy()

    def _made(self) -> dict[str, Any]:
        if self._values is None:
            self._values = self._timestep.info(self._index)
            self._values[TRUNCATED] = False
        return self._values

    def __getitem__(self, name: str) -> Any:
        return self._made()[name]

    def __setitem__(self, name: str, value: Any) -> None:
        self._made()[name] = value

    def __delitem__(self, name: str) -> None:
        del self._made()[name]

    def __or__(self, other: Mapping[str, Any]) -> dict[str, Any]:
        return self._made() | dict(other) if isinstance(other, Mapping) else NotImplemented

    def __ror__(self, other: Mapping[str, Any]) -> dict[str, Any]:
        return dict(other) | self._made() if isinstance(other, Mapping) else NotImplemented

    def __ior__(self, other: Mapping[str, Any] | Iterable[tuple[str, Any]]) -> Self:
        self._made().update(other)
        return self

    def __iter__(self) -> Iterator[str]:
        return iter(self._made())

    def __len__(self) -> int:
        return len(self._made())

    def __repr__(self) -> str:
        return repr(self._made())

    def __reduce__(self) -> tuple[type, tuple[dict[str, Any]]]:
        return dict, (self._made(),)


def glance(info: MutableMapping[str, Any]) -> tuple[float, float, dict[str, float]]:
    """
    Look up a few values of a timestep, at the least cost.

    :param info: of the timestep
    :return: speed [m/s], time of the lap that it completed, or 0 [s], and terms of the reward
    """
    return info.glance() if isinstance(info, LazyInfo) else _glance(info)


def _glance(info: Mapping[str, Any]) -> tuple[float, float, dict[str, float]]:
    return info["car"].speed_x, info.get("lap_time", 0.0), info.get("reward_terms", {})
