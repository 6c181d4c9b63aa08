"""``sb3-torcs evaluate``: drive some laps and report the results."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_torcs.car import DEFAULT_CAR
from sb3_torcs.cli.common import (
    MODEL_HELP,
    TRUST_HELP,
    asked_files,
    positive,
    print_json,
    quiet_output,
    seed,
    setting,
    table,
    told_record,
)

if TYPE_CHECKING:
    from sb3_torcs.agents.models import TrainingRecord
    from sb3_torcs.evaluation.protocol import Episode
    from sb3_torcs.evaluation.recording import Recorder
    from sb3_torcs.telemetry import DriveLog

__all__ = ["add_parser", "environment_kwargs", "run"]

FILES = {
    "video": (".mp4",), "line": (".png",), "telemetry": (".parquet", ".csv"), "report": (".html",),
}  # fmt: skip
"""Endings of what can be written of a drive."""

OPTIONS = ("track", "car", "laps", "action_repeat", "range_finders")
"""Arguments of the environment that have an option of their own."""

HEADERS = ("episode", "laps", "lap times s", "distance m", "end", "damage", "return")

DESCRIPTION = """\
Drive some episodes from the grid, deterministically, and report the results.

An episode ends after --laps laps, or when the car leaves the road, faces backwards, stands still
or breaks. The time limit is long enough for the slowest car that does not count as standing still.

