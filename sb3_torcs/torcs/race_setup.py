"""The files that the game reads before a race: its set-up, and the SCR server's drivers."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sb3_torcs.car import DEFAULT_CAR, MANY_LAPS, checked_choice, checked_laps
from sb3_torcs.errors import GameIncomplete, InvalidOption
from sb3_torcs.torcs.installation import Game
from sb3_torcs.torcs.nodes import Node
from sb3_torcs.torcs.starting_list import GRID_SLOTS

__all__ = [
    "RACE_FILE",
    "SCR_DRIVER",
    "SCR_DRIVERS",
    "SCR_SERVER",
    "SESSIONS",
    "RaceSetup",
    "Session",
    "session_for",
    "write_race",
]

Session = Literal["practice", "race"]
SESSIONS: Mapping[str, str] = {"practice": "practice", "race": "quickrace"}
"""The game's own descriptions of the sessions; all but track, drivers and laps stays as there."""

RACE_FILE = "race.xml"  # names the folder of the results, too
ENGINE_SETTINGS = "config/raceengine.xml"

SCR_SERVER = "scr_server"
SCR_DRIVER = (SCR_SERVER, 0)  # the first driver of our own module
"""The module whose drivers are clients of the SCR protocol."""
SCR_DRIVERS = 10  # of the module, as that of the championship had


def session_for(drivers: Sequence[tuple[str, int]]) -> Session:
    """
    Say which session a number of drivers calls for.

    :param drivers: names and indices
    :return: ``"practice"`` for one, ``"race"`` for several
    """
    return "race" if len(drivers) > 1 else "practice"


@dataclass(frozen=True)
class RaceSetup:
    """
    The set-up of a race.

    :param track: ``"aalborg"``, ``"road/aalborg"``, or the path of a TORCS XML file
    :param drivers: modules and indices, the first one at the head of the grid;
        ``("scr_server", 0)`` is the first of our own module
    :param laps: to drive
    :param session: ``"practice"``, for one driver, lap by lap; or ``"race"``
    :param car: of the drivers of ``scr_server``, or of each of them, by their indices
    :raises InvalidOption: if the game cannot run this race
    """

    track: str | os.PathLike[str]
    drivers: Sequence[tuple[str, int]]
    laps: int = MANY_LAPS
    session: Session = "practice"
    car: str | Sequence[str] = DEFAULT_CAR

    def __post_init__(self) -> None:
        checked_choice("session", self.session, SESSIONS)
        checked_laps(self.laps)
        drivers = list(self.drivers)
        if not drivers:
            raise InvalidOption("no robot is named; name at least one")
        for driver in drivers:
            if isinstance(driver, str) or not isinstance(driver, Sequence) or len(driver) != 2:
                raise InvalidOption(
                    f"robots hold {driver!r}; expected pairs of a name and an index, e.g. "
                    "[('inferno', 3), ('bt', 1)]"
                )
        twice = next((driver for driver in drivers if drivers.count(driver) > 1), None)
        if twice is not None:
            raise InvalidOption(
                f"robot '{twice[0]}:{twice[1]}' is named twice; name each robot once, e.g. "
                "inferno:3,inferno:4"
            )
        if self.session == "practice" and len(drivers) != 1:
            raise InvalidOption(
                f"a practice is for one robot, but {len(drivers)} are named; choose session 'race'"
            )
        if len(drivers) > GRID_SLOTS:
            raise InvalidOption(
                f"{len(drivers)} cars are named; a grid of the game has room for {GRID_SLOTS}"
            )
        for name, index in drivers:
            if name == SCR_SERVER and not 0 <= index < SCR_DRIVERS:
                raise InvalidOption(
                    f"{SCR_SERVER} has no driver {index}; expected 0 to {SCR_DRIVERS - 1}"
                )

    @property
    def has_clients(self) -> bool:
        """Whether there are clients of the SCR protocol."""
        return any(name == SCR_SERVER for name, _ in self.drivers)

    def client_car(self, index: int) -> str:
        """
        Return the car of a driver of ``scr_server``.

        :param index: of the driver
        """
        return self.car if isinstance(self.car, str) else self.car[index]

    def driver_name(self, slot: int, game: Game) -> str:
        """
        Return a driver's name as the game's window has it.

        :param slot: on the grid, from 0
        :param game: the installation
        """
        name, index = self.drivers[slot]
        return f"{name} {index}" if name == SCR_SERVER else game.find_robot(name, index).name

    def cars(self, game: Game) -> list[str]:
        """
        List the drivers' cars.

        :param game: the installation
        :return: the cars of the drivers, in their order
        """
        return [
            self.client_car(index) if name == SCR_SERVER else game.find_robot(name, index).car
            for name, index in self.drivers
        ]


