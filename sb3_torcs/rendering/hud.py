"""The instruments on the picture: speed, gear, revs, pedals, steering, laps and a small map."""

from __future__ import annotations

import math
import string
from collections.abc import Sequence

import numpy as np

from sb3_torcs.actions import SHIFT_UP_RPM
from sb3_torcs.car import KMH, RPM, CarState, Controls, FloatArray
from sb3_torcs.rendering.highway import pygame, to_highway
from sb3_torcs.rendering.scenery import Colour
from sb3_torcs.tracks.track import Track

__all__ = ["MARGIN", "MUTED", "TEXT", "Dashboard", "Typeface", "lap_clock", "panel", "unit_of"]

DESIGN = 640  # [px] the shorter side for which the sizes here are meant
MARGIN = 10
PANEL = (16, 18, 22, 190)
FRAME: Colour = (62, 66, 74)
TEXT: Colour = (244, 244, 240)
MUTED: Colour = (170, 174, 182)
GREEN: Colour = (74, 190, 92)
RED: Colour = (226, 70, 58)
AMBER: Colour = (242, 180, 58)
BLUE: Colour = (92, 164, 236)
CHARACTERS = string.ascii_letters + string.digits + string.punctuation + " "

REVS_SHOWN = 10000.0  # [rpm] at the bar's end
NO_TIME = "-:--.--"  # shown before the first whole lap
GEARS = {-1: "R", 0: "N"}


def lap_clock(seconds: float) -> str:
    """
    Format a lap time to the hundredth, e.g. ``1:23.46``.

    :param seconds: the time [s]
    """
    hundredths = round(100.0 * seconds)
    return f"{hundredths // 6000}:{hundredths // 100 % 60:02d}.{hundredths % 100:02d}"


def unit_of(size: tuple[int, int]) -> float:
    """
    Return how much larger instruments are than their design.

    :param size: width and height of the picture [px]
    """
    return min(size) / DESIGN


class Typeface:
    """
    Letters of one size, rendered once, which is faster.

    They also survive ``pygame.quit()``, which highway-env's own viewer calls when it closes.

    :param size: height [px]
    """

    def __init__(self, size: float) -> None:
        pygame.font.init()
        font = pygame.font.Font(None, max(round(size), 8))
        self.height = font.get_height()
        self._letters = {
            colour: {c: font.render(c, True, colour) for c in CHARACTERS}
            for colour in (TEXT, MUTED, RED)
        }

    def width(self, text: str) -> int:
        """Width of a text [px]."""
        return sum(self._letter(c, TEXT).get_width() for c in text)

    def _letter(self, character: str, colour: Colour) -> pygame.Surface:
        letters = self._letters[colour]
        return letters.get(character, letters["?"])

    def write(
        self,
        target: pygame.Surface,
        text: str,
        place: tuple[float, float],
        colour: Colour = TEXT,
        align: float = 0.0,
    ) -> None:
        """
        Write a line.

        :param target: the picture
        :param text: letters that are not of ``CHARACTERS`` become question marks
        :param place: left and top [px]
        :param colour: of the letters
        :param align: 0 puts the text right of the place, 0.5 on it, 1 left of it
        """
        x = round(place[0] - align * self.width(text))
        for character in text:
            letter = self._letter(character, colour)
            target.blit(letter, (x, round(place[1])))
            x += letter.get_width()


