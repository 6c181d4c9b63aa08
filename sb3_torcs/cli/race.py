"""``sb3-torcs race``: agents and robots against each other, and who is better."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_torcs.cli.common import (
    DRIVER_HELP,
    INTERRUPTED,
    TRUST_HELP,
    output_files,
    positive,
    print_json,
    quiet_output,
    seed,
    status_of,
    table,
    warn_unless_known,
)
from sb3_torcs.cli.results import show_standings
from sb3_torcs.files import PICTURES
from sb3_torcs.signals import defer_signals
from sb3_torcs.torcs.starting_list import GRIDS

if TYPE_CHECKING:
    from sb3_torcs.agents.drivers import NamedDriver
    from sb3_torcs.races.protocol import Race
    from sb3_torcs.races.video import Footage
    from sb3_torcs.telemetry import DriveLog

__all__ = ["add_parser", "run"]

FILES = {
    "video": (".mp4",), "picture": PICTURES, "telemetry": (".parquet",),
    "report": (".html",),
}  # fmt: skip
"""Endings of what can be written: a video of the first race, the others of the last one."""
NEED_THE_LAST = ("telemetry", "report")
"""What is written only if all races were held."""

DRAWING = "sb3-torcs: drawing the video of the first race; Ctrl-C again leaves it out\n"
BAR = "{l_bar}{bar}| {n:.1f}/{total} races [{elapsed}<{remaining}]"
HEADERS = ("driver", "races", "wins", "win rate", "mean place", "finished", "damage/km", "rating")

DESCRIPTION = """\
Let drivers race against each other: robots of the game, shipped agents, files of trained ones. Each
agent sees and drives as in its training; the rules and the flag are the game's. One that learned
alone hits others, unless --aids all lets it brake and steer for them.

Drivers and worlds are deterministic, so races differ by the grid, which is drawn from the seed of
each race: --grid last puts the first driver behind all others, whose order is drawn; random draws
all; reverse begins each race in the reverse order of the standings before. With --field N each race
holds the first driver and N - 1 of the others, who are drawn.

Win rates and mean places come with their 95 % intervals. Ratings are those of openskill
(Plackett-Luce).