def write_race(game: Game, folder: Path, race: RaceSetup) -> str:
    """
    Write what the game reads: its own settings, the race, and our drivers if there are any.

    :param game: the installation
    :param folder: private to the game
    :param race: who races where; its track by ``category/name``
    :return: the name of the race in the results
    :raises GameIncomplete: if the game lacks a file, or has a broken one
    """
    settings = folder / ENGINE_SETTINGS
    settings.parent.mkdir(exist_ok=True)
    _needed(game, ENGINE_SETTINGS)
    shutil.copyfile(game.data / ENGINE_SETTINGS, settings)
    if race.has_clients:
        _write_scr_drivers(folder, race)
        _forbid_learning(folder, race)
    template = f"config/raceman/{SESSIONS[race.session]}.xml"
    _needed(game, template)
    try:
        root = Node.read(game.data / template)
        race_name = root.find("Races", "1").text("name")
        root.find(race_name).set("laps", race.laps)
        category, _, name = str(race.track).rpartition("/")
        (place,) = root.find("Tracks").number_sections(1)
        place.set("name", name)
        place.set("category", category)
        entries = root.find("Drivers").number_sections(len(race.drivers))
    except (ValueError, LookupError) as error:
        raise GameIncomplete(
            f"{game.data / template} is broken ({error}); type: `sb3-torcs install-torcs`"
        ) from error
    for entry, (module, index) in zip(entries, race.drivers, strict=True):
        entry.set("idx", index)
        entry.set("module", module)
    root.write(folder / RACE_FILE)
    return race_name


def _write_scr_drivers(folder: Path, race: RaceSetup) -> None:
    """
    Describe the drivers of our module, as the game wants it of a robot.

    :param folder: private to the game
    :param race: in which they drive
    """
    root = Node.new(SCR_SERVER, "robotdef")
    for number in sorted(index for name, index in race.drivers if name == SCR_SERVER):
        driver = root.make("Robots", "index", str(number))
        driver.set("name", f"{SCR_SERVER} {number}")
        driver.set("team", SCR_SERVER)
        driver.set("author", "sb3_torcs")
        driver.set("car name", race.client_car(number))
        driver.set("race number", number + 1)
        for channel, share in (("red", 1.0), ("green", 0.4), ("blue", 0.0)):
            driver.set(channel, share)
    file = folder / "drivers" / SCR_SERVER / f"{SCR_SERVER}.xml"
    file.parent.mkdir(parents=True)
    root.write(file)


def _forbid_learning(folder: Path, race: RaceSetup) -> None:
    """
    Keep robots from saving what they learn: after a restart they would drive differently.

    :param folder: private to the game
    :param race: who races where
    """
    for module, _ in race.drivers:
        if module != SCR_SERVER:
            (folder / "drivers" / module).touch()  # the file is where they would make a folder


def _needed(game: Game, file: str) -> None:
    """Make sure that a file of the game's data is there."""
    if not (game.data / file).is_file():
        raise GameIncomplete(f"there is no {game.data / file}; type: `sb3-torcs install-torcs`")
