"""Opponents that are agents, which a higher floor loads and registers here."""

from __future__ import annotations

import pkgutil
from collections.abc import Sequence
from typing import Any

from sb3_torcs.torcs.installation import Game

__all__ = ["agents_among", "load_opponents", "register_opponents"]

_registered: list[str] = []


def register_opponents(path: str) -> None:
    """
    Register what drives opponents that are no robots.

    :param path: dotted, of :class:`sb3_torcs.agents.pilots.AgentOpponents` or its like, as
        ``"package.module:name"``; it is imported when a race has such an opponent
    """
    _registered[:] = [path]


def load_opponents(names: list[str]) -> Any:
    """
    Load opponents that are agents.

    :param names: or paths
    :raises InvalidOption: if there is no such agent
    """
    (path,) = _registered
    return pkgutil.resolve_name(path)(names)


def agents_among(opponents: Sequence[str], game: Game) -> list[str]:
    """
    Return the agents among opponents.

    :param opponents: names
    :param game: the installation, whose robots are none
    """
    if not isinstance(opponents, (list, tuple)):
        return []
    return [name for name in opponents if isinstance(name, str) and not game.has_robot(name)]
