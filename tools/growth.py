"""Measure how the speed grows with races, threads, opponents and batch sizes, and draw it."""

import argparse
import functools
import json
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

from sb3_torcs import cores
from sb3_torcs.bench.drives import scripted_actions
from sb3_torcs.bench.updates import default_model
from sb3_torcs.errors import ends_in_a_line
from sb3_torcs.policies.updates import LeanUpdates
from sb3_torcs.training.zoo import config_file, read_entry
from sb3_torcs.vec_env import TorcsVecEnv

RACES = (1, 2, 4, 8, 16, 32, 64)
OPPONENTS = ("inferno", "berniw", "bt", "olethros", "lliaw", "tita", "inferno:4", "bt:3", "tita:4")
BATCHES = (32, 64, 128, 256, 512, 1024, 2048, 4096)
TRIES = 3  # of which the fastest counts: other programs only slow down

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--seconds", type=float, default=1.0, help="of each try; default: 1")
parser.add_argument("--output", type=Path, default=Path("growth"), help="of .json and .png")
parser.add_argument("--from-json", action="store_true", help="draw what was measured before")


def rate(step, seconds):
    """Return the calls per second of a function."""
    step()
    rates = []
    for _ in range(TRIES):
        begin, calls = time.perf_counter(), 0
        while time.perf_counter() - begin < seconds:
            step()
            calls += 1
        rates.append(calls / (time.perf_counter() - begin))
    return max(rates)


@functools.cache
def drive_of_the_scripted_driver():
    """Return the actions of a drive from the grid."""
    single = gym.make("Torcs-v0")
    asked = scripted_actions(single, 100)
    single.close()
    return asked


def driving(races, threads, seconds, **env_kwargs):
    """Return the timesteps per second of all races, driven by the scripted driver."""
    asked = drive_of_the_scripted_driver()
    envs = TorcsVecEnv(races, threads=threads, **env_kwargs)
    envs.reset()
    drive = iter(())

    def step():
        nonlocal drive
        action = next(drive, None)
        if action is None:
            envs.reset()
            drive = iter(asked)
            action = next(drive)
        envs.step(np.tile(action, (races, 1)))

    found = races * rate(step, seconds)
    envs.close()
    return found


def learning(batch, seconds):
    """Return the transitions per second of the default DDPG's updates, on one core."""
    entry = {**read_entry(config_file("ddpg"), "Torcs-v0"), "batch_size": batch}
    updates = LeanUpdates(default_model(entry))
    with cores.at_most(1):
        return batch * rate(lambda: updates.train(1, batch), seconds)


def measure(seconds):
    """Measure all three."""
    threads = [number for number in (1, 2, 4, 8, 16) if number <= cores.number()]
    return {
        "races": {
            str(number): [driving(races, number, seconds) for races in RACES] for number in threads
        },
        "opponents": [driving(1, 1, seconds, opponents=OPPONENTS[:number]) for number in range(10)],
        "batches": [learning(batch, seconds) for batch in BATCHES],
    }


def draw(found, path):
    """Draw one picture with three panels."""
    figure = Figure(figsize=(12.0, 3.8), layout="constrained")
    races, opponents, batches = figure.subplots(1, 3)
    for threads, rates in found["races"].items():
        label = f"{threads} thread" + "s" * (threads != "1")
        races.plot(RACES, rates, marker="o", label=label)
    races.set(xlabel="races in one TorcsVecEnv", ylabel="timesteps/s, all races")
    races.legend(fontsize=8)
    opponents.plot(range(10), found["opponents"], marker="o")
    opponents.set(xlabel="opponents in the race", ylabel="timesteps/s, one race")
    batches.plot(BATCHES, found["batches"], marker="o")
    batches.set(xlabel="batch size", ylabel="transitions/s learned from, default DDPG")
    for panel in (races, opponents, batches):
        panel.set_yscale("log")
        panel.grid(alpha=0.3, which="both")
    for panel, ticks in ((races, RACES), (batches, BATCHES)):
        panel.set_xscale("log", base=2)
        panel.set_xticks(ticks, [str(tick) for tick in ticks], fontsize=8)
    figure.savefig(path, dpi=100)


def main() -> None:
    args = parser.parse_args()
    table = args.output.with_suffix(".json")
    if not args.from_json:
        table.write_text(json.dumps(measure(args.seconds), indent=1) + "\n")
    draw(json.loads(table.read_text()), args.output.with_suffix(".png"))
    print(args.output.with_suffix(".png"))


if __name__ == "__main__":
    with ends_in_a_line():
        main()
