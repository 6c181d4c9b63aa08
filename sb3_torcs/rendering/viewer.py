"""The picture of a race: the road from above, the car, its beams and its instruments.

Loaded by the first ``render()``; it brings highway-env and pygame with it. A frame depends only
on the state: the same state gives the same bytes.

The car is highway-env's (``VehicleGraphics`` on a ``WorldSurface``). The road is not: its
``LaneGraphics`` draws unbroken lines as one chord per lane (across the bend) or as pieces that
leave gaps where lanes are short, has one width per lane, and knows no grounds beside the road. So
the ground is made of polygons here, from :class:`Scenery`.
"""

from __future__ import annotations

import copy
import logging
import math
import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_torcs.car import STEER_LOCK, CarState, Controls, FloatArray
from sb3_torcs.errors import EnvClosed, InvalidOption
from sb3_torcs.rendering.board import Board, Field
from sb3_torcs.rendering.highway import (
    RaceCar,
    Road,
    VehicleGraphics,
    WorldSurface,
    pygame,
    road_network,
    to_highway,
    unchanged_environment,
)
from sb3_torcs.rendering.hud import Dashboard
from sb3_torcs.rendering.scenery import GRASS_FAR, WALL, WHITE, Colour, Scenery
from sb3_torcs.tracks.track import Track

__all__ = ["Viewer"]

Frame = npt.NDArray[np.uint8]

logger = logging.getLogger(__name__)

SUPERSAMPLING = 2  # pixels drawn per pixel shown and axis: smooth edges without a GPU
CAR_HEIGHT = 0.70  # [-] where the car is on the picture: share of the height from the top
VIEW_STANDING = 42.0  # [m] seen ahead of a standing car
VIEW_PER_SPEED = 0.5  # [s] and so much more per m/s
LOOK_BACK, LOOK_AHEAD = 6.0, 16.0  # [m] of the axis whose chord points up on the picture
LINE_WIDTH, WALL_WIDTH = 0.3, 0.4  # [m]
BEAM = (255, 236, 120, 70)
BEAM_WIDTH = 0.14  # [m]
BEAM_END = (255, 214, 64)
RANGE = 199.5  # [m] a beam as long as this met nothing
TYRE = (28, 28, 30)
AXLES, TYRES, TYRE_SIZE = (1.25, -1.40), (0.92, -0.92), (0.66, 0.34)  # [m]
BODY_SHIFT = 1.5  # [px]
SMALLEST_DASHBOARD = 240  # [px] smaller pictures show the road only: figures would be illegible


class Camera(NamedTuple):
    """The view of the picture, in highway-env's frame."""

    position: FloatArray  # (2,) [m] what is seen at the car's place on the picture
    heading: float  # [rad] what points up
    scaling: float  # [px/m]


class TurnedSurface(WorldSurface):
    """A surface of highway-env on which the road ahead points up."""

    def __init__(self, size: tuple[int, int]) -> None:
        super().__init__(size, 0, pygame.Surface(size, 0, 32))
        self.anchor = np.array([0.5 * size[0], CAR_HEIGHT * size[1]])  # [px]
        self.look(Camera(np.zeros(2), 0.0, 1.0))

    def look(self, camera: Camera) -> None:
        """Move, turn and zoom."""
        self.origin, self.scaling = camera.position, camera.scaling
        cos, sin = math.cos(camera.heading), math.sin(camera.heading)
        # Rows: a metre along each axis of the world; columns: pixels to the right and down.
        self._matrix = camera.scaling * np.array([[-sin, -cos], [cos, -sin]])
        self.up = camera.heading

    def project(self, points: FloatArray) -> FloatArray:
        """
        Turn points of the world into pixels.

        :param points: (..., 2) [m]
        :return: (..., 2) [px]
        """
        return (points - self.origin) @ self._matrix + self.anchor

    def pos2pix(self, x: float, y: float) -> tuple[int, int]:
        """Turn a point of the world [m] into a pixel: what highway-env's graphics ask for."""
        px, py = self.project(np.array([x, y]))
        return round(px), round(py)


def _camera(track: Track, car: CarState, pixels_ahead: float) -> Camera:
    """
    Follow the car along the road. The road's chord, unlike the car, does not jerk.

    :param track: what the car drives on
    :param car: its state
    :param pixels_ahead: between the car and the picture's upper edge [px]
    """
    behind = track.pose(car.distance_from_start - LOOK_BACK)
    ahead = track.pose(car.distance_from_start + LOOK_AHEAD)
    up = math.atan2(ahead.y - behind.y, ahead.x - behind.x)
    seen = VIEW_STANDING + VIEW_PER_SPEED * math.hypot(car.speed_x, car.speed_y)
    return Camera(to_highway(car.x, car.y), -up, pixels_ahead / seen)


class _Stage(NamedTuple):
    """The prepared drawing of a track, kept while the track stays the same."""

    track: Track
    scenery: Scenery
    road: Road
    dashboard: Dashboard | None
    board: Board | None


