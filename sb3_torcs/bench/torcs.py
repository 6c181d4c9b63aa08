"""Speed of the real game in this process, compared with its bare physics, and on two threads."""

from __future__ import annotations

import multiprocessing
import signal
import statistics
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from sb3_torcs import cores
from sb3_torcs.bench.drives import (
    RACES,
    REPEAT,
    TICKS_PER_TURN,
    TORCS,
    Actions,
    Figures,
    mean_reset_ms,
    scripted_actions,
    scripted_batches,
)
from sb3_torcs.car import FloatArray

__all__ = ["loads", "resets", "ticks", "vector"]

PHYSICS_STEPS = 10  # of 0.002 s in a control tick
STRETCH = 50  # ticks of the drive between two places where the bare physics is measured
HELD = 25  # ticks for which it goes on there: the car still drives as it did
RESETS = 100  # of each kind
SLOWEST_TRACK = "road/spring"  # has by far the most segments
LOADS = 5
BATCHES = 100  # timesteps of all races per measurement of the threads: a sixth of a second
SLICE = 0.15  # [s] of wall time per measurement of the processes


def ticks(seconds: float) -> Figures:
    """
    Measure control ticks per second of one drive: the bare physics, the engine, the environment.

    :param seconds: of processor time, at least one turn each [s]
    :return: the medians over the turns
    """
    single, repeated = (gym.make(TORCS, action_repeat=repeat) for repeat in (1, REPEAT))
    actions = scripted_actions(single, TICKS_PER_TURN)
    timesteps = scripted_actions(repeated, TICKS_PER_TURN // REPEAT)
    controls = np.array(actions, np.float64)
    engine = single.get_wrapper_attr("backend").engine
    measurements: dict[str, Callable[[], float]] = {
        "torcs_limit_ticks_per_s": lambda: _limit(engine, controls),
        "torcs_cpp_ticks_per_s": lambda: _replay(engine, controls),
        "torcs_env_ticks_per_s": lambda: _drive(single, actions),
        "torcs_env_repeat5_ticks_per_s": lambda: REPEAT * _drive(repeated, timesteps),
    }
    rates: dict[str, list[float]] = {name: [] for name in measurements}
    begin = time.process_time()
    while not rates["torcs_limit_ticks_per_s"] or time.process_time() - begin < seconds:
        for name, measure in measurements.items():
            rates[name].append(measure())
    single.close()
    repeated.close()
    return {name: statistics.median(values) for name, values in rates.items()}


def _limit(engine: Any, controls: FloatArray) -> float:
    """Time the physics alone, at places all along the drive, with the controls held there."""
    engine.start()
    spent, done = 0.0, 0
    for first in range(0, len(controls), STRETCH):
        engine.replay(controls[first : first + STRETCH], False)
        place = engine.save()
        engine.update_physics(PHYSICS_STEPS)  # fills the processor's caches before the measurement
        begin = time.process_time()
        engine.update_physics(PHYSICS_STEPS * (HELD - 1))
        spent += time.process_time() - begin
        done += HELD - 1
        engine.restore(place)
    return done / spent


def _replay(engine: Any, controls: FloatArray) -> float:
    """Time the drive in the engine, with the race's rules and all sensors after each tick."""
    engine.start()
    begin = time.process_time()
    engine.replay(controls, True)
    return len(controls) / (time.process_time() - begin)


def _drive(env: gym.Env[Any, Any], actions: Actions) -> float:
    """Time the drive in an environment, timesteps per second."""
    env.reset(seed=0)
    begin = time.process_time()
    for action in actions:
        env.step(action)
    return len(actions) / (time.process_time() - begin)


def resets() -> Figures:
    """
    Measure a reset of an environment that was reset before, to the grid and elsewhere by turns.

    :return: ``torcs_reset_ms``, the mean of both
    """
    return {"torcs_reset_ms": mean_reset_ms(gym.make(TORCS), RESETS, time.process_time)}


def loads() -> Figures:
    """
    Measure ``gym.make`` on the slowest track, in a process that has loaded the game before.

    :return: ``torcs_load_ms``
    """
    others = [gym.make(TORCS)]  # so that the next race cannot reuse a closed one
    spent = []
    for _ in range(LOADS):
        begin = time.process_time()
        others.append(gym.make(TORCS, track=SLOWEST_TRACK))
        spent.append(time.process_time() - begin)
    for env in others:
        env.close()
    return {"torcs_load_ms": 1000.0 * statistics.median(spent)}


def vector(seconds: float) -> Figures:
    """
    Measure what a second thread brings to a vector environment, against what a second core brings.

    :param seconds: of wall time, at least one turn [s]
    :return: ``torcs_vector2_ratio``: the speed-up of ``gym.make_vec`` by a second thread, divided
        by that of bare engines by a second process; the median over the turns
    """
    if cores.number() < 2:
        return {"torcs_vector2_ratio": None}
    one, two = (gym.make_vec(TORCS, num_envs=RACES, threads=threads) for threads in (1, 2))
    actions = scripted_batches(one.reset(seed=0)[0], one.step, BATCHES)
    measurements: list[Callable[[], float]] = [
        lambda: _sweep(one, actions),
        lambda: _sweep(two, actions),
        lambda: bare.rate(1),
        lambda: bare.rate(2),
    ]
    ratios: list[float] = []
    begin = time.perf_counter()
    with _BareEngines(np.repeat([batch[0] for batch in actions], REPEAT, axis=0)) as bare:
        while not ratios or time.perf_counter() - begin < seconds:
            # Now in one order, now in the other: a machine that slows down favours neither.
            order = measurements if len(ratios) % 2 else measurements[::-1]
            rates = {id(measure): measure() for measure in order}
            slow, fast, single, double = (rates[id(measure)] for measure in measurements)
            ratios.append((fast / slow) / (double / single))
    one.close()
    two.close()
    return {"torcs_vector2_ratio": statistics.median(ratios)}


def _sweep(envs: gym.vector.VectorEnv[Any, Any, Any], actions: Actions) -> float:
    """Time the drive in a vector environment by the wall clock, timesteps per second."""
    envs.reset(seed=0)
    begin = time.perf_counter()
    for action in actions:
        envs.step(action)
    return len(actions) / (time.perf_counter() - begin)


class _BareEngines:
    """
    Two processes with an engine each, and little else: what two cores can do at most.

    :param controls: (ticks, 3) to drive again and again
    """

    def __init__(self, controls: npt.NDArray[np.floating]) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would copy this process's threads
        self._pipes, self._processes = [], []
        for _ in range(2):
            here, there = context.Pipe()
            process = context.Process(target=_serve, args=(there, controls.astype(np.float64)))
            process.start()
            self._pipes.append(here)
            self._processes.append(process)
        for pipe in self._pipes:
            pipe.recv()

    def __enter__(self) -> _BareEngines:
        return self

    def __exit__(self, *error: object) -> None:
        for pipe in self._pipes:
            pipe.send(0.0)
        for process in self._processes:
            process.join()

    def rate(self, number: int) -> float:
        """
        Drive in some of the processes at once.

        :param number: of processes
        :return: control ticks per second of all of them
        """
        for pipe in self._pipes[:number]:
            pipe.send(SLICE)
        return float(sum(pipe.recv() for pipe in self._pipes[:number]))


def _serve(pipe: Connection, controls: FloatArray) -> None:
    """Drive for as many seconds as are asked for, until none are, and say how fast it went."""
    from sb3_torcs.backends.native import NativeBackend

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # which is for the parent, who ends this process
    backend = NativeBackend()
    pipe.send("ready")
    while seconds := pipe.recv():
        begin, done = time.perf_counter(), 0
        while time.perf_counter() - begin < seconds:
            backend.engine.start()
            backend.engine.replay(controls, True)
            done += len(controls)
        pipe.send(done / (time.perf_counter() - begin))
    backend.close()
