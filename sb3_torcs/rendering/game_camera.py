"""The game's own picture of a race that is driven elsewhere.

A hidden game shows the same cars on the same track, but drives none of them: for each picture it
receives the appearance of the race at that moment. So a picture belongs to the simulated time,
however long the drawing takes, and two pictures of one moment are equal.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import weakref
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from sb3_torcs.errors import GameFailed, GameTimeout
from sb3_torcs.torcs.display import VirtualDisplay
from sb3_torcs.torcs.installation import Game
from sb3_torcs.torcs.process import GameProcess
from sb3_torcs.torcs.race_setup import SCR_SERVER, RaceSetup
from sb3_torcs.torcs.scenery import find_scenery
from sb3_torcs.torcs.track_names import find_track
from sb3_torcs.torcs.window import Window, window_arguments
from sb3_torcs.tracks.trial import check_track

__all__ = ["HEADER", "GameView", "check_view", "read_frame"]

AGENT = f"{SCR_SERVER} 0"  # the agent's name in the game
PATIENCE = 120.0  # [s] for one frame, on a busy machine
GRACE = 5.0  # [s] for a game to end after it closed the connection

HEADER = struct.Struct("=4sIIIdd")  # as in native/window/frames.cpp
MARK = b"SB3F"


def check_view(game: Game, track: str, size: tuple[int, int]) -> None:
    """
    Make sure that the game can draw a track here, before long work.

    :param game: the installation
    :param track: as of :class:`~sb3_torcs.torcs.race_setup.RaceSetup`
    :param size: of the pictures, width and height [pixels]
    :raises DisplayUnavailable: if there is no virtual display
    :raises SceneryMissing: if the game cannot draw the track
    """
    find_scenery(game, find_track(track, game).path)
    VirtualDisplay(size).close()


class GameView:
    """
    Pictures of a race. The game ends when this is closed.

    :param game: the installation
    :param race: who races where; agents are ``("scr_server", 0)`` and so on
    :param window: that the game would show: its size, its view, whether it has boards, and who is
        looked at; without a name it is the first agent
    :raises DisplayUnavailable: if there is no virtual display
    :raises GameIncomplete: if the game lacks its program, or a file that it needs for this
    :raises BackendUnavailable: if our libraries that the game loads were not built
    """

    def __init__(self, game: Game, race: RaceSetup, window: Window) -> None:
        with ExitStack() as stack:
            display = stack.enter_context(VirtualDisplay(window.size))
            self._line, end = socket.socketpair()
            stack.enter_context(self._line)
            with end:
                window = replace(
                    window, driver=window.driver or AGENT,
                    display=display.name, frames=end.fileno(),
                    traces=False,  # the moments before were not drawn, or were of another race
                )  # fmt: skip
                arguments = window_arguments(game, window)
                arguments["environment"] |= {
                    "SB3_TORCS_APPEARANCES": str(end.fileno()),
                    "SB3_TORCS_SCR_SOCKETS": "",  # nobody drives there
                }
                self._game = stack.enter_context(
                    GameProcess(game, race, check=check_track, **arguments)
                )
            self._end = weakref.finalize(self, stack.pop_all().close)

    def __enter__(self) -> GameView:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def frame(self, appearance: bytes) -> npt.NDArray[np.uint8]:
        """
        Draw a moment of the race.

        :param appearance: of that moment, from the engine
        :return: (height, width, 3) red, green and blue, from the top
        :raises GameFailed: if the game has ended
        :raises GameTimeout: if it hangs
        """
        try:
            self._line.sendall(appearance)
            frame = read_frame(self._line.fileno(), self._game)
        except ConnectionError:
            frame = None
        if frame is None:
            self._game.wait(GRACE)  # its error is more precise
            raise GameFailed(self._game.epitaph())
        return frame

    def close(self) -> None:
        """End the game and its display. A second call does nothing."""
        self._end()


def read_frame(file: int, game: GameProcess) -> npt.NDArray[np.uint8] | None:
    """
    Read the next picture that the game sends.

    :param file: the open file
    :param game: that sends it
    :return: (height, width, 3); ``None`` if the game has sent its last one
    :raises GameFailed: if the game ends within a frame
    :raises GameTimeout: if no frame comes
    """
    header = bytearray(HEADER.size)
    got = _fill(file, memoryview(header), game)
    if got == 0:
        return None
    mark, width, height, *_ = HEADER.unpack(header)
    if got < HEADER.size or mark != MARK:
        raise GameFailed(game.epitaph())
    picture = np.empty((height, width, 3), np.uint8)
    if _fill(file, picture.reshape(-1).data, game) < picture.nbytes:
        raise GameFailed(game.epitaph())
    return picture


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
