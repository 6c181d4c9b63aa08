"""A picture of a race as people read it: place and gap over distance."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sb3_torcs.files import IN_A_FOLDER, atomic_file
from sb3_torcs.races.protocol import Race

__all__ = ["draw_race"]

AT_REST = 1.0  # [m] that a car which is out may still roll


def draw_race(race: Race, path: Path) -> None:
    """
    Draw the place of each driver, and how far it is behind the leader, over the leader's distance.

    The picture ends where the winner crosses the line, and a line with a cross where its car stops
    for good.

    :param race: at least a second of it
    :param path: of the picture; its ending is the format
    :raises OutputNotWritable: if the file cannot be written; the previous one is kept
    """
    from matplotlib.figure import Figure

    leader = race.distances.max(axis=1)
    raced = max(int((leader < race.goal).sum()), 1)  # moments; afterwards cars roll out
    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    places, gaps = figure.subplots(2, 1, sharex=True)
    out = {standing.driver for standing in race.standings if standing.out}
    for car, driver in enumerate(race.drivers):
        distance = race.distances[:, car]
        moved = np.flatnonzero(np.abs(distance - distance[-1]) > AT_REST)
        last = moved[-1] + 2 if driver in out and len(moved) else len(distance)
        kept = slice(min(last, raced))
        stops = driver in out and last <= raced
        looks = {"marker": "x", "markevery": [-1]} if stops else {}
        x = leader[kept] / 1000.0
        places.step(x, race.places[kept, car], where="post", label=driver, **looks)
        gaps.plot(x, leader[kept] - distance[kept], **looks)
    places.set_ylabel("place")
    places.set_yticks(np.arange(1, len(race.drivers) + 1))
    places.invert_yaxis()
    places.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    gaps.set_ylabel("behind the leader [m]")
    gaps.invert_yaxis()
    gaps.set_xlabel("distance of the leader [km]")
    with atomic_file(path, IN_A_FOLDER) as aside:
        figure.savefig(aside)
