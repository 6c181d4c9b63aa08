"""Several agents in one race of the real TORCS: one environment for each of their cars."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_torcs.actions import ActionName, GearboxName, used_gearbox
from sb3_torcs.backends.native import make_grid
from sb3_torcs.backends.seats import Seat, SharedRace
from sb3_torcs.backends.several import is_several
from sb3_torcs.car import DEFAULT_CAR, CarState
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.errors import InvalidOption
from sb3_torcs.sensors import RangeFinderName

__all__ = ["RaceCarEnv", "make_race"]


class RaceCarEnv(RacingEnv):
    """
    The environment of one agent of a race. It is reset alone, and stepped with the others.

    :param seat: of the agent
    :param options: of :class:`~sb3_torcs.envs.racing.RacingEnv`
    """

    def __init__(self, seat: Seat, **options: Any) -> None:
        world: Any = seat  # whose track and car may not be set
        super().__init__(world, **options)
        self.seat = seat

    def _end(self, car: CarState) -> str | None:
        """Return why the episode ends; a car that is laps behind is flagged off with the others."""
        return super()._end(car) or ("laps" if self.seat.finished else None)


def make_race(
    agents: int,
    *,
    track: str | Path | Sequence[str | Path] = "aalborg",
    car: str | Sequence[str] = DEFAULT_CAR,
    opponents: Sequence[str] | Sequence[Sequence[str]] = (),
    grid_place: int | Sequence[int] | None = None,
    range_finders: RangeFinderName | Sequence[float] = "scr",
    action: ActionName = "pedals",
    gearbox: GearboxName = "automatic",
    laps: int | None = None,
    sensor_noise: bool = False,
    flagged: bool = False,
    **options: Any,
) -> list[RaceCarEnv]:
    """
    Make a race of several agents.

    :param agents: their number
    :param track: as of :class:`~sb3_torcs.envs.torcs.TorcsEnv`; each race is on one of a list
    :param car: of all agents; each race has one of a list
    :param opponents: robots; each race has one of a list of lists
    :param grid_place: of the first agent, whom the others follow, 1 in front; ``None`` is behind
        all opponents; each race has one of a list
    :param range_finders: as of ``TorcsEnv``
    :param action: as there
    :param gearbox: as there
    :param laps: after which the episode of an agent is truncated; ``None`` drives on
    :param sensor_noise: as there
    :param flagged: whether agents are flagged off when the winner has finished, as robots are
    :param options: of :class:`~sb3_torcs.envs.racing.RacingEnv`
    :return: one environment for each agent
    """
    if options.pop("delay", 0) != 0:
        raise InvalidOption("delay is for a race of one agent; leave it out")
    several = not isinstance(opponents, str) and any(
        is_several(field, "opponents") for field in opponents
    )
    fields: Any = opponents if several else [opponents]
    choices = itertools.product(
        track if is_several(track) else [track],
        car if is_several(car, "car") else [car],
        fields,
        grid_place if is_several(grid_place, "grid_place") else [grid_place],
    )
    shared: dict[str, Any] = {
        "agents": agents,
        "range_finders": range_finders,
        "gearbox": used_gearbox(gearbox, action),
        "laps": laps,
        "flagged": flagged,
    }
    grids = [
        make_grid(one, model, opponents=field, grid_place=place, **shared)
        for one, model, field, place in choices
    ]
    race = SharedRace(grids, sensor_noise)
    return [RaceCarEnv(seat, action=action, laps=laps, **options) for seat in race.seats]
