"""Check the engine against the game: the same robots by both, every time equal to the millisecond.

Without arguments six robots drive three laps of every installed track, alone, in the session that
the game calls practice; with --race they drive four at a time against each other. The exit status
is 1 if anything differs.
"""

import argparse
import sys

from rich.console import Console
from rich.progress import track as progress
from text_mode import run as run_game

from sb3_torcs.agents.robots import race
from sb3_torcs.cli.common import print_json, quiet_output, table
from sb3_torcs.errors import Sb3TorcsError
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.race_results import RobotResult
from sb3_torcs.torcs.race_setup import session_for
from sb3_torcs.torcs.track_names import find_track

ROBOTS = "inferno,berniw,bt,olethros,tita,lliaw"
FIELD = 4  # robots in a race
HEADERS = ("robots", "track", "equal", "difference")


def milliseconds(seconds: float | None) -> int:
    """The game writes six digits: up to 1000 s they hold the milliseconds, beyond hundredths."""
    written = float(f"{seconds or 0.0:.6g}")
    return round(1000.0 * written)


def lap_by_lap(result: RobotResult) -> dict[str, object]:
    """What a practice is compared by."""
    laps = {f"lap {n}": milliseconds(lap.time) for n, lap in enumerate(result.laps, 1)}
    damages = {f"damage after lap {n}": lap.damage for n, lap in enumerate(result.laps, 1)}
    return {**laps, **damages, "best lap": milliseconds(result.best_lap)}


def place_by_place(results: list[RobotResult]) -> dict[str, object]:
    """What a race is compared by: the game writes no laps of races."""
    return {
        f"{result.rank}: {what}": value
        for result in results
        for what, value in (
            ("robot", result.robot),
            ("laps", result.laps_completed),
            ("total time", milliseconds(result.total_time)),
            ("best lap", milliseconds(result.best_lap)),
            ("damage", result.damage),
        )
    }


def measures(results: list[RobotResult]) -> dict[str, object]:
    """Name and number everything that has to be equal; times in milliseconds."""
    return lap_by_lap(results[0]) if len(results) == 1 else place_by_place(results)


def compare(field: list[str], track: str, laps: int) -> dict[str, object]:
    """
    Let the game and the engine drive the same race.

    :param field: names of robots, the first one at the head of the grid
    :param track: ``category/name``
    :param laps: to drive
    :return: who, where, whether all is equal, and what is not
    """
    robots = [find_game().parse_robot(name) for name in field]
    session = session_for(robots)
    row = {"robots": field, "track": track}
    try:
        game = measures(run_game(find_game(), track, robots, laps, session))
        engine = measures(race(robots, track, laps, session=session))
    except Sb3TorcsError as error:
        return {**row, "equal": False, "error": str(error), "game": {}, "engine": {}}
    return {**row, "equal": game == engine, "game": game, "engine": engine}


def difference(row: dict) -> str:
    """Say the first thing that is not equal."""
    if "error" in row:
        return row["error"]
    for what in {**row["game"], **row["engine"]}:
        game, engine = row["game"].get(what), row["engine"].get(what)
        if game != engine:
            return f"{what}: game {game}, engine {engine}"
    return ""


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--robots", default=ROBOTS, help=f"NAME or NAME:INDEX,…; default: {ROBOTS}")
parser.add_argument("--tracks", help="NAME,…; default: all that are installed")
parser.add_argument("--laps", type=int, default=3)
parser.add_argument("--race", action="store_true", help=f"fields of {FIELD} against each other")
parser.add_argument("--json", action="store_true", help="print JSON and nothing else")
args = parser.parse_args()

game = find_game()
tracks = (
    [find_track(name, game).name for name in args.tracks.split(",")]
    if args.tracks
    else game.tracks()
)
names = args.robots.split(",")
fields = [[name] for name in names]
if args.race:  # each robot is at the head of one field
    fields = [(names[i:] + names[:i])[:FIELD] for i in range(len(names))]
with quiet_output(args.json):
    work = [(field, track) for track in tracks for field in fields]
    console = Console(stderr=True)
    rows = [compare(*item, args.laps) for item in progress(work, "racing", console=console)]
equal = sum(row["equal"] for row in rows)
if args.json:
    print_json({"races": len(rows), "equal": equal, "rows": rows})
else:
    cells = [
        (" ".join(row["robots"]), row["track"], "yes" if row["equal"] else "NO", difference(row))
        for row in rows
    ]
    print(table(HEADERS, cells))
    print(f"{equal} of {len(rows)} equal")
sys.exit(0 if equal == len(rows) else 1)
