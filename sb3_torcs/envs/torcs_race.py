"""Several agents in one race of the real TORCS: one environment for each of their cars."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import numpy.typing as npt

from sb3_torcs.actions import choose_gearbox
from sb3_torcs.backends.native import load_race
from sb3_torcs.backends.seats import LoadedRace, Seat, SeatWorld, SharedRace
from sb3_torcs.backends.several import is_several, world_pool
from sb3_torcs.car import (
    RangeFinderName,
    checked_flag,
    checked_laps,
    range_finder_angles,
)
from sb3_torcs.envs.arguments import read_options, select
from sb3_torcs.envs.options import CONDITIONS, RACING, TORCS, TorcsOptions
from sb3_torcs.envs.racing import Observation, RacingEnv
from sb3_torcs.errors import InvalidOption
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.opponents import agents_among, load_opponents
from sb3_torcs.torcs.starting_list import starting_list

__all__ = ["RaceCarEnv", "load_shared_race", "make_race", "make_shared_race"]


OF_ONE_AGENT = ("backend", "scr", "picture")
"""Options of ``Torcs-v0`` that races of several agents do not have."""


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

    def look(self) -> Observation:
        """Return what the agent sees, whose race is driven elsewhere."""
        self.episode["car"][0] = self.seat.read()
        return self._eyes.see(self.episode)[0]

    def hold(self, action: npt.NDArray[np.float32]) -> None:
        """
        Let the car do what an action asks for, when its race is driven on.

        :param action: as of ``step``
        :raises InvalidAction: as ``step`` does
        """
        self._ask(action, self.episode)
        self.seat.hold(self.controls)


def load_shared_race(
    track: str | Path,
    car: str,
    *,
    agents: int,
    range_finders: RangeFinderName | Sequence[float] = "scr",
    opponents: Sequence[str] = (),
    laps: int | None = None,
    grid_place: int | None = None,
    gearbox: str = "automatic",
    flagged: bool = False,
) -> LoadedRace:
    """
    Load a race of several agents, for a :class:`~sb3_torcs.backends.seats.SharedRace`.

    :param track: as of :func:`make_race`
    :param car: of all agents
    :param agents: their number
    :param range_finders: as of :func:`make_race`
    :param opponents: robots, and names or paths of agents
    :param laps: of the race, for which robots take fuel; ``None`` drives on
    :param grid_place: of the first agent, whom the others follow; ``None`` is behind all robots
    :param gearbox: as of :func:`make_race`
    :param flagged: whether agents are flagged off after the last lap
    :return: the cars of the agents, and who drives the opponents that are agents
    """
    game = find_game()
    named = agents_among(opponents, game)
    entries = starting_list(game, opponents, grid_place, agents, named)
    others = load_opponents(named) if named else None
    every: list[list[Any]] = [[car], [gearbox], [range_finder_angles(range_finders)]]
    more = ([], [], []) if others is None else (others.cars, others.gearboxes, others.angles)
    cars, gearboxes, angles = (a * agents + b for a, b in zip(every, more, strict=True))
    engine, road = load_race(
        track, entries, cars=cars, gearboxes=gearboxes, angles=angles,
        laps=checked_laps(laps) or 0, flagged=flagged,
    )  # fmt: skip
    worlds = [
        SeatWorld(engine, seat, road, beams)
        for seat, beams in zip(engine.agents, angles, strict=True)
    ]
    if others is not None:
        others.take_seats(worlds[agents:])
    return LoadedRace(worlds[:agents], others, flagged)


def make_race(
    agents: int, *, flagged: bool = False, **options: Unpack[TorcsOptions]
) -> list[RaceCarEnv]:
    """
    Make a race of several agents.

    :param agents: their number
    :param flagged: whether agents are flagged off when the winner has finished, as robots are
    :param options: of :class:`~sb3_torcs.envs.torcs.TorcsEnv`, for all agents. Each race has one of
        a list of tracks, of cars, of lists of ``opponents``, and of places of the first agent on
        the grid, whom the others follow
    :return: one environment for each agent
    :raises InvalidOption: if an option is for a race of one agent, or has a wrong value
    """
    given = read_options("make_race", TORCS, options)
    _check_several_agents(given)
    race = make_shared_race(
        agents, given["track"], given["car"], given["opponents"], given["grid_place"],
        sensor_noise=given["conditions"]["sensor_noise"], action_repeat=given["action_repeat"],
        range_finders=given["range_finders"],
        gearbox=choose_gearbox(given["gearbox"], given["action"]), laps=given["laps"],
        flagged=checked_flag("flagged", flagged),
    )  # fmt: skip
    return [RaceCarEnv(seat, **select(RACING, given)) for seat in race.seats]


def _check_several_agents(given: Mapping[str, Any]) -> None:
    """
    Refuse the options of a race of one agent.

    :param given: all options
    :raises InvalidOption: if one has not its default
    """
    chosen = [(name, given[name], read_options("", TORCS, {})[name]) for name in OF_ONE_AGENT]
    chosen += [
        (name, given["conditions"][name], option.default)
        for name, option in CONDITIONS.items()
        if name != "sensor_noise"
    ]
    for name, value, usual in chosen:
        if value != usual:
            raise InvalidOption(
                f"{name} is {value!r}, which is for a race of one agent against robots; leave it "
                "out"
            )


def make_shared_race(
    agents: int,
    track: str | Path | Sequence[str | Path],
    car: str | Sequence[str],
    opponents: Sequence[str] | Sequence[Sequence[str]],
    grid_place: int | Sequence[int] | None,
    *,
    sensor_noise: bool,
    action_repeat: int,
    **shared: Any,
) -> SharedRace:
    """
    Make a race that is drawn among several, one of each of which is loaded at once.

    :param agents: as of :func:`make_race`
    :param track: as there
    :param car: as there
    :param opponents: as there
    :param grid_place: as there
    :param sensor_noise: as there
    :param action_repeat: of the agents; opponents that are agents have to have the same
    :param shared: of all races, as of :func:`load_shared_race`
    """
    listed = isinstance(opponents, (list, tuple))
    several = listed and any(isinstance(field, (list, tuple)) for field in opponents)
    fields: Any = opponents if several else [opponents]
    choices = itertools.product(
        track if is_several(track) else [track],
        car if is_several(car, "car") else [car],
        fields,
        grid_place if is_several(grid_place, "grid_place") else [grid_place],
    )
    shared["agents"] = agents
    races = world_pool(
        [
            partial(load_shared_race, one, model, opponents=field, grid_place=place, **shared)
            for one, model, field, place in choices
        ]
    )
    for race in races.examples:
        if race.opponents is not None and race.opponents.action_repeats != {action_repeat}:
            raise InvalidOption(
                f"action_repeat is {action_repeat!r}, and agents among the opponents were trained "
                f"with {', '.join(map(str, sorted(race.opponents.action_repeats)))}; give the same"
            )
    return SharedRace(races, sensor_noise)