Ctrl-C ends the command after the races that are over, and tells how they went. Then it draws the
video of the first one, if there is to be any; Ctrl-C again leaves it out.
"""


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    from sb3_torcs.torcs.window import VIEWS

    parser = subparsers.add_parser(
        "race",
        help="race agents and robots against each other",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("drivers", nargs="+", metavar="DRIVER",
        help=f"{DRIVER_HELP}; no ghost")  # fmt: skip
    add("--track", default="aalborg", metavar="T", help="the track; default: aalborg")
    add("--laps", type=positive, default=5, metavar="N", help="laps of a race; default: 5")
    add("--races", type=positive, default=20, metavar="N", help="races to hold; default: 20")
    add("--grid", choices=GRIDS, default="last", help="who starts where; default: last")
    add("--aids", metavar="NAMES",
        help="driver aids for each agent, besides those that it learned with: all, or names with "
        "commas between them, e.g. keep_distance,keep_clear")  # fmt: skip
    add("--field", type=positive, metavar="N", help="cars in a race; default: all drivers")
    add("--seed", type=seed, default=0, metavar="S", help="seed of the first race; default: 0")
    add("--video", metavar="FILE.mp4",
        help="video of the first race; the camera follows its best agent")  # fmt: skip
    add("--view", choices=VIEWS, metavar="V",
        help=f"let the game draw the video: {', '.join(VIEWS)}; default: from above")  # fmt: skip
    add("--picture", metavar="FILE",
        help="draw place and gap over distance of the last race (.png, .svg, .pdf)")  # fmt: skip
    add("--telemetry", metavar="FILE.parquet", help="write the drives of the last race")
    add("--report", metavar="FILE.html",
        help="make the lap report of the last race, as `sb3-torcs compare` does")  # fmt: skip
    add("--trust", action="store_true", help=TRUST_HELP)
    add("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    files = output_files(args, FILES)
    from sb3_torcs.errors import check_extras
    from sb3_torcs.telemetry import DriveLog

    check_extras("a rating", "openskill")
    with quiet_output(args.json):
        drivers = _find(args)
        log = DriveLog() if "telemetry" in files or "report" in files else None
        footage = _footage(args)
        races, status = _held(args, drivers, log, footage)
    with defer_signals():  # to compute the figures takes a while
        _tell(args, races)
    stopped = len(races) < args.races
    if stopped:
        print(f"sb3-torcs: {len(races)} of {args.races} races were held", file=sys.stderr)
        _drop(files, NEED_THE_LAST, "the last race was not held")
    if status not in (0, INTERRUPTED):
        _drop(files, ("video",), "the command was told to end")
    with quiet_output(args.json):
        _write(files, races[-1], log, drivers[0].name)
        if footage is not None and "video" in files:  # last: it takes longest, and may fail
            sys.stderr.write(DRAWING if stopped else "")
            footage.save(files["video"], _followed(drivers, races[0]), args.laps)
    if not args.json:
        for what, path in files.items():
            print(f"{what}: {path}")
    return status if stopped else 0


def _tell(args: argparse.Namespace, races: list[Race]) -> None:
    """Print what came of the races."""
    for race in races:
        for driver, why in race.failures.items():
            print(f"sb3-torcs: race {race.seed}: {driver} is out: {why}", file=sys.stderr)
    if args.json:
        print_json(_as_json(args, races))
    else:
        _show(races)
    sys.stdout.flush()


def _find(args: argparse.Namespace) -> list[NamedDriver]:
    """Find the drivers, and warn of agents without a record."""
    from sb3_torcs.agents.drivers import find_drivers
    from sb3_torcs.agents.pilots import check_racers
    from sb3_torcs.envs.aids import parse_aids
    from sb3_torcs.errors import InvalidOption

    aids = () if args.aids is None else parse_aids(args.aids)
    drivers = find_drivers(args.drivers, aids)
    check_racers(drivers)
    agents = [driver for driver in drivers if driver.robot is None]
    if aids and not agents:
        raise InvalidOption("--aids is for agents, and all drivers are robots; leave it out")
    for agent in agents:
        warn_unless_known(agent)
    return drivers


def _drop(files: dict[str, Path], kinds: Sequence[str], why: str) -> None:
    """Leave out files, and say why."""
    for what in kinds:
        if files.pop(what, None) is not None:
            print(f"sb3-torcs: no {what}, since {why}", file=sys.stderr)


def _footage(args: argparse.Namespace) -> Footage | None:
    """Prepare the video of the first race; what cannot be drawn is refused before any race."""
    from sb3_torcs.errors import InvalidOption
    from sb3_torcs.races.video import GAME_SIZE, Footage
    from sb3_torcs.torcs.installation import find_game
    from sb3_torcs.torcs.window import Window

    if args.view is not None:
        if args.video is None:
            raise InvalidOption("--view is for videos; add --video FILE.mp4")
        from sb3_torcs.rendering.game_camera import check_view

        check_view(find_game(), args.track, GAME_SIZE)
    return None if args.video is None else Footage(view=args.view or Window.view)


def _followed(drivers: Sequence[NamedDriver], race: Race) -> str:
    """Name the driver whom the camera follows: the best agent, or else the first one named."""
    agents = {driver.name for driver in drivers if driver.robot is None}
    places = [standing.driver for standing in race.standings if standing.driver in agents]
    return next(iter(places), drivers[0].name)


def _write(files: dict[str, Path], race: Race, log: DriveLog | None, first: str) -> None:
    """
    Write the files that show the last race.

    :param files: by what they hold; loses those that cannot be made of it
    :param race: the last one
    :param log: of its drives
    :param first: driver that the others are measured against
    """
    if "picture" in files:
        from sb3_torcs.races.picture import draw_race

        draw_race(race, files["picture"])
    if log is not None and "telemetry" in files:
        log.write(files["telemetry"])
    if log is not None and "report" in files:
        from sb3_torcs.evaluation.comparing import report_of

        if any(standing.laps for standing in race.standings):
            report_of(log.frame(), first=first).save(files["report"])
        else:
            print("sb3-torcs: no report: no driver completed a lap", file=sys.stderr)
            del files["report"]


def _held(
    args: argparse.Namespace,
    drivers: Sequence[NamedDriver],
    log: DriveLog | None,
    footage: Footage | None,
) -> tuple[list[Race], int]:
    """
    Hold the races behind a progress bar; the first one is recorded, the last one is noted.

    Ctrl-C ends them early, and so do SIGTERM and SIGHUP.

    :return: those that are over, and the exit status of what has ended them, or 0
    """
    from tqdm import tqdm

    from sb3_torcs.races.protocol import Notes, Watcher, run_race, run_races
    from sb3_torcs.races.video import race_setup

    races: list[Race] = []
    with tqdm(total=args.races, file=sys.stderr, leave=False, disable=None, bar_format=BAR) as bar:

        def tell(share: float) -> None:
            bar.update(len(races) + share - bar.n)

        def hold(order: Sequence[NamedDriver], number: int) -> Race:
            options: dict[str, Any] = {
                "laps": args.laps, "seed": number, "trust": args.trust, "progress": tell,
            }  # fmt: skip
            watchers: list[Watcher] = []
            if footage is not None and number == args.seed:
                if args.view is not None:
                    footage.setup = race_setup(order, args.track, args.laps)
                watchers.append(footage)
            if log is not None and number == args.seed + args.races - 1:
                watchers.append(Notes(log))
            return run_race(order, args.track, watchers=watchers, **options)

        try:
            for race in run_races(
                drivers, hold, races=args.races, grid=args.grid, field_size=args.field,
                seed=args.seed,
            ):  # fmt: skip
                races.append(race)
                tell(0.0)
        except (KeyboardInterrupt, SystemExit) as ended:
            if not races:
                raise
            return races, status_of(ended)
    return races, 0


def _as_json(args: argparse.Namespace, races: list[Race]) -> dict[str, Any]:
    from sb3_torcs.races.standings import driver_figures

    return {
        "track": args.track,
        "laps": args.laps,
        "grid": args.grid,
        "races": [
            {
                "seed": race.seed,
                "standings": [standing.as_dict() for standing in race.standings],
                "taken_out": race.failures,
            }
            for race in races
        ],
        "drivers": driver_figures(races),
    }


def _mean_place(figures: dict[str, Any]) -> str:
    mean, interval = f"{figures['mean_place']:.2f}", figures["mean_place_interval"]
    return mean if interval is None else "{} ({:.2f} to {:.2f})".format(mean, *interval)


def _show(races: list[Race]) -> None:
    """Print the figures of the drivers, and the standings of the last race."""
    from sb3_torcs.races.standings import driver_figures

    print(table(HEADERS, [
        (
            f["driver"], str(f["races"]), str(f["wins"]),
            "{1:.0%} ({0:.0%} to {2:.0%})".format(*f["win_rate"]), _mean_place(f),
            str(f["finished"]),
            f"{f['damage_per_km']:.0f}",
            "{:.1f} ± {:.1f}".format(*f["rating"]),
        )
        for f in driver_figures(races)
    ]))  # fmt: skip
    print(f"\nlast race, seed {races[-1].seed}")
    show_standings(races[-1])
