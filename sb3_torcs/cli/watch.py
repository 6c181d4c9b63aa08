"""``sb3-torcs watch``: a driver in the game's 3D window, or in a video."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_torcs.cli.common import DRIVER_HELP, TRUST_HELP, named_driver, parsed_robots, positive
from sb3_torcs.cli.results import show_results, show_standings
from sb3_torcs.files import writable_file

if TYPE_CHECKING:
    from sb3_torcs.agents.drivers import NamedDriver
    from sb3_torcs.torcs.installation import Game

__all__ = ["add_parser", "run"]

DESCRIPTION = """\
Show a driver in the game's own window. The game's keys work there: F2 to F11 change the view, p
pauses, + and - change the speed of time, Esc ends the race.

With --video the command writes a video instead: the engine drives, and the game draws each picture,
however slow the machine. It needs no display, only the program Xvfb, which
`sb3-torcs install-torcs --video` gets.

The race ends after --laps laps. An agent's race also ends two seconds after the car has left the
road or stands still.
"""


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    from sb3_torcs.torcs.window import VIEWS

    parser = subparsers.add_parser(
        "watch",
        help="show a driver in the game's own window, or record a video",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("driver", metavar="DRIVER", help=DRIVER_HELP)
    add("--track", metavar="T", help="default: that of an agent's training, or aalborg")
    add("--car", metavar="C", help="an agent's car; default: that of its training")
    add("--robots", metavar="NAME:I,…", help="robots to race against, which start behind")
    add("--laps", type=positive, default=1, metavar="L", help="laps to drive; default: 1")
    add("--view", choices=VIEWS, default="behind", metavar="V",
        help=f"the camera: {', '.join(VIEWS)}; default: behind")  # fmt: skip
    add("--size", type=_size, default=(1280, 720), metavar="WxH",
        help="width and height in pixels; default: 1280x720")  # fmt: skip
    add("--video", metavar="FILE.mp4", help="write a video of the race to this file")
    add("--beside", metavar="DRIVER",
        help="also show this driver's race, in the right half of the video")  # fmt: skip
    add("--trust", action="store_true", help=TRUST_HELP)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    from sb3_torcs.errors import InvalidOption, check_extras
    from sb3_torcs.torcs.installation import find_game

    if args.video is not None:
        check_extras("a video", "imageio_ffmpeg")
    if args.beside is not None and args.video is None:
        raise InvalidOption("--beside is for videos; add --video FILE.mp4")
    video = writable_file(args.video, (".mp4",)) if args.video else None
    game = find_game()
    names = [args.driver] if args.beside is None else [args.driver, args.beside]
    drivers = [named_driver(name) for name in names]
    track = _checked(drivers, args)
    if video is None:
        _show(game, drivers[0], track, args)
        return 0
    _record(game, drivers, track, args, video)
    print(f"video: {video}")
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


def _checked(drivers: Sequence[NamedDriver], args: argparse.Namespace) -> str:
    """
    Refuse what cannot be shown.

    :param drivers: each with a race of its own
    :param args: from the command line
    :return: the track of all
    """
    from sb3_torcs.agents.ghosts import check_laps, read_ghost
    from sb3_torcs.agents.models import require_one
    from sb3_torcs.errors import InvalidOption

    for driver in drivers:
        if driver.kind == "ghost":
            check_laps(read_ghost(driver.source), args.laps, driver.source)
        if driver.kind == "ghost" and args.robots:
            raise InvalidOption(
                "a ghost drives as it did, alone on the road, whoever is there; leave --robots out"
            )
    if args.car is not None and all(driver.robot for driver in drivers):
        raise InvalidOption(
            f"--car is for agents; a robot has one for each index, e.g. {drivers[0].source}:1, and "
            "`sb3-torcs drivers` lists them"
        )
    for driver in drivers:
        if args.car is None and driver.robot is None:
            require_one("car", driver.record.env_kwargs.get("car"))
    trained = [driver.record.env_kwargs.get("track") for driver in drivers]
    usual = next((track for track in trained if track is not None), "aalborg")
    track: str = require_one("track", usual if args.track is None else args.track)
    return track


def _show(game: Game, driver: NamedDriver, track: str, args: argparse.Namespace) -> None:
    """
    Show a race on the user's display, and print how it ended.

    :param game: the installation
    :param driver: whom the camera follows
    :param track: of the race
    :param args: from the command line
    """
    from sb3_torcs.agents.remote import check_observable
    from sb3_torcs.agents.saved.record import DRIVEN_WITH
    from sb3_torcs.evaluation.watching import Show, show_in_window
    from sb3_torcs.torcs.display import find_display
    from sb3_torcs.torcs.window import Window

    settings = driver.record.select(("car", *DRIVEN_WITH))
    settings |= {} if args.car is None else {"car": args.car}
    check_observable(driver.source, settings, "`--video FILE.mp4` records it, driven by the engine")
    opponents = parsed_robots(args.robots, game)
    show = Show(game, track, driver, settings, opponents, args.laps, args.trust)
    display = find_display("`--video FILE.mp4` records the race without one")
    window = Window(size=args.size, view=args.view, display=display, driver=show.driver_name)
    show_in_window(show, window)
    if show.results:
        show_results(show.results, show.race.drivers[0], str(track))
    elif show.agent is not None and show.agent.end is not None:
        print(f"{driver.name}: {show.agent.end} after {show.agent.distance:.0f} m")


def _record(
    game: Game, drivers: Sequence[NamedDriver], track: str, args: argparse.Namespace, video: Path
) -> None:
    """
    Let the engine drive, record what it drove, and print how it ended.

    :param game: the installation
    :param drivers: each with a race of its own
    :param track: of the races
    :param args: from the command line
    :param video: path of the video
    """
    from dataclasses import replace

    from sb3_torcs.agents.drivers import find_drivers
    from sb3_torcs.errors import InvalidOption
    from sb3_torcs.races.protocol import run_race
    from sb3_torcs.races.video import Footage, race_setup, save_beside
    from sb3_torcs.rendering.game_camera import check_view

    width, height = args.size[0] // len(drivers), args.size[1]
    if args.size[0] % (2 * len(drivers)) or height % 2:
        raise InvalidOption(
            f"size is {args.size[0]}x{height}; a video of {len(drivers)} side by side has a width "
            f"that is a multiple of {2 * len(drivers)}, and an even height"
        )
    check_view(game, track, (width, height))
    footages = []
    for driver in drivers:
        if args.car is not None and driver.robot is None:
            kwargs = {**driver.record.env_kwargs, "car": args.car}
            driver = replace(driver, record=replace(driver.record, env_kwargs=kwargs))
        others = find_drivers(args.robots.split(",")) if args.robots else []
        order = [driver, *others]
        ends = None if driver.robot else driver.name
        footage = Footage(
            race_setup(order, track, args.laps), args.view, (width, height), agent=ends
        )
        race = run_race(order, track, laps=args.laps, trust=args.trust, watchers=[footage])
        show_standings(race)
        footages.append(footage)
    names = [driver.name for driver in drivers]
    if len(footages) == 1:
        footages[0].save(video, names[0], args.laps)
    else:
        save_beside(footages, names, video, args.laps)
