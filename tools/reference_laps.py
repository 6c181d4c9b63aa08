"""Measure the laps that the ladder compares with: the scripted driver and robots, on all tracks."""

import argparse
import csv
from pathlib import Path

import sb3_torcs
from sb3_torcs.agents.robots import race
from sb3_torcs.agents.scripted import SCRIPTED, ScriptedDriver
from sb3_torcs.car import DEFAULT_CAR
from sb3_torcs.evaluation.ladder import REFERENCE_FIELDS, REFERENCE_FILE, ROBOTS
from sb3_torcs.evaluation.protocol import RACE_LAPS, evaluate, race_environment
from sb3_torcs.files import atomic_file
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.tracks.catalogue import available_tracks

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--tracks", nargs="+", help="category/name; default: all")
parser.add_argument("--out", type=Path, default=REFERENCE_FILE)
args = parser.parse_args()
if args.tracks and args.out == REFERENCE_FILE:
    parser.error("--tracks measures some of the tracks; give an --out, or the others were lost")


def scripted(track):
    """Lap times [s] of the driver without a network."""
    env = race_environment("Torcs-v0", {"car": DEFAULT_CAR}, track)
    (episode,) = evaluate(env, ScriptedDriver())
    env.close()
    return episode.lap_times


def robot(name, track):
    """Lap times [s] of a robot in the car of the class."""
    (result,) = race([find_game().parse_robot(name)], track, RACE_LAPS)
    return [lap.time for lap in result.laps] if result.car == DEFAULT_CAR else []


with atomic_file(args.out) as aside, aside.open("w", newline="", encoding="utf-8") as file:
    file.write(f"# python tools/reference_laps.py, sb3_torcs {sb3_torcs.__version__}\n")
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(REFERENCE_FIELDS)
    for track in args.tracks or [f"{s.category}/{s.name}" for s in available_tracks()]:
        for driver in (SCRIPTED, *ROBOTS):
            laps = scripted(track) if driver == SCRIPTED else robot(driver, track)
            whole = len(laps) == RACE_LAPS
            times = (f"{laps[0]:.3f}", f"{min(laps[1:]):.3f}") if whole else ("", "")
            writer.writerow((track.rpartition("/")[2], driver, DEFAULT_CAR, *times))
            print(f"{track}: {driver} {', '.join(f'{lap:.3f}' for lap in laps) or 'no lap'}")
