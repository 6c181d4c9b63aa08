"""``Torcs-v0``: the racing environment on the real game."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, Unpack

import numpy as np
import numpy.typing as npt

from sb3_torcs.actions import choose_gearbox
from sb3_torcs.backends.base import Backend
from sb3_torcs.backends.native import NativeBackend
from sb3_torcs.backends.scr import ScrBackend
from sb3_torcs.backends.seats import LoneSeat
from sb3_torcs.backends.several import is_several, one_or_several
from sb3_torcs.envs.arguments import read_options, select, takes_options
from sb3_torcs.envs.options import RACING, TORCS, TorcsOptions, picture_keys
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.envs.torcs_race import make_shared_race
from sb3_torcs.errors import InvalidOption, UnknownRobot
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.opponents import agents_among
from sb3_torcs.torcs.scenery import find_scenery
from sb3_torcs.torcs.track_names import find_track
from sb3_torcs.torcs.window import Window

__all__ = ["TorcsEnv"]


@takes_options(TORCS)
class TorcsEnv(RacingEnv):
    """
    A car in the real TORCS, alone or against robots, in this process or in one of its own.

    Action space, observation space, rewards, starting states and the end of an episode are those
    of :class:`~sb3_torcs.envs.torcs_lite.TorcsLiteEnv`. The world is different: the game's own
    physics with fuel, damage, walls and slopes, and its rules. Laps with a cut corner or a touched
    wall do not count as ``best_lap_time``.

    With ``opponents`` the race is the game's "quick race". A start elsewhere than on the grid
    moves the whole field along the road, at the agent's speed.

    With ``backend="scr"`` the game runs in a process of its own and sends its sensors by the
    protocol of the Simulated Car Racing championship. The drive is the same to the bit, and slower.
    With ``scr`` the game is one that runs already; other servers than ours send six digits.

    Units are SI and radians; left is positive.

    :raises BackendUnavailable: if the game or the extension is missing, or not as expected
    :raises SceneryMissing: if the game cannot draw the track
    """

    def __init__(self, **options: Unpack[TorcsOptions]) -> None:
        given = read_options("TorcsEnv.__init__", TORCS, options)
        self._window = _window(given)
        opponents = given["opponents"]
        named = opponents if isinstance(opponents, (list, tuple)) else ()
        agents = agents_among(named, find_game()) if named else []
        if agents and given["backend"] != "native":
            try:
                find_game().parse_robot(agents[0])
            except UnknownRobot as error:
                only = "agents are opponents with backend 'native' only"
                raise UnknownRobot(f"{error}; {only}") from None
        if self._window is not None:
            if agents:
                raise InvalidOption(
                    f"picture 'game' is for races against robots, and '{agents[0]}' is an agent; "
                    "use picture 'above'"
                )
            self.metadata = {**self.metadata, "render_modes": ["rgb_array"]}
            game = find_game()
            find_scenery(game, find_track(given["track"], game).path)
        super().__init__(_world(given, bool(agents)), **select(RACING, given))

    def render(self) -> npt.NDArray[np.uint8] | None:
        """
        Draw the present moment: the road and the car from above, or the game's own picture.

        :return: (height, width, 3) of red, green and blue; ``None`` in the mode ``"human"``
        :raises DisplayUnavailable: if the game has no display to draw at
        :raises GameFailed: if the game that draws has ended; the next picture starts it again
        :raises GameTimeout: if that game hangs; the next picture starts it again
        """
        if self._window is None or self.render_mode is None:
            return super().render()
        self.check_ready("render")
        backend: Any = self.backend  # a NativeBackend, perhaps in one that notes its drives
        appearance = backend.engine.appearance()
        if self._viewer is None:
            # Imported here because graphics take long to load.
            from sb3_torcs.rendering.game_camera import GameView

            self._viewer = GameView(find_game(), backend.race_setup(), self._window)
        try:
            frame: npt.NDArray[np.uint8] = self._viewer.frame(appearance)
        except BaseException:  # also Ctrl-C: the picture that was requested may still arrive
            self._viewer.close()
            self._viewer = None
            raise
        return frame


def _world(given: Mapping[str, Any], agents: bool) -> Backend:
    """
    Make the backend.

    :param given: all options of :class:`TorcsEnv`
    :param agents: whether there are agents among the opponents
    :raises InvalidOption: if an option is for another world
    """
    track, car, noise = given["track"], given["car"], given["conditions"]["sensor_noise"]
    shared = {
        "range_finders": given["range_finders"],
        "gearbox": choose_gearbox(given["gearbox"], given["action"]),
        "laps": given["laps"],
    }
    field = {"opponents": given["opponents"], "grid_place": given["grid_place"]}
    if given["backend"] == "scr":
        if noise:
            raise InvalidOption(
                "sensor_noise is for backend 'native'; an SCR server adds its own noise if it is "
                "started with -noisy"
            )
        for name in ("track", "car"):
            if is_several(given[name], name):
                raise InvalidOption(
                    f"{name} is {given[name]!r}; a game of backend 'scr' has one {name}, backend "
                    "'native' takes several"
                )
        return ScrBackend(track, car=car, **field, **shared, **given["scr"])
    if any(value is not None for value in given["scr"].values()):
        raise InvalidOption(
            f"scr is {given['scr']!r}, the address of an SCR server; add backend='scr'"
        )
    if agents:
        race = make_shared_race(
            1, track, car, **field, sensor_noise=noise, action_repeat=given["action_repeat"],
            **shared,
        )  # fmt: skip
        world: Any = LoneSeat(race, 0)  # whose track and car may not be set
        return world
    make = partial(NativeBackend, sensor_noise=noise, **field, **shared)
    return one_or_several(make, track, car)


def _window(given: Mapping[str, Any]) -> Window | None:
    """
    Check the option of the game's picture.

    :param given: all options of :class:`TorcsEnv`
    :return: the window that the game would show; ``None`` for the picture from above
    :raises InvalidOption: if the game cannot draw this
    """
    picture = picture_keys(given["picture"])
    if picture is None:
        return None
    if given["render_mode"] == "human":
        raise InvalidOption(
            "picture 'game' is for render_mode 'rgb_array'; `sb3-torcs watch` shows the game's "
            "own window"
        )
    if given["backend"] != "native":
        raise InvalidOption(
            "picture 'game' is for backend 'native'; `sb3-torcs serve --window` shows the game of "
            "backend 'scr'"
        )
    if is_several(given["track"]) or is_several(given["car"], "car"):
        raise InvalidOption("picture 'game' is for one track and one car, not for a list")
    width, height = picture["size"]
    return Window((int(width), int(height)), picture["view"], boards=bool(picture["boards"]))
