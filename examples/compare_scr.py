"""Hold the SCR protocol to the engine: the same driver on the same track by both.

First the engine drives, and what its driver decided is repeated over SCR in the stock game: all
observations have to be equal to the six digits that the protocol carries, lap times to the
millisecond. Then the driver decides by itself, on six digits in the engine, too: all decisions have
to be the same. The exit status is 1 if they are not. What the missing digits do to lap times is
seen beside that: a driver that sees all of them in the engine.
"""

import argparse
import sys
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.progress import track as progress

import sb3_torcs  # noqa: F401  (registers the environments)
from sb3_torcs.car import CarState, Start
from sb3_torcs.cli.common import table
from sb3_torcs.evaluation import Driver
from sb3_torcs.models import load_driver
from sb3_torcs.scr_protocol import ScrState, format_state, parse_state
from sb3_torcs.sensors import encode

SIX_DIGITS = 2e-5  # [-] of numbers that are at most 3 in an observation
SAME = 1e-4  # [-] between two actions that count as the same decision
MILLISECOND = 0.001  # [s]
HEADERS = (
    "track", "equal", "repeated", "difference", "same by itself", "laps, all digits",
    "laps, six digits",
)  # fmt: skip


class Drive(NamedTuple):
    """What was seen and done."""

    observations: list[np.ndarray]
    actions: list[np.ndarray]
    laps: list[float]  # [s]
    damage: float


class Comparison(NamedTuple):
    """Two drives, the engine's first."""

    decisions: int  # that both made
    largest_difference: float  # [-] between observations
    same_decisions: int  # before the first that differs
    laps: tuple[list[float], list[float]]  # [s]
    damage: tuple[float, float]

    @property
    def equal(self) -> bool:
        """Whether six digits show no difference."""
        one, other = self.laps
        return (
            self.largest_difference < SIX_DIGITS
            and len(one) == len(other)
            and all(abs(a - b) < MILLISECOND for a, b in zip(one, other, strict=True))
            and self.damage[0] == self.damage[1]
        )


def six_digits(car: CarState) -> np.ndarray:
    """Observe a car as if its sensors had been told by the protocol."""
    told = ScrState()._asdict()
    told |= {name: value for name, value in car._asdict().items() if name in told}
    told |= {name: tuple(told[name]) for name in ("wheel_speeds", "range_finders", "opponents")}
    state = parse_state(format_state(ScrState(**{**told, "track_position": car.track_position})))
    seen = {name: value for name, value in state._asdict().items() if name in car._fields}
    offset = 0.5 * car.track_width * state.track_position
    seen |= {name: np.array(seen[name]) for name in ("wheel_speeds", "range_finders", "opponents")}
    return encode(car._replace(**seen, distance_from_axis=offset))


def drive(
    env: gym.Env, driver: Driver, start: Start | None, actions: Any = None, digits: bool = False
) -> Drive:
    """Drive until the episode ends, by a driver, on all digits or six, or by given actions."""
    observation, info = env.reset(seed=0, options=start._asdict() if start else None)
    done = Drive([observation], [], [], 0.0)
    ended = False
    while not ended and (actions is None or len(done.actions) < len(actions)):
        if actions is None:
            seen = six_digits(info["car"]) if digits else observation
            action = driver.predict(seen, deterministic=True)[0]
        else:
            action = actions[len(done.actions)]
        observation, _, terminated, truncated, info = env.step(action)
        ended = terminated or truncated
        done.actions.append(action)
        done.observations.append(observation)
        if "lap_time" in info:
            done.laps.append(info["lap_time"])
    return done._replace(damage=info["damage"])


def held(one: Drive, other: Drive) -> Comparison:
    """Hold one drive to another."""
    number = min(len(one.actions), len(other.actions))
    apart = np.abs(np.subtract(one.observations[: number + 1], other.observations[: number + 1]))
    turned = np.abs(np.subtract(one.actions[:number], other.actions[:number])).max(axis=1) > SAME
    same = int(np.argmax(turned)) if turned.any() else number
    laps, damage = (one.laps, other.laps), (one.damage, other.damage)
    return Comparison(number, float(apart.max()), same, laps, damage)


def compare(
    track: str, driver: Driver, start: Start | None = None, laps: int = 1
) -> tuple[Comparison, Comparison]:
    """Repeat over SCR what a driver decides in the engine; then let it decide on six digits."""
    engine, game = (
        gym.make("Torcs-v0", backend=backend, track=track, laps=laps)
        for backend in ("native", "scr")
    )
    try:
        driven = drive(engine, driver, start)
        repeated = held(driven, drive(game, driver, start, driven.actions))
        by_itself = held(drive(engine, driver, start, digits=True), drive(game, driver, start))
    finally:
        engine.close()
        game.close()
    return repeated, by_itself


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", default="scripted", help="a model's file, or scripted")
    parser.add_argument("--tracks", default="aalborg,g-track-1,dirt-1", help="names, with commas")
    parser.add_argument("--laps", type=int, default=1)
    words = parser.parse_args()
    tracks = words.tracks.split(",")
    rows, all_equal = [], True
    driver = load_driver(words.model, gym.make("Torcs-v0"))
    for track in progress(tracks, "racing", console=Console(stderr=True)):
        repeated, by_itself = compare(track, driver, laps=words.laps)
        equal = repeated.equal and by_itself.equal
        equal = equal and by_itself.same_decisions == by_itself.decisions
        all_equal &= equal
        same = f"{by_itself.same_decisions} of {by_itself.decisions}"
        numbers = (str(repeated.decisions), f"{repeated.largest_difference:.1e}", same)
        laps = (times(repeated.laps[1]), times(by_itself.laps[1]))
        rows.append((track, "yes" if equal else "NO", *numbers, *laps))
    print(table(HEADERS, rows))
    sys.exit(0 if all_equal else 1)


def times(laps: list[float]) -> str:
    """Write lap times."""
    return ", ".join(f"{lap:.3f}" for lap in laps) or "none"


if __name__ == "__main__":
    main()