class Viewer:
    """
    Draws frames. Any number may live in a process, but only one may have a window.

    :param size: width and height [px]
    :param mode: ``"rgb_array"``, which needs no display, or ``"human"``, which opens a window
    :param fps: frames per second at which the window shows them; ``"rgb_array"`` never waits
    :raises InvalidOption: if the process has a window already, or SDL cannot open one
    """

    def __init__(
        self, *, size: tuple[int, int] = (640, 640), mode: str = "rgb_array", fps: float = 10
    ) -> None:
        if mode not in ("rgb_array", "human"):
            raise InvalidOption(f"mode is {mode!r}; expected 'rgb_array' or 'human'")
        if len(size) != 2 or min(size) < 16:
            raise InvalidOption(f"size is {size}; expected width and height of at least 16 pixels")
        self._size = size
        self._fps = fps
        self._closed = False
        self._world = TurnedSurface((SUPERSAMPLING * size[0], SUPERSAMPLING * size[1]))
        self._picture = pygame.Surface(size, 0, 32)
        self._stage: _Stage | None = None
        self._window: Any = _open_window(size) if mode == "human" else None
        self._clock = pygame.time.Clock()

    def frame(
        self,
        track: Track,
        car: CarState,
        controls: Controls,
        range_finder_angles: FloatArray | None,
        field: Field | None = None,
    ) -> Frame:
        """
        Draw one frame, and show it if there is a window.

        :param track: what the car drives on
        :param car: its state
        :param controls: what it was told
        :param range_finder_angles: (19,) of the beams against the car's axis, left negative [rad];
            ``None`` draws no beams
        :param field: the other cars of its race, and the board
        :return: (height, width, 3)
        :raises EnvClosed: after ``close``, or when the window has been closed
        """
        if self._closed:
            raise EnvClosed("the viewer is closed; make a new environment with gym.make")
        stage = self._set_stage(track, car)
        others = () if field is None else field.others
        self._draw_world(stage, car, controls, range_finder_angles, others)
        pygame.transform.smoothscale(self._world, self._size, self._picture)
        if stage.dashboard is not None:
            stage.dashboard.draw(self._picture, car, controls, others)
        if stage.board is not None and field is not None:
            stage.board.draw(self._picture, field)
        if self._window is not None:
            self._show()
        pixels = np.frombuffer(pygame.image.tobytes(self._picture, "RGB"), np.uint8)
        return pixels.reshape(self._size[1], self._size[0], 3).copy()

    def close(self) -> None:
        """Close the window. A second call does nothing."""
        if self._window is not None:
            pygame.display.quit()
            self._window = None
        self._closed = True

    def _set_stage(self, track: Track, car: CarState) -> _Stage:
        """Lay out a track that was not drawn in the frame before."""
        if self._stage is None or self._stage.track is not track:
            road = Road(road_network(track))
            road.vehicles.append(RaceCar(road, track, car))
            dashboard = board = None
            if min(self._size) >= SMALLEST_DASHBOARD:
                dashboard, board = Dashboard(self._size, track), Board(self._size)
            self._stage = _Stage(track, Scenery(track), road, dashboard, board)
        return self._stage

    def _draw_world(
        self,
        stage: _Stage,
        car: CarState,
        controls: Controls,
        angles: FloatArray | None,
        others: Sequence[tuple[CarState, Colour]],
    ) -> None:
        """Draw all that lies in the track's plane, far to near."""
        world = self._world
        world.look(_camera(stage.track, car, float(world.anchor[1])))
        world.fill(GRASS_FAR)
        _draw_ground(world, stage.scenery)
        if angles is not None:
            _draw_beams(world, car, angles)
        vehicle = stage.road.vehicles[0]
        for other, colour in others:
            vehicle.color = colour
            _draw_car(world, vehicle, other, 0.0)
        vehicle.color = RaceCar.color
        _draw_car(world, vehicle, car, controls.steering)

    def _show(self) -> None:
        """Show the picture in the window, and wait until the next is due."""
        for event in pygame.event.get():
            if event.type == pygame.QUIT:
                self.close()
                raise EnvClosed("the window was closed; make a new environment with gym.make")
        self._window.blit(self._picture, (0, 0))
        pygame.display.flip()
        self._clock.tick(self._fps)


