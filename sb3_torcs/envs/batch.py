"""Many racing environments at once: what ``RacingEnv.step`` does, in a few calls for all."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import astuple
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_torcs.actions import actions_of_races, controls_from_action
from sb3_torcs.backends.base import Backend, Fleet
from sb3_torcs.backends.lite.backend import LiteBackend
from sb3_torcs.backends.lite.fleet import LiteFleet
from sb3_torcs.backends.native import NativeBackend, NativeFleet
from sb3_torcs.backends.seats import SeatWorld
from sb3_torcs.backends.several import present_world
from sb3_torcs.car import CAR_RECORD, CarState, Controls, FloatArray, car_from_record
from sb3_torcs.envs.aids import AIDS
from sb3_torcs.envs.compiled import COMPILED, RULES, aid_cars, read_actions, value_timesteps
from sb3_torcs.envs.info import racing_info
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.errors import CarLost, InvalidAction, InvalidOption
from sb3_torcs.rewards import Term
from sb3_torcs.sensors import View

__all__ = ["Batch", "Outcome", "fleet_of"]

Counts = npt.NDArray[np.int64]

Held = tuple[FloatArray, Counts]
"""Controls of all races, (n, 5), and for how many control ticks each of them is held, (n,)."""

Parts = list[Held]
"""A timestep, whose controls may change once: where those that were late arrive."""

CONTROLS_RECORD = np.dtype([(name, "f8") for name in Controls._fields])
CAR_NUMBERS = CAR_RECORD.itemsize // 8
NO_TERM = -1


class Outcome(NamedTuple):
    """The outcome of a timestep of all races."""

    before: FloatArray  # (n, 111) cars
    after: FloatArray  # (n, 111) cars
    observations: npt.NDArray[np.float32]  # (n, size)
    rewards: list[float]
    terms: list[list[float]]  # of the rewards, in the order of `names`
    names: list[tuple[str, ...]]  # of the terms
    rules: npt.NDArray[np.void]  # (n,) of RULES, before
    waiting: list[tuple[Controls, ...]]  # controls that had not arrived before, of each race
    ended: npt.NDArray[np.bool_]  # (n,) also if the race has failed; time limits are not known here
    failures: dict[int, Exception]  # the errors of races, by index

    def info(self, race: int) -> dict[str, Any]:
        """
        Make the ``info`` of a race whose episode goes on.

        :param race: index of the race
        """
        _, lap_time, terms = self.glance(race)
        return racing_info(car_from_record(self.after[race]), lap_time, terms)

    def glance(self, race: int) -> tuple[float, float, dict[str, float]]:
        """
        Read a few values of a race whose episode goes on.

        :param race: index of the race
        :return: speed [m/s], time of the lap that the timestep completed, or 0 [s], and terms of
            the reward
        """
        number = self.after.item  # no view of the row: this is asked of each race
        has_lapped = number(race, LAPS) > self.before.item(race, LAPS)
        # A race with fewer terms than another has zeros after its own.
        terms = dict(zip(self.names[race], self.terms[race], strict=False))
        terms["crash"] = 0.0
        return number(race, SPEED_X), number(race, LAST_LAP_TIME) if has_lapped else 0.0, terms

    def car(self, race: int) -> CarState:
        """
        Return the car of a race, as the backend's ``step`` does.

        :param race: index of the race
        :raises Exception: that stopped the race
        """
        if race in self.failures:
            raise self.failures[race]
        return car_from_record(self.after[race])


LAPS, LAST_LAP_TIME, SPEED_X = map(CarState._fields.index, ("laps", "last_lap_time", "speed_x"))


class Batch:
    """
    Racing environments that take their timesteps at once.

    ``race`` is the index of one of them, also where several share a race: they stand side by side.

    This object holds the state of a race while :meth:`step` drives it. Call :meth:`leave` before
    the environment is used alone: it gives the state back. :meth:`enter` takes it over again.

    :param envs: of one kind and with the same layout of actions
    :param threads: that drive, at least 1; those beyond one per race are left out
    :raises InvalidOption: if they cannot be driven together
    """

    def __init__(self, envs: Sequence[RacingEnv], threads: int = 1) -> None:
        self.envs = list(envs)
        number = len(self.envs)
        races = {id(getattr(env.backend, "race", env)) for env in self.envs}
        self.threads = min(threads, len(races))
        layouts = {(env.layout.names, env.layout.high) for env in self.envs}
        if len(layouts) > 1:
            raise InvalidOption(
                f"the environments read actions in {len(layouts)} ways; give all the same action "
                "and cars with as many gears"
            )
        views = {env.sensors for env in self.envs}
        if len(views) > 1:
            raise InvalidOption(
                f"the environments have observations of {len(views)} kinds; give all the same "
                "sensors"
            )
        self._layout, self._view = self.envs[0].layout, View(*views)
        self._bounds = np.array(self._layout.low), np.array(self._layout.high)
        self._fleet = fleet_of([present_world(env.backend) for env in self.envs], self.threads)
        self._races = np.arange(number)
        self._cars = np.zeros((number, CAR_NUMBERS))
        self._rules = np.zeros(number, RULES)
        self._aids = np.zeros((number, len(AIDS)), np.bool_)
        self._driven: list[list[Parts]] = [[] for _ in self.envs]  # timesteps since `enter`
        self._controls = np.zeros((number, len(Controls._fields)))
        self._rewards = [env.reward for env in self.envs]
        self._read_rewards()

    def _read_rewards(self) -> None:
        """Look up which terms the rewards have, and which of them are compiled."""
        number, most = len(self.envs), max(len(reward.terms) for reward in self._rewards)
        self._choices = np.full((number, most), NO_TERM)
        self._weights = np.zeros((number, most))
        self._in_python: list[tuple[int, int, Term, float]] = []
        for race, reward in enumerate(self._rewards):
            for i, (_, term, weight) in enumerate(reward.terms):
                self._weights[race, i] = weight
                if term in COMPILED:
                    self._choices[race, i] = COMPILED.index(term)
                else:
                    self._in_python.append((race, i, term, weight))
        self._names = [tuple(name for name, _, _ in reward.terms) for reward in self._rewards]

    def renew(self) -> None:
        """Take an array of its own before races are taken over: earlier outcomes look at this."""
        self._cars = self._cars.copy()

    def enter(self, race: int) -> None:
        """
        Take the state of a race over from its environment, which has been reset.

        :param race: index of the race
        """
        env = self.envs[race]
        assert env.car is not None, "step raises before the first reset"
        self._fleet.put(race, present_world(env.backend))
        self._cars[race] = np.hstack(env.car)
        self._rules[race] = (
            math.inf if env.laps is None else env.laps,
            env.runoff,
            env.recovery_ticks,
            env.action_repeat,
            env.patience,
            env.standing,
        )
        self._aids[race] = astuple(env.aids)
        self._driven[race] = []
        if env.reward is not self._rewards[race]:
            self._rewards[race] = env.reward
            self._read_rewards()

    def leave(self, race: int) -> None:
        """
        Give the state of a race back to its environment.

        :param race: index of the race
        """
        if not self._driven[race]:
            return
        env, car = self.envs[race], car_from_record(self._cars[race])
        steps = (
            (_controls(controls[race]), int(ticks[race]))
            for parts in self._driven[race]
            for controls, ticks in parts
            if ticks[race]
        )
        self._fleet.arrive(race, steps, car)
        env.arrive(car, _controls(self._controls[race]), *_clocks(self._rules[race]))
        self._driven[race] = []

    def step(self, asked: npt.NDArray[np.floating]) -> Outcome:
        """
        Hold an action in each race.

        :param asked: (n, numbers of an action)
        :return: the outcome; a race that has ended or failed has to be finished
        :raises InvalidAction: if there is not one action per race, or one is invalid; then no race
            has been driven
        """
        controls = self._read(asked)
        if self._aids.any():
            aid_cars(self._cars.view(CAR_RECORD)[:, 0], self._aids, controls)
        before, after = self._cars, np.empty_like(self._cars)
        waiting = [env.delay.waiting for env in self.envs]
        parts = self._parts(controls)
        failed = self._drive(parts, after)
        after[failed] = before[failed]
        self._cars, self._controls = after, controls  # driven, even if a term of a reward fails
        for driven in self._driven:
            driven.append(parts)
        number = len(self.envs)
        observations = np.empty((number, self._view.size), np.float32)
        values, ended = np.empty_like(self._weights), np.empty(number, np.bool_)
        rules = self._rules.copy()
        value_timesteps(
            before.view(CAR_RECORD)[:, 0],
            after.view(CAR_RECORD)[:, 0],
            controls.view(CONTROLS_RECORD)[:, 0],
            self._choices,
            self._weights,
            self._rules,
            observations,
            values,
            ended,
        )
        if self._view.has_more:
            for env, row, seen in zip(self.envs, after, observations, strict=True):
                self._view.add(car_from_record(row), env.backend, seen)
        for race, i, term, weight in self._in_python:
            values[race, i] = _ask(term, weight, before[race], after[race], controls[race])
        ended[failed] = True
        terms = values.tolist()
        return Outcome(
            before,
            after,
            observations,
            [sum(row) for row in terms],
            terms,
            self._names,
            rules,
            waiting,
            ended,
            {race: self._fleet.failure(race) for race in failed},
        )

    def finish(self, race: int, timestep: Outcome, act: Callable[[], Any]) -> Any:
        """
        Let an environment take the timestep itself, with all its wrappers, without driving again.

        :param race: index of the race
        :param timestep: the outcome of the latest ``step``
        :param act: steps the outermost wrapper
        :return: what ``act`` returns
        :raises Exception: the error that stopped the race; its state is that before the timestep
        """
        env = self.envs[race]
        failure = timestep.failures.get(race)
        if failure is not None and not isinstance(failure, CarLost):
            self._driven[race].pop()
            env.delay.waiting = timestep.waiting[race]
            self._rules[race] = timestep.rules[race]
            raise failure
        before = car_from_record(timestep.before[race])
        env.arrive(before, env.controls, *_clocks(timestep.rules[race]))
        env.delay.waiting = timestep.waiting[race]
        env.driven = partial(timestep.car, race)
        try:
            return act()
        finally:
            env.driven = None
            self._driven[race] = []

    def close(self) -> None:
        """End the threads."""
        self._fleet.close()

    def _parts(self, controls: FloatArray) -> Parts:
        """
        Split the timestep where controls arrive.

        :param controls: (n, 5) that were asked for
        :return: what is held, one part if no controls arrive during the timestep, else two
        """
        if not any(env.delay.ticks for env in self.envs):
            return [(controls, self._rules["ticks"].copy())]
        first, second = np.zeros((2, *controls.shape))
        ticks = np.zeros((2, len(self.envs)), np.int64)
        for race, env in enumerate(self.envs):
            *begun, (held, ticks[1, race]) = env.delay.hold(_controls(controls[race]))
            second[race] = _row(held)
            for held, number in begun:
                first[race], ticks[0, race] = _row(held), number
        return [(first, ticks[0]), (second, ticks[1])]

    def _drive(self, parts: Parts, after: FloatArray) -> list[int]:
        """
        Drive all races.

        :param parts: of the timestep
        :param after: (n, 111) filled
        :return: the races that failed, whose rows are not
        """
        if len(parts) == 1:
            return self._fleet.step(self._races, *parts[0], after)
        going, failed = np.ones(len(self.envs), np.bool_), []
        for controls, ticks in parts:
            races = np.flatnonzero(going & (ticks > 0))
            cars = np.empty((len(races), CAR_NUMBERS))
            lost = self._fleet.step(races, controls[races], ticks[races], cars)
            after[races] = cars
            failed += races[lost].tolist()
            going[races[lost]] = False
        return failed

    def _read(self, asked: npt.NDArray[np.floating]) -> FloatArray:
        """Turn the actions into controls, (n, 5)."""
        low, high = self._bounds
        controls = np.empty((len(self.envs), len(Controls._fields)))
        if isinstance(asked, np.ndarray) and asked.dtype.char in "fd":
            fits = asked.shape == (len(self.envs), len(low))
            if fits and read_actions(np.ascontiguousarray(asked), low, high, controls):
                return controls
        shape = len(self.envs), len(low)
        rows = actions_of_races(asked, shape, ", as of model.predict(observations)")
        for race, row in enumerate(rows):
            try:
                controls[race] = _row(controls_from_action(row, self._layout))
            except InvalidAction as error:
                raise InvalidAction(f"environment {race}: {error}") from error
        return controls


def _ask(
    term: Term, weight: float, before: FloatArray, after: FloatArray, controls: FloatArray
) -> float:
    """Return the weighted value of a term that is not compiled."""
    was, car = car_from_record(before), car_from_record(after)
    seconds = car.time - was.time
    return weight * seconds * term(was, car, _controls(controls)) if seconds else 0.0


def _clocks(rules: Any) -> tuple[int, int]:
    """Read for how many control ticks a car has been standing, and how many it may."""
    return int(rules["standing"]), int(rules["patience"])


def _row(controls: Controls) -> tuple[float, ...]:
    """Write controls as a row of an array, (5,)."""
    steering, throttle, brake, gear, clutch = controls
    return steering, throttle, brake, math.nan if gear is None else gear, clutch


def _controls(row: FloatArray) -> Controls:
    """Read controls from an array, (5,)."""
    steering, throttle, brake, gear, clutch = row.tolist()
    return Controls(steering, throttle, brake, None if gear != gear else int(gear), clutch)


def fleet_of(worlds: Sequence[Backend], threads: int) -> Fleet:
    """
    Make a fleet of worlds.

    :param worlds: of one kind
    :param threads: that drive
    :raises InvalidOption: if worlds of that kind cannot be driven at once
    """
    native = [world for world in worlds if isinstance(world, (NativeBackend, SeatWorld))]
    lite = [world for world in worlds if isinstance(world, LiteBackend)]
    if len(native) == len(worlds):
        return NativeFleet(native, threads)
    if len(lite) == len(worlds):
        return LiteFleet(lite, threads)
    kinds = sorted({type(world).__name__ for world in worlds})
    raise InvalidOption(
        f"races on threads are for backend 'native' of Torcs-v0 or for TorcsLite-v0, these are "
        f"of {', '.join(kinds)}; others drive in DummyVecEnv or SubprocVecEnv"
    )
