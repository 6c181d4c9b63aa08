"""Options of the game's window: size, camera, boards, and frames of a video."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypedDict

from sb3_torcs.errors import GameIncomplete, InvalidOption, near_miss
from sb3_torcs.torcs.installation import Game
from sb3_torcs.torcs.nodes import Node
from sb3_torcs.torcs.process import compiled_library

__all__ = ["VIEWS", "ViewName", "Window", "WindowArguments", "window_arguments", "window_files"]

ViewName = Literal[
    "behind", "close", "far", "front", "cockpit", "hood", "road", "side", "above", "track",
    "helicopter", "tv",
]  # fmt: skip
VIEWS: Mapping[ViewName, tuple[int, int]] = {
    "behind": (0, 1),
    "close": (0, 0),
    "far": (1, 0),
    "front": (1, 3),
    "cockpit": (0, 3),
    "hood": (0, 2),
    "road": (0, 4),
    "side": (2, 0),
    "above": (3, 0),
    "track": (7, 0),
    "helicopter": (8, 0),
    "tv": (9, 0),
}
"""The game's cameras: the list, which has a key (0 is F2), and the place in it."""

SMALLEST, LARGEST = 64, 4096  # [pixels] of either side

SCREEN, GRAPHICS, SOUND = "config/screen.xml", "config/graph.xml", "config/sound.xml"
BOARDS = {
    "driver board": 2,  # with what the driver has to say
    "driver counter": 1,
    "leader board": 0,
    "G graph": 1,  # the controls
    "debug info": 0,
    "map mode": 4,  # the whole track
}
TRACES = ("smoke value", "skid value")
NO_BOARDS = {**dict.fromkeys(BOARDS, 0), "map mode": 1}
USER_VARIABLES = (  # that a program with a window and sound needs; others are not passed on
    "XAUTHORITY",
    "XDG_RUNTIME_DIR",
    "PULSE_SERVER",
)


@dataclass(frozen=True)
class Window:
    """
    The window of a game.

    :param size: width and height [pixels]
    :param view: one of :data:`VIEWS`
    :param display: of the X server, e.g. ``":0"``
    :param driver: the name, as the game shows it, of the one who is looked at, e.g.
        ``"scr_server 0"``; ``None`` for the first on the grid
    :param frames: an open file for pictures, see :mod:`sb3_torcs.rendering.game_camera`;
        ``None`` shows the race in real time
    :param boards: whether lap times, instruments and a map are drawn over the picture
    :param traces: whether smoke and skid marks are drawn, which depend on earlier moments
    :raises InvalidOption: if there is no such view, or the game cannot draw this
    """

    size: tuple[int, int] = (1280, 720)
    view: ViewName = "behind"
    display: str = ":0"
    driver: str | None = None
    frames: int | None = None
    boards: bool = True
    traces: bool = True

    def __post_init__(self) -> None:
        if not isinstance(self.view, str) or self.view not in VIEWS:
            hint = near_miss(self.view, VIEWS) or f"; it is {' or '.join(VIEWS)}"
            raise InvalidOption(f"there is no view {self.view!r}{hint}")
        if not all(SMALLEST <= side <= LARGEST for side in self.size):
            raise InvalidOption(
                f"size is {self.size[0]}x{self.size[1]}; "
                f"expected {SMALLEST} to {LARGEST} pixels for each side, e.g. 1280x720"
            )


class WindowArguments(TypedDict):
    """Arguments of :class:`~sb3_torcs.torcs.process.GameProcess` for a window."""

    environment: dict[str, str]
    descriptors: list[int]
    preload: Path | None
    files: dict[str, str]


def window_arguments(game: Game, window: Window) -> WindowArguments:
    """
    Make the arguments by which a :class:`~sb3_torcs.torcs.process.GameProcess` has a window.

    :param game: the installation
    :param window: of the game
    :return: arguments by name
    :raises GameIncomplete: if the game lacks one of its settings, or has a broken one
    :raises BackendUnavailable: if our library for the game's window was not built
    """
    return {
        "environment": _environment(window),
        "descriptors": [] if window.frames is None else [window.frames],
        "preload": compiled_library("_game_window"),
        "files": window_files(game, window),
    }


def _environment(window: Window) -> dict[str, str]:
    """
    Make the variables that a game with a window needs besides those of its race.

    :param window: of the game
    """
    variables = {name: os.environ[name] for name in USER_VARIABLES if name in os.environ}
    # The game has another home folder, in which this file does not exist.
    cookies = Path.home() / ".Xauthority"
    if "XAUTHORITY" not in variables and cookies.is_file():
        variables["XAUTHORITY"] = str(cookies)
    variables["DISPLAY"] = window.display
    if window.frames is not None:
        variables["SB3_TORCS_FRAMES"] = str(window.frames)
    return variables


def window_files(game: Game, window: Window) -> dict[str, str]:
    """
    Write the files that the game reads about its window.

    :param game: the installation
    :param window: of the game
    :return: texts by file, seen from the game's private folder
    :raises GameIncomplete: if the game lacks one of these files, or has a broken one
    """
    screen = _parse(game, SCREEN)
    properties = screen.make("Screen Properties")
    width, height = window.size
    numbers = {"x": width, "y": height, "window width": width, "window height": height, "bpp": 24}
    for name, number in numbers.items():
        properties.set(name, number)
    properties.set("fullscreen", "no")
    graphics = _parse(game, GRAPHICS)
    display = graphics.make("Display Mode", "0")
    camera_list, camera = VIEWS[window.view]
    numbers = {"camera head list": camera_list, "camera": camera}
    numbers |= BOARDS if window.boards else NO_BOARDS
    for name, number in numbers.items():
        display.set(name, number)
    if window.driver is not None:
        display.set("current driver", window.driver)
    if not window.traces:
        for name in TRACES:
            graphics.make("Graphic").set(name, 0)
    sound = _parse(game, SOUND)
    silent = window.frames is not None or not _has_sound()
    sound.make("Sound Settings").set("state", "disabled" if silent else "openal")
    sound.make("Menu Music").set("enable", "disabled")
    return {SCREEN: screen.as_text(), GRAPHICS: graphics.as_text(), SOUND: sound.as_text()}


def _has_sound() -> bool:
    """Whether there is a device for sound, or a service that has one."""
    runtime = Path(os.environ.get("XDG_RUNTIME_DIR", f"/run/user/{os.getuid()}"))
    services = [runtime / "pulse" / "native", runtime / "pipewire-0"]
    devices = Path("/dev/snd").glob("pcm*p")
    return "PULSE_SERVER" in os.environ or any(s.exists() for s in services) or any(devices)


def _parse(game: Game, file: str) -> Node:
    """
    Read one of the game's own settings.

    :param game: the installation
    :param file: seen from its data
    """
    try:
        return Node.read(game.data / file)
    except (OSError, ValueError) as error:
        raise GameIncomplete(
            f"{game.data / file} cannot be read ({error}); type: `sb3-torcs install-torcs`"
        ) from error
