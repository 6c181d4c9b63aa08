"""Let saved models drive three laps of many tracks, and compare them with the game's robots."""

import argparse
import statistics
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from math import inf, nan
from multiprocessing import get_context
from typing import NamedTuple

from rich.progress import track as progress

from sb3_torcs.agents import driver_record, load_driver
from sb3_torcs.car import DEFAULT_CAR
from sb3_torcs.cli.common import table
from sb3_torcs.errors import ends_in_a_line
from sb3_torcs.evaluation import evaluate, race_environment
from sb3_torcs.evaluation.ladder import ROBOTS, reference_laps
from sb3_torcs.tracks.catalogue import lasting_name, load_track, tracks_of

HEADERS = ("track", "laps", "flying lap s", "best robot s", "gap %", "damage", "distance m")

parser = argparse.ArgumentParser(description=__doc__)
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

    @property
    def whole(self) -> bool:
        """Whether all laps were driven."""
        return self.flying_lap < inf

    @property
    def gap(self) -> float:
        """By how much the lap is longer than that of the best robot [%]."""
        return 100 * (self.flying_lap / best_robot(self.track) - 1)

    def row(self) -> list[str]:
        times = (f"{self.flying_lap:.3f}", f"{self.gap:+.1f}") if self.whole else ("-", "-")
        return [
            self.track, str(self.laps), times[0], f"{best_robot(self.track):.3f}", times[1],
            f"{self.damage:.0f}", f"{self.distance:.0f}",
        ]  # fmt: skip


def best_robot(track: str) -> float:
    """The best flying lap [s] of the robots; NaN on a track that is not one of the game's."""
    laps = reference_laps(track)
    return min((laps[robot] for robot in ROBOTS if robot in laps), default=nan)


def drive(model: str, track: str) -> Drive:
    """Drive three laps from the grid."""
    record = driver_record(model)
    kwargs = {**record.env_kwargs, "car": DEFAULT_CAR}
    env = race_environment("Torcs-v0", kwargs, track, hyperparameters=record.hyperparameters)
    (race,) = evaluate(env, load_driver(model, env))
    env.close()
    lap = race.flying_lap if race.finished and race.flying_lap else inf
    return Drive(track, race.laps, lap, race.damage, race.distance)


def summary(drives: list[Drive]) -> str:
    """Say in a line how all tracks went."""
    whole = [drive for drive in drives if drive.whole]
    clean = sum(drive.damage == 0 for drive in whole)
    before_bt = sum(
        drive.flying_lap < reference_laps(drive.track).get("bt", nan) for drive in whole
    )
    before_all = sum(drive.gap < 0 for drive in whole)
    gap = statistics.median(drive.gap for drive in drives)  # without all laps it is infinite
    told = f"{gap:+.1f} %" if gap < inf else "unknown, since half of the tracks are not completed"
    return (
        f"completes {len(whole)} of {len(drives)}, {clean} without damage; median gap to the best "
        f"robot {told}; faster than bt on {before_bt}, than every robot on {before_all}"
    )


def main() -> None:
    args = parser.parse_args()
    listed = [track for name in args.track for track in tracks_of(name)]
    names = [lasting_name(load_track(track)) for track in listed]
    tracks = [name for name in names if name not in args.without]
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
