"""Drivers by name: agents, models' files, ghosts, robots of the game, and the scripted driver."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

from sb3_torcs.agents.ghosts import is_ghost, read_ghost, shipped_ghosts
from sb3_torcs.agents.models import AGENTS, driver_name, driver_record, find_model, shipped_agents
from sb3_torcs.agents.saved.record import BEST_MODEL, TrainingRecord
from sb3_torcs.agents.scripted import SCRIPTED
from sb3_torcs.car import FloatArray, range_finder_angles
from sb3_torcs.envs.options import AidName
from sb3_torcs.errors import BackendUnavailable, InvalidOption, UnknownDriver, near_miss
from sb3_torcs.torcs.installation import INSTALL, Game, find_game

__all__ = ["DriverRow", "Kind", "NamedDriver", "find_driver", "find_drivers", "list_drivers"]

LISTED = "`sb3-torcs drivers` lists them, and a trained model is named by its file or folder"

Kind = Literal["agent", "robot", "ghost", "scripted"]


@dataclass(frozen=True)
class NamedDriver:
    """
    A driver, found by its name.

    :param name: for boards and tables
    :param kind: what it is; the file of a saved model is an agent
    :param source: what was typed: a name, or a path
    :param robot: name and index of a robot
    :param record: of an agent's training, or of a ghost's drive
    :param aids: driver aids that an agent gets besides those of its training
    """

    name: str
    kind: Kind
    source: str
    robot: tuple[str, int] | None = None
    record: TrainingRecord = field(default_factory=TrainingRecord)
    aids: tuple[AidName, ...] = ()

    @property
    def car(self) -> str:
        """The car of an agent or a ghost."""
        return self.record.one_car

    @property
    def gearbox(self) -> str:
        """The gearbox of an agent's car."""
        gearbox: str = self.record.env_kwargs.get("gearbox", "automatic")
        return gearbox

    @cached_property
    def angles(self) -> FloatArray:
        """(19,) [rad] of the range finders of an agent's car."""
        return range_finder_angles(self.record.env_kwargs.get("range_finders", "scr"))

    def options(self, names: Iterable[str]) -> dict[str, Any]:
        """
        Select keyword arguments of the environment in which an agent drives as in its training.

        :param names: of keyword arguments
        :return: those that its training had, and the aids that it got
        """
        kept = self.record.select(names)
        return {**kept, "aids": (*kept.get("aids", ()), *self.aids)} if self.aids else kept


def find_driver(source: str | Path, aids: Sequence[AidName] = ()) -> NamedDriver:
    """
    Find a driver by its name.

    :param source: a shipped agent, a saved model's ``.zip`` or its run's folder, a robot, e.g.
        ``"inferno"`` or ``"bt:3"``, a ghost, or ``"scripted"``
    :param aids: driver aids that an agent gets besides those of its training
    :raises InvalidOption: if there is none; the message names the nearest
    """
    text, game = str(source), _installed_game()
    if text == SCRIPTED:
        return NamedDriver(SCRIPTED, "scripted", text, aids=tuple(aids))
    if is_ghost(source):
        return NamedDriver(driver_name(source), "ghost", text, record=driver_record(source))
    if game is not None and game.has_robot(text):
        robot = game.parse_robot(text)
        return NamedDriver(game.robot_name(robot), "robot", text, robot)
    try:
        record = driver_record(source)
    except UnknownDriver:
        if Path(text).name != text or Path(text).suffix:  # a path, whose error names the file
            raise
        robots = [] if game is None else [*game.robots()]
        names = [*shipped_agents(), *shipped_ghosts(), *robots, SCRIPTED]
        advice = LISTED
        if game is None:
            advice += f"; there are no robots, since TORCS was not found; type: {INSTALL}"
        raise UnknownDriver(
            f"there is no driver '{text}'{near_miss(text, names, advice)}"
        ) from None
    return NamedDriver(driver_name(source), "agent", text, record=record, aids=tuple(aids))


