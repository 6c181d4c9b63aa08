"""Drivers beside the game's robots: agents, which a higher floor loads and registers here."""

from __future__ import annotations

import pkgutil
from typing import Any

__all__ = ["crew_of", "register_crew"]

_crews: list[str] = []


def register_crew(path: str) -> None:
    """
    Say what drives opponents that are no robots.

    :param path: dotted, of :class:`sb3_torcs.agents.pilots.Crew` or its like, as
        ``"package.module:name"``; it is imported when somebody names such an opponent
    """
    _crews[:] = [path]


def crew_of(drivers: list[str]) -> Any:
    """
    Make the crew of some drivers.

    :param drivers: names or paths of agents
    :raises InvalidOption: if there is no such agent
    """
    (path,) = _crews
    return pkgutil.resolve_name(path)(drivers)
