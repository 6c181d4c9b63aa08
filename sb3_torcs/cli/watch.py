"""``sb3-torcs watch``: an agent or a robot in the game's 3D window, or in a video."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from sb3_torcs.cli.common import MODEL_HELP, TRUST_HELP, parsed_robots, positive, told_record
from sb3_torcs.cli.results import show_results
from sb3_torcs.files import writable_file

if TYPE_CHECKING:
    from sb3_torcs.evaluation.watching import Show
    from sb3_torcs.torcs.installation import Game

__all__ = ["add_parser", "run"]

DESCRIPTION = """\
Show a saved model or a robot in the game's own window. The game's keys work there: F2 to F11 change
the view, p pauses, + and - change the speed of time, Esc ends the race.

With --video the command writes a video instead, frame by frame in simulated time: no frame is
dropped or doubled, however slow the machine. It needs no display, only the program Xvfb, which
`sb3-torcs install-torcs --video` gets.

The race ends after --laps laps. A model's race also ends two seconds after the car has left the
road or stands still.
"""


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    from sb3_torcs.torcs.window import VIEWS

    parser = subparsers.add_parser(
        "watch",
        help="show an agent or a robot in the game's own window, or record a video",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("name", metavar="MODEL|ROBOT", help=f"{MODEL_HELP}; or a robot, e.g. inferno")
    add("--track", metavar="T", help="the track; default: that of the training, or aalborg")
    add("--car", metavar="C", help="the car that a model drives; default: that of its training")
    add("--robots", metavar="NAME:I,…", help="robots to race against, which start behind")
    add("--laps", type=positive, default=1, metavar="L", help="laps to drive; default: 1")
    add(
        "--view",
        default="behind",
        metavar="V",
        help=f"the camera: {', '.join(VIEWS)}; default: behind",
    )
    add(
        "--size",
        type=_size,
        default=(1280, 720),
        metavar="WxH",
        help="width and height in pixels; default: 1280x720",
    )
    add("--video", metavar="FILE.mp4", help="write a video of the race to this file")
    add("--film", dest="video", help=argparse.SUPPRESS)  # its older name
    add("--fps", type=float, metavar="N", help="frames per second of the video; default: 30")
    add("--telemetry", metavar="FILE.parquet",
        help="write the drives: an agent's timesteps, a robot's control ticks")  # fmt: skip
    add("--trust", action="store_true", help=TRUST_HELP)
    add(
        "--beside",
        metavar="MODEL|ROBOT",
        help="also show this driver's race, in the right half of the video",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    from sb3_torcs.errors import InvalidOption
    from sb3_torcs.evaluation.watching import drive_logs, record_shows
    from sb3_torcs.torcs.installation import find_game

    for option in ("beside", "fps"):
        if getattr(args, option) is not None and args.video is None:
            raise InvalidOption(f"--{option} is for videos; add --video FILE.mp4")
    video = writable_file(args.video, (".mp4",)) if args.video else None
    telemetry = writable_file(args.telemetry, (".parquet",)) if args.telemetry else None
    game = find_game()
    names = [args.name] if args.beside is None else [args.name, args.beside]
    shows = _shows(game, names, args)
    if video is None:
        _in_window(shows[0], args)
    else:
        fps = {} if args.fps is None else {"fps": args.fps}
        record_shows(shows, video, size=args.size, view=args.view, **fps)
    for name, show in zip(names, shows, strict=True):
        _report(name, show)
    if telemetry is not None:
        drive_logs(shows).write(telemetry)
    for what, path in (("video", video), ("telemetry", telemetry)):
        if path is not None:
            print(f"{what}: {path}")
    return 0


def _size(text: str) -> tuple[int, int]:
    """
    Read a size, for argparse.

    :param text: from the command line
    :return: width and height [pixels]
    """
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r}: expected WIDTHxHEIGHT, e.g. 1280x720")
    return int(width), int(height)


def _shows(game: Game, names: Sequence[str], args: argparse.Namespace) -> list[Show]:
    """
    Choose driver and car of each race, all on one track.

    :param game: the installation
    :param names: of models or robots
    :param args: from the command line
    """
    from sb3_torcs.agents.ghosts import check_laps, is_ghost, read_ghost
    from sb3_torcs.agents.models import one_of
    from sb3_torcs.agents.remote import check_told
    from sb3_torcs.agents.saved.record import DRIVEN_WITH, TrainingRecord
    from sb3_torcs.errors import InvalidOption
    from sb3_torcs.evaluation.watching import Show

    robots = [game.parse_robot(name) if game.has_robot(name) else None for name in names]
    if args.robots and any(map(is_ghost, names)):
        raise InvalidOption(
            "a ghost drives as it did, alone on the road, whoever is there; leave --robots out"
        )
    for name in filter(is_ghost, names):
        check_laps(read_ghost(name), args.laps, name)
    if args.car is not None and all(robots):
        raise InvalidOption(
            f"--car is for models; a robot has one for each index, e.g. {names[0]}:1, and "
            "`sb3-torcs robots` lists them"
        )
    records = [
        told_record(name, game) if robot is None else TrainingRecord()
        for name, robot in zip(names, robots, strict=True)
    ]
    for name, record in zip(names, records, strict=True):
        instead = (
            f"`sb3-torcs race {name} inferno --video FILE.mp4` races and records it in the engine"
        )
        check_told(name, record.kept(DRIVEN_WITH), instead)
    trained = [r.env_kwargs["track"] for r in records if "track" in r.env_kwargs]
    usual = next(iter(trained), "aalborg")
    track = one_of("track", usual if args.track is None else args.track)
    opponents = parsed_robots(args.robots, game)
    own = {} if args.car is None else {"car": args.car}
    settings = [{**record.kept(("car", *DRIVEN_WITH)), **own} for record in records]
    for kept in settings:
        one_of("car", kept.get("car"))
    return [
        Show(game, track, robot, name, kept, opponents, args.laps, args.trust)
        for name, robot, kept in zip(names, robots, settings, strict=True)
    ]


def _in_window(show: Show, args: argparse.Namespace) -> None:
    """
    Show a race on the user's display.

    :param show: the race
    :param args: from the command line
    """
    from sb3_torcs.evaluation.watching import show_in_window
    from sb3_torcs.torcs.display import find_display
    from sb3_torcs.torcs.window import Window

    display = find_display("`--video FILE.mp4` records the race without one")
    window = Window(size=args.size, view=args.view, display=display, driver=show.driver_name)
    show_in_window(show, window)


def _report(name: str, show: Show) -> None:
    """Print how the race ended."""
    if show.results:
        show_results(show.results, show.race.drivers[0], str(show.track))
    elif show.agent is not None and show.agent.end is not None:
        print(f"{name}: {show.agent.end} after {show.agent.distance:.0f} m")
