"""Who takes part: a robot of the game, or an agent."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sb3_torcs.agents.models import driver_name, find_model, shipped_agents
from sb3_torcs.agents.pilots import CarOfAnAgent
from sb3_torcs.agents.saved.record import BEST_MODEL
from sb3_torcs.agents.scripted import SCRIPTED
from sb3_torcs.errors import InvalidOption
from sb3_torcs.torcs.installation import Game

__all__ = ["Entrant", "find_entrants"]


@dataclass(frozen=True)
class Entrant:
    """
    A driver that was named for a race: either a robot or an agent.

    :param name: for tables
    :param robot: its name and index
    :param agent: its car, and what it was trained with
    """

    name: str
    robot: tuple[str, int] | None = None
    agent: CarOfAnAgent | None = None


def find_entrants(drivers: Sequence[str], game: Game, aids: Sequence[str] = ()) -> list[Entrant]:
    """
    Find drivers by their names.

    :param drivers: robots, e.g. ``"inferno"`` or ``"bt:3"``; shipped agents; or paths of models
    :param game: the installation
    :param aids: names of driver aids that each agent gets besides its own
    :return: in the same order; names that would be equal have folders before them
    :raises InvalidOption: if one is named twice, or there is none of this name
    """
    entrants = [_find(driver, game, aids) for driver in drivers]
    driven = [_driven(entrant) for entrant in entrants]
    for driver, what in zip(drivers, driven, strict=True):
        if driven.count(what) > 1:
            raise InvalidOption(f"driver '{driver}' is named twice; name each driver once")
    return _told_apart(entrants)


def _find(driver: str, game: Game, aids: Sequence[str]) -> Entrant:
    if not game.has_robot(driver):
        return Entrant(driver_name(driver), agent=CarOfAnAgent(driver, aids))
    robot = name, index = game.parse_robot(driver)
    usual = game.parse_robot(name) == robot
    return Entrant(name if usual else f"{name}:{index}", robot=robot)


def _driven(entrant: Entrant) -> object:
    """Tell what drives: a robot and its index, a file, or the scripted driver."""
    if entrant.agent is None or entrant.agent.driver == SCRIPTED:
        return entrant.robot or SCRIPTED
    return find_model(entrant.agent.driver).resolve()


def _told_apart(entrants: Sequence[Entrant]) -> list[Entrant]:
    """Put folders before names that are equal, as many as it takes."""
    names = [entrant.name for entrant in entrants]
    alike = [entrant for entrant in entrants if names.count(entrant.name) > 1]
    parts = {id(entrant): _parts(entrant) for entrant in alike}

    def name(entrant: Entrant) -> str:
        own = parts[id(entrant)]
        others = [other for key, other in parts.items() if key != id(entrant)]
        for size in range(1, len(own) + 1):
            if not any(other[-size:] == own[-size:] for other in others):
                return "/".join(own[-size:])
        return "/".join(own)

    return [
        replace(entrant, name=name(entrant)) if id(entrant) in parts else entrant
        for entrant in entrants
    ]


def _parts(entrant: Entrant) -> tuple[str, ...]:
    """Split where an agent is into folders and its name; robots and shipped agents have no more."""
    driver = "" if entrant.agent is None else entrant.agent.driver
    path = Path(os.path.abspath(os.path.expanduser(driver)))
    if entrant.agent is None or driver == SCRIPTED or driver in shipped_agents():
        return (entrant.name,)
    folder = path.parent
    if path.name in (BEST_MODEL, Path(BEST_MODEL).stem):
        folder = folder.parent
    return (*folder.parts[1:], entrant.name)
