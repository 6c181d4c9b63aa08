"""``Torcs-v0``: the racing environment on the real game."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from sb3_torcs.actions import ActionName, GearboxName, used_gearbox
from sb3_torcs.backends.base import Backend
from sb3_torcs.backends.native import NativeBackend
from sb3_torcs.backends.scr import ScrBackend
from sb3_torcs.backends.seats import LoneSeat
from sb3_torcs.backends.several import is_several, one_or_several
from sb3_torcs.car import (
    DEFAULT_CAR,
    RangeFinderName,
    StartName,
    checked_choice,
    checked_flag,
    is_count,
)
from sb3_torcs.envs.racing import RacingEnv, RenderMode
from sb3_torcs.envs.torcs_race import make_shared_race
from sb3_torcs.errors import InvalidOption, UnknownRobot, with_known_arguments
from sb3_torcs.rewards import RewardChoice
from sb3_torcs.sensors import SensorsName
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.scenery import find_scenery
from sb3_torcs.torcs.starting_list import guests_of
from sb3_torcs.torcs.track_names import find_track
from sb3_torcs.torcs.window import ViewName, Window

__all__ = ["TorcsEnv"]

BackendName = Literal["native", "scr"]
PictureName = Literal["above", "game"]
GameRenderMode = Literal[RenderMode, "game"]
BACKENDS, PICTURES = get_args(BackendName), get_args(PictureName)


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
    With ``host`` the game is one that runs already; other servers than ours send six digits.

    Units are SI and radians; left is positive.

    :param track: ``"aalborg"``, ``"road/aalborg"``, or the path of a TORCS XML file; or a list of
        them: each episode is on one, drawn from the seed; with ``host`` that of its race, or
        ``None`` if nobody knows it
    :param car: any of the game's, e.g. ``"car1-trb1"``; or a list of them, as for the track
    :param reward: ``"progress"``, ``"blog"``, ``"apex"``, or a dict of weights
    :param action_repeat: control ticks of 0.02 s per timestep
    :param range_finders: ``"scr"``, ``"narrow"``, or 19 angles in degrees, left to right
    :param sensors: groups of sensors in an observation: ``"base"``, the 29 numbers, and any of
        ``"preview"``, the road ahead, ``"limits"``, the speeds that it allows, ``"line"``, the
        racing line, ``"opponents"``, ``"rivals"`` and ``"race"``, the other cars, ``"car"``,
        which car it is, ``"car_line"``, the racing line as fast as this car may be on it, and
        ``"motion"``, how the car turns and jumps
    :param action: ``"pedals"``: steering, throttle, brake; ``"pedal"``: steering and one signed
        pedal; or ``"manual"``: steering, throttle, brake, gear, clutch
    :param gearbox: ``"automatic"``, by motor speed; or ``"road_speed"``, which does not hunt while
        the wheels spin, and slips the clutch to set off
    :param start: ``"grid"`` or ``"random"``
    :param laps: whole laps after which the episode is truncated; ``None`` drives on
    :param runoff: how far the mass centre may be beside the road before the episode ends [m]
    :param recovery: how long a car may stand, or face backwards, before the episode ends [s]; 0
        ends it after 1.5 s of standing, 3 s after a standing start, and at once if it faces
        backwards
    :param unstick: whether a car that is stuck across the road or beside it frees itself, as the
        game's robots do; actions count for nothing meanwhile
    :param keep_distance: whether a car brakes by itself where it is too close to the car ahead;
        for the backend ``"native"``
    :param keep_clear: whether a car steers away by itself from cars beside it; for the backend
        ``"native"``
    :param catch_slides: whether a car that slides steers against it by itself, before it spins
    :param delay: control ticks of 0.02 s from an observation until the controls that answer it
        arrive; or a pair, e.g. ``(0, 5)``, between which each episode draws
    :param grip: factor on the friction of all ground; or a pair, e.g. ``(0.8, 1.1)``, between which
        each episode draws
    :param mass: factor on the mass of the agent's car; or a pair, as for the grip
    :param render_mode: ``"rgb_array"`` or ``"human"``; ``"game"`` is another name for
        ``"rgb_array"`` with ``picture="game"``
    :param picture: ``"above"``, the road and the car from above, or ``"game"``, the game's own 3D
        picture, for ``"rgb_array"`` only; it needs Xvfb
    :param view: of the game's picture: ``"behind"``, ``"close"``, ``"far"``, ``"front"``,
        ``"cockpit"``, ``"hood"``, ``"road"``, ``"side"``, ``"above"``, ``"track"``,
        ``"helicopter"`` or ``"tv"``
    :param boards: whether the game's picture has lap times, instruments and a map drawn over it
    :param render_size: width and height of the game's picture [pixels]
    :param backend: ``"native"``, the game in this process, or ``"scr"``
    :param opponents: robots of the game, e.g. ``("inferno", "berniw:3")``; with ``"native"`` also
        agents, by name or path
    :param grid_place: of the agent on the grid, 1 in front; ``None`` is behind all opponents
    :param sensor_noise: range finders and opponent sensors err by 10 % and 2 %, as those of the
        SCR server's ``-noisy``; not with ``"scr"``
    :param host: of a running SCR server; its race is driven as it is, and each episode starts on
        the grid. With ``None``, ``"scr"`` starts a game of its own
    :param port: of the driver there; ``None`` is 3001, the first one
    :raises BackendUnavailable: if the game or the extension is missing, or not as expected
    :raises SceneryMissing: if the game cannot draw the track
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        **RacingEnv.metadata,
        "render_modes": [*get_args(GameRenderMode)],
    }

    @with_known_arguments
    def __init__(
        self,
        *,
        track: str | Path | Sequence[str | Path] | None = "aalborg",
        car: str | Sequence[str] = DEFAULT_CAR,
        reward: RewardChoice = "progress",
        action_repeat: int = 5,
        range_finders: RangeFinderName | Sequence[float] = "scr",
        sensors: Sequence[SensorsName] = ("base",),
        action: ActionName = "pedals",
        gearbox: GearboxName = "automatic",
        start: StartName = "grid",
        laps: int | None = None,
        runoff: float = 0.0,
        recovery: float = 0.0,
        unstick: bool = False,
        keep_distance: bool = False,
        keep_clear: bool = False,
        catch_slides: bool = False,
        delay: int | Sequence[int] = 0,
        grip: float | Sequence[float] = 1.0,
        mass: float | Sequence[float] = 1.0,
        render_mode: GameRenderMode | None = None,
        backend: BackendName = "native",
        opponents: Sequence[str] = (),
        grid_place: int | None = None,
        sensor_noise: bool = False,
        picture: PictureName = "above",
        view: ViewName = "behind",
        boards: bool = True,
        render_size: tuple[int, int] = (640, 480),
        host: str | None = None,
        port: int | None = None,
    ) -> None:
        checked_choice("backend", backend, BACKENDS)
        self.picture = _picture(picture, render_mode)
        self._window = _window(render_size, view, boards, self.picture)
        self.render_size = self._window.size
        if self.picture == "game" and backend != "native":
            raise InvalidOption(
                "picture 'game' is for backend 'native'; `sb3-torcs serve --window` shows the "
                "game of backend 'scr'"
            )
        several = is_several(track) or is_several(car, "car")
        if self.picture == "game" and several:
            raise InvalidOption("picture 'game' is for one track and one car, not for a list")
        named = opponents if isinstance(opponents, (list, tuple)) else ()
        guests = guests_of(named, find_game()) if named else []
        if self.picture == "game" and guests:
            raise InvalidOption(
                f"picture 'game' is for races against robots, and '{guests[0]}' is an agent; use "
                "picture 'above'"
            )
        if guests and backend != "native":
            try:
                find_game().parse_robot(guests[0])
            except UnknownRobot as error:
                only = "agents are opponents with backend 'native' only"
                raise UnknownRobot(f"{error}; {only}") from None
        if backend != "native" or several or guests:
            self.metadata = RacingEnv.metadata  # without "game", which would be refused
        if picture == "game":
            self.metadata = {**self.metadata, "render_modes": ["rgb_array", "game"]}
        if self.picture == "game":
            one: Any = track
            game = find_game()
            find_scenery(game, find_track(one, game).path)
        super().__init__(
            _world(
                backend,
                track,
                car,
                sensor_noise=sensor_noise,
                address={"host": host, "port": port},
                guests=bool(guests),
                action_repeat=action_repeat,
                range_finders=range_finders,
                gearbox=used_gearbox(gearbox, action),
                opponents=opponents,
                laps=laps,
                grid_place=grid_place,
            ),
            action=action,
            sensors=sensors,
            reward=reward,
            action_repeat=action_repeat,
            start=start,
            laps=laps,
            runoff=runoff,
            recovery=recovery,
            unstick=unstick,
            keep_distance=keep_distance,
            keep_clear=keep_clear,
            catch_slides=catch_slides,
            delay=delay,
            grip=grip,
            mass=mass,
            render_mode=render_mode,
        )

    def render(self) -> npt.NDArray[np.uint8] | None:
        """
        Draw the present moment: the road and the car from above, or the game's own picture.

        :return: (height, width, 3) of red, green and blue; ``None`` in the mode ``"human"``
        :raises DisplayUnavailable: if the game has no display to draw at
        :raises GameFailed: if the game that draws has ended; the next picture starts it again
        :raises GameTimeout: if that game hangs; the next picture starts it again
        """
        if self.picture != "game" or self.render_mode is None:
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


def _world(
    backend: BackendName,
    track: Any,
    car: Any,
    *,
    sensor_noise: bool,
    address: Mapping[str, Any],
    guests: bool,
    action_repeat: int,
    **options: Any,
) -> Backend:
    """
    Make the backend.

    :param backend: as of :class:`TorcsEnv`
    :param track: as there
    :param car: as there
    :param sensor_noise: as there
    :param address: host and port, as there
    :param guests: whether there are agents among the opponents
    :param action_repeat: as there
    :param options: that all worlds have
    :raises InvalidOption: if an option is for another world
    """
    checked_flag("sensor_noise", sensor_noise)
    if backend == "scr":
        if sensor_noise:
            raise InvalidOption(
                "sensor_noise is for backend 'native'; an SCR server adds noise of its own if it "
                "is started with -noisy"
            )
        for name, choice in (("track", track), ("car", car)):
            if is_several(choice, name):
                raise InvalidOption(
                    f"{name} is {choice!r}; a game of backend 'scr' has one {name}, backend "
                    "'native' takes several"
                )
        return ScrBackend(track, car=car, **options, **address)
    for name, value in address.items():
        if value is not None:
            raise InvalidOption(
                f"{name} is {value!r}, which is for an SCR server; add backend='scr'"
            )

    if guests:
        opponents, grid_place = options.pop("opponents"), options.pop("grid_place")
        race = make_shared_race(
            1, track, car, opponents, grid_place, sensor_noise=sensor_noise,
            action_repeat=action_repeat, **options,
        )  # fmt: skip
        world: Any = LoneSeat(race, 0)  # whose track and car may not be set
        return world
    make = partial(NativeBackend, sensor_noise=sensor_noise, **options)
    return one_or_several(make, track, car)


def _picture(picture: PictureName, render_mode: GameRenderMode | None) -> PictureName:
    """
    Check the choice of a picture.

    :param picture: as of :class:`TorcsEnv`
    :param render_mode: as there
    :return: one of :data:`PICTURES`
    :raises InvalidOption: if there is no such picture, or not in this mode
    """
    checked_choice("picture", picture, PICTURES)
    if picture == "game" and render_mode == "human":
        raise InvalidOption(
            "picture 'game' is for render_mode 'rgb_array'; `sb3-torcs watch` shows the game's "
            "own window"
        )
    return "game" if render_mode == "game" else picture


def _window(size: Any, view: Any, boards: Any, picture: str) -> Window:
    """
    Check the options of the game's picture.

    :param size: width and height [pixels]
    :param view: where the camera is
    :param boards: whether lap times and such are drawn over the picture
    :param picture: that is drawn
    :return: the window that the game would show
    :raises InvalidOption: if the game cannot draw this, or another picture is chosen
    """
    is_pair = isinstance(size, (list, tuple, np.ndarray)) and len(size) == 2
    if not is_pair or not all(map(is_count, size)):
        raise InvalidOption(
            f"render_size is {size!r}; expected width and height in pixels, e.g. (640, 480)"
        )
    checked_flag("boards", boards)
    window = Window((int(size[0]), int(size[1])), view, boards=bool(boards))
    for name, given, usual in (("view", view, Window.view), ("boards", boards, Window.boards)):
        if picture != "game" and given != usual:
            raise InvalidOption(
                f"{name} is {given!r}, which is for the game's picture; add picture='game'"
            )
    return window