class Dashboard:
    """
    All instruments, for pictures of one size on one track.

    :param size: width and height of the picture [px]
    :param track: what the car drives on
    """

    def __init__(self, size: tuple[int, int], track: Track) -> None:
        self._unit = unit = unit_of(size)
        self._size = size
        self._small, self._normal = Typeface(19 * unit), Typeface(26 * unit)
        self._large, self._huge = Typeface(44 * unit), Typeface(72 * unit)
        self._laps = panel(158 * unit, 112 * unit)
        self._panel = panel(416 * unit, 92 * unit)
        self._warning = panel(140 * unit, 34 * unit)
        self._map = _Map(150 * unit, track)

    def draw(
        self,
        picture: pygame.Surface,
        car: CarState,
        controls: Controls,
        others: Sequence[tuple[CarState, Colour]] = (),
    ) -> None:
        """
        Draw the instruments over a picture.

        :param picture: of the size given to the constructor
        :param car: its state
        :param controls: its controls
        :param others: cars that the map shows, too, and their colours
        """
        margin = MARGIN * self._unit
        self._draw_laps(picture, (margin, margin), car)
        self._map.draw(picture, (self._size[0] - margin - self._map.side, margin), car, others)
        left = 0.5 * (self._size[0] - self._panel.get_width())
        self._draw_panel(
            picture, (left, self._size[1] - margin - self._panel.get_height()), car, controls
        )
        if car.off_track:
            middle = 0.5 * self._size[0]
            picture.blit(self._warning, (middle - 0.5 * self._warning.get_width(), margin))
            self._normal.write(picture, "OFF TRACK", (middle, margin + 8 * self._unit), RED, 0.5)

    def _draw_laps(
        self, picture: pygame.Surface, place: tuple[float, float], car: CarState
    ) -> None:
        """Draw lap number and lap times, from the panel's upper left corner on."""
        unit, (left, top) = self._unit, place
        picture.blit(self._laps, place)
        x, right = left + 10 * unit, left + 148 * unit
        self._small.write(picture, "LAP", (x, top + 13 * unit), MUTED)
        self._normal.write(picture, str(car.laps + 1), (x + 38 * unit, top + 10 * unit))
        self._large.write(picture, lap_clock(car.lap_time), (x, top + 32 * unit))
        for row, (label, value) in enumerate(
            (("last", car.last_lap_time), ("best", car.best_lap_time))
        ):
            y = top + (70 + 19 * row) * unit
            self._small.write(picture, label, (x, y), MUTED)
            self._small.write(
                picture, lap_clock(value) if value > 0.0 else NO_TIME, (right, y), align=1.0
            )

    def _draw_panel(
        self,
        picture: pygame.Surface,
        place: tuple[float, float],
        car: CarState,
        controls: Controls,
    ) -> None:
        """Draw speed, gear, revs, steering and pedals, from the panel's upper left corner on."""
        unit, (left, top) = self._unit, place

        def at(x: float, y: float) -> tuple[float, float]:
            return left + x * unit, top + y * unit

        def box(x: float, y: float, width: float, height: float) -> pygame.Rect:
            return pygame.Rect(*map(round, (*at(x, y), width * unit, height * unit)))

        picture.blit(self._panel, place)
        speed, gear = f"{abs(car.speed_x) * KMH:.0f}", GEARS.get(car.gear, str(car.gear))
        revs = car.engine_speed / RPM
        self._huge.write(picture, speed, at(100, 14), align=1.0)
        self._small.write(picture, "km/h", at(100, 68), MUTED, 1.0)
        self._huge.write(picture, gear, at(140, 14), align=0.5)
        self._small.write(picture, "gear", at(140, 68), MUTED, 0.5)
        _bar(
            picture, box(178, 14, 150, 16), revs / REVS_SHOWN, RED if revs > SHIFT_UP_RPM else AMBER
        )
        self._small.write(picture, f"{revs:.0f} rpm", at(253, 33), MUTED, 0.5)
        _needle(picture, box(178, 54, 150, 10), controls.steering)
        self._small.write(picture, "steering", at(253, 68), MUTED, 0.5)
        for x, label, value, colour in (
            (348, "thr", controls.throttle, GREEN),
            (382, "brk", controls.brake, RED),
        ):
            _bar(picture, box(x, 14, 20, 50), value, colour, upright=True)
            self._small.write(picture, label, at(x + 10, 68), MUTED, 0.5)


def panel(width: float, height: float) -> pygame.Surface:
    """
    Make a translucent ground for instruments.

    :param width: [px]
    :param height: [px]
    """
    ground = pygame.Surface((round(width), round(height)), pygame.SRCALPHA, 32)
    pygame.draw.rect(ground, PANEL, ground.get_rect(), border_radius=8)
    return ground


