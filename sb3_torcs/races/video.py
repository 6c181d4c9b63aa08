"""A video of a race: all cars, from above or as the game draws them, and a board of the gaps."""

from __future__ import annotations

import colorsys
import contextlib
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_torcs.agents.drivers import NamedDriver
from sb3_torcs.car import CONTROL_TICK, CarState, Controls, FloatArray
from sb3_torcs.envs.ends import GRACE_TICKS, end_of, stands
from sb3_torcs.errors import InvalidOption
from sb3_torcs.races.protocol import behind_the_line
from sb3_torcs.telemetry import STATE_FIELDS
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.race_setup import SCR_DRIVERS, SCR_SERVER, RaceSetup, session_for
from sb3_torcs.torcs.window import ViewName, Window
from sb3_torcs.tracks.track import Track

if TYPE_CHECKING:
    from sb3_torcs._engine import Engine
    from sb3_torcs.rendering.board import Field
    from sb3_torcs.rendering.scenery import Colour

__all__ = ["FPS", "GAME_SIZE", "Footage", "gaps", "race_setup", "save_beside"]

Frame = npt.NDArray[np.uint8]

SIZE, GAME_SIZE = (960, 720), (1280, 720)  # [px] of pictures from above, and of the game's
FPS = 25
AFTERMATH = 2.0  # [s] that are shown after an agent's drive has ended
LAST_PICTURE = 3 * FPS  # frames for which the final board is shown

FIELDS = len(STATE_FIELDS)
NOTHING_SENSED = {
    "wheel_speeds": np.zeros(4), "range_finders": np.zeros(19), "opponents": np.zeros(36),
}  # fmt: skip
HUE_STEP = 0.62  # of all hues, from one car to the next: so neighbours differ most
RED_MARGIN = 0.08  # of all hues, on both sides of red, which is for the car that is followed


def race_setup(order: Sequence[NamedDriver], track: str, laps: int) -> RaceSetup:
    """
    Describe a race to the game, whose SCR server has a seat for each agent.

    :param order: the drivers, the one in front first
    :param track: as of ``Torcs-v0``
    :param laps: to drive
    :raises InvalidOption: if there are more agents than the game has seats
    """
    seats = itertools.count()
    drivers = [driver.robot or (SCR_SERVER, next(seats)) for driver in order]
    cars = [driver.car for driver in order if driver.robot is None]
    if len(cars) > SCR_DRIVERS:
        raise InvalidOption(
            f"{len(cars)} agents in a race that the game draws, which has {SCR_DRIVERS} seats for "
            "them; name fewer, or leave out --view"
        )
    return RaceSetup(track, drivers, laps, session_for(drivers), cars)


class Moment(NamedTuple):
    """A race at one moment. A row is a car, by grid slot."""

    states: FloatArray  # (cars, FIELDS) as of CarState
    controls: FloatArray  # (cars, 5) as of Controls
    finished: npt.NDArray[np.bool_]  # (cars,)
    out: npt.NDArray[np.bool_]  # (cars,)
    appearance: bytes = b""  # for the game's own picture


