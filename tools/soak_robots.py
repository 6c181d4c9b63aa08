"""Start robots all over the tracks, each race in a process of its own, and count what crashes.

Without arguments every robot that comes with the game drives with an agent on every installed
track, from 100 starts drawn at random: where, how fast and how the agent stands. The agent does at
random what agents do: it drives on, stands in the way, or reverses. The exit status is 1 if a
process died.
"""

import argparse
import multiprocessing
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track as progress

from sb3_torcs.backends.native import NativeBackend
from sb3_torcs.car import CONTROL_TICK, DEFAULT_CAR, Controls, Start
from sb3_torcs.cli.common import table
from sb3_torcs.errors import CarLost, InvalidOption, Sb3TorcsError, TrackFileError
from sb3_torcs.torcs.installation import find_game

SPAWN = multiprocessing.get_context("spawn")
TICKS = 10  # between two thoughts of the agent
FASTEST = 80.0  # [m/s]
REVERSE = -1
HEADERS = ("robots", "track", "starts", "refused", "lost", "crashed")


class Job(NamedTuple):
    """One field of robots on one track."""

    robots: tuple[str, ...]
    track: str
    starts: int
    seconds: float


def draw_start(rng: np.random.Generator, length: float) -> Start:
    """
    Draw a place on the road, or a little beside it.

    :param rng: source of chance
    :param length: of the track [m]
    """
    return Start(
        float(rng.uniform(0.0, length)),
        float(rng.uniform(-1.1, 1.1)),
        float(rng.normal(0.0, 0.3)),
        float(rng.uniform(0.0, FASTEST)) * int(rng.integers(2)),
    )


def draw_controls(rng: np.random.Generator, habit: int) -> Controls:
    """
    Draw what an agent of a certain habit does next.

    :param rng: source of chance
    :param habit: 0 drives on, 1 stands, 2 reverses
    """
    steering = float(rng.uniform(-0.3, 0.3))
    if habit == 1:
        return Controls(0.0, 0.0, 1.0)
    return Controls(steering, 1.0, 0.0, REVERSE if habit == 2 else None)


def drive(job: Job, done: Any, refused: Any, lost: Any) -> None:
    """
    Drive what is left of a job; in a process of its own.

    :param job: what to drive
    :param done: starts that were driven, counted up here
    :param refused: of these refused with an error of ours
    :param lost: of these ended by an error of ours
    """
    try:
        backend = NativeBackend(job.track, opponents=job.robots)
    except TrackFileError:  # its grid is too small
        refused.value += job.starts - done.value
        done.value = job.starts
        return
    while done.value < job.starts:
        rng = np.random.default_rng([done.value, *job.track.encode()])
        try:
            backend.reset(rng, draw_start(rng, backend.track.length))
            habit = int(rng.integers(3))
            for _ in range(int(job.seconds / CONTROL_TICK / TICKS)):
                backend.step(draw_controls(rng, habit), TICKS)
        except InvalidOption:
            refused.value += 1
        except CarLost:
            lost.value += 1
        done.value += 1
    backend.close()


def soak(job: Job) -> dict[str, Any]:
    """
    Drive a job to its end, however often its process dies.

    :param job: what to drive
    :return: what came of it
    """
    done, refused, lost = (SPAWN.Value("i", 0) for _ in range(3))
    crashed = []
    while done.value < job.starts:
        process = SPAWN.Process(target=drive, args=(job, done, refused, lost))
        process.start()
        process.join()
        if process.exitcode:
            crashed.append(done.value)
            done.value += 1
    return {
        "robots": job.robots,
        "track": job.track,
        "starts": job.starts,
        "refused": refused.value,
        "lost": lost.value,
        "crashed": crashed,
    }


def every_robot() -> list[str]:
    """Name one driver of each module that can drive here, that of the agent's car if it has one."""
    names = []
    for name, drivers in find_game().robots().items():
        for entry in sorted(drivers, key=lambda entry: entry.car != DEFAULT_CAR):
            try:
                find_game().find_robot(name, entry.index)
            except Sb3TorcsError:
                continue
            names.append(f"{name}:{entry.index}")
            break
    return names


def jobs_of(args: argparse.Namespace) -> list[Job]:
    """Say who drives where."""
    robots = args.robots.split(",") if args.robots else every_robot()
    tracks = args.tracks.split(",") if args.tracks else sorted(find_game().tracks())
    fields = [tuple(robots)] if args.together else [(robot,) for robot in robots]
    return [Job(field, track, args.starts, args.seconds) for track in tracks for field in fields]


def as_text(value: object) -> str:
    """Write a cell of the table."""
    return " ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)


def main() -> int:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", help="separated by commas; all without it")
    parser.add_argument("--tracks", help="separated by commas; all without it")
    parser.add_argument("--starts", type=int, default=100, help="of each on each track [100]")
    parser.add_argument("--seconds", type=float, default=5.0, help="driven after each [5]")
    parser.add_argument("--together", action="store_true", help="all robots in one race")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="at once")
    args = parser.parse_args()
    jobs = jobs_of(args)
    with ThreadPoolExecutor(args.processes) as threads:
        results = threads.map(soak, jobs)
        rows = list(progress(results, total=len(jobs), console=Console(stderr=True)))
    bad = [row for row in rows if row["crashed"]]
    if bad:
        print(table(HEADERS, [[as_text(value) for value in row.values()] for row in bad]))
    starts, refused, lost = (sum(row[name] for row in rows) for name in HEADERS[2:5])
    crashed = sum(len(row["crashed"]) for row in rows)
    print(f"{starts} starts: {crashed} crashed, {refused} refused, {lost} lost a car")
    return int(crashed > 0)


if __name__ == "__main__":
    sys.exit(main())
