"""A video of a race: all cars, from above or as the game draws them, and a board of the gaps."""

from __future__ import annotations

import colorsys
import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_torcs.car import CarState, Controls, FloatArray
from sb3_torcs.races.protocol import behind_the_line
from sb3_torcs.telemetry import STATE_FIELDS
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.race_setup import RaceSetup
from sb3_torcs.torcs.window import ViewName, Window
from sb3_torcs.tracks.track import Track

if TYPE_CHECKING:
    from sb3_torcs._engine import Engine
    from sb3_torcs.rendering.board import Field
    from sb3_torcs.rendering.scenery import Colour

__all__ = ["GAME_SIZE", "Footage", "gaps"]

Frame = npt.NDArray[np.uint8]

SIZE, GAME_SIZE = (960, 720), (1280, 720)  # [px] of pictures from above, and of the game's
FPS = 25
LAST_PICTURE = 3 * FPS  # frames for which the final board is shown

FIELDS = len(STATE_FIELDS)
NOTHING_SENSED = {
    "wheel_speeds": np.zeros(4), "range_finders": np.zeros(19), "opponents": np.zeros(36),
}  # fmt: skip
HUE_STEP = 0.62  # of all hues, from one car to the next: so neighbours differ most
RED_MARGIN = 0.08  # of all hues, on both sides of red, which is for the car that is followed


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

    :param view: one of :data:`sb3_torcs.torcs.window.VIEWS`, from which the game draws the race;
        ``None`` draws it from above
    """

    def __init__(self, view: ViewName | None = None) -> None:
        self.view = view
        self.setup: RaceSetup | None = None
        """The race as the game would hold it, which it has to know to draw it."""
        self.moments: list[Moment] = []

    def begin(self, engine: Engine, names: Sequence[str], road: Track) -> None:
        """See ``Watcher``."""
        self._engine, self.names, self.road = engine, list(names), road
        self.behind = behind_the_line(engine, road, len(names))
        self._record()

    def look(self) -> None:
        """See ``Watcher``. Control ticks differ in length, so pictures go by the race's clock."""
        if self._engine.read(0).time >= len(self.moments) / FPS:
            self._record()

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
                b"" if self.view is None else engine.appearance(),
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
        followed = self.names.index(driver)
        if self.setup is None or self.view is None:
            self._save_from_above(path, followed, laps)
        else:
            self._save_game_view(path, followed, laps, self.setup, self.view)

    def _save_from_above(self, path: Path, followed: int, laps: int) -> None:
        from sb3_torcs.rendering.encoder import ENCODING
        from sb3_torcs.rendering.viewer import Viewer

        with contextlib.closing(Viewer(size=SIZE)) as viewer:

            def draw(moment: Moment, car: CarState, field: Field) -> Frame:
                controls = Controls(*moment.controls[followed])
                return viewer.frame(self.road, car, controls, None, field)

            self._write(path, followed, laps, draw, ENCODING)

    def _save_game_view(
        self, path: Path, followed: int, laps: int, race: RaceSetup, view: ViewName
    ) -> None:
        from sb3_torcs.rendering.board import Board
        from sb3_torcs.rendering.encoder import PHOTOGRAPHIC
        from sb3_torcs.rendering.game_camera import GameView

        game = find_game()
        window = Window(GAME_SIZE, view, driver=race.driver_name(followed, game), boards=False)
        board = Board(GAME_SIZE)
        with GameView(game, race, window) as camera:

            def draw(moment: Moment, car: CarState, field: Field) -> Frame:
                del car
                return board.over(camera.frame(moment.appearance), field)

            self._write(path, followed, laps, draw, PHOTOGRAPHIC)

    def _write(
        self,
        path: Path,
        followed: int,
        laps: int,
        draw: Callable[[Moment, CarState, Field], Frame],
        encoding: Mapping[str, Any],
    ) -> None:
        from sb3_torcs.rendering.encoder import write_video

        total = len(self.moments) + LAST_PICTURE
        write_video(path, self._frames(followed, laps, draw), FPS, total, encoding)

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
