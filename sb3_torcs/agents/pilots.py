"""Agents that drive cars of one race: their policies are asked at once, if they are the same."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_torcs.agents.ghosts import is_ghost
from sb3_torcs.agents.models import agent_record, load_driver
from sb3_torcs.agents.saved.record import DRIVEN_WITH
from sb3_torcs.agents.wrapping import wrapped
from sb3_torcs.backends.seats import SeatWorld, SharedRace
from sb3_torcs.car import FloatArray, range_finder_angles
from sb3_torcs.envs.torcs_race import RaceCarEnv
from sb3_torcs.errors import InvalidAction, InvalidOption, ModelMismatch
from sb3_torcs.torcs.installation import find_game

__all__ = ["CarOfAnAgent", "Crew", "Pilots"]

OF_THE_SEAT = ("range_finders", "gearbox")
"""What an agent drives with that its seat brings along: both are chosen before a race is loaded."""
OF_THE_ENV = tuple(name for name in DRIVEN_WITH if name not in OF_THE_SEAT)


class CarOfAnAgent:
    """
    What an agent's car needs before its race is loaded.

    :param driver: as of :func:`~sb3_torcs.agents.models.load_driver`
    :param aids: names of driver aids that it gets besides those that it was trained with
    :raises InvalidOption: if there is no such agent, or it is a ghost
    """

    def __init__(self, driver: str, aids: Iterable[str] = ()) -> None:
        if is_ghost(driver):
            raise InvalidOption(f"'{driver}' is a ghost, which looks at nobody and cannot race")
        self.driver = driver
        self.record = agent_record(driver, find_game())
        kwargs = self.record.env_kwargs
        self._aids = (*kwargs.get("aids", ()), *aids)
        self.car = self.record.one_car
        self.gearbox: str = kwargs.get("gearbox", "automatic")
        self.angles: FloatArray = range_finder_angles(kwargs.get("range_finders", "scr"))

    def kept(self, names: Iterable[str]) -> dict[str, Any]:
        """
        Tell how the agent drives: as in its training, and with the aids that it was given.

        :param names: of options of an environment
        :return: those that its training had, and the aids
        """
        return {**self.record.kept(names), **({"aids": self._aids} if self._aids else {})}


@dataclass
class _Team:
    """Agents with the same policy."""

    driver: Any
    members: list[int]  # their numbers
    state: Any = None  # of a recurrent policy


class Pilots:
    """
    The agents of a race that is loaded.

    :param cars: of the agents
    :param race: in which they have the seats, in the same order
    :param trust: load models as SB3 does, which runs code that is pickled in them
    :raises ModelMismatch: if an agent does not fit, or was trained behind wrappers that have to
        see each timestep
    """

    def __init__(self, cars: Sequence[CarOfAnAgent], race: SharedRace, trust: bool = False) -> None:
        self._envs = [
            RaceCarEnv(seat, **car.kept(OF_THE_ENV))
            for car, seat in zip(cars, race.seats, strict=True)
        ]
        teams: dict[str, _Team] = {}
        for number, (car, env) in enumerate(zip(cars, self._envs, strict=True)):
            if car.driver in teams:
                teams[car.driver].members.append(number)
                continue
            if wrapped(env, car.record.hyperparameters, trust=trust) is not env:
                raise ModelMismatch(
                    f"'{car.driver}' was trained behind a wrapper of its environment, which "
                    "cannot be put around one car of several; race an agent without one"
                )
            teams[car.driver] = _Team(load_driver(car.driver, env, trust=trust), [number])
        self._teams = list(teams.values())
        self.failed: dict[int, str] = {}
        """Agents that were taken out of the race, and why."""

    def begin(self, seed: int) -> None:
        """
        Begin the race on the grid.

        :param seed: of the environments
        """
        for env in self._envs:
            env.reset(seed=seed)
        for team in self._teams:
            team.state = None
        self.failed.clear()

    def act(self, tick: int) -> int:
        """
        Ask the agents whose timestep begins, and let their cars hold the answers. A car whose agent
        answers no number is taken out of the race.

        :param tick: control ticks that have been driven
        :return: control ticks until the next agent has to be asked
        """
        for team in self._teams:
            due = tick % self._envs[team.members[0]].action_repeat == 0
            if due and any(number not in self.failed for number in team.members):
                self._ask(team, tick == 0)
        return min(env.action_repeat - tick % env.action_repeat for env in self._envs)

    def _ask(self, team: _Team, race_begins: bool) -> None:
        """Ask a team's policy once, for all its cars."""
        seen = [self._envs[number].look() for number in team.members]
        begins = np.full(len(team.members), race_begins)
        try:
            actions, team.state = team.driver.predict(
                np.stack(seen), team.state, begins, deterministic=True
            )
        except InvalidAction as error:
            for number in team.members:
                self._take_out(number, error)
            return
        for number, action in zip(team.members, actions, strict=True):
            if number in self.failed:
                continue
            try:
                self._envs[number].hold(action)
            except InvalidAction as error:
                self._take_out(number, error)

    def _take_out(self, number: int, error: InvalidAction) -> None:
        """Take a car out of the race, and note why."""
        self.failed.setdefault(number, str(error))
        self._envs[number].seat.retire()


class Crew:
    """
    Agents as opponents, in a race that others have begun.

    :param drivers: as of :class:`CarOfAnAgent`
    """

    def __init__(self, drivers: Sequence[str]) -> None:
        self._members = [CarOfAnAgent(driver) for driver in drivers]
        self.cars = [member.car for member in self._members]
        self.gearboxes = [member.gearbox for member in self._members]
        self.angles = [member.angles for member in self._members]
        repeats = {member.record.env_kwargs.get("action_repeat", 5) for member in self._members}
        self.action_repeats: set[int] = repeats

    def board(self, worlds: Sequence[SeatWorld]) -> None:
        """
        Load the agents.

        :param worlds: their cars, in the order of the drivers
        """
        self._race = SharedRace.of(worlds)
        self._pilots = Pilots(self._members, self._race)

    def begin(self) -> None:
        """Take part in the race that begins."""
        self._race.join()
        self._pilots.begin(0)

    def act(self, tick: int) -> None:
        """
        Let the cars hold what the agents answer.

        :param tick: control ticks that have been driven
        """
        self._pilots.act(tick)
