"""The board of a race on the picture: places, drivers, gaps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_torcs.car import CarState
from sb3_torcs.rendering.highway import pygame
from sb3_torcs.rendering.hud import MUTED, TEXT, Typeface, panel, unit_of
from sb3_torcs.rendering.scenery import Colour

__all__ = ["Board", "Field", "Row"]

WIDTH = 236  # [px] these are meant for a picture whose shorter side is hud.DESIGN
TOP = 132
HEAD, LINE = 26, 19
SPACE = 10
LONGEST = 16  # [characters] of a driver's name
FOLLOWED: Colour = (62, 66, 74)


class Row(NamedTuple):
    """A line of the board."""

    place: str
    driver: str
    gap: str
    colour: Colour | None  # of the car
    followed: bool  # by the camera


class Field(NamedTuple):
    """What a picture shows of a race besides the car that the camera follows."""

    others: Sequence[tuple[CarState, Colour]]
    title: str
    rows: Sequence[Row]


class Board:
    """
    The board, for pictures of one size.

    :param size: width and height of the picture [px]
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._unit = unit = unit_of(size)
        self._small, self._normal = Typeface(19 * unit), Typeface(26 * unit)
        self._grounds: dict[int, pygame.Surface] = {}  # by the number of rows

    def draw(self, picture: pygame.Surface, field: Field) -> None:
        """
        Draw the board at the left side of a picture.

        :param picture: of the size given to the constructor
        :param field: of the race
        """
        unit, rows = self._unit, field.rows
        left, top = SPACE * unit, TOP * unit
        if len(rows) not in self._grounds:
            height = HEAD + LINE * len(rows) + 1.6 * SPACE
            self._grounds[len(rows)] = panel(WIDTH * unit, height * unit)
        picture.blit(self._grounds[len(rows)], (left, top))
        self._normal.write(picture, field.title, (left + SPACE * unit, top + 8 * unit))
        for number, row in enumerate(rows):
            self._draw_row(picture, row, left, top + (SPACE + HEAD + LINE * number) * unit)

    def over(self, frame: npt.NDArray[np.uint8], field: Field) -> npt.NDArray[np.uint8]:
        """
        Draw the board over a picture that was drawn elsewhere, without the colours of the cars.

        :param frame: (height, width, 3)
        :param field: of the race
        :return: another picture
        """
        height, width, _ = frame.shape
        picture = pygame.image.frombuffer(frame.tobytes(), (width, height), "RGB")
        self.draw(picture, field._replace(rows=[row._replace(colour=None) for row in field.rows]))
        return np.frombuffer(pygame.image.tobytes(picture, "RGB"), np.uint8).reshape(frame.shape)

    def _draw_row(self, picture: pygame.Surface, row: Row, left: float, top: float) -> None:
        """Draw a line from its upper left corner [px] on."""
        unit = self._unit

        def box(x: float, y: float, width: float, height: float) -> pygame.Rect:
            numbers = (left + x * unit, top + y * unit, width * unit, height * unit)
            return pygame.Rect(*map(round, numbers))

        if row.followed:
            pygame.draw.rect(picture, FOLLOWED, box(4, -3, WIDTH - 8, LINE))
        colour = TEXT if row.followed else MUTED
        self._small.write(picture, row.place, (left + 28 * unit, top), colour, align=1.0)
        if row.colour is not None:
            pygame.draw.rect(picture, row.colour, box(36, 1, 11, 11))
        name = row.driver if len(row.driver) <= LONGEST else f"{row.driver[: LONGEST - 2]}.."
        self._small.write(picture, name, (left + 54 * unit, top), TEXT)
        self._small.write(picture, row.gap, (left + (WIDTH - SPACE) * unit, top), colour, 1.0)
