"""``sb3-torcs compete``: a trained agent as a client in a race of another SCR server."""

from __future__ import annotations

import argparse
import gc
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
)

if TYPE_CHECKING:
    from sb3_torcs.agents.remote import Agent

__all__ = ["add_parser", "run"]

DESCRIPTION = """\
Drive a saved model in a race of an SCR server: `sb3-torcs serve`, a patched game, a league's
server. The agent chooses an action as often as in its training, and repeats it at every control
tick in between. It drives to the end of the race, even beside the road.

The protocol does not tell the client which track and which car it drives. Give the car with --car:
the gearbox is made for it. An agent that sees the road ahead, and a ghost, need the track, too,
with --track: without it they take the race to be on the track of their training. Others drive any
road.
"""


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "compete",
        help="drive a saved model in a race that runs elsewhere",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("driver", metavar="DRIVER", help=f"{DRIVER_HELP}; no robot")
    add("--host", default="127.0.0.1", metavar="H", help="default: 127.0.0.1")
    add("--port", type=positive, default=3001, metavar="P", help="default: 3001")
    add_environment(parser, world=False)
    add("--name", metavar="N", help="name of the driver, which `serve` shows; default: the model's")
    add("--algo", help="the model's algorithm, if it cannot be found out")
    add("--trust", action="store_true", help=TRUST_HELP)
    add("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    if args.name is not None:
        _check_name(args.name)
    where = f"{args.host}, UDP port {args.port}"
    with quiet_output(args.json):  # said first, because loading takes seconds
        print(f"{args.driver} is being loaded for the race at {where}", flush=True)

    from sb3_torcs.agents.models import require_one
    from sb3_torcs.agents.remote import Agent, check_observable
    from sb3_torcs.agents.saved.record import DRIVEN_WITH
    from sb3_torcs.errors import InvalidOption
    from sb3_torcs.sensors import NEEDS_ROAD

    driver = named_driver(args.driver)
    if driver.robot is not None:
        raise InvalidOption(
            f"'{args.driver}' is a robot, which drives in the game's own races only"
        )
    settings = driver.record.select(("track", "car", *DRIVEN_WITH))
    check_observable(
        args.driver, settings, f"`sb3-torcs race {args.driver} inferno` races it in the engine"
    )
    given = environment_settings(args)
    settings |= {**given, "scr": {"host": args.host, "port": args.port}}
    sees_road = NEEDS_ROAD.intersection(settings.get("sensors", ()))
    if "track" not in given and not sees_road and driver.kind != "ghost":
        settings["track"] = None  # the race may be on another track than the training was
    require_one("track", settings.get("track"))
    require_one("car", settings.get("car"))
    with quiet_output(args.json):
        name = args.name or driver.name
        agent = Agent(args.driver, settings, args.algo, args.trust, name)
        assumed = settings.get("track", "aalborg")
        if "track" not in given and assumed is not None:
            print(f"{args.driver} takes {assumed} to be the track; give another one with --track")
        print(f"waiting for the SCR server at {where} and the start of its race", flush=True)
    # A garbage collection over everything that was loaded would take longer than a tick.
    gc.collect()
    gc.freeze()
    try:
        with quiet_output(args.json):
            agent.drive()
    finally:
        gc.unfreeze()
        # The results so far are told, also after Ctrl-C and when the server is gone.
        if agent.backend.latencies and args.json:
            print_json(_figures(agent))
        elif agent.backend.latencies:
            _show(agent)
    return 0


def _check_name(name: str) -> None:
    """Refuse a driver's name that the game cannot draw, instead of changing it."""
    from sb3_torcs.errors import InvalidOption
    from sb3_torcs.scr.protocol import LONGEST_NAME, plain_name

    if not name or plain_name(name) != name:
        raise InvalidOption(
            f"--name is {name!r:.60}; expected 1 to {LONGEST_NAME} letters, digits, single spaces "
            f"and -_.:+@; type --name '{plain_name(name) or 'Ann Other'}'"
        )


def _figures(agent: Agent) -> dict[str, Any]:
    """
    Collect the results.

    :param agent: after its drive
    """
    import numpy as np

    latencies = 1000.0 * np.array(agent.backend.latencies)
    median, late, longest = np.percentile(latencies, (50, 99, 100))
    return {
        "laps": len(agent.lap_times),
        "lap_times": [round(seconds, 3) for seconds in agent.lap_times],
        "distance": agent.distance,
        "ticks": len(latencies),
        "lost_ticks": agent.backend.lost_ticks,
        "latency_ms": {"median": median, "p99": late, "longest": longest},
    }


def _show(agent: Agent) -> None:
    """
    Print the results as text.

    :param agent: after its drive
    """
    figures = _figures(agent)
    times = ", ".join(f"{seconds:.3f}" for seconds in agent.lap_times) or "none"
    print(f"lap times s: {times}; {agent.distance:.0f} m")
    print(f"lost ticks: {figures['lost_ticks']}; answers: {figures['ticks']}")
    latency = figures["latency_ms"]
    print(
        f"answer ms: median {latency['median']:.2f}, 99 % within {latency['p99']:.2f}, "
        f"longest {latency['longest']:.2f}; the server waits 10 unless it says otherwise"
    )