class Footage:
    """
    What a camera recorded of a race; a :class:`~sb3_torcs.races.protocol.Watcher`.

    :param setup: the race as the game would hold it, which then draws it; ``None`` draws it from
        above
    :param view: one of :data:`sb3_torcs.torcs.window.VIEWS`, for the game's picture
    :param size: width and height of the game's picture [px]; ``None`` is 1280x720
    :param agent: name of the driver whose end ends the race: two seconds after it has left the
        road, or stands; ``None`` ends it by the rules
    """

    def __init__(
        self,
        setup: RaceSetup | None = None,
        view: ViewName = "behind",
        size: tuple[int, int] | None = None,
        agent: str | None = None,
    ) -> None:
        self.setup, self.view, self._agent = setup, view, agent
        self.size = size or GAME_SIZE
        self.moments: list[Moment] = []
        self._moving = 0.0  # [s] when the agent last drove along the road
        self._ended: float | None = None  # [s] when its episode would have ended

    def begin(self, engine: Engine, names: Sequence[str], road: Track) -> None:
        """See ``Watcher``."""
        self._engine, self.names, self.road = engine, list(names), road
        self.behind = behind_the_line(engine, road, len(names))
        self._record()

    def look(self) -> bool:
        """See ``Watcher``. Control ticks differ in length, so pictures go by the race's clock."""
        if self._engine.read(0).time >= len(self.moments) / FPS:
            self._record()
        if self._agent is None:
            return True
        car = self._engine.read(self.names.index(self._agent))
        if not stands(car):
            self._moving = car.time
        stuck = car.time - self._moving > GRACE_TICKS * CONTROL_TICK
        if self._ended is None and (stuck or end_of(car, math.inf, 0.0, 0.0)):
            self._ended = car.time
        return self._ended is None or car.time < self._ended + AFTERMATH

    def _record(self) -> None:
        engine, slots = self._engine, range(len(self.names))
        out = np.zeros(len(self.names), bool)
        for slot, *_, is_out in engine.results():
            out[slot] = is_out
        self.moments.append(
            Moment(
                np.array([engine.read(slot)[:FIELDS] for slot in slots]),
                np.array([engine.controls(slot) for slot in slots], float),
                np.array([engine.finished(slot) for slot in slots]),
                out,
                b"" if self.setup is None else engine.appearance(),
            )
        )

    def save(self, path: Path, driver: str, laps: int) -> None:
        """
        Draw the video.

        :param path: of the video, ending in ``.mp4``
        :param driver: whom the camera follows
        :param laps: of the race
        :raises DisplayUnavailable: if there is no virtual display, which the game needs
        :raises OutputNotWritable: if the file cannot be written; no part of it is left behind
        """
        from sb3_torcs.rendering.encoder import ENCODING, PHOTOGRAPHIC, write_video

        encoding = ENCODING if self.setup is None else PHOTOGRAPHIC
        total = len(self.moments) + LAST_PICTURE
        write_video(path, self.pictures(driver, laps), FPS, total, encoding)

    def pictures(self, driver: str, laps: int) -> Iterator[Frame]:
        """
        Draw the pictures of the video.

        :param driver: whom the camera follows
        :param laps: of the race
        """
        followed = self.names.index(driver)
        if self.setup is None:
            yield from self._from_above(followed, laps)
        else:
            yield from self._of_the_game(followed, laps, self.setup)

    def _from_above(self, followed: int, laps: int) -> Iterator[Frame]:
        from sb3_torcs.rendering.viewer import Viewer

        with contextlib.closing(Viewer(size=SIZE)) as viewer:

            def draw(moment: Moment, car: CarState, field: Field) -> Frame:
                controls = Controls(*moment.controls[followed])
                return viewer.frame(self.road, car, controls, None, field)

            yield from self._frames(followed, laps, draw)

    def _of_the_game(self, followed: int, laps: int, race: RaceSetup) -> Iterator[Frame]:
        from sb3_torcs.rendering.board import Board
        from sb3_torcs.rendering.game_camera import GameView

        game, alone = find_game(), len(self.names) == 1
        name = race.driver_name(followed, game)
        window = Window(self.size, self.view, driver=name, boards=alone)
        board = Board(self.size)
        with GameView(game, race, window) as camera:

            def draw(moment: Moment, car: CarState, field: Field) -> Frame:
                del car
                picture = camera.frame(moment.appearance)
                return picture if alone else board.over(picture, field)

            yield from self._frames(followed, laps, draw)

    def _frames(
        self, followed: int, laps: int, draw: Callable[[Moment, CarState, Field], Frame]
    ) -> Iterator[Frame]:
        """Draw all moments; the last one stays for a while."""
        from sb3_torcs.rendering.board import Field, Row

        colours = _colours(len(self.names), followed)
        for moment, texts in zip(self.moments, gaps(self, laps), strict=True):
            cars = [_car(row) for row in moment.states]
            others = [
                (car, colours[slot])
                for slot, car in enumerate(cars)
                if slot != followed and not moment.out[slot]
            ]
            order = sorted(range(len(cars)), key=lambda slot: cars[slot].race_position)
            rows = [
                Row(str(place), self.names[slot], texts[slot], colours[slot], slot == followed)
                for place, slot in enumerate(order, start=1)
            ]
            lap = min(cars[order[0]].laps + 1, laps)
            picture = draw(moment, cars[followed], Field(others, f"LAP {lap} of {laps}", rows))
            yield picture
        for _ in range(LAST_PICTURE):
            yield picture