def _open_window(size: tuple[int, int]) -> Any:
    """
    Open the process' window.

    :param size: width and height [px]
    :raises InvalidOption: if there is a window already, or SDL cannot open one
    """
    remedy = 'use render_mode="rgb_array", or write a video: `sb3-torcs evaluate --video`'
    if pygame.display.get_init() and pygame.display.get_surface() is not None:
        raise InvalidOption(
            f'render_mode is "human", but this process has a window already; {remedy}'
        )
    try:
        pygame.display.init()
        # Without a display SDL draws nowhere, and does not report it.
        if pygame.display.get_driver() == "offscreen" and "SDL_VIDEODRIVER" not in os.environ:
            logger.warning(
                "no display was found, so nobody will see this window; are DISPLAY or "
                "WAYLAND_DISPLAY set? Else %s",
                remedy,
            )
        with unchanged_environment():
            # Acceleration loads LLVM, beside which PyTorch cannot load its own: a segmentation
            # fault, as soon as a model is built.
            os.environ.setdefault("SDL_FRAMEBUFFER_ACCELERATION", "0")
            window = pygame.display.set_mode(size)
    except pygame.error as error:
        pygame.display.quit()
        raise InvalidOption(f'render_mode is "human", but {error}; {remedy}') from None
    pygame.display.set_caption("TORCS")
    return window


def _draw_ground(world: TurnedSurface, scenery: Scenery) -> None:
    """Draw grounds beside the road, then all road, then lines: a hairpin's legs are neighbours."""
    reach = math.hypot(*world.get_size()) * CAR_HEIGHT / world.scaling
    chunks, bands = scenery.near(world.origin, reach)
    strips = [(chunk, world.project(chunk.points)) for chunk in chunks]
    polygon, lines = pygame.draw.polygon, pygame.draw.lines
    for chunk, points in strips + [(band, world.project(band.points)) for band in bands]:
        polygon(world, chunk.left, _outline(points, 0, 1))
        polygon(world, chunk.right, _outline(points, 2, 3))
    for chunk, points in strips:
        polygon(world, chunk.road, _outline(points, 1, 2))
    if scenery.sees_start(world.origin, reach):
        for colour, square in scenery.start_line:
            polygon(world, colour, world.project(square).tolist())
    for colour, columns, width in ((WALL, (0, 3), WALL_WIDTH), (WHITE, (1, 2), LINE_WIDTH)):
        pixels = max(round(width * world.scaling), 2)
        for _, points in strips:
            for column in columns:
                lines(world, colour, False, points[:, column].tolist(), pixels)


def _outline(points: FloatArray, left: int, right: int) -> list[list[float]]:
    """
    Go round a strip between two of a chunk's lines.

    :param points: (n, 4, 2) [px]
    :param left: column of one line
    :param right: column of the other
    """
    outline: list[list[float]] = points[:, left].tolist() + points[::-1, right].tolist()
    return outline


def _draw_beams(world: TurnedSurface, car: CarState, angles: FloatArray) -> None:
    """Draw the range finders; off the road they see nothing (-1) and are not drawn."""
    if car.range_finders.min() < 0.0:
        return
    directions = -(car.yaw - angles)  # in highway-env's frame
    along = np.stack([np.cos(directions), np.sin(directions)], axis=1)
    across = 0.5 * BEAM_WIDTH * np.stack([-along[:, 1], along[:, 0]], axis=1)
    eye = to_highway(car.x, car.y)
    ends = eye + car.range_finders[:, None] * along
    corners = np.stack([eye + across, ends + across, ends - across, eye - across], axis=1)
    for corner in world.project(corners).tolist():
        pygame.gfxdraw.filled_polygon(world, corner, BEAM)
    radius = max(0.45 * world.scaling, 3.0)
    for (x, y), distance in zip(world.project(ends).tolist(), car.range_finders, strict=True):
        if distance < RANGE:
            pygame.draw.circle(world, BEAM_END, (x, y), radius)


def _draw_car(world: TurnedSurface, vehicle: RaceCar, car: CarState, steering: float) -> None:
    """Draw a car where its state says, with its front wheels steered [-1, 1]."""
    vehicle.pose(car)
    _draw_tyres(world, vehicle, steering)
    # highway-env draws the heading as it is in the world; on a turned view it is relative.
    turned = copy.copy(vehicle)
    turned.heading = vehicle.heading - world.up - 0.5 * math.pi
    # It also rounds all sizes down, which moves the body to its left by a pixel or two.
    right = np.array([-math.sin(vehicle.heading), math.cos(vehicle.heading)])
    turned.position = vehicle.position + BODY_SHIFT / world.scaling * right
    VehicleGraphics.display(turned, world, offscreen=True, draw_roof=True)


def _draw_tyres(world: TurnedSurface, vehicle: RaceCar, steering: float) -> None:
    """Draw the wheels; highway-env draws those of its own vehicle classes only."""
    half_length, half_width = 0.5 * TYRE_SIZE[0], 0.5 * TYRE_SIZE[1]
    box = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * (half_length, half_width)
    for axle, steered in zip(AXLES, (-steering * STEER_LOCK, 0.0), strict=True):
        for side in TYRES:
            corners = box @ _turn(steered) + (axle, side)
            corners = corners @ _turn(vehicle.heading) + vehicle.position
            pygame.draw.polygon(world, TYRE, world.project(corners).tolist())


def _turn(angle: float) -> FloatArray:
    """Matrix that turns row vectors by an angle [rad]."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, sin], [-sin, cos]])
