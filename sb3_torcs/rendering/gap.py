"""The time between two drivers, on the picture that shows them side by side."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import zip_longest

import numpy as np
import numpy.typing as npt

__all__ = ["Passing", "draw_gap", "side_by_side", "time_behind"]

Frame = npt.NDArray[np.uint8]

HEIGHT = 0.055  # of the letters, as a share of the picture's height
TOP = 0.02  # of the board, likewise
GROUND, LETTERS = (16, 18, 22), (244, 244, 240)


class Passing:
    """When a car was where, from the frames of a video."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._shares: list[float] = []

    def note(self, time: float, share: float) -> None:
        """
        Note a frame. The end of the race lies between two frames, and is placed there.

        :param time: simulated [s]
        :param share: of the race that the car has driven, 0 to 1
        """
        if share <= self.share:
            return
        if share >= 1.0 and len(self._times) > 1:
            (t0, t1), (s0, s1) = self._times[-2:], self._shares[-2:]
            time = min(time, t1 + (1.0 - s1) * (t1 - t0) / (s1 - s0))
        self._times.append(time)
        self._shares.append(share)

    @property
    def share(self) -> float:
        """How much of the race the car has driven, 0 before the line."""
        return self._shares[-1] if self._shares else 0.0

    @property
    def time(self) -> float:
        """When that was [s]."""
        return self._times[-1]

    def when(self, share: float) -> float:
        """
        Return when the car was somewhere [s].

        :param share: of the race
        """
        return float(np.interp(share, self._shares, self._times))


def time_behind(first: Passing, second: Passing) -> float | None:
    """
    Measure by how much one car is behind another, at the place of the last one.

    :param first: the car that is measured against
    :param second: the other one
    :return: [s], negative if the second is ahead; ``None`` while one is before the line
    """
    if not first.share or not second.share:
        return None
    if second.share <= first.share:
        return second.time - first.when(second.share)
    return second.when(first.share) - first.time


def draw_gap(picture: npt.NDArray[np.uint8], name: str, behind: float) -> npt.NDArray[np.uint8]:
    """
    Write a gap above the middle of a picture.

    :param picture: (height, width, 3)
    :param name: of the second driver
    :param behind: as of :func:`time_behind`
    :return: another picture
    """
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    height, width, _ = picture.shape
    font = ImageFont.load_default(max(HEIGHT * height, 8.0))
    text = f"{name}: {abs(behind):.2f} s {'behind' if behind >= 0.0 else 'ahead'}"
    draw = ImageDraw.Draw(image)
    middle, top = 0.5 * width, (TOP + 0.3 * HEIGHT) * height
    left, upper, right, lower = draw.textbbox((middle, top), text, font, anchor="ma")
    space = 0.3 * HEIGHT * height
    draw.rounded_rectangle(
        (left - 2 * space, upper - space, right + 2 * space, lower + space), space, GROUND
    )
    draw.text((middle, top), text, LETTERS, font, anchor="ma")
    return np.asarray(image)


def side_by_side(*videos: Iterator[Frame]) -> Iterator[Frame]:
    """
    Join videos of one height. A video that ends before the others keeps its last picture.

    :param videos: pictures of each, from left to right
    :return: joint pictures
    """
    last: list[Frame] = []
    for pictures in zip_longest(*videos):
        last = [
            last[place] if picture is None else picture for place, picture in enumerate(pictures)
        ]
        yield np.concatenate(last, axis=1)