def _bar(
    picture: pygame.Surface, box: pygame.Rect, share: float, colour: Colour, upright: bool = False
) -> None:
    """
    Draw a bar that fills from the left, or upright from below.

    :param picture: what to draw on
    :param box: the full bar
    :param share: how much of it is filled, in [0, 1]
    :param colour: of the filled part
    :param upright: whether it fills from below
    """
    share = min(max(share, 0.0), 1.0)
    filled = box.copy()
    if upright:
        filled.height = round(share * box.height)
        filled.bottom = box.bottom
    else:
        filled.width = round(share * box.width)
    pygame.draw.rect(picture, FRAME, box)
    pygame.draw.rect(picture, colour, filled)


def _needle(picture: pygame.Surface, box: pygame.Rect, steering: float) -> None:
    """
    Draw the steering as a bar from the middle: to the left on the picture is left.

    :param picture: what to draw on
    :param box: full lock to full lock
    :param steering: in [-1, 1], left positive
    """
    pygame.draw.rect(picture, FRAME, box)
    filled = box.copy()
    filled.width = round(0.5 * abs(steering) * box.width)
    if steering > 0.0:
        filled.right = box.centerx
    else:
        filled.left = box.centerx
    pygame.draw.rect(picture, BLUE, filled)
    pygame.draw.line(picture, TEXT, (box.centerx, box.top - 2), (box.centerx, box.bottom + 1))


class _Map:
    """
    The whole track, north up, with a dot for the car.

    :param side: width and height [px]
    :param track: any circuit
    """

    def __init__(self, side: float, track: Track) -> None:
        self.side = round(side)
        count = max(math.ceil(track.length / 10.0), 16)
        places = [track.pose(track.length * i / count) for i in range(count)]
        points = np.array([to_highway(place.x, place.y) for place in places])
        low, high = points.min(0), points.max(0)
        self._centre = 0.5 * (low + high)
        self._scaling = 0.84 * self.side / float((high - low).max())
        self._ground = panel(self.side, self.side)
        pixels = [self._pixel(point) for point in points]
        outline = pygame.Surface((2 * self.side, 2 * self.side), pygame.SRCALPHA, 32)
        outline.fill((*MUTED, 0))  # of the line's colour, or scaling would darken its edges
        doubled = [(2.0 * x, 2.0 * y) for x, y in pixels]
        pygame.draw.lines(outline, MUTED, True, doubled, max(round(0.04 * self.side), 3))
        self._ground.blit(pygame.transform.smoothscale(outline, self._ground.get_size()), (0, 0))
        self._line(places[0].heading, pixels[0])

    def _pixel(self, point: FloatArray) -> tuple[float, float]:
        """Turn a point of highway-env's frame [m] into one of the map [px]."""
        x, y = (point - self._centre) * self._scaling + 0.5 * self.side
        return float(x), float(y)

    def _line(self, heading: float, place: tuple[float, float]) -> None:
        """Mark the start line across the road's heading [rad] at a place [px]."""
        reach = 0.035 * self.side
        x, y = reach * math.sin(heading), reach * math.cos(heading)
        ends = (place[0] - x, place[1] - y), (place[0] + x, place[1] + y)
        pygame.draw.line(self._ground, TEXT, *ends, max(round(0.014 * self.side), 1))

    def draw(
        self,
        picture: pygame.Surface,
        place: tuple[float, float],
        car: CarState,
        others: Sequence[tuple[CarState, Colour]] = (),
    ) -> None:
        """
        Draw the map.

        :param picture: what to draw on
        :param place: upper left corner [px]
        :param car: the dot in front of all others
        :param others: cars and their colours
        """
        left, top = round(place[0]), round(place[1])
        picture.blit(self._ground, (left, top))
        for other, colour in (*others, (car, RED)):
            x, y = self._pixel(to_highway(other.x, other.y))
            dot = left + min(max(x, 0.0), self.side), top + min(max(y, 0.0), self.side)
            pygame.draw.circle(picture, TEXT, dot, 0.036 * self.side)
            pygame.draw.circle(picture, colour, dot, 0.026 * self.side)
