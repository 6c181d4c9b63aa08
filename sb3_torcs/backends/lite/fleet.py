"""Several fallback worlds that are driven at once: one call of compiled code per track."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait

import numpy as np
import numpy.typing as npt
from numba import njit

from sb3_torcs.backends.lite import physics
from sb3_torcs.backends.lite.backend import LiteBackend
from sb3_torcs.backends.lite.rays import RANGE, Edges
from sb3_torcs.car import NO_RACE, CarState, Controls, FloatArray
from sb3_torcs.errors import EngineForked

__all__ = ["LiteFleet"]

Rows = npt.NDArray[np.int64]
Road = tuple[FloatArray, Edges]

WHEELS = physics.SCALARS + 1  # first column of the wheels, after the place in the race
BEAMS = WHEELS + 4
OPPONENTS = BEAMS + 19
RACE = OPPONENTS + 36


@njit(cache=True, nogil=True)
def _drive(
    rows: Rows,
    worlds: Rows,
    states: FloatArray,
    table: FloatArray,
    shapes: FloatArray,
    first: npt.NDArray[np.int64],
    reach: npt.NDArray[np.int64],
    angles: FloatArray,
    gearboxes: Rows,
    flying: npt.NDArray[np.bool_],
    controls: FloatArray,
    ticks: Rows,
    cars: FloatArray,
    lost: npt.NDArray[np.bool_],
) -> None:
    """
    Drive worlds that are on one track.

    :param rows: of the worlds, in the arrays that have a row for each race of a step
    :param worlds: (n,) which world each race is in
    :param states: (worlds, STATE_SIZE) of the physics, changed
    :param table: ``Track.table``
    :param shapes: of the road's edges, as :class:`~sb3_torcs.backends.lite.rays.Edges` has them
    :param first: of the edges
    :param reach: of the edges
    :param angles: (worlds, 19) of the range finders [rad]
    :param gearboxes: (worlds,) ``AUTOMATIC`` or ``BY_ROAD_SPEED``
    :param flying: (worlds,) whether the episode began elsewhere than on the grid
    :param controls: (n, 5)
    :param ticks: (n,) control ticks
    :param cars: (n, 111) filled
    :param lost: (n,) filled: whether the physics has given NaN
    """
    for row in rows:
        world = worlds[row]
        state, car = states[world], cars[row]
        steering, throttle, brake, gear, clutch = controls[row]
        wanted = gearboxes[world] if math.isnan(gear) else int(gear)
        asked = (steering, throttle, brake, wanted, clutch)
        physics.advance(state, table, asked, ticks[row], flying[world])
        lost[row] = not math.isfinite(state[physics.X] + state[physics.VX])
        physics.read(
            state,
            table,
            shapes,
            first,
            reach,
            angles[world],
            car[: physics.SCALARS],
            car[WHEELS:BEAMS],
            car[BEAMS:OPPONENTS],
        )
        car[physics.SCALARS] = 1.0  # there are no opponents in this world
        car[OPPONENTS:RACE] = RANGE
        car[RACE:] = NO_RACE


class LiteFleet:
    """
    Several worlds that are driven at once, by threads that live as long as this object.

    :param backends: none may be in the list twice; this object keeps their cars from now on
    :param threads: that drive, with the calling one among them
    """

    def __init__(self, backends: Sequence[LiteBackend], threads: int) -> None:
        self._backends = list(backends)
        self._states = np.zeros((len(self._backends), physics.STATE_SIZE))
        for backend, state in zip(self._backends, self._states, strict=True):
            backend.keep_state_in(state)
        self._angles = np.stack([backend.range_finder_angles for backend in self._backends])
        self._gearboxes = np.zeros(len(self._backends), np.int64)
        self._flying = np.zeros(len(self._backends), np.bool_)
        self._threads = threads
        self._others = ThreadPoolExecutor(max(threads - 1, 1))  # threads begin at need
        self._owner = os.getpid()

    def step(self, worlds: Rows, controls: FloatArray, ticks: Rows, cars: FloatArray) -> list[int]:
        """Drive some of them; see :class:`~sb3_torcs.backends.base.Fleet`."""
        if os.getpid() != self._owner:
            raise EngineForked(
                "these threads belong to the parent process; make the environment after the fork"
            )
        lost = np.zeros(len(worlds), np.bool_)

        def drive(rows: Rows, road: Road) -> None:
            table, edges = road
            manners = self._gearboxes, self._flying
            _drive(
                rows, worlds, self._states, table, *edges, self._angles, *manners, controls, ticks,
                cars, lost,
            )  # fmt: skip

        jobs = iter(list(self._jobs(worlds)))

        def work() -> None:
            for rows, road in jobs:  # an iterator that all threads share
                drive(rows, road)

        others = [self._others.submit(work) for _ in range(self._threads - 1)]
        try:
            work()
        finally:
            wait(others)
        for other in others:
            other.result()
        return np.flatnonzero(lost).tolist()

    def _jobs(self, worlds: Rows) -> Iterator[tuple[Rows, Road]]:
        """Return the rows of each track, split so that all threads have work."""
        tracks: dict[int, list[int]] = {}
        for row, world in enumerate(worlds.tolist()):
            backend = self._backends[world]
            self._gearboxes[world], self._flying[world] = backend.manner
            tracks.setdefault(id(backend.road[0]), []).append(row)
        for rows in tracks.values():
            road = self._backends[worlds[rows[0]]].road
            parts = math.ceil(self._threads * len(rows) / len(worlds))
            yield from ((part, road) for part in np.array_split(rows, parts) if len(part))

    def failure(self, world: int) -> Exception:
        """Return what stopped a race; see :class:`~sb3_torcs.backends.base.Fleet`."""
        return self._backends[world].lost()

    def arrive(self, world: int, steps: Iterable[tuple[Controls, int]], car: CarState) -> None:
        """Do nothing: the worlds share the cars. See :class:`~sb3_torcs.backends.base.Fleet`."""

    def close(self) -> None:
        """End the threads; see :class:`~sb3_torcs.backends.base.Fleet`."""
        self._others.shutdown()
