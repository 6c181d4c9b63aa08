"""``sb3-torcs optimize-lap``: search a faster lap than an agent's, and keep it as a ghost."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from sb3_torcs.cli.common import (
    DRIVER_HELP,
    TRUST_HELP,
    add_environment,
    environment_settings,
    named_driver,
    positive,
    print_json,
    quiet_output,
    seed,
    status_of,
    table,
)
from sb3_torcs.files import writable_file

if TYPE_CHECKING:
    from sb3_torcs.agents.drivers import NamedDriver
    from sb3_torcs.agents.ghosts import Ghost
    from sb3_torcs.training.lap_search.search import Budget, LapSearch, State

__all__ = ["add_parser", "run"]

SECONDS = 300
HEADERS = ("lap", "time s")

DESCRIPTION = """\
Search for the fastest three laps of a track from the grid, in the game, and write them to a file: a
ghost. A ghost drives as any driver does: `sb3-torcs watch GHOST`, `sb3-torcs evaluate GHOST`.

The search begins with the fastest of these drives: the agent's, and those of the robots that have
the same car. It drives the race again and again. On the way it restores the engine's snapshots to
try some ten ways to go on, each a few seconds long, and takes the best.

It uses all cores. With --rollouts the same seed finds the same ghost; what is found in --seconds
depends on the machine, and is another ghost each time. Ctrl-C keeps what was found, once
the first race is whole.
"""


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "optimize-lap",
        help="search for a faster lap, beginning with an agent's drive",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("driver", metavar="DRIVER",
        help=f"whose drive the search begins with: {DRIVER_HELP}")  # fmt: skip
    add_environment(parser, world=False)
    add("--seconds", type=positive, metavar="S",
        help=f"how long to search; default: {SECONDS}, or no limit with --rollouts")  # fmt: skip
    add("--rollouts", type=positive, metavar="N",
        help="end the search after N tries; a ghost takes some 10,000")  # fmt: skip
    add("--seed", type=seed, default=0, metavar="S", help="seed of the search; default: 0")
    add("--alone", action="store_true", help="begin with the driver's drive, however slow")
    add("--out", metavar="FILE.npz", help="the ghost; default: ghost-DRIVER-TRACK.npz")
    add("--trust", action="store_true", help=TRUST_HELP)
    add("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    from sb3_torcs.errors import InvalidOption
    from sb3_torcs.training.lap_search.starts import ghost_environment

    driver = named_driver(args.driver)
    kwargs = ghost_environment(driver, environment_settings(args))
    name, track = (
        driver.name.replace("/", "-").replace(":", "-"),
        str(kwargs["track"]).rpartition("/")[2],
    )
    out = writable_file(args.out or f"ghost-{name}-{track.removesuffix('.xml')}.npz", (".npz",))
    begun = time.monotonic()
    with quiet_output(args.json):
        ghost, state, status = _search(args, driver, kwargs)
    seconds = time.monotonic() - begun
    if ghost is None:
        why = (
            f"the search ended before its first race of its own was whole ({state.rollouts} "
            f"rollouts, {seconds:.0f} s), so no ghost is kept"
        )
        if status:
            print(f"sb3-torcs: {why}", file=sys.stderr)
            return status
        raise InvalidOption(f"{why}; give more --seconds or --rollouts")
    standing, *flying = ghost.lap_times
    figures = {
        "track": track,
        "car": kwargs["car"],
        "agent": args.driver,
        "standing_lap": standing,
        "flying_lap": min(flying),
        "rollouts": state.rollouts,
        "seconds": round(seconds, 1),
        "ghost": str(out),
    }
    if args.json:
        print_json(figures)
    else:
        print(f"{track}, {kwargs['car']}: {state.rollouts} rollouts, {seconds:.0f} s")
        rows = [(f"{number}", f"{time:.3f}") for number, time in enumerate(ghost.lap_times, 1)]
        print(table(HEADERS, rows))
    ghost.write(out)
    if not args.json:
        print(f"ghost: {out}")
    return status


def _search(
    args: argparse.Namespace, driver: NamedDriver, kwargs: dict[str, Any]
) -> tuple[Ghost | None, State, int]:
    """
    Search until the budget is used up or somebody stops it.

    :return: the best lap, how far the search came, and the exit status
    """
    from sb3_torcs.training.lap_search.search import Budget, LapSearch
    from sb3_torcs.training.lap_search.starts import find_starts

    begun = time.monotonic()
    starts = find_starts(driver, kwargs, alone=args.alone, trust=args.trust)
    first = starts[0]
    print(
        f"beginning with {first.driver}: {', '.join(f'{lap:.3f}' for lap in first.lap_times)} s",
        file=sys.stderr,
    )
    seconds = args.seconds or (None if args.rollouts else SECONDS)
    left = math.inf if seconds is None else seconds - (time.monotonic() - begun)
    budget = Budget(left, args.rollouts or math.inf)
    search = LapSearch(driver.source, kwargs, starts, seed=args.seed)
    status = 0
    try:
        for _ in _shown(search, budget):
            pass
    except (KeyboardInterrupt, SystemExit) as stopped:  # Ctrl-C, SIGTERM
        status = status_of(stopped)
    finally:
        search.close()
    return search.ghost, search.state(), status


def _shown(search: LapSearch, budget: Budget) -> Iterator[State]:
    """Search, and show on standard error how far it has come."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}")
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("the first race", total=1.0)
        for state in search.run(budget):
            share = max(state.rollouts / budget.rollouts, state.seconds / budget.seconds)
            progress.update(task, completed=min(share, 1.0), description=_spoken(state))
            yield state


def _spoken(state: State) -> str:
    rollouts = f"{state.rollouts} rollouts"
    if state.ghost is None:
        return f"{rollouts}, the first race"
    standing, *flying = state.ghost.lap_times
    return f"{rollouts}, {state.races} races, flying {min(flying):.3f} s, standing {standing:.3f} s"