Environment, track, car, reward, action repeat and range finders are those of the training, unless
you give others. They are read from the model's record, or from the config.yml beside it. A model
without either drives in the game, or in TorcsLite-v0 where Torcs-v0 does not run; standard error
tells which, and why.
"""


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "evaluate",
        help="drive laps with a saved model",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("model", metavar="MODEL", help=MODEL_HELP)
    add("--env", metavar="ID", help="default: that of the training, or Torcs-v0 if it runs here")
    add("--track", metavar="T", help="default: that of the training, or aalborg; needed if the "
        "training had several")  # fmt: skip
    add("--car", metavar="C", help=f"default: that of the training, or {DEFAULT_CAR}; needed if "
        "the training had several")  # fmt: skip
    add("--episodes", type=positive, default=1, metavar="N", help="default: 1")
    add("--laps", type=positive, default=3, metavar="L", help="laps per episode; default: 3")
    add("--seed", type=seed, default=0, metavar="S", help="seed of the first reset; default: 0")
    add("--action-repeat", type=positive, metavar="N", help="control ticks of 0.02 s per timestep")
    add("--range-finders", metavar="SET", help="scr or narrow")
    add(
        "--env-kwargs",
        nargs="+",
        type=setting,
        default=[],
        metavar="NAME=VALUE",
        help="other arguments of the environment, e.g. delay=2 or opponents='[inferno, bt]'",
    )
    add("--algo", help="the model's algorithm, if it cannot be found out")
    add("--trust", action="store_true", help=TRUST_HELP)
    add("--json", action="store_true", help="print one JSON object and nothing else")
    add("--video", metavar="FILE.mp4", help="record the best lap from above")
    add("--line", metavar="FILE.png", help="draw the line of the best lap, coloured by speed")
    add("--telemetry", metavar="FILE", help="write the drives: all control ticks to a .parquet, "
        "or all timesteps to a .csv")  # fmt: skip
    add("--report", metavar="FILE.html", help="make the lap report, as `sb3-torcs compare` does")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    files = asked_files(args, FILES)
    with quiet_output(args.json):
        result, recorder, log = _drive(args, ticks=_ticks_wanted(files, "telemetry", "report"))
    # Before the files: a full disk does not drop what was driven.
    if args.json:
        episodes = [episode.as_dict() for episode in result]
        print_json({"env": recorder.env_id, **recorder.names(), "episodes": episodes})
    else:
        print(f"{recorder.env_id}, {', '.join(recorder.names().values())}")
        print(table(HEADERS, [_row(number, episode) for number, episode in enumerate(result, 1)]))
    with quiet_output(args.json), contextlib.closing(recorder):
        _write(files, recorder, log, str(args.model))
        if "report" in files and not _reported(files["report"], recorder, log):
            print(f"sb3-torcs: no report: nobody drove a whole lap of {recorder.names()['track']}",
                file=sys.stderr)  # fmt: skip
            del files["report"]
        if "video" in files:  # last: it takes longest, and may fail
            recorder.save_video(files["video"])
    for what, path in files.items():
        if not args.json:
            print(f"{what}: {path}")
    return 0


def _write(files: Mapping[str, Path], recorder: Recorder, log: DriveLog, model: str) -> None:
    """
    Write the line and the telemetry of the drives.

    :param files: by what they hold
    :param recorder: of the timesteps
    :param log: of the control ticks
    :param model: as typed
    """
    if "line" in files:
        recorder.draw_line(files["line"])
    if _ticks_wanted(files, "telemetry"):
        log.write(files["telemetry"])
    elif "telemetry" in files:
        recorder.write(files["telemetry"], model)


def _reported(path: Path, recorder: Recorder, log: DriveLog) -> bool:
    """Make the lap report, unless there is no whole lap; return whether it was made."""
    from sb3_torcs.evaluation.comparing import report_of
    from sb3_torcs.telemetry.laps import drives_of

    frame = log.frame()
    if not any(drive.laps for drive in drives_of(frame)):
        return False
    track = recorder.get_wrapper_attr("backend").track  # which may be of somebody's own file
    report_of(frame, track).save(path)
    return True


def _ticks_wanted(files: Mapping[str, Path], *kinds: str) -> bool:
    """Whether one of the files is made of control ticks, and not of timesteps."""
    return any(kind in files and files[kind].suffix.lower() != ".csv" for kind in kinds)


def _drive(args: argparse.Namespace, *, ticks: bool) -> tuple[list[Episode], Recorder, DriveLog]:
    """
    Build the environment, load the driver, drive.

    :param args: from the command line
    :param ticks: whether to note every control tick
    :return: the results, the timesteps and the control ticks
    """
    from sb3_torcs.agents.models import driver_name, load_driver
    from sb3_torcs.agents.wrapping import wrapped
    from sb3_torcs.errors import InvalidOption
    from sb3_torcs.evaluation.protocol import choose_world, evaluate, time_limit
    from sb3_torcs.evaluation.recording import Recorder
    from sb3_torcs.evaluation.ticks import log_drives
    from sb3_torcs.telemetry import DriveLog
    from sb3_torcs.torcs.track_names import RANDOM_TRACK
    from sb3_torcs.training.zoo import check_env_kwargs, check_racing

    _check_options(args.env_kwargs)
    record = told_record(args.model)
    env_id = args.env
    if env_id is None:
        env_id, reason = choose_world(args.model, record.env_id, args.track)
        print(f"driving {env_id}: {reason}", file=sys.stderr)
    check_racing(env_id)
    check_env_kwargs(dict(args.env_kwargs), env_id, "--env-kwargs")
    kwargs = environment_kwargs(args, record)
    if args.report is not None and kwargs.get("track") == RANDOM_TRACK:
        raise InvalidOption("--report compares laps of one track; give --track a name")
    recorder = Recorder(env_id, kwargs, time_limit(kwargs))
    # The recorder is inside the wrappers, so it records the actions that reach the car.
    env = wrapped(recorder, record.hyperparameters, trust=args.trust)
    driver = load_driver(args.model, env, args.algo, args.trust)
    log = log_drives(env, driver_name(args.model)) if ticks else DriveLog()
    result = evaluate(env, driver, episodes=args.episodes, seed=args.seed)
    return result, recorder, log


def _check_options(settings: Sequence[tuple[str, Any]]) -> None:
    """Refuse what is said twice, or has an option of its own: one of the two would be dropped."""
    from sb3_torcs.errors import InvalidOption
    from sb3_torcs.training.zoo import TIME_LIMIT

    names = [name for name, _ in settings]
    for name, value in settings:
        if names.count(name) > 1:
            raise InvalidOption(f"--env-kwargs has {name} twice; give it one value")
        if name == "render_mode":
            raise InvalidOption(
                f"--env-kwargs has {name}={value}; type --video FILE.mp4 for a video, or "
                "sb3-torcs watch MODEL for the game's window"
            )
        if name == TIME_LIMIT:
            raise InvalidOption(
                f"--env-kwargs has {name}={value}, but the time limit follows from the laps; "
                "type --laps L instead"
            )
        if name in OPTIONS:
            one = value[0] if isinstance(value, list) and value else value
            shown = name.upper() if one in ([], None, "") else one
            raise InvalidOption(
                f"--env-kwargs has {name}={value}, for which there is an option; type "
                f"--{name.replace('_', '-')} {shown} instead"
            )


def environment_kwargs(args: argparse.Namespace, record: TrainingRecord) -> dict[str, Any]:
    """
    Choose the keyword arguments of the environment.

    :param args: from the command line, which go before the record
    :param record: of the training
    :return: keyword arguments of the environment
    """
    from sb3_torcs.agents.models import one_of
    from sb3_torcs.evaluation.protocol import KEPT

    kwargs = record.kept(KEPT)
    given = {name: getattr(args, name, None) for name in KEPT}
    kwargs.update({name: value for name, value in given.items() if value is not None})
    kwargs.update(getattr(args, "env_kwargs", ()))
    one_of("track", kwargs.get("track"))
    one_of("car", kwargs.get("car"))
    return {**kwargs, "laps": args.laps}


def _row(number: int, episode: Episode) -> list[str]:
    times = ", ".join(f"{seconds:.3f}" for seconds in episode.lap_times) or "-"
    return [
        str(number),
        str(episode.laps),
        times,
        f"{episode.distance:.1f}",
        episode.end,
        f"{episode.damage:.0f}",
        f"{episode.episode_return:.2f}",
    ]
