"""Check the SCR protocol against the engine: the same driver on the same track by both.

The driver decides by what it sees: in the engine, and over SCR in the stock game with our driver
module. All observations, actions, lap times and the damage have to be the same. The exit status
is 1 if they are not.
"""

import argparse
import sys
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.progress import track as progress

import sb3_torcs  # noqa: F401  (registers the environments)
from sb3_torcs.agents.models import driver_record, load_driver
from sb3_torcs.agents.rollout import Driver, drive
from sb3_torcs.agents.saved.record import DRIVEN_WITH
from sb3_torcs.car import Start
from sb3_torcs.cli.common import table
from sb3_torcs.errors import ends_in_a_line

ROUNDING = 1e-6  # [-] between observations, which are at most 3
SAME = 1e-4  # [-] between two actions that count as equal
MILLISECOND = 0.001  # [s]
HEADERS = ("track", "equal", "same actions", "difference", "laps, engine", "laps, game")


class Drive(NamedTuple):
    """What was seen and done."""

    observations: list[np.ndarray]
    actions: list[np.ndarray]
    laps: list[float]  # [s]
    damage: float


class Comparison(NamedTuple):
    """Two drives, the engine's first."""

    timesteps: int  # that both made
    largest_difference: float  # [-] between observations
    same_actions: int  # before the first that differs
    laps: tuple[list[float], list[float]]  # [s]
    damage: tuple[float, float]

    @property
    def equal(self) -> bool:
        """Whether nothing differs."""
        one, other = self.laps
        return (
            self.largest_difference < ROUNDING
            and self.same_actions == self.timesteps
            and len(one) == len(other)
            and all(abs(a - b) < MILLISECOND for a, b in zip(one, other, strict=True))
            and self.damage[0] == self.damage[1]
        )


def driven(env: gym.Env, driver: Driver, start: Start | None) -> Drive:
    """Drive until the episode ends."""
    steps = list(drive(env, driver, seed=0, options=start._asdict() if start else None))
    return Drive(
        [steps[0].observation, *(step.next_observation for step in steps)],
        [step.action for step in steps],
        [step.info["lap_time"] for step in steps if step.info["lap_time"]],
        steps[-1].info["damage"],
    )


def held(one: Drive, other: Drive) -> Comparison:
    """Hold one drive to another."""
    number = min(len(one.actions), len(other.actions))
    apart = np.abs(np.subtract(one.observations[: number + 1], other.observations[: number + 1]))
    turned = np.abs(np.subtract(one.actions[:number], other.actions[:number])).max(axis=1) > SAME
    same = int(np.argmax(turned)) if turned.any() else number
    laps, damage = (one.laps, other.laps), (one.damage, other.damage)
    return Comparison(number, float(apart.max()), same, laps, damage)


def compare(
    track: str, driver: Driver, start: Start | None = None, laps: int = 1, **settings: Any
) -> Comparison:
    """Let a driver drive by both, in an environment with these settings."""
    drives = []
    for backend in ("native", "scr"):
        env = gym.make("Torcs-v0", backend=backend, track=track, laps=laps, **settings)
        try:
            drives.append(driven(env, driver, start))
        finally:
            env.close()
    return held(*drives)


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", default="scripted", help="a model's file, or scripted")
    parser.add_argument("--tracks", default="aalborg,g-track-1,dirt-1", help="names, with commas")
    parser.add_argument("--laps", type=int, default=1)
    words = parser.parse_args()
    tracks = words.tracks.split(",")
    rows, all_equal = [], True
    settings = driver_record(words.model).select(("car", *DRIVEN_WITH))
    with gym.make("Torcs-v0", **settings) as env:
        driver = load_driver(words.model, env)
    for track in progress(tracks, "racing", console=Console(stderr=True)):
        answer = compare(track, driver, laps=words.laps, **settings)
        all_equal &= answer.equal
        same = f"{answer.same_actions} of {answer.timesteps}"
        apart = f"{answer.largest_difference:.1e}"
        laps = tuple(map(times, answer.laps))
        rows.append((track, "yes" if answer.equal else "NO", same, apart, *laps))
    print(table(HEADERS, rows))
    sys.exit(0 if all_equal else 1)


def times(laps: list[float]) -> str:
    """Write lap times."""
    return ", ".join(f"{lap:.3f}" for lap in laps) or "none"


if __name__ == "__main__":
    with ends_in_a_line():
        main()