def find_drivers(sources: Sequence[str | Path], aids: Sequence[AidName] = ()) -> list[NamedDriver]:
    """
    Find drivers by their names.

    :param sources: as of :func:`find_driver`
    :param aids: driver aids that each agent gets besides those of its training
    :return: in the same order; names that would be equal have folders before them
    :raises InvalidOption: if one is named twice, or there is none of this name
    """
    drivers = [find_driver(source, aids) for source in sources]
    driven = [_what_drives(driver) for driver in drivers]
    for driver, what in zip(drivers, driven, strict=True):
        if driven.count(what) > 1:
            raise InvalidOption(f"driver '{driver.source}' is named twice; name each driver once")
    return _with_folders(drivers)


def _installed_game() -> Game | None:
    """Return the installation; without one there are no robots."""
    try:
        return find_game()
    except BackendUnavailable:
        return None


def _what_drives(driver: NamedDriver) -> object:
    """Identify what drives: a robot and its index, a file, or the scripted driver."""
    if driver.kind == "agent":
        return find_model(driver.source).resolve()
    return driver.robot or driver.source


def _with_folders(drivers: Sequence[NamedDriver]) -> list[NamedDriver]:
    """Put folders before names that are equal, as many as it takes."""
    names = [driver.name for driver in drivers]
    parts = {
        number: _parts(driver)
        for number, driver in enumerate(drivers)
        if names.count(driver.name) > 1
    }

    def name(number: int) -> str:
        own = parts[number]
        others = [other for key, other in parts.items() if key != number]
        for size in range(1, len(own) + 1):
            if not any(other[-size:] == own[-size:] for other in others):
                return "/".join(own[-size:])
        return "/".join(own)

    return [
        replace(driver, name=name(number)) if number in parts else driver
        for number, driver in enumerate(drivers)
    ]


def _parts(driver: NamedDriver) -> tuple[str, ...]:
    """Split where an agent is into folders and its name; robots and shipped agents have no more."""
    if driver.kind != "agent" or driver.source in shipped_agents():
        return (driver.name,)
    path = Path(os.path.abspath(os.path.expanduser(driver.source)))
    folder = path.parent
    if path.name in (BEST_MODEL, Path(BEST_MODEL).stem):
        folder = folder.parent
    return (*folder.parts[1:], driver.name)


class DriverRow(NamedTuple):
    """A driver in the list of all."""

    name: str
    kind: Kind
    does: str


def list_drivers() -> list[DriverRow]:
    """List the drivers that come with the package, and the robots of the installed game."""
    rows = [DriverRow(name, "agent", _agent_does(name)) for name in shipped_agents()]
    rows += [DriverRow(name, "ghost", _ghost_does(name)) for name in shipped_ghosts()]
    game = _installed_game()
    if game is not None:
        robots = [(name, _robot_does(game, name)) for name in game.robots()]
        rows += [DriverRow(name, "robot", does) for name, does in robots if does]
    return [*rows, DriverRow(SCRIPTED, "scripted", "drives any road by its range finders")]


def _agent_does(name: str) -> str:
    """Return the first sentence of an agent's card."""
    card = (AGENTS / name / "README.md").read_text(encoding="utf-8")
    text = " ".join(card.partition("\n\n")[2].partition("\n\n")[0].split())
    return re.split(r"(?<=[.:]) ", text, maxsplit=1)[0].rstrip(".:").replace("`", "")


def _ghost_does(name: str) -> str:
    ghost = read_ghost(name)
    where = f"{ghost.env_kwargs['track']} in {ghost.env_kwargs['car']}"
    return f"repeats a drive of {where}, best lap {min(ghost.lap_times):.3f} s"


def _robot_does(game: Game, name: str) -> str:
    """Name the cars of a robot; some packages leave cars out."""
    cars = game.cars()
    entries = [entry for entry in game.robots()[name] if entry.car in cars]
    if not entries:
        return ""
    usual = game.parse_robot(name)[1]
    first = next((entry for entry in entries if entry.index == usual), entries[0])
    others = [f"{name}:{entry.index} {entry.car}" for entry in entries if entry is not first]
    return f"drives {first.car}" + (f"; {', '.join(others)}" if others else "")
