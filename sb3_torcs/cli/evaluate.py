"""``sb3-torcs evaluate``: drive some laps and report the results."""

from __future__ import annotations

import argparse
import contextlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sb3_torcs.cli.common import (
    DRIVER_HELP,
    TRUST_HELP,
    add_environment,
    environment_settings,
    named_driver,
    output_files,
    positive,
    print_json,
    quiet_output,
    seed,
    table,
)

if TYPE_CHECKING:
    from sb3_torcs.agents.drivers import NamedDriver
    from sb3_torcs.car import FloatArray
    from sb3_torcs.evaluation.protocol import Episode
    from sb3_torcs.telemetry import DriveLog

__all__ = ["add_parser", "run"]

FILES = {
    "video": (".mp4",), "line": (".png",), "telemetry": (".parquet",), "report": (".html",),
}  # fmt: skip
"""Endings of what can be written of a drive."""

NEEDS = {"video": "imageio_ffmpeg", "telemetry": "pyarrow", "report": "plotly"}
"""Packages of extras that files need."""

OTHERWISE = {
    "render_mode": "type --video FILE.mp4 for a video, or sb3-torcs watch DRIVER for a window",
    "max_episode_steps": "the time limit follows from the laps; type --laps L instead",
    "laps": "type --laps L instead",
}
"""Arguments of the environment that are chosen in another way, and how."""

HEADERS = ("episode", "laps", "lap times s", "distance m", "end", "damage", "return")

DESCRIPTION = """\
Drive some episodes from the grid, deterministically, and report the results.

An episode ends after --laps laps, or when the car leaves the road, faces backwards, stands still
or breaks. The time limit is long enough for the slowest car that does not count as standing still.

Environment, track, car, reward, sensors, actions and aids are those of an agent's training, unless
you give others. They are read from the model's record, or from the config.yml beside it. A robot
drives in the game, alone, in a practice session.
"""


class Evaluation(NamedTuple):
    """What was driven."""

    env_id: str
    track: str
    car: str
    episodes: list[Episode]
    log: DriveLog
    angles: FloatArray | None  # of the range finders


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "evaluate",
        help="drive laps with an agent, a robot or a ghost",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("driver", metavar="DRIVER", help=DRIVER_HELP)
    add_environment(parser)
    add("--episodes", type=positive, default=1, metavar="N", help="default: 1")
    add("--laps", type=positive, default=3, metavar="L", help="laps per episode; default: 3")
    add("--seed", type=seed, default=0, metavar="S", help="seed of the first reset; default: 0")
    add("--algo", help="the model's algorithm, if it cannot be found out")
    add("--trust", action="store_true", help=TRUST_HELP)
    add("--json", action="store_true", help="print one JSON object and nothing else")
    add("--video", metavar="FILE.mp4", help="record the best lap from above")
    add("--line", metavar="FILE.png", help="draw the line of the best lap, coloured by speed")
    add("--telemetry", metavar="FILE.parquet", help="write every control tick of the drives")
    add("--report", metavar="FILE.html", help="make the lap report, as `sb3-torcs compare` does")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    from sb3_torcs.errors import check_extras

    files = output_files(args, FILES)
    for what in files.keys() & NEEDS.keys():
        check_extras(f"--{what}", NEEDS[what])
    with quiet_output(args.json):
        driver = named_driver(args.driver)
        driven = _race(args, driver) if driver.robot else _drive(args, driver, bool(files))
    # Before the files: a full disk does not drop what was driven.
    where = {"env": driven.env_id, "track": driven.track, "car": driven.car}
    if args.json:
        print_json({**where, "episodes": [episode.as_dict() for episode in driven.episodes]})
    else:
        print(", ".join(where.values()))
        rows = [_row(number, episode) for number, episode in enumerate(driven.episodes, 1)]
        print(table(HEADERS, rows))
    with quiet_output(args.json):
        _write(files, driven)
    for what, path in files.items():
        if not args.json:
            print(f"{what}: {path}")
    return 0


def _write(files: dict[str, Path], driven: Evaluation) -> None:
    """
    Write the files that show the drives.

    :param files: by what they hold; loses those that cannot be made
    :param driven: what was driven
    """
    from sb3_torcs.evaluation.pictures import best_lap, draw_line, save_video

    if "line" in files:
        draw_line(best_lap(driven.log), files["line"])
    if "telemetry" in files:
        driven.log.write(files["telemetry"])
    if "report" in files and not _reported(files["report"], driven):
        print(f"sb3-torcs: no report: no whole lap of {driven.track} was driven", file=sys.stderr)
        del files["report"]
    if "video" in files:  # last: it takes longest, and may fail
        save_video(best_lap(driven.log), files["video"], driven.angles)


