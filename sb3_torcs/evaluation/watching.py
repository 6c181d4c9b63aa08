"""A driver's race in the game's window."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sb3_torcs.agents.drivers import NamedDriver
from sb3_torcs.agents.remote import Agent
from sb3_torcs.car import DEFAULT_CAR
from sb3_torcs.errors import GameFailed, ServerLost
from sb3_torcs.scr.protocol import plain_name
from sb3_torcs.scr.server import open_ports, start_server
from sb3_torcs.torcs.installation import Game
from sb3_torcs.torcs.process import GameProcess
from sb3_torcs.torcs.race_results import RobotResult
from sb3_torcs.torcs.race_setup import SCR_DRIVER, RaceSetup, session_for
from sb3_torcs.torcs.results import read_results
from sb3_torcs.torcs.window import Window, window_arguments
from sb3_torcs.tracks.trial import check_track

__all__ = ["Show", "show_in_window"]

AFTERMATH = 2.0  # [s] of the race that are shown after an agent's drive has ended


@dataclass
class Show:
    """
    A race, and the driver whom the camera follows.

    :param game: the installation
    :param track: as of :class:`~sb3_torcs.torcs.race_setup.RaceSetup`
    :param driver: whom the camera follows
    :param settings: of an agent's environment: ``car``, ``action_repeat`` and so on
    :param opponents: names and indices of robots, which start behind
    :param laps: to drive
    :param trust: run what is pickled in the model
    """

    game: Game
    track: str | Path
    driver: NamedDriver
    settings: Mapping[str, Any] = field(default_factory=dict)
    opponents: Sequence[tuple[str, int]] = ()
    laps: int = 1
    trust: bool = False
    agent: Agent | None = None
    results: list[RobotResult] = field(default_factory=list)

    @property
    def race(self) -> RaceSetup:
        """The set-up of the race."""
        drivers = [self.driver.robot or SCR_DRIVER, *self.opponents]
        car = self.settings.get("car", DEFAULT_CAR)
        return RaceSetup(self.track, drivers, self.laps, session_for(drivers), car)

    @property
    def driver_name(self) -> str:
        """The driver's name, as the game shows it."""
        if self.driver.robot is not None:
            return self.game.find_robot(*self.driver.robot).name
        return plain_name(self.driver.name)

    def start(self, window: Window) -> GameProcess:
        """
        Start the game, and connect the agent to its car.

        :param window: of the game
        :return: the game
        """
        if self.driver.robot is not None:
            arguments = window_arguments(self.game, window)
            return GameProcess(self.game, self.race, check=check_track, **arguments)
        (bound,) = open_ports(1)
        with bound:
            address = {"host": "127.0.0.1", "port": bound.getsockname()[1]}
            process = start_server(self.game, self.race, [bound], window=window)
        try:
            settings = {"track": self.track, "scr": address, **self.settings}
            self.agent = Agent(
                self.driver.source, settings, trust=self.trust, name=self.driver_name
            )
        except BaseException:
            process.stop()
            raise
        return process


def show_in_window(show: Show, window: Window) -> None:
    """
    Show a race in real time, to its end or until the window is closed.

    :param show: the race
    :param window: of the game
    :raises GameFailed: if the game ends with an error
    """
    with show.start(window) as process:
        if show.agent is not None:
            try:
                show.agent.drive(AFTERMATH)
            except ServerLost as error:
                if not process.is_ending():
                    raise
                raise GameFailed(process.epitaph()) from error
            if show.agent.end is not None:
                return
        process.wait()
        if process.poll() == 0:
            show.results = read_results(process, show.race, show.race.cars(show.game))
