"""The starting list: the agent among the game's robots."""

from __future__ import annotations

from collections.abc import Sequence

from sb3_torcs.car import is_count
from sb3_torcs.errors import InvalidOption
from sb3_torcs.torcs.installation import Game

__all__ = ["AGENT", "starting_list"]

AGENT = ("", 0)
"""The agent's entry in a starting list; robots have a name and an index."""


def starting_list(
    game: Game, opponents: Sequence[str], grid_place: int | None
) -> list[tuple[str, int]]:
    """
    Make the starting list.

    :param game: the installation
    :param opponents: robots, e.g. ``("inferno", "berniw:3")``
    :param grid_place: of the agent among them, 1 in front; ``None`` is behind them all
    :return: names and indices, and :data:`AGENT`
    :raises InvalidOption: if there is no such slot, or the opponents are no list
    :raises UnknownRobot: if there is no such robot
    """
    if not isinstance(opponents, (list, tuple)) or not all(isinstance(o, str) for o in opponents):
        raise InvalidOption(
            f"opponents is {opponents!r}; expected a list of names, e.g. ['inferno', 'berniw:3']"
        )
    entries = [game.parse_robot(name) for name in opponents]
    slot = len(entries) + 1 if grid_place is None else grid_place
    if not is_count(slot) or slot > len(entries) + 1:
        raise InvalidOption(
            f"grid_place is {grid_place!r}; expected 1 to {len(entries) + 1}, or None"
        )
    entries.insert(slot - 1, AGENT)
    return entries
