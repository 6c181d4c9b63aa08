"""The pits of a track file, as far as the game's loader depends on them.

The loader follows the pits along the road and takes the ground beside each segment on the way; it
crashes where there is none. Worlds have no use for pits yet, so that nothing else is read.
"""

from __future__ import annotations

from collections.abc import Sequence

from sb3_torcs.errors import TrackFileError
from sb3_torcs.torcs.params import Keys, Section
from sb3_torcs.tracks.track import Segment

__all__ = ["check_pits"]

LEFT, RIGHT = "left", "right"
SHORTEST_PIT = 1.0  # [m]
PLACES = ("entry", "start", "end", "exit")


def check_pits(main: Section, version: int, names: Sequence[str], steps: Sequence[Segment]) -> None:
    """
    Refuse pits that the game's loader cannot lay.

    :param main: the section with the road
    :param version: of the format
    :param names: of the steps' segments
    :param steps: of the road, as the game's loader cuts it
    :raises TrackFileError: naming the place
    """
    pits = Keys(main.child("Pits"), "") if version >= 4 else Keys(main, "pit ")
    if version < 4 and pits.text("type", "no pit") == "no pit":
        return
    places = [pits.text(name) for name in PLACES]
    if not all(place in names for place in places):
        return  # the game then has no pits
    length = pits.number("length", 15.0)
    if length < SHORTEST_PIT:
        raise TrackFileError(
            f"{pits.section.place}: pits of {length:g} m; at least {SHORTEST_PIT:g} m are "
            "needed, and 15 m are usual: see 'length'"
        )
    side = RIGHT if pits.text("side", RIGHT) == RIGHT else LEFT
    for index in _beside(names, places[1], places[2]):
        step = steps[index]
        width = step.right_start + step.right_end
        if side == LEFT:
            width = step.left_start + step.left_end
        if width <= 0.0:
            raise TrackFileError(
                f"{pits.section.place}: the pits lie on the {side}, where segment "
                f"'{names[index]}' has no ground beside it; give it a width there, or see 'side' "
                "of the pits, which is 'right' if it is not given"
            )


def _beside(names: Sequence[str], start: str, end: str) -> list[int]:
    """List the steps that the game's loader visits: those of the pits, and one before and after."""
    first = names.index(start) - 1
    last = len(names) - names[::-1].index(end)
    if last < first:
        last += len(names)
    return [index % len(names) for index in range(first, last + 1)]
