"""A picture of a race as people read it: place and gap over distance."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sb3_torcs.files import IN_A_FOLDER, whole_file
from sb3_torcs.races.protocol import Race

__all__ = ["draw_race"]


def draw_race(race: Race, path: Path) -> None:
    """
    Draw the place of each driver, and how far it is behind the leader, over the leader's distance.

    :param race: at least a second of it
    :param path: of the picture; its ending is the format
    :raises OutputNotWritable: if the file cannot be written; the previous one is kept
    """
    from matplotlib.figure import Figure

    leader = race.distances.max(axis=1)
    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    places, gaps = figure.subplots(2, 1, sharex=True)
    for car, driver in enumerate(race.drivers):
        places.step(leader / 1000.0, race.places[:, car], where="post", label=driver)
        gaps.plot(leader / 1000.0, race.distances[:, car] - leader)
    places.set_ylabel("place")
    places.set_yticks(np.arange(1, len(race.drivers) + 1))
    places.invert_yaxis()
    places.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    gaps.set_ylabel("behind the leader [m]")
    gaps.set_xlabel("distance of the leader [km]")
    with whole_file(path, IN_A_FOLDER) as aside:
        figure.savefig(aside)
