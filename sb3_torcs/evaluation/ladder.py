"""The ladder: rank a driver on a track against the scripted driver and the game's robots.

Their laps were measured by the engine (``tools/reference_laps.py``) and are shipped.
"""

from __future__ import annotations

import csv
import functools
from collections.abc import Iterable
from pathlib import Path

from sb3_torcs.agents.scripted import SCRIPTED
from sb3_torcs.car import DEFAULT_CAR
from sb3_torcs.evaluation.protocol import Episode

__all__ = ["REFERENCE_FIELDS", "ROBOTS", "RUNGS", "reference_laps", "rung"]

ROBOTS = ("inferno", "berniw", "tita", "lliaw", "bt", "olethros")
"""Robots that have a driver in every car of the class that is raced here."""

RUNGS = ("finishes", "beats scripted", "beats bt", "beats the best robot")
"""From the lowest to the highest; who stands on one has climbed all below."""

REFERENCE_FIELDS = ("track", "driver", "car", "standing_lap_s", "best_flying_lap_s")
REFERENCE_FILE = Path(__file__).parents[1] / "data" / "reference_laps.csv"
REFERENCE_ENV = "Torcs-v0"  # laps of another world say nothing here


@functools.cache
def reference_laps(track: str, car: str = DEFAULT_CAR) -> dict[str, float]:
    """
    Look up the laps of the other drivers.

    :param track: its name, without category
    :param car: that they drive it with
    :return: best flying laps [s] by driver; without drivers that do not finish three laps
    """
    with REFERENCE_FILE.open(newline="", encoding="utf-8") as file:
        return {
            row["driver"]: float(row["best_flying_lap_s"])
            for row in csv.DictReader(line for line in file if not line.startswith("#"))
            if row["track"] == track and row["car"] == car and row["best_flying_lap_s"]
        }


def rung(race: Episode, env_id: str, car: str, track: str) -> str:
    """
    Return the rung of a race of three laps from the grid.

    :param race: what was driven
    :param env_id: where
    :param car: with what
    :param track: its name, without category
    :return: one of :data:`RUNGS`, or nothing
    """
    if not race.finished:
        return ""
    laps = reference_laps(track, car) if env_id == REFERENCE_ENV else {}
    if not laps or race.flying_lap is None:
        return RUNGS[0]
    height = 0
    for rivals in ((SCRIPTED,), ("bt",), ROBOTS):
        if not _beaten(race.flying_lap, laps, rivals):
            break
        height += 1
    return RUNGS[height]


def _beaten(lap: float, laps: dict[str, float], rivals: Iterable[str]) -> bool:
    """Whether a lap is better than those of all rivals who finished."""
    return all(lap < laps[rival] for rival in rivals if rival in laps)