def save_beside(footages: Sequence[Footage], drivers: Sequence[str], path: Path, laps: int) -> None:
    """
    Draw two races side by side, and by how much the second driver is behind the first.

    :param footages: of the races, from left to right
    :param drivers: whom the cameras follow
    :param path: of the video, ending in ``.mp4``
    :param laps: of both races
    :raises OutputNotWritable: if the file cannot be written; no part of it is left behind
    """
    from sb3_torcs.rendering.encoder import PHOTOGRAPHIC, write_video
    from sb3_torcs.rendering.gap import Passing, draw_gap, side_by_side, time_behind

    passings = [Passing() for _ in footages]

    def noted(footage: Footage, driver: str, passing: Passing) -> Iterator[Frame]:
        slot, goal = footage.names.index(driver), laps * footage.road.length
        for number, picture in enumerate(footage.pictures(driver, laps)):
            if number < len(footage.moments):
                car = _car(footage.moments[number].states[slot])
                way = car.distance_raced - footage.behind[slot]
                passing.note(car.time, min(max(way / goal, 0.0), 1.0))
            yield picture

    def joint() -> Iterator[Frame]:
        shown = zip(footages, drivers, passings, strict=True)
        for picture in side_by_side(*(noted(*each) for each in shown)):
            behind = time_behind(*passings)
            yield picture if behind is None else draw_gap(picture, drivers[1], behind)

    total = max(len(footage.moments) for footage in footages) + LAST_PICTURE
    write_video(path, joint(), FPS, total, PHOTOGRAPHIC)


def gaps(footage: Footage, laps: int) -> list[list[str]]:
    """
    Say at each moment how far each car is behind the leader, as boards do.

    A gap is the time since the leader was where the car is now, so it grows while the car stands.
    It is final when the car has finished.

    :param footage: of the race
    :param laps: of the race
    :return: by moment and grid slot
    """
    times, raced = (
        np.stack([moment.states[:, STATE_FIELDS.index(name)] for moment in footage.moments], axis=1)
        for name in ("time", "distance_raced")
    )
    ways = np.maximum.accumulate(raced - footage.behind[:, None], axis=1)
    drives = _Drives(times[0], ways, footage.road.length, laps)
    slots = range(len(footage.names))
    return [
        [_gap(slot, moment, number, drives) for slot in slots]
        for number, moment in enumerate(footage.moments)
    ]


class _Drives(NamedTuple):
    """Where all cars were at all moments."""

    times: FloatArray  # (moments,) [s]
    ways: FloatArray  # (cars, moments) [m] from the start line on; never back
    lap: float  # [m]
    laps: int  # of the race

    def when(self, slot: int, way: float) -> float:
        """Return when [s] a car first had gone so far [m]; its first moment is as early as any."""
        ways = self.ways[slot]
        after = int(np.searchsorted(ways, way))
        around = slice(max(after - 1, 0), after + 1)
        return float(np.interp(way, ways[around], self.times[around]))


def _gap(slot: int, moment: Moment, number: int, drives: _Drives) -> str:
    """
    Say how far a car is behind the leader.

    :param slot: of the car
    :param moment: at which this is asked
    :param number: of the moment
    :param drives: of all cars
    """
    leader = int(moment.states[:, STATE_FIELDS.index("race_position")].argmin())
    way, first = np.minimum(drives.ways[[slot, leader], number], drives.laps * drives.lap)
    if moment.out[slot]:
        return "out"
    if slot == leader or way < 0.0:
        return ""
    behind = (first - way) / drives.lap
    if moment.finished[slot]:
        driven = moment.states[:, STATE_FIELDS.index("laps")]
        behind = driven[leader] - driven[slot]
    if behind >= 1.0:
        return "+1 LAP" if behind < 2.0 else f"+{int(behind)} LAPS"
    now = drives.when(slot, way) if moment.finished[slot] else drives.times[number]
    return f"+{now - drives.when(leader, way):.2f}"


def _colours(cars: int, followed: int) -> list[Colour]:
    """Choose a colour for each car by its slot; red is for the one that is followed."""
    from sb3_torcs.rendering.highway import RaceCar

    hues = RED_MARGIN + (1.0 - 2.0 * RED_MARGIN) * (np.arange(cars) * HUE_STEP % 1.0)
    drawn = [colorsys.hsv_to_rgb(hue, 0.65, 0.95) for hue in hues]
    colours: list[Colour] = [(round(255 * r), round(255 * g), round(255 * b)) for r, g, b in drawn]
    colours[followed] = RaceCar.color
    return colours


def _car(numbers: FloatArray) -> CarState:
    """Make a car of what was recorded; its arrays of sensors are blank."""
    values = dict(zip(STATE_FIELDS, numbers.tolist(), strict=True))
    whole = {name: int(values[name]) for name in ("gear", "laps", "race_position")}
    return CarState(**{**NOTHING_SENSED, **values, **whole})
