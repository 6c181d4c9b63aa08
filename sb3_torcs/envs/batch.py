"""Many racing environments at once: what ``RacingEnv.step`` does, in a few calls for all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_torcs.actions import controls_from_action, list_actions, read_actions
from sb3_torcs.backends.base import Backend, Fleet
from sb3_torcs.backends.lite.backend import LiteBackend
from sb3_torcs.backends.lite.fleet import LiteFleet
from sb3_torcs.backends.native import NativeBackend, NativeFleet
from sb3_torcs.backends.seats import Seat, SeatWorld, SharedRace
from sb3_torcs.backends.several import present_world
from sb3_torcs.car import CAR_NUMBERS, CarState, Controls, FloatArray, controls_from_record
from sb3_torcs.envs.aids import help_cars
from sb3_torcs.envs.conditions import hold_controls
from sb3_torcs.envs.ends import LOST, end_episodes
from sb3_torcs.envs.episode import (
    EPISODE,
    RULES,
    Episodes,
    car_of,
    copy_of,
    new_episodes,
    numbers_of,
)
from sb3_torcs.envs.info import racing_info
from sb3_torcs.envs.options import AIDS
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.errors import CarLost, InvalidAction, InvalidOption
from sb3_torcs.rewards import Rewards
from sb3_torcs.sensors import Eyes, View

__all__ = ["Batch", "Outcome", "Replay", "fleet_of"]

Counts = npt.NDArray[np.int64]

Held = tuple[FloatArray, Counts]
"""Controls of all, (n, 5), and for how many control ticks each of them is held, (n,)."""

ASKED = slice(CAR_NUMBERS, CAR_NUMBERS + len(Controls._fields))  # in the numbers of an episode
SPEED_X = CarState._fields.index("speed_x")
LAP_TIME = EPISODE.fields["lap_time"][1] // 8  # type: ignore[index]  # of a record it is not None


@dataclass(slots=True)
class Outcome:
    """The outcome of a timestep of all environments."""

    before: Episodes  # (n,)
    after: Episodes  # (n,) whose ``over`` does not know of time limits
    observations: npt.NDArray[np.float32]  # (n, size)
    failures: dict[int, Exception]  # what stopped cars, by index
    valued: Rewards  # of the environments
    terms: list[list[float]] = field(default_factory=list)  # of the rewards, once they are valued
    speeds: list[float] = field(default_factory=list)  # [m/s] then
    lap_times: list[float] = field(default_factory=list)  # [s] of laps just completed, or 0, then

    @property
    def ended(self) -> npt.NDArray[np.bool_]:
        """Which episodes are over, (n,), also by a failure."""
        return self.after["over"] != 0.0

    def info(self, index: int) -> dict[str, Any]:
        """
        Make the ``info`` of an environment whose episode goes on.

        :param index: of the environment
        """
        _, lap_time, terms = self.glance(index)
        return racing_info(car_of(self.after, index), lap_time, terms)

    def glance(self, index: int) -> tuple[float, float, dict[str, float]]:
        """
        Read a few values of an environment whose episode goes on.

        :param index: of the environment
        :return: speed [m/s], time of the lap that the timestep completed, or 0 [s], and terms of
            the reward
        """
        terms = self.valued.rewards[index].explain(self.terms[index], None)
        return self.speeds[index], self.lap_times[index], terms


class Replay:
    """
    A world whose next timestep has been driven already.

    :param world: that was driven
    :param arrival: the car after it, or what stopped it
    """

    def __init__(self, world: Backend, arrival: CarState | Exception) -> None:
        self._world, self._arrival = world, arrival

    def step(self, controls: Controls, ticks: int) -> CarState:
        """
        Return the car after the timestep.

        :param controls: not used
        :param ticks: not used
        :raises Exception: that stopped the car
        """
        del controls, ticks
        if isinstance(self._arrival, Exception):
            raise self._arrival
        return self._arrival

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)


class Batch:
    """
    Racing environments that take their timesteps at once.

    Those that share a race stand side by side.

    This object holds the episode of an environment while :meth:`step` drives it. Call :meth:`leave`
    before the environment is used alone: it gives the episode back. :meth:`enter` takes it over
    again.

    :param envs: of one kind and with the same layout of actions
    :param threads: that drive, at least 1; those beyond one per race are left out
    :param names: of the environments in errors; by default their indices
    :raises InvalidOption: if they cannot be driven together
    """

    def __init__(
        self, envs: Sequence[RacingEnv], threads: int = 1, names: Sequence[str] | None = None
    ) -> None:
        self.envs = list(envs)
        number = len(self.envs)
        self._names = names or [f"environment {index}" for index in range(number)]
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
        self._layout, self._eyes = self.envs[0].layout, Eyes(View(*views), number)
        self._bounds = np.array(self._layout.low), np.array(self._layout.high)
        self._fleet = fleet_of([present_world(env.backend) for env in self.envs], self.threads)
        self._all = np.arange(number)
        self._races: dict[SharedRace, list[int]] = {}
        for index, env in enumerate(self.envs):
            seat: Any = env.backend
            if isinstance(seat, Seat):
                self._races.setdefault(seat.race, []).append(index)
        self.episodes = new_episodes(number)
        self._rules: Episodes = np.zeros(number, RULES)
        self._rewards = Rewards([env.reward for env in self.envs])
        self._driven: list[list[list[Held]]] = [[] for _ in self.envs]  # since `enter`

    def enter(self, index: int) -> None:
        """
        Take over the episode of an environment, which has been reset.

        :param index: of the environment
        """
        env = self.envs[index]
        self._fleet.put(index, present_world(env.backend))
        self._eyes.open(index, env.backend)
        self.episodes = copy_of(self.episodes)  # outcomes of earlier timesteps look at the old ones
        self.episodes[index], self._rules[index] = env.episode[0], env.rules[0]
        self._ticks = self._rules["ticks"].astype(np.int64)
        self._helps = any(self._rules[aid].any() for aid in AIDS)
        self._late = bool(self.episodes["delay"].any())
        self._driven[index] = []
        if env.reward is not self._rewards.rewards[index]:
            self._rewards = Rewards([env.reward for env in self.envs])

    def leave(self, index: int) -> None:
        """
        Give the episode of an environment back to it.

        :param index: of the environment
        """
        if not self._driven[index]:
            return
        steps = (
            (controls_from_record(controls[index]), int(ticks[index]))
            for parts in self._driven[index]
            for controls, ticks in parts
            if ticks[index]
        )
        self._fleet.arrive(index, steps, car_of(self.episodes, index))
        self.envs[index].episode = copy_of(self.episodes[index : index + 1])
        self._driven[index] = []

    def step(
        self, actions: npt.NDArray[np.floating] | Sequence[Any], indices: Counts | None = None
    ) -> Outcome:
        """
        Hold an action in each environment.

        :param actions: (n, numbers of an action)
        :param indices: (n,) of the environments that take the timestep; by default all
        :return: the outcome; an environment that has ended or failed has to be finished, and then
            the others are to be valued
        :raises InvalidAction: if there is not one action per environment, or one is invalid; then
            no car has been driven
        """
        indices = self._all if indices is None else indices
        before, after = self.episodes, copy_of(self.episodes)
        numbers = numbers_of(after)
        numbers[indices, ASKED] = self._read(actions, indices)
        if self._helps:
            help_cars(after, self._rules)
        parts = self._hold(after, numbers)
        races = [race for race, seats in self._races.items() if np.isin(seats, indices).any()]
        for race in races:
            race.ask()
        failed = self._drive(parts, indices, numbers)
        for race in races:
            race.advance(self.envs[self._races[race][0]].action_repeat)
        end_episodes(after, self._rules)
        for index in failed:
            after["over"][index] = LOST
        self.episodes = after
        for index in indices.tolist():
            self._driven[index].append(parts)
        failures = {index: self._fleet.failure(index) for index in failed}
        return Outcome(before, after, self._eyes.see(after), failures, self._rewards)

    def value(self, timestep: Outcome, going: npt.NDArray[np.bool_]) -> list[float]:
        """
        Value a timestep of the environments whose episodes go on; the others value it themselves.

        :param timestep: the outcome of the latest ``step``
        :param going: (n,) which they are
        :return: rewards
        """
        numbers = numbers_of(timestep.after)
        timestep.speeds = numbers[:, SPEED_X].tolist()
        timestep.lap_times = numbers[:, LAP_TIME].tolist()
        timestep.terms = self._rewards.value(timestep.before, timestep.after, going)
        return [sum(terms) for terms in timestep.terms]

    def finish(self, index: int, timestep: Outcome, act: Callable[[], Any]) -> Any:
        """
        Let an environment take the timestep itself, with all its wrappers, without driving again.

        :param index: of the environment
        :param timestep: the outcome of the latest ``step``
        :param act: steps the outermost wrapper
        :return: what ``act`` returns
        :raises Exception: the error that stopped the car; its state is that before the timestep
        """
        env, world = self.envs[index], self.envs[index].backend
        failure = timestep.failures.get(index)
        if failure is not None and not isinstance(failure, CarLost):
            self._driven[index].pop()
            self.episodes[index] = timestep.before[index]
            raise failure
        env.episode = copy_of(timestep.before[index : index + 1])
        env.episode["race_end"] = timestep.after["race_end"][index]
        env.backend = Replay(world, failure or car_of(timestep.after, index))
        try:
            return act()
        finally:
            env.backend = world
            self._driven[index] = []

    def close(self) -> None:
        """End the threads."""
        self._fleet.close()

    def _hold(self, after: Episodes, numbers: FloatArray) -> list[Held]:
        """
        Split the timestep where controls arrive.

        :param after: whose controls set out
        :param numbers: the same as a matrix
        :return: what is held: one part if no controls arrive during the timestep, else two
        """
        if not self._late:
            return [(numbers[:, ASKED].copy(), self._ticks)]
        held, ticks = np.empty((2, len(after), 5)), np.empty((2, len(after)), np.int64)
        hold_controls(after, self._rules, held, ticks)
        return list(zip(held, ticks, strict=True))

    def _drive(self, parts: list[Held], indices: Counts, numbers: FloatArray) -> list[int]:
        """
        Drive cars.

        :param parts: of the timestep
        :param indices: of the cars
        :param numbers: (all, numbers of an episode) whose cars change
        :return: who failed, whose cars stay as they were
        """
        failed: list[int] = []
        arrivals = np.empty((len(numbers), CAR_NUMBERS))
        for controls, ticks in parts:
            driving = indices if len(parts) == 1 else indices[ticks[indices] > 0]
            cars = np.empty((len(driving), CAR_NUMBERS))
            lost = self._fleet.step(driving, controls[driving], ticks[driving], cars)
            arrivals[driving] = cars
            if lost:
                failed += driving[lost].tolist()
                indices = np.setdiff1d(indices, driving[lost])
        numbers[indices, :CAR_NUMBERS] = arrivals[indices]
        return failed

    def _read(
        self, actions: npt.NDArray[np.floating] | Sequence[Any], indices: Counts
    ) -> FloatArray:
        """Turn the actions of some environments into controls, (n, 5)."""
        low, high = self._bounds
        controls = np.empty((len(indices), len(Controls._fields)))
        if (
            isinstance(actions, np.ndarray)
            and actions.dtype.char in "fd"
            and actions.dtype.isnative
        ):
            fits = actions.shape == (len(indices), len(low))
            if fits and read_actions(np.ascontiguousarray(actions), low, high, controls):
                return controls
        shape = len(indices), len(low)
        rows = list_actions(actions, shape, ", as of model.predict(observations)")
        for place, row in enumerate(rows):
            try:
                controls[place] = controls_from_action(row, self._layout)
            except InvalidAction as error:
                raise InvalidAction(f"{self._names[indices[place]]}: {error}") from error
        return controls


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
