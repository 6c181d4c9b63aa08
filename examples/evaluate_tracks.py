"""Let saved models drive three laps of many tracks, and compare them with the game's robots.

On tracks that the game did not bring, such as those of random_roads.py, the robots drive first.
"""

import argparse
import functools
import statistics
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from math import inf, isnan, nan
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

from rich.progress import track as progress

from sb3_torcs.agents import driver_record, load_driver
from sb3_torcs.agents.robots import race
from sb3_torcs.car import DEFAULT_CAR
from sb3_torcs.cli.common import table
from sb3_torcs.errors import ends_in_a_line
from sb3_torcs.evaluation import evaluate, race_environment
from sb3_torcs.evaluation.ladder import ROBOTS, reference_laps
from sb3_torcs.evaluation.protocol import RACE_LAPS
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.tracks.catalogue import load_track, stable_name, tracks_of

HEADERS = ("track", "laps", "flying lap s", "best robot s", "gap %", "damage", "distance m")

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("model", nargs="+", help="a .zip, the folder of a run, or a shipped agent")
parser.add_argument(
    "--track", nargs="+", default=["road"], help="tracks, or kinds of them: road, oval, dirt"
)
parser.add_argument("--without", nargs="+", default=[], help="tracks to leave out")
parser.add_argument("--jobs", type=int, help="tracks at a time; default: one per core")


class Drive(NamedTuple):
    """How three laps of a track went."""

    track: str
    laps: int
    flying_lap: float  # [s] infinite if the laps were not all driven
    damage: float  # [points]
    distance: float  # [m]
    robots: dict[str, float]  # their best flying laps [s]

    @property
    def whole(self) -> bool:
        """Whether all laps were driven."""
        return self.flying_lap < inf

    @property
    def gap(self) -> float:
        """By how much the lap is longer than that of the best robot [%]."""
        return 100 * (self.flying_lap / self.best_robot - 1)

    @property
    def best_robot(self) -> float:
        """The best flying lap of the robots [s]; NaN if none of them finishes."""
        return min(self.robots.values(), default=nan)

    def row(self) -> list[str]:
        times = (f"{self.flying_lap:.3f}", f"{self.gap:+.1f}") if self.whole else ("-", "-")
        return [
            Path(self.track).stem, str(self.laps), times[0], f"{self.best_robot:.3f}", times[1],
            f"{self.damage:.0f}", f"{self.distance:.0f}",
        ]  # fmt: skip


@functools.cache
def robot_laps(track: str) -> dict[str, float]:
    """Return the best flying laps [s] of the robots that finish three laps."""
    known = {robot: lap for robot, lap in reference_laps(track).items() if robot in ROBOTS}
    return known or {
        robot: min(lap.time for lap in result.laps[1:])
        for robot in ROBOTS
        for result in race([find_game().parse_robot(robot)], track, RACE_LAPS)
        if len(result.laps) == RACE_LAPS and result.car == DEFAULT_CAR
    }


def drive(model: str, track: str) -> Drive:
    """Drive three laps from the grid."""
    record = driver_record(model)
    kwargs = {**record.env_kwargs, "car": DEFAULT_CAR}
    env = race_environment("Torcs-v0", kwargs, track, hyperparameters=record.hyperparameters)
    (driven,) = evaluate(env, load_driver(model, env))
    env.close()
    lap = driven.flying_lap if driven.finished and driven.flying_lap else inf
    return Drive(track, driven.laps, lap, driven.damage, driven.distance, robot_laps(track))


def summary(drives: list[Drive]) -> str:
    """Say in a line how all tracks went."""
    whole = [drive for drive in drives if drive.whole]
    clean = sum(drive.damage == 0 for drive in whole)
    before_bt = sum(drive.flying_lap < drive.robots.get("bt", nan) for drive in whole)
    before_all = sum(drive.gap < 0 for drive in whole)
    # Without all laps a gap is infinite; where no robot finishes, there is none.
    gap = statistics.median([drive.gap for drive in drives if not isnan(drive.gap)] or [inf])
    told = f"{gap:+.1f} %" if gap < inf else "unknown, since half of the tracks are not completed"
    return (
        f"completes {len(whole)} of {len(drives)}, {clean} without damage; median gap to the best "
        f"robot {told}; faster than bt on {before_bt}, than every robot on {before_all}"
    )


def main() -> None:
    args = parser.parse_args()
    names, without = (
        [stable_name(load_track(track)) for word in words for track in tracks_of(word)]
        for words in (args.track, args.without)
    )
    tracks = [name for name in names if name not in without]
    if not tracks:
        parser.error("no track is left; name another --track")
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        for model in args.model:
            drives = list(
                progress(pool.map(partial(drive, model), tracks), model, total=len(tracks))
            )
            print(table(HEADERS, [drive.row() for drive in drives]))
            print(f"{model}: {summary(drives)}\n")


if __name__ == "__main__":
    with ends_in_a_line():
        main()