def _reported(path: Path, driven: Evaluation) -> bool:
    """Make the lap report, unless there is no whole lap; return whether it was made."""
    from sb3_torcs.evaluation.comparing import report_of
    from sb3_torcs.telemetry.laps import drives_of

    frame = driven.log.frame()
    if not any(drive.laps for drive in drives_of(frame)):
        return False
    *_, track = driven.log.tracks.values()  # which may be of somebody's own file
    report_of(frame, track).save(path)
    return True


def _race(args: argparse.Namespace, driver: NamedDriver) -> Evaluation:
    """Let a robot drive; it drives the same in each episode."""
    from sb3_torcs.errors import InvalidOption
    from sb3_torcs.evaluation.protocol import DEFAULT_TRACK, GAME, evaluate_robot
    from sb3_torcs.telemetry import DriveLog

    assert driver.robot is not None, "of a robot"
    if args.env not in (None, GAME):
        raise InvalidOption(f"--env is {args.env}, and a robot drives in {GAME}; leave --env out")
    others = [name for name in environment_settings(args) if name != "track"]
    if others:
        raise InvalidOption(
            f"{others[0]} is for an agent; a robot has its own car and set-up, e.g. "
            f"{driver.robot[0]}:1, and `sb3-torcs drivers` lists them"
        )
    track = environment_settings(args).get("track", DEFAULT_TRACK)
    log = DriveLog()
    episode = evaluate_robot(driver.robot, track, args.laps, log)
    label = next(iter(log.tracks))
    return Evaluation(GAME, log.tracks[label].name, label.car, [episode] * args.episodes, log, None)


def _drive(args: argparse.Namespace, driver: NamedDriver, noted: bool) -> Evaluation:
    """
    Build the environment, load the driver, drive.

    :param args: from the command line
    :param driver: an agent, a ghost, or the scripted one
    :param noted: whether to note every control tick
    """
    import gymnasium as gym

    from sb3_torcs.agents.models import load_driver, require_one
    from sb3_torcs.agents.wrapping import wrap_env
    from sb3_torcs.errors import InvalidOption
    from sb3_torcs.evaluation.protocol import GAME, KEPT, evaluate, time_limit
    from sb3_torcs.evaluation.ticks import log_drives
    from sb3_torcs.telemetry import DriveLog
    from sb3_torcs.torcs.track_names import RANDOM_TRACK
    from sb3_torcs.training.zoo import check_env_kwargs, check_racing

    given, record = environment_settings(args), driver.record
    for name, advice in OTHERWISE.items():
        if name in given:
            raise InvalidOption(f"--env-kwargs has {name}={given[name]}; {advice}")
    env_id = args.env or record.env_id or GAME
    check_racing(env_id)
    check_env_kwargs(given, env_id, "--env-kwargs")
    kwargs = {**record.select(KEPT), **given, "laps": args.laps}
    for name in ("track", "car"):
        require_one(name, kwargs.get(name))
    if args.report is not None and kwargs.get("track") == RANDOM_TRACK:
        raise InvalidOption("--report compares laps of one track; give --track a name")
    bare = gym.make(env_id, max_episode_steps=time_limit(kwargs), **kwargs)
    with contextlib.closing(bare):
        env = wrap_env(bare, record.hyperparameters, trust=args.trust)
        model = load_driver(driver.source, env, args.algo, args.trust)
        log = log_drives(bare, driver.name) if noted else DriveLog()
        episodes = evaluate(env, model, episodes=args.episodes, seed=args.seed)
        world = bare.get_wrapper_attr("backend")
        angles = bare.get_wrapper_attr("range_finder_angles")
        return Evaluation(env_id, world.track.name, world.car, episodes, log, angles)


def _row(number: int, episode: Episode) -> list[str]:
    times = ", ".join(f"{seconds:.3f}" for seconds in episode.lap_times) or "-"
    return [
        str(number),
        str(episode.laps),
        times,
        f"{episode.distance:.1f}",
        episode.end,
        f"{episode.damage:.0f}",
        "-" if episode.episode_return is None else f"{episode.episode_return:.2f}",
    ]
