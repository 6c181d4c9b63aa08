"""Who takes part: a robot of the game, or an agent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sb3_torcs.agents.models import driver_name
from sb3_torcs.agents.pilots import CarOfAnAgent
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


def find_entrants(drivers: Sequence[str], game: Game) -> list[Entrant]:
    """
    Find drivers by their names.

    :param drivers: robots, e.g. ``"inferno"`` or ``"bt:3"``; shipped agents; or paths of models
    :param game: the installation
    :raises InvalidOption: if one is named twice, or there is none of this name
    """
    entrants = [_find(driver, game) for driver in drivers]
    names = [entrant.name for entrant in entrants]
    for driver, name in zip(drivers, names, strict=True):
        if names.count(name) > 1:
            raise InvalidOption(f"driver '{driver}' is named twice; name each driver once")
    return entrants


def _find(driver: str, game: Game) -> Entrant:
    if not game.has_robot(driver):
        return Entrant(driver_name(driver), agent=CarOfAnAgent(driver))
    robot = name, index = game.parse_robot(driver)
    usual = game.parse_robot(name) == robot
    return Entrant(name if usual else f"{name}:{index}", robot=robot)
