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
    indices: Rows,
    states: FloatArray,
    table: FloatArray,
    shapes: FloatArray,
    first: npt.NDArray[np.int64],
    reach: npt.NDArray[np.int64],
    angles: FloatArray,
    gearboxes: Rows,
    controls: FloatArray,
    ticks: Rows,
    cars: FloatArray,
    lost: npt.NDArray[np.bool_],
) -> None:
    """
    Drive worlds that are on one track.

    :param rows: of the worlds, in the arrays that have a row for each world of a step
    :param indices: (n,) which world each row is of
    :param states: (worlds, STATE_SIZE) of the physics, changed
    :param table: ``Track.table``
    :param shapes: of the road's edges, as :class:`~sb3_torcs.backends.lite.rays.Edges` has them
    :param first: of the edges
    :param reach: of the edges
    :param angles: (worlds, 19) of the range finders [rad]
    :param gearboxes: (worlds,) ``AUTOMATIC`` or ``BY_ROAD_SPEED``
    :param controls: (n, 5)
    :param ticks: (n,) control ticks
    :param cars: (n, 111) filled
    :param lost: (n,) filled: whether the physics has given NaN
    """
    for row in rows:
        index = indices[row]
        state, car = states[index], cars[row]
        steering, throttle, brake, gear, clutch = controls[row]
        wanted = gearboxes[index] if math.isnan(gear) else int(gear)
        asked = (steering, throttle, brake, wanted, clutch)
        physics.advance(state, table, asked, ticks[row])
        lost[row] = not math.isfinite(state[physics.X] + state[physics.VX])
        physics.read(
            state,
            table,
            shapes,
            first,
            reach,
            angles[index],
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

    :param worlds: none may be in the list twice; this object keeps their cars from now on
    :param threads: that drive, with the calling one among them
    """

    def __init__(self, worlds: Sequence[LiteBackend], threads: int) -> None:
        self._worlds = list(worlds)
        self._states = np.zeros((len(self._worlds), physics.STATE_SIZE))
        self._rows = list(self._states)
        for world, row in zip(self._worlds, self._rows, strict=True):
            world.keep_state_in(row)
        self._angles = np.stack([world.range_finder_angles for world in self._worlds])
        self._gearboxes = np.zeros(len(self._worlds), np.int64)
        self._threads = threads
        self._others = ThreadPoolExecutor(max(threads - 1, 1))  # threads begin at need
        self._owner = os.getpid()

    def put(self, index: int, world: LiteBackend) -> None:
        """Give an environment a world; see :class:`~sb3_torcs.backends.base.Fleet`."""
        before, row = self._worlds[index], self._rows[index]
        if before is not world:
            if before.keeps_state_in(row):  # not in that of another environment, which took it over
                before.keep_state_in(np.empty_like(row))
            self._worlds[index] = world
        if not world.keeps_state_in(row):
            world.keep_state_in(row)

    def step(self, indices: Rows, controls: FloatArray, ticks: Rows, cars: FloatArray) -> list[int]:
        """Drive some of them; see :class:`~sb3_torcs.backends.base.Fleet`."""
        if os.getpid() != self._owner:
            raise EngineForked(
                "these threads belong to the parent process; make the environment after the fork"
            )
        lost = np.zeros(len(indices), np.bool_)

        def drive(rows: Rows, road: Road) -> None:
            table, edges = road
            _drive(
                rows, indices, self._states, table, *edges, self._angles, self._gearboxes, controls,
                ticks, cars, lost,
            )  # fmt: skip

        jobs = iter(list(self._jobs(indices)))

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

    def _jobs(self, indices: Rows) -> Iterator[tuple[Rows, Road]]:
        """Return the rows of each track, split so that all threads have work."""
        tracks: dict[int, list[int]] = {}
        for row, index in enumerate(indices.tolist()):
            world = self._worlds[index]
            self._gearboxes[index] = world.gearbox
            tracks.setdefault(id(world.road[0]), []).append(row)
        for rows in tracks.values():
            road = self._worlds[indices[rows[0]]].road
            parts = math.ceil(self._threads * len(rows) / len(indices))
            yield from ((part, road) for part in np.array_split(rows, parts) if len(part))

    def failure(self, index: int) -> Exception:
        """Return what stopped a world; see :class:`~sb3_torcs.backends.base.Fleet`."""
        return self._worlds[index].lost()

    def arrive(self, index: int, steps: Iterable[tuple[Controls, int]], car: CarState) -> None:
        """Do nothing: the worlds share the cars. See :class:`~sb3_torcs.backends.base.Fleet`."""

    def close(self) -> None:
        """End the threads; see :class:`~sb3_torcs.backends.base.Fleet`."""
        self._others.shutdown()
