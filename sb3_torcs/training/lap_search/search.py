"""Search a fast lap: candidates from the engine's snapshots, over a receding horizon.

The search drives a race of three laps, again and again. Every half second it drives some ten
candidates from where the car is, a few seconds far: each follows the best line so far, and steers,
brakes and accelerates a little otherwise for a while. The best of them is driven for half a second,
and its rest is where the next candidates begin. What comes out is the line of the next race.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sb3_torcs import maths
from sb3_torcs.agents.ghosts import Ghost
from sb3_torcs.backends.native import make_engine, make_rollouts
from sb3_torcs.car import CONTROL_TICK, DEFAULT_CAR, RESTING, FloatArray
from sb3_torcs.envs.making import checked_threads
from sb3_torcs.evaluation.protocol import RACE_LAPS
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.starting_list import AGENT
from sb3_torcs.training.lap_search.line import (
    PEDAL,
    STEERING,
    Line,
    blended,
    lap_of,
    repeated,
    waypoint,
)
from sb3_torcs.training.lap_search.starts import FirstDrive

__all__ = ["Budget", "LapSearch", "State"]

GAINS = (0.15, 2.0, 0.15)  # of `Gains` in native/rollouts.h; tried, not tuned
CANDIDATES = 8  # per generation; more races are worth more than more candidates
GENERATIONS = 1  # a second one is around the best of the first
MORE_GENERATIONS = 4  # where no candidate stays on the road
HORIZON = 4.5  # [s] that candidates are driven
CAUTION = 1.0  # [s] more, after a dead end
WINDOW = 2.0  # [s] of it in which they differ from each other
STRIDE = 0.5  # [s] that the best one is driven
BACK = 4  # strides to go back from a dead end
CAREFUL = 8  # strides that are then driven with caution
MOST_DEAD_ENDS = 30  # per race
SPREAD = np.array([0.15, 0.8, 1.5])  # of steering [-], pedal [-] and place [m]
SHORTEST = 0.2  # [s] of one change
LONGEST = 2.302585092994046  # logarithm of how much longer the longest is: ten times
SMALLEST = -2.302585092994046  # logarithm of how small changes can be: a tenth of the spread
FAILED = -100.0  # [s] that a candidate has won that leaves the road


@dataclass(frozen=True)
class Budget:
    """What a search may take; it ends with the first that is used up."""

    seconds: float = math.inf
    rollouts: float = math.inf


@dataclass(frozen=True)
class State:
    """How far a search has come."""

    rollouts: int
    seconds: float
    races: int  # that were driven to the end
    ghost: Ghost | None  # the best so far


@dataclass
class _Plan:
    """A candidate that was driven."""

    gain: float  # [s]
    offsets: FloatArray  # (steps, 3)
    path: FloatArray  # (steps + 1, 7)
    lasted: int  # timesteps on the road


class LapSearch:
    """
    A search for the fastest three laps from the grid.

    :param agent: in whose environment the ghost is to drive, for its record
    :param env_kwargs: of the ``Torcs-v0`` that the ghost is to drive in, with track, car, layout of
        the action and ``action_repeat``
    :param starts: drives to begin with; the next one if there is no way along the first
    :param seed: of all random numbers
    :param threads: that drive candidates; ``None`` is one per core, as
        far as there are candidates. They change nothing but time
    """

    def __init__(
        self,
        agent: str,
        env_kwargs: Mapping[str, Any],
        starts: Sequence[FirstDrive],
        *,
        seed: int = 0,
        threads: int | None = None,
    ) -> None:
        self.agent = agent
        self.env_kwargs = {**env_kwargs, "laps": RACE_LAPS}
        self.rollouts = self.races = 0
        self.ghost: Ghost | None = None
        self._rng = np.random.default_rng(seed)
        self._ticks = int(env_kwargs["action_repeat"])
        self._begun = time.monotonic()
        self._engines = [self._engine() for _ in range(min(checked_threads(threads), CANDIDATES))]
        for engine in self._engines:
            engine.start()
        self._rollouts = make_rollouts(self._engines)
        self._length = self._engines[0].track_summary()["length"]
        self._to_line = self._length - self._engines[0].read(0).distance_from_start
        self._best_laps = [math.inf, math.inf]  # [s] standing, flying
        self._starts = list(starts)
        self._begin()

    def _begin(self) -> None:
        """Follow the next start."""
        self._start = self._starts.pop(0)
        self._launch = self._start.rows
        number = min((1, 2), key=lambda lap: self._start.lap_times[lap])
        self._flying = self._flying_lap(self._start.rows, number)

    def _flying_lap(self, rows: FloatArray, number: int) -> FloatArray:
        return lap_of(rows, self._to_line + number * self._length, self._length)

    def _engine(self) -> Any:
        kwargs = self.env_kwargs
        gearbox = kwargs.get("gearbox", "automatic")
        car = kwargs.get("car", DEFAULT_CAR)
        return make_engine(find_game(), kwargs["track"], [AGENT], car=car, gearbox=gearbox)

    def close(self) -> None:
        """Give the races back."""
        for engine in self._engines:
            engine.close()

    def run(self, budget: Budget) -> Iterator[State]:
        """
        Search. What was found so far is in ``ghost``, whenever the search is left.

        :param budget: of the search; one in seconds ends elsewhere each time
        :return: how far it has come, many times a second
        """
        while not self._spent(budget):
            rows: list[FloatArray] = []
            for _ in self._race(rows):
                yield self.state()
                if self._spent(budget):
                    return
            if rows:
                self._keep(rows)
                yield self.state()
            elif self.ghost is None and self._starts:
                self._begin()

    def _spent(self, budget: Budget) -> bool:
        seconds = time.monotonic() - self._begun
        return self.rollouts >= budget.rollouts or seconds >= budget.seconds

    def state(self) -> State:
        """Return how far it has come."""
        seconds = time.monotonic() - self._begun
        return State(self.rollouts, seconds, self.races, self.ghost)

    # ---- One race ---------------------------------------------------------------------------

    def _race(self, rows: list[FloatArray]) -> Iterator[None]:
        """Drive three laps into ``rows``, which are empty if there is no way on."""
        for engine in self._engines:
            engine.start()
        self._rollouts.mark()
        stride, steps = self._timesteps(STRIDE), self._timesteps(HORIZON)
        mean, careful, dead_ends, lap = np.zeros((steps, 3)), 0, 0, -1
        while (car := self._engines[0].read(0)).laps < RACE_LAPS:
            here = np.array(waypoint(car, RESTING))
            if car.laps != lap:
                lap = car.laps
                self._note_laps([*rows, here])
                line = self._line(lap)
            ahead = steps + self._timesteps(CAUTION) * (careful > 0)
            mean = np.pad(mean[:ahead], ((0, max(ahead - len(mean), 0)), (0, 0)))
            plan = self._plan(line, here, line.rows_from(here, len(rows)), mean)
            yield
            if plan.lasted >= ahead // 2:
                self._rollouts.drive(plan.path[:stride], self._ticks)
                rows.extend(plan.path[:stride])
                mean = np.pad(plan.offsets[stride:], ((0, stride), (0, 0)))
                careful = max(careful - 1, 0)
                continue
            back = min(BACK, len(rows) // stride)
            dead_ends += 1
            if dead_ends > MOST_DEAD_ENDS:
                rows.clear()
                return
            self._rollouts.go_back(back)
            del rows[len(rows) - back * stride :]
            mean, careful = np.zeros((ahead, 3)), CAREFUL
        rows.append(np.array(waypoint(car, RESTING)))

    def _timesteps(self, seconds: float) -> int:
        return max(round(seconds / (self._ticks * CONTROL_TICK)), 1)

    def _line(self, lap: int) -> Line:
        """Return the line to follow in a lap."""
        laps = repeated(self._flying, self._length, range(max(lap, 1) - 1, lap + 2))
        laps[:, 1] += self._to_line
        return Line(blended(self._launch, laps) if lap == 0 else laps)

    def _plan(self, line: Line, here: FloatArray, rows: FloatArray, mean: FloatArray) -> _Plan:
        """Search the best way on, generation by generation."""
        best = _Plan(-math.inf, mean, np.empty(0), 0)
        generation = 0
        while generation < GENERATIONS or (
            best.lasted < len(mean) and generation < GENERATIONS + MORE_GENERATIONS
        ):
            candidates = best.offsets + self._changes(len(mean))
            if generation == 0:
                candidates = np.concatenate([np.zeros((1, *mean.shape)), mean[None], candidates])
            best = max(best, self._driven(line, here, rows, candidates), key=lambda p: p.gain)
            generation += 1
        return best

    def _driven(
        self, line: Line, here: FloatArray, rows: FloatArray, candidates: FloatArray
    ) -> _Plan:
        """Drive candidates and return the best."""
        paths, lasted = self._rollouts.follow(rows, GAINS, candidates, self._ticks)
        self.rollouts += len(candidates)
        gains = line.gain(here, paths[:, -1])
        gains = np.where(lasted == candidates.shape[1], gains, FAILED + lasted)
        index = int(np.argmax(gains))
        return _Plan(gains[index], candidates[index], paths[index], int(lasted[index]))

    def _changes(self, steps: int) -> FloatArray:
        """Draw changes of the controls and of the line: each rises and falls once."""
        draw = self._rng
        changes = np.zeros((CANDIDATES, steps, 3))
        seconds = np.arange(steps) * self._ticks * CONTROL_TICK
        for change in changes:
            for _ in range(draw.integers(1, 4)):
                kind = draw.integers(3)
                lasts = SHORTEST * maths.exp(draw.uniform(0.0, LONGEST))
                share = (seconds - draw.uniform(-0.3 * lasts, WINDOW)) / lasts
                height = SPREAD[kind] * draw.normal() * maths.exp(draw.uniform(SMALLEST, 0.0))
                rise = maths.directions(np.pi * np.clip(share, 0.0, 1.0))[:, 1]
                change[:, kind] += height * rise
        return changes

    # ---- What was found ---------------------------------------------------------------------

    def _note_laps(self, rows: Sequence[FloatArray]) -> None:
        """Follow a race's laps from now on that are faster than the laps followed so far."""
        times = [seconds for seconds, _ in self._engines[0].laps(0)]
        if len(times) == RACE_LAPS and times[0] < self._best_laps[0]:
            self._best_laps[0], self._launch = times[0], np.array(rows)
        for number in range(1, len(times)):
            if times[number] < self._best_laps[1]:
                self._best_laps[1] = times[number]
                self._flying = self._flying_lap(np.array(rows), number)

    def _keep(self, rows: Sequence[FloatArray]) -> None:
        """Keep a race, if it is the fastest so far."""
        self.races += 1
        self._note_laps(rows)
        ghost = self._driven_again(np.array(rows[:-1]))
        if len(ghost.lap_times) < RACE_LAPS:
            return  # it spun or stood on its way, which ends an episode
        if self.ghost is None or sum(ghost.lap_times) < sum(self.ghost.lap_times):
            self.ghost = ghost

    def _driven_again(self, rows: FloatArray) -> Ghost:
        """Drive a race in the environment itself, which says when it ends and how long it took."""
        steering, pedal = rows[:, STEERING], rows[:, PEDAL]
        throttle, brake = np.maximum(pedal, 0.0), np.maximum(-pedal, 0.0)
        pedals = (pedal,) if self.env_kwargs["action"] == "pedal" else (throttle, brake)
        actions = np.stack([steering, *pedals], axis=1).astype(np.float32)
        told = self.agent, self._start.driver, self.rollouts
        ghost = Ghost(self.env_kwargs, actions, (), *told)
        steps = list(ghost.drive())
        laps = tuple(step.info["lap_time"] for step in steps if step.info["lap_time"])
        return replace(ghost, actions=actions[: len(steps)], lap_times=laps)
