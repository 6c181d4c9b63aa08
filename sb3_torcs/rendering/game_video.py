"""Videos of the game: every frame is drawn, however long it takes, and none is drawn twice.

Between two frames the game advances by exactly one frame's time. A video begins one second before
the start and ends one second after the race.
"""

from __future__ import annotations

import os
import select
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np
import numpy.typing as npt

from sb3_torcs.errors import GameFailed, GameTimeout, InvalidOption
from sb3_torcs.torcs.display import VirtualDisplay
from sb3_torcs.torcs.process import GameProcess
from sb3_torcs.torcs.window import ViewName, Window

__all__ = ["FPS", "Frame", "GameVideo", "read_frame", "side_by_side"]

FPS = 30.0
PATIENCE = 120.0  # [s] for one frame, on a busy machine
GRACE = 20.0  # [s] for the game to end after its last frame
PIPE_SIZE = 1 << 20  # [bytes] as much as a user may have

HEADER = struct.Struct("=4sIIIdd")  # as in native/window/frames.cpp
MARK = b"SB3F"


@dataclass(frozen=True)
class Frame:
    """
    One picture of a video.

    :param number: from 0
    :param time: simulated [s], negative before the start
    :param picture: red, green and blue, from the top
    :param share: of the race that the first car on the grid has driven, 0 to 1
    """

    number: int
    time: float
    picture: npt.NDArray[np.uint8]  # (height, width, 3)
    share: float = 0.0


class GameVideo:
    """
    A race that is recorded instead of shown, under a display of its own.

    Use it in a ``with`` statement; leaving it ends the game.

    :param start: starts the game with the window that it is given, e.g.
        ``lambda window: GameProcess(game, race, **window_arguments(game, window))``
    :param size: width and height [pixels], both even
    :param view: one of :data:`sb3_torcs.torcs.window.VIEWS`
    :param fps: frames per second of simulated time
    :param driver: name of the driver whom the camera follows; ``None`` is the first on the grid
    :raises InvalidOption: if there is no such view, or the game cannot draw this
    :raises DisplayUnavailable: if there is no virtual display
    """

    def __init__(
        self,
        start: Callable[[Window], GameProcess],
        *,
        size: tuple[int, int] = (1280, 720),
        view: ViewName = "behind",
        fps: float = FPS,
        driver: str | None = None,
    ) -> None:
        window = Window(size, view, driver=driver, fps=fps)
        if any(side % 2 for side in size):
            raise InvalidOption(f"size is {size[0]}x{size[1]}; a video needs even numbers")
        self.fps = fps
        with ExitStack() as stack:
            self.display = stack.enter_context(VirtualDisplay(size))
            self._frames, written = os.pipe()
            stack.callback(os.close, self._frames)
            import fcntl  # of Linux, like the game: other systems import this module, too

            with suppress(OSError):  # only faster
                fcntl.fcntl(written, fcntl.F_SETPIPE_SZ, PIPE_SIZE)
            try:
                self.game = start(replace(window, display=self.display.name, frames=written))
            finally:
                os.close(written)
            stack.callback(self.game.stop)
            self._stack = stack.pop_all()

    def __enter__(self) -> GameVideo:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the game and its display. A second call does nothing."""
        self._stack.close()

    def frames(self) -> Iterator[Frame]:
        """
        Yield every frame, to the end of the race.

        :raises GameFailed: if the game ends too early
        :raises GameTimeout: if it hangs
        """
        frame = None
        while (following := read_frame(self._frames, self.game)) is not None:
            frame = following
            yield frame
        self.game.wait(GRACE)
        if frame is None:  # the game ends like that if it cannot load a driver
            raise GameFailed(self.game.epitaph())


def side_by_side(*videos: Iterator[npt.NDArray[np.uint8]]) -> Iterator[npt.NDArray[np.uint8]]:
    """
    Join videos of one height. A video that ends before the others keeps its last picture.

    :param videos: pictures of each, from left to right
    :return: joint pictures
    """
    last: list[npt.NDArray[np.uint8]] = []
    for pictures in zip_longest(*videos):
        last = [
            last[place] if picture is None else picture for place, picture in enumerate(pictures)
        ]
        yield np.concatenate(last, axis=1)


def read_frame(file: int, game: GameProcess) -> Frame | None:
    """
    Read the next frame that the game sends.

    :param file: the open file
    :param game: that sends it
    :return: the frame; ``None`` if the game has sent its last one
    :raises GameFailed: if the game ends within a frame
    :raises GameTimeout: if no frame comes
    """
    header = bytearray(HEADER.size)
    got = _fill(file, memoryview(header), game)
    if got == 0:
        return None
    mark, width, height, number, time, share = HEADER.unpack(header)
    if got < HEADER.size or mark != MARK:
        raise GameFailed(game.epitaph())
    picture = np.empty((height, width, 3), np.uint8)
    if _fill(file, picture.reshape(-1).data, game) < picture.nbytes:
        raise GameFailed(game.epitaph())
    return Frame(number, time, picture, share)


def _fill(file: int, buffer: memoryview, game: GameProcess) -> int:
    """
    Read until the buffer is full.

    :param file: the open file
    :param buffer: to fill
    :param game: that sends
    :return: number of bytes read; fewer only at the end
    """
    got = 0
    while got < len(buffer):
        ready, _, _ = select.select([file], [], [], PATIENCE)
        if not ready:
            raise GameTimeout(
                f"the game sent no picture for {PATIENCE:g} s; it last said: {game.last_words()}"
            )
        count = os.readv(file, [buffer[got:]])
        if count == 0:
            break
        got += count
    return got
