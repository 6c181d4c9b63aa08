"""Agents that drive cars of one race: their policies are asked at once, if they are the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_torcs.agents.drivers import NamedDriver, find_driver
from sb3_torcs.agents.models import load_driver
from sb3_torcs.agents.saved.record import DRIVEN_WITH
from sb3_torcs.agents.wrapping import wrap_env
from sb3_torcs.backends.seats import SeatWorld, SharedRace
from sb3_torcs.envs.torcs_race import RaceCarEnv
from sb3_torcs.errors import InvalidAction, InvalidOption, ModelMismatch

__all__ = ["AgentOpponents", "Pilots", "check_racers"]

OF_THE_SEAT = ("range_finders", "gearbox")
"""What an agent drives with that its seat brings along: both are chosen before a race is loaded."""
OF_THE_ENV = tuple(name for name in DRIVEN_WITH if name not in OF_THE_SEAT)


@dataclass
class _Policy:
    """Agents with the same policy."""

    driver: Any
    members: list[int]  # their numbers
    state: Any = None  # of a recurrent policy


class Pilots:
    """
    The agents of a race that is loaded.

    :param drivers: the agents
    :param race: in which they have the seats, in the same order
    :param trust: load models as SB3 does, which runs code that is pickled in them
    :raises ModelMismatch: if an agent does not fit, or was trained behind wrappers that have to
        see each timestep
    """

    def __init__(
        self, drivers: Sequence[NamedDriver], race: SharedRace, trust: bool = False
    ) -> None:
        self._envs = [
            RaceCarEnv(seat, **driver.options(OF_THE_ENV))
            for driver, seat in zip(drivers, race.seats, strict=True)
        ]
        policies: dict[str, _Policy] = {}
        for number, (driver, env) in enumerate(zip(drivers, self._envs, strict=True)):
            if driver.source in policies:
                policies[driver.source].members.append(number)
                continue
            if wrap_env(env, driver.record.hyperparameters, trust=trust) is not env:
                raise ModelMismatch(
                    f"'{driver.source}' was trained behind a wrapper of its environment, which "
                    "cannot be put around one car of several; race an agent without one"
                )
            policies[driver.source] = _Policy(
                load_driver(driver.source, env, trust=trust), [number]
            )
        self._policies = list(policies.values())
        self.failed: dict[int, str] = {}
        """Agents that were taken out of the race, and why."""

    def begin(self, seed: int) -> None:
        """
        Begin the race on the grid.

        :param seed: of the environments
        """
        for env in self._envs:
            env.reset(seed=seed)
        for policy in self._policies:
            policy.state = None
        self.failed.clear()

    def act(self, tick: int) -> int:
        """
        Ask the agents whose timestep begins, and let their cars hold the answers. A car whose agent
        answers no number is taken out of the race.

        :param tick: control ticks that have been driven
        :return: control ticks until the next agent has to be asked
        """
        for policy in self._policies:
            due = tick % self._envs[policy.members[0]].action_repeat == 0
            if due and any(number not in self.failed for number in policy.members):
                self._ask(policy, tick == 0)
        return min(env.action_repeat - tick % env.action_repeat for env in self._envs)

    def _ask(self, policy: _Policy, race_begins: bool) -> None:
        """Ask a policy once, for all its cars."""
        seen = [self._envs[number].look() for number in policy.members]
        begins = np.full(len(policy.members), race_begins)
        try:
            actions, policy.state = policy.driver.predict(
                np.stack(seen), policy.state, begins, deterministic=True
            )
        except InvalidAction as error:
            for number in policy.members:
                self._take_out(number, error)
            return
        for number, action in zip(policy.members, actions, strict=True):
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


class AgentOpponents:
    """
    Agents as opponents, in a race that others have begun.

    :param sources: their names or paths
    :raises InvalidOption: if there is no such agent, or one cannot race
    """

    def __init__(self, sources: Sequence[str]) -> None:
        self._drivers = [find_driver(source) for source in sources]
        check_racers(self._drivers)
        self.cars = [driver.car for driver in self._drivers]
        self.gearboxes = [driver.gearbox for driver in self._drivers]
        self.angles = [driver.angles for driver in self._drivers]
        repeats = {driver.record.env_kwargs.get("action_repeat", 5) for driver in self._drivers}
        self.action_repeats: set[int] = repeats

    def take_seats(self, worlds: Sequence[SeatWorld]) -> None:
        """
        Load the agents.

        :param worlds: their cars, in the order of the drivers
        """
        self._race = SharedRace.of(worlds)
        self._pilots = Pilots(self._drivers, self._race)

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


def check_racers(drivers: Sequence[NamedDriver]) -> None:
    """
    Refuse drivers that cannot race others.

    :param drivers: of a race
    :raises InvalidOption: if one is a ghost
    """
    for driver in drivers:
        if driver.kind == "ghost":
            raise InvalidOption(
                f"'{driver.source}' is a ghost, which looks at nobody and cannot race"
            )
