"""The starting list: agents among the game's robots."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Literal, get_args

from sb3_torcs.car import is_count
from sb3_torcs.errors import InvalidOption
from sb3_torcs.torcs.installation import Game

__all__ = ["AGENT", "GRIDS", "GRID_SLOTS", "GridName", "starting_list"]

AGENT = ("", 0)
"""The entry of the first agent in a starting list; robots have a name and an index."""

GRID_SLOTS = 20
"""[-] For which the grids of the game's tracks have room."""

GridName = Literal["last", "reverse", "random"]
"""Who starts where: see :func:`~sb3_torcs.races.protocol.run_races`."""
GRIDS = get_args(GridName)


def starting_list(
    game: Game,
    opponents: Sequence[str],
    grid_place: int | None,
    agents: int = 1,
    agents_named: Sequence[str] = (),
) -> list[tuple[str, int]]:
    """
    Make the starting list.

    :param game: the installation
    :param opponents: robots, e.g. ``("inferno", "berniw:3")``
    :param grid_place: of the first agent among them, 1 in front; ``None`` is behind them all
    :param agents: that follow each other
    :param agents_named: the opponents that are agents; they are numbered after the others
    :return: names and indices, and those of the agents: no name, and 0, 1 and so on
    :raises InvalidOption: if there is no such slot, or not enough of them, or the opponents are no
        list
    :raises UnknownRobot: if there is no such robot
    """
    if not isinstance(opponents, (list, tuple)) or not all(isinstance(o, str) for o in opponents):
        raise InvalidOption(
            f"opponents is {opponents!r}; expected a list of names, e.g. ['inferno', 'berniw:3'], "
            "or of paths as text"
        )
    numbers = itertools.count(agents if is_count(agents) else 1)
    entries = [
        (AGENT[0], next(numbers)) if name in agents_named else game.parse_robot(name)
        for name in opponents
    ]
    slot = len(entries) + 1 if grid_place is None else grid_place
    if not is_count(slot) or slot > len(entries) + 1:
        places = f"1 to {len(entries) + 1}" if entries else "1, since there are no opponents"
        raise InvalidOption(f"grid_place is {grid_place!r}; expected {places}, or None")
    if agents == 1 and len(entries) >= GRID_SLOTS:  # gym.make has no ``agents``
        raise InvalidOption(
            f"opponents has {len(entries)} names; expected at most {GRID_SLOTS - 1}, since a grid "
            f"has room for {GRID_SLOTS} cars"
        )
    if not is_count(agents) or agents + len(entries) > GRID_SLOTS:
        raise InvalidOption(
            f"agents is {agents!r}, with {len(entries)} opponents; expected a whole number from 1, "
            f"and no more than {GRID_SLOTS} cars in all, which is what a grid has room for"
        )
    name, first = AGENT
    entries[slot - 1 : slot - 1] = [(name, first + number) for number in range(agents)]
    return entries
