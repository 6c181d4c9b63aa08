"""Laps of agents, robots and saved drives laid on each other: the lap report of drivers by name."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_torcs.agents.drivers import NamedDriver, find_driver
from sb3_torcs.agents.models import load_driver, require_one
from sb3_torcs.agents.robots import race
from sb3_torcs.agents.rollout import drive
from sb3_torcs.car import MANY_LAPS, check_count
from sb3_torcs.errors import DriveFileError, InvalidOption
from sb3_torcs.evaluation.protocol import DEFAULT_TRACK, GAME, RACE_LAPS, race_environment
from sb3_torcs.evaluation.ticks import log_drives
from sb3_torcs.files import writable_file
from sb3_torcs.telemetry.comparison import Comparison, compare_drives
from sb3_torcs.telemetry.document import write_document
from sb3_torcs.telemetry.drives import DriveLog, read_drives
from sb3_torcs.telemetry.laps import Drive, drives_of
from sb3_torcs.telemetry.page import lap_report
from sb3_torcs.torcs.track_names import RANDOM_TRACK
from sb3_torcs.tracks.catalogue import load_track
from sb3_torcs.tracks.track import Track

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["LapReport", "compare", "report_of", "saved_drives"]

HEIGHT = 900  # [px] of a report in a notebook

SAVED: dict[str, Callable[[Path], pd.DataFrame]] = {".parquet": read_drives}
"""Who reads a file of drives, by its ending. A ghost is none: it drives again, as an agent."""


@dataclass(frozen=True)
class LapReport:
    """
    A comparison of laps; in a notebook it shows itself.

    :param comparison: the figures
    """

    comparison: Comparison

    @cached_property
    def html(self) -> str:
        """The page, which needs no other file and no network."""
        return lap_report(self.comparison)

    def save(self, path: str | Path) -> Path:
        """
        Write the page.

        :param path: of the file, ending in ``.html``
        :return: the path
        :raises OutputNotWritable: if the file cannot be written
        """
        file = writable_file(path, (".html",))
        write_document(file, self.html)
        return file

    def _repr_html_(self) -> str:
        """Show the page in a notebook."""
        page = escape(self.html)
        return f'<iframe srcdoc="{page}" width="100%" height="{HEIGHT}" frameborder="0"></iframe>'


def compare(
    *drivers: str | Path, track: str | None = None, laps: int = RACE_LAPS, trust: bool = False
) -> LapReport:
    """
    Let drivers drive alone, and compare their best laps.

    :param drivers: agents, robots and files of saved drives; the first is what the others are
        measured against
    :param track: that they drive on; ``None`` is that of a saved drive, or of an agent's training
    :param laps: each drives so many from the grid, and its best flying one counts
    :param trust: run the code that is pickled in a model
    :return: the report
    :raises InvalidOption: if there is no such driver, or a drive is of another track
    :raises DriveFileError: if a file cannot be read, or no driver completes a lap
    """
    check_count("laps", laps, MANY_LAPS)
    if not drivers:
        raise InvalidOption("no driver is named; name some, e.g. ddpg-aalborg inferno")
    for driver in drivers:
        if not isinstance(driver, str | os.PathLike):
            raise InvalidOption(
                f"a driver is {driver!r}; expected names and paths, one after the other, e.g. "
                'compare("ddpg-aalborg", "inferno")'
            )
    saved = {driver: saved_drives(driver) for driver in drivers if is_saved(driver)}
    named = {driver: find_driver(driver) for driver in drivers if driver not in saved}
    where = _track(track, [*named.values()], saved)
    drives = []
    with ExitStack() as worlds:
        # All are made ready before anybody drives, so that what is wrong is told at once.
        ready = [
            None if driver in saved else _ready(named[driver], where, laps, trust, worlds)
            for driver in drivers
        ]
        for driver, drive_alone in zip(drivers, ready, strict=True):
            drives += saved[driver] if drive_alone is None else drive_alone()
    return LapReport(compare_drives(_numbered(drives), load_track(where)))


def report_of(
    frame: pd.DataFrame, track: Track | None = None, first: str | None = None
) -> LapReport:
    """
    Make the lap report of drives that are there already, such as those of a race.

    :param frame: of a :class:`~sb3_torcs.telemetry.DriveLog`, on one track
    :param track: which it is; ``None`` finds it by its name
    :param first: driver that the others are measured against; ``None`` is the first of the table
    :return: the report
    :raises DriveFileError: if no driver completed a lap
    """
    drives = sorted(drives_of(frame), key=lambda drive: drive.driver != first)
    if track is None:
        track = load_track(_track(None, (), {"": drives}))
    return LapReport(compare_drives(drives, track))


def is_saved(driver: str | Path) -> bool:
    """Whether a driver is a file of drives, by its ending."""
    return Path(driver).suffix.lower() in SAVED


def saved_drives(file: str | Path) -> list[Drive]:
    """
    Read the drives of a file.

    :param file: of saved drives, such as ``--telemetry`` writes
    :return: one per driver in it
    :raises DriveFileError: if it cannot be read
    """
    path = Path(os.path.expanduser(file))
    return drives_of(SAVED[path.suffix.lower()](path))


def _track(
    given: str | None, drivers: Sequence[NamedDriver], saved: dict[str | Path, list[Drive]]
) -> str:
    """Choose the track, and make sure that saved drives are of it."""
    stored = [drive for drives in saved.values() for drive in drives]
    names = list(dict.fromkeys(drive.track for drive in stored))
    track = given
    if track is None:
        track = next(iter(names), None) or _trained_on(drivers)
    if track == RANDOM_TRACK:
        raise InvalidOption(
            f"laps of one track are compared, and '{track}' is another one each time; give --track "
            "a name: `sb3-torcs tracks` lists them"
        )
    others = [drive for drive in stored if not _same_track(drive.track, track)]
    if others:
        told = ", ".join(f"{drive.driver} on {drive.track}" for drive in others)
        raise DriveFileError(
            f"laps of different tracks cannot be compared: {told}, not on {track}; "
            f"name drives of one track{'' if given is None else ', or leave out --track'}"
        )
    return track


def _same_track(stored: str, track: str) -> bool:
    """Whether the name in a drive is that of a track: with its category or without, or a path."""
    return Path(stored).stem in (Path(track).stem, load_track(track).name)


def _trained_on(drivers: Sequence[NamedDriver]) -> str:
    """Return the track of the first agent whose training is known."""
    for driver in drivers:
        track = driver.record.env_kwargs.get("track")
        if track is not None:
            return str(require_one("track", track))
    return DEFAULT_TRACK


def _ready(
    driver: NamedDriver, track: str, laps: int, trust: bool, worlds: ExitStack
) -> Callable[[], list[Drive]]:
    """
    Make a robot or an agent ready to drive, an agent where it was trained.

    :param driver: that drives
    :param track: that it drives on
    :param laps: to drive
    :param trust: run the code that is pickled in a model
    :param worlds: which closes the agent's
    :return: what lets it drive
    """
    robot, record = driver.robot, driver.record
    if robot is not None:
        log = DriveLog()

        def race_alone() -> list[Drive]:
            race([robot], track, laps, log=log)
            return drives_of(log.frame())

        return race_alone
    env = race_environment(
        record.env_id or GAME,
        {**record.env_kwargs, "car": record.one_car},
        track,
        laps=laps,
        hyperparameters=record.hyperparameters,
        trust=trust,
    )
    worlds.callback(env.close)
    log = log_drives(env, driver.name)
    pilot = load_driver(driver.source, env, trust=trust)

    def drive_alone() -> list[Drive]:
        for _ in drive(env, pilot, seed=0):
            pass
        return drives_of(log.frame())

    return drive_alone


def _numbered(drives: Sequence[Drive]) -> list[Drive]:
    """Number drivers of one name."""
    told: dict[str, Drive] = {}
    for one in drives:
        name, count = one.driver, 1
        while name in told:
            count += 1
            name = f"{one.driver} ({count})"
        told[name] = replace(one, driver=name)
    return [*told.values()]
