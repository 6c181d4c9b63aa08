"""The compiled engine, as type checkers see it; use it through sb3_torcs.backends.native."""

from collections.abc import Sequence
from typing import TypedDict

import numpy as np
import numpy.typing as npt

from sb3_torcs.car import CarState, FloatArray

class TrackSummary(TypedDict):
    name: str  # as its file calls it
    length: float  # [m] along the axis
    width: float  # [m] of the road
    segments: int
    x: float  # [m] middle of the start line, in the game's frame
    y: float  # [m]
    heading: float  # [rad] of the road there

class Moment:
    @property
    def size(self) -> int: ...  # [bytes]

class Engine:
    def __init__(
        self,
        *,
        data: bytes,
        libraries: bytes,
        plib: bytes,
        track: bytes,
        session: str,
        entries: Sequence[tuple[str, int]],
        cars: Sequence[str],  # of the agents, by their index
        laps: int,
        angles: Sequence[Sequence[float]],  # (agents or 1, 19) [rad]
        road_speed: Sequence[bool] = (),  # of the agents: whether the gearbox goes by it
        flagged: bool = False,  # whether agents are flagged off
    ) -> None: ...
    @property
    def agents(self) -> list[int]: ...  # their cars, by their index
    @property
    def ended(self) -> bool: ...
    def start(self) -> None: ...
    def start_at(self, distance: float, position: float, error: float, speed: float) -> None: ...
    def step(
        self,
        steering: float,
        throttle: float,
        brake: float,
        gear: int | None,
        ticks: int,
        clutch: float = 0.0,
    ) -> CarState: ...
    def hold(
        self,
        car: int,
        steering: float,
        throttle: float,
        brake: float,
        gear: int | None,
        clutch: float = 0.0,
    ) -> None: ...
    def drive(self, ticks: int) -> None: ...
    def advance(self, ticks: int) -> None: ...
    def retire(self, car: int) -> None: ...
    def rejoin(self, car: int, position: float, error: float, speed: float) -> None: ...
    def finished(self, car: int) -> bool: ...  # whether it was flagged off
    def lost(self, car: int) -> bool: ...  # whether it was taken out for a division by zero
    def read(self, car: int) -> CarState: ...
    def set_noise(self, seed: int | None) -> None: ...
    def mute_noise(self, muted: bool) -> bool: ...  # what was set before
    def set_conditions(self, grip: float, mass: float) -> None: ...
    def set_origin(self, x: float, y: float) -> None: ...
    def save(self) -> Moment: ...
    def restore(self, moment: Moment) -> None: ...
    def focus(self, car: int, direction: float) -> FloatArray: ...  # (5,) [m]
    def appearance(self) -> bytes: ...  # for the game's window to draw it
    def close(self) -> None: ...
    def controls(self, car: int) -> tuple[float, float, float, int, float]: ...
    def car_name(self, car: int) -> str: ...
    def gears(self, car: int) -> int: ...  # forward ones
    def laps(self, car: int) -> list[tuple[float, int]]: ...  # time [s], damage
    def results(self) -> list[tuple[int, int, float, float, int, bool]]: ...
    def track_summary(self) -> TrackSummary: ...
    def road(self) -> FloatArray: ...  # (n_segments, 17), see native/road.h
    def replay(self, controls: FloatArray, sensors: bool) -> None: ...
    def update_physics(self, steps: int) -> None: ...

class Fleet:
    def __init__(self, engines: Sequence[Engine], threads: int) -> None: ...
    def put(self, race: int, engine: Engine) -> None: ...
    def step(
        self,
        races: npt.NDArray[np.int64],  # (n,); rows of one follow each other
        seats: npt.NDArray[np.int64],  # (n,) which car
        controls: FloatArray,  # (n, 5) as of Controls; a gear of nan is the gearbox's choice
        ticks: npt.NDArray[np.int64],  # (n,)
        cars: FloatArray,  # (n, 111) filled, as of CarState
    ) -> list[int]: ...  # the rows that were not, of races that failed
    def check(self, race: int) -> None: ...  # raises what stopped it in the latest step

class Rollouts:
    def __init__(self, engines: Sequence[Engine]) -> None: ...
    def mark(self) -> None: ...
    def drive(self, path: FloatArray, ticks: int) -> None: ...  # (n, 7), see native/rollouts.h
    def go_back(self, drives: int) -> None: ...
    def follow(
        self,
        line: FloatArray,  # (n, 7)
        gains: tuple[float, float, float],
        offsets: FloatArray,  # (candidates, steps, 3)
        ticks: int,
    ) -> tuple[FloatArray, npt.NDArray[np.int64]]: ...  # (candidates, steps + 1, 7), (candidates,)

def scr_format_state(  # 79 numbers, SI, in the protocol's order
    numbers: Sequence[float], exact: bool = False
) -> bytes: ...
def scr_parse_action(
    text: bytes,
) -> tuple[float, float, int, float, float, bool, float | None, float | None]: ...
def scr_parse_init(
    text: bytes,
) -> tuple[list[float], tuple[float, float, float, float] | None, bool, str]: ...
def wrong_functions() -> list[str]: ...  # of our mathematics, on this machine
def maths_checksum(function: str, step: int, added: bool = False) -> int: ...
