"""Many racing environments at once: what ``RacingEnv.step`` does, in a few calls for all."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import astuple
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_torcs.actions import controls_from_action, listed_actions
from sb3_torcs.backends.base import Backend, Fleet
from sb3_torcs.backends.lite.backend import LiteBackend
from sb3_torcs.backends.lite.fleet import LiteFleet
from sb3_torcs.backends.native import NativeBackend, NativeFleet
from sb3_torcs.backends.seats import SeatWorld
from sb3_torcs.backends.several import present_world
from sb3_torcs.car import CAR_RECORD, CarState, Controls, FloatArray, car_from_record
from sb3_torcs.envs.compiled import COMPILED, RULES, aid_cars, read_actions, value_timesteps
from sb3_torcs.envs.info import racing_info
from sb3_torcs.envs.options import AIDS
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.errors import CarLost, InvalidAction, InvalidOption
from sb3_torcs.rewards import Term
from sb3_torcs.sensors import View

__all__ = ["Batch", "Outcome", "fleet_of"]

Counts = npt.NDArray[np.int64]

Held = tuple[FloatArray, Counts]
"""Controls of all, (n, 5), and for how many control ticks each of them is held, (n,)."""

Parts = list[Held]
"""A timestep, whose controls may change once: where those that were late arrive."""

CONTROLS_RECORD = np.dtype([(name, "f8") for name in Controls._fields])
CAR_NUMBERS = CAR_RECORD.itemsize // 8
NO_TERM = -1


class Outcome(NamedTuple):
    """The outcome of a timestep of all environments."""

    before: FloatArray  # (n, 111) cars
    after: FloatArray  # (n, 111) cars
    observations: npt.NDArray[np.float32]  # (n, size)
    rewards: list[float]
    terms: list[list[float]]  # of the rewards, in the order of `names`
    names: list[tuple[str, ...]]  # of the terms
    rules: npt.NDArray[np.void]  # (n,) of RULES, before
    waiting: list[tuple[Controls, ...]]  # controls that had not arrived before, of each
    ended: npt.NDArray[np.bool_]  # (n,) also by a failure; time limits are not known here
    failures: dict[int, Exception]  # what stopped cars, by index

    def info(self, index: int) -> dict[str, Any]:
        """
        Make the ``info`` of an environment whose episode goes on.

        :param index: of the environment
        """
        _, lap_time, terms = self.glance(index)
        return racing_info(car_from_record(self.after[index]), lap_time, terms)

    def glance(self, index: int) -> tuple[float, float, dict[str, float]]:
        """
        Read a few values of an environment whose episode goes on.

        :param index: of the environment
        :return: speed [m/s], time of the lap that the timestep completed, or 0 [s], and terms of
            the reward
        """
        number = self.after.item  # no view of the row: this is asked of each
        has_lapped = number(index, LAPS) > self.before.item(index, LAPS)
        # Who has fewer terms than another has zeros after its own.
        terms = dict(zip(self.names[index], self.terms[index], strict=False))
        terms["crash"] = 0.0
        return number(index, SPEED_X), number(index, LAST_LAP_TIME) if has_lapped else 0.0, terms

    def car(self, index: int) -> CarState:
        """
        Return the car of an environment, as the backend's ``step`` does.

        :param index: of the environment
        :raises Exception: that stopped the car
        """
        if index in self.failures:
            raise self.failures[index]
        return car_from_record(self.after[index])


LAPS, LAST_LAP_TIME, SPEED_X = map(CarState._fields.index, ("laps", "last_lap_time", "speed_x"))


class Batch:
    """
    Racing environments that take their timesteps at once.

    Those that share a race stand side by side.

    This object holds the state of an environment while :meth:`step` drives it. Call :meth:`leave`
    before the environment is used alone: it gives the state back. :meth:`enter` takes it over
    again.

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
        self._indices = np.arange(number)
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
        for index, reward in enumerate(self._rewards):
            for column, (_, term, weight) in enumerate(reward.terms):
                self._weights[index, column] = weight
                if term in COMPILED:
                    self._choices[index, column] = COMPILED.index(term)
                else:
                    self._in_python.append((index, column, term, weight))
        self._names = [tuple(name for name, _, _ in reward.terms) for reward in self._rewards]

    def renew(self) -> None:
        """Take an array of its own before states are taken over: earlier outcomes look at this."""
        self._cars = self._cars.copy()

    def enter(self, index: int) -> None:
        """
        Take the state of an environment over, which has been reset.

        :param index: of the environment
        """
        env = self.envs[index]
        assert env.car is not None, "step raises before the first reset"
        self._fleet.put(index, present_world(env.backend))
        self._cars[index] = np.hstack(env.car)
        self._rules[index] = (
            math.inf if env.laps is None else env.laps,
            env.runoff,
            env.recovery_ticks,
            env.action_repeat,
            env.patience,
            env.standing,
        )
        self._aids[index] = astuple(env.aids)
        self._driven[index] = []
        if env.reward is not self._rewards[index]:
            self._rewards[index] = env.reward
            self._read_rewards()

    def leave(self, index: int) -> None:
        """
        Give the state of an environment back to it.

        :param index: of the environment
        """
        if not self._driven[index]:
            return
        env, car = self.envs[index], car_from_record(self._cars[index])
        steps = (
            (_controls(controls[index]), int(ticks[index]))
            for parts in self._driven[index]
            for controls, ticks in parts
            if ticks[index]
        )
        self._fleet.arrive(index, steps, car)
        env.arrive(car, _controls(self._controls[index]), *_clocks(self._rules[index]))
        self._driven[index] = []

    def step(self, asked: npt.NDArray[np.floating]) -> Outcome:
        """
        Hold an action in each environment.

        :param asked: (n, numbers of an action)
        :return: the outcome; an environment that has ended or failed has to be finished
        :raises InvalidAction: if there is not one action per environment, or one is invalid; then
            no car has been driven
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
        for index, column, term, weight in self._in_python:
            values[index, column] = _ask(term, weight, before[index], after[index], controls[index])
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
            {index: self._fleet.failure(index) for index in failed},
        )

    def finish(self, index: int, timestep: Outcome, act: Callable[[], Any]) -> Any:
        """
        Let an environment take the timestep itself, with all its wrappers, without driving again.

        :param index: of the environment
        :param timestep: the outcome of the latest ``step``
        :param act: steps the outermost wrapper
        :return: what ``act`` returns
        :raises Exception: the error that stopped the car; its state is that before the timestep
        """
        env = self.envs[index]
        failure = timestep.failures.get(index)
        if failure is not None and not isinstance(failure, CarLost):
            self._driven[index].pop()
            env.delay.waiting = timestep.waiting[index]
            self._rules[index] = timestep.rules[index]
            raise failure
        before = car_from_record(timestep.before[index])
        env.arrive(before, env.controls, *_clocks(timestep.rules[index]))
        env.delay.waiting = timestep.waiting[index]
        env.driven = partial(timestep.car, index)
        env.valued = dict(zip(timestep.names[index], timestep.terms[index], strict=False))
        try:
            return act()
        finally:
            env.driven = env.valued = None
            self._driven[index] = []

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
        for index, env in enumerate(self.envs):
            *begun, (held, ticks[1, index]) = env.delay.hold(_controls(controls[index]))
            second[index] = _row(held)
            for held, number in begun:
                first[index], ticks[0, index] = _row(held), number
        return [(first, ticks[0]), (second, ticks[1])]

    def _drive(self, parts: Parts, after: FloatArray) -> list[int]:
        """
        Drive all cars.

        :param parts: of the timestep
        :param after: (n, 111) filled
        :return: who failed, whose rows are not
        """
        if len(parts) == 1:
            return self._fleet.step(self._indices, *parts[0], after)
        going, failed = np.ones(len(self.envs), np.bool_), []
        for controls, ticks in parts:
            indices = np.flatnonzero(going & (ticks > 0))
            cars = np.empty((len(indices), CAR_NUMBERS))
            lost = self._fleet.step(indices, controls[indices], ticks[indices], cars)
            after[indices] = cars
            failed += indices[lost].tolist()
            going[indices[lost]] = False
        return failed

    def _read(self, asked: npt.NDArray[np.floating]) -> FloatArray:
        """Turn the actions into controls, (n, 5)."""
        low, high = self._bounds
        controls = np.empty((len(self.envs), len(Controls._fields)))
        if isinstance(asked, np.ndarray) and asked.dtype.char in "fd" and asked.dtype.isnative:
            fits = asked.shape == (len(self.envs), len(low))
            if fits and read_actions(np.ascontiguousarray(asked), low, high, controls):
                return controls
        shape = len(self.envs), len(low)
        rows = listed_actions(asked, shape, ", as of model.predict(observations)")
        for index, row in enumerate(rows):
            try:
                controls[index] = _row(controls_from_action(row, self._layout))
            except InvalidAction as error:
                raise InvalidAction(f"environment {index}: {error}") from error
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
