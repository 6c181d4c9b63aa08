"""``Torcs-v0``: the racing environment on the real game."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_torcs.backends.base import Backend
from sb3_torcs.backends.native import NativeBackend
from sb3_torcs.backends.scr import ScrBackend
from sb3_torcs.backends.several import SeveralTracks, is_several
from sb3_torcs.car import is_count
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.errors import EnvClosed, InvalidOption
from sb3_torcs.game import find_game

__all__ = ["TorcsEnv"]

BACKENDS = ("native", "scr")


class TorcsEnv(RacingEnv):
    """
    A car of the real TORCS, alone or among its robots, in this process or in one of its own.

    Action space, observation space, rewards, starting states and the end of an episode are those
    of :class:`~sb3_torcs.envs.torcs_lite.TorcsLiteEnv`. What differs is the world: the game's own
    physics with fuel, damage, walls and slopes, and its rules; laps with a cut corner or a touched
    wall do not count as ``best_lap_time``.

    With ``opponents`` the race is the game's "quick race". A start elsewhere than on the grid
    moves the whole field along the road, at the agent's speed.

    With ``backend="scr"`` the game runs in a process of its own and tells what its sensors read by
    the protocol of the Simulated Car Racing championship: the same drive, in six digits, and
    slower. With ``host`` it is a game that somebody else has started.

    Units are SI and radians; left is positive.

    :param track: ``"aalborg"``, ``"road/aalborg"``, or the path of a TORCS XML file; or a list of
        them: each episode is on one, drawn from the seed
    :param car: any of the game's, e.g. ``"car1-trb1"``
    :param reward: ``"progress"``, ``"blog"``, ``"apex"``, or a dict of weights
    :param action_repeat: control ticks of 0.02 s per decision
    :param range_finders: ``"scr"``, ``"narrow"``, or 19 angles in degrees, left to right
    :param start: ``"grid"`` or ``"random"``
    :param laps: whole laps after which the episode is truncated; ``None`` drives on
    :param render_mode: ``"rgb_array"`` or ``"human"``, from above; or ``"game"``, the game's own
        picture from behind the car as an ``rgb_array``, which needs Xvfb
    :param render_size: width and height of the game's picture [pixels]
    :param backend: ``"native"``, the game in this process, or ``"scr"``
    :param opponents: robots of the game, e.g. ``("inferno", "berniw:3")``
    :param grid_place: of the agent on the grid, 1 in front; ``None`` is behind all opponents
    :param sensor_noise: range finders and opponent sensors err by 10 % and 2 %, as those of the
        SCR server's ``-noisy``; not with ``"scr"``
    :param host: of an SCR server that runs already, in the race that it has and without starts
        elsewhere than on the grid; ``None`` starts a game where ``"scr"`` needs one
    :param port: of the driver there; ``None`` is 3001, the first one
    :raises BackendUnavailable: if the game or the extension is missing, or not as expected
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        **RacingEnv.metadata,
        "render_modes": [*RacingEnv.metadata["render_modes"], "game"],
    }

    def __init__(
        self,
        *,
        track: str | Path | Sequence[str | Path] = "aalborg",
        car: str = "car1-trb1",
        reward: str | Mapping[str, float] = "progress",
        action_repeat: int = 5,
        range_finders: str | Sequence[float] = "scr",
        start: str = "grid",
        laps: int | None = None,
        render_mode: str | None = None,
        backend: str = "native",
        opponents: Sequence[str] = (),
        grid_place: int | None = None,
        sensor_noise: bool = False,
        render_size: tuple[int, int] = (640, 480),
        host: str | None = None,
        port: int | None = None,
    ) -> None:
        if backend not in BACKENDS:
            raise InvalidOption(f"backend is {backend!r}; expected {' or '.join(BACKENDS)}")
        if render_mode == "game" and backend != "native":
            raise InvalidOption(
                "render_mode 'game' is for backend 'native'; `sb3-torcs serve --window` shows "
                "the game of backend 'scr'"
            )
        if render_mode == "game" and is_several(track):
            raise InvalidOption("render_mode 'game' is for one track; give one, not a list")
        if backend != "native":
            self.metadata = RacingEnv.metadata
        self.render_size = _size(render_size)
        super().__init__(
            _world(
                backend,
                track,
                sensor_noise=sensor_noise,
                address={"host": host, "port": port},
                car=car,
                range_finders=range_finders,
                opponents=opponents,
                laps=laps,
                grid_place=grid_place,
            ),
            reward=reward,
            action_repeat=action_repeat,
            start=start,
            laps=laps,
            render_mode=render_mode,
        )

    def render(self) -> npt.NDArray[np.uint8] | None:
        """
        Draw the present moment: the road and the car from above, or the game's own picture.

        :return: (height, width, 3) in the modes ``"rgb_array"`` and ``"game"``, else ``None``
        :raises DisplayUnavailable: if the game has no display to draw at
        :raises GameFailed: if the game that draws has ended; the next picture starts another
        :raises GameTimeout: if it hangs; the same holds
        """
        if self.render_mode != "game":
            return super().render()
        if self._closed or self.car is None:
            when = "after close" if self._closed else "before reset; call reset first"
            raise EnvClosed(f"render {when}")
        assert isinstance(self.backend, NativeBackend), "the constructor refuses others"
        appearance = self.backend.engine.appearance()
        if self._viewer is None:
            from sb3_torcs.game_view import GameView  # loaded only when somebody looks

            self._viewer = GameView(find_game(), self.backend.race_setup(), self.render_size)
        try:
            frame: npt.NDArray[np.uint8] = self._viewer.frame(appearance)
        except BaseException:  # also Ctrl-C: the picture that was asked for may still come
            self._viewer.close()
            self._viewer = None
            raise
        return frame


def _world(
    backend: str, track: Any, *, sensor_noise: bool, address: Mapping[str, Any], **options: Any
) -> Backend:
    """
    Make the world that was chosen.

    :param backend: as of :class:`TorcsEnv`
    :param track: as there
    :param sensor_noise: as there
    :param address: host and port, as there
    :param options: that all worlds have
    :raises InvalidOption: if an option is for another world
    """
    if backend == "scr":
        if sensor_noise:
            raise InvalidOption(
                "sensor_noise is for backend 'native'; an SCR server adds noise of its own if it "
                "is started with -noisy"
            )
        if is_several(track):
            raise InvalidOption(
                f"track is {track!r}; a game of backend 'scr' has one track, backend 'native' "
                "takes several"
            )
        return ScrBackend(track, **options, **address)
    for name, value in address.items():
        if value is not None:
            raise InvalidOption(f"{name} is {value!r}, for no server; add backend='scr'")
    make: Callable[[Any], Backend] = partial(NativeBackend, **options, sensor_noise=sensor_noise)
    return SeveralTracks(map(make, track)) if is_several(track) else make(track)


def _size(size: Any) -> tuple[int, int]:
    """
    Check the size of pictures.

    :param size: what was asked for
    :return: width and height [pixels]
    """
    from sb3_torcs.game_window import Window

    if isinstance(size, str) or np.shape(size) != (2,) or not all(map(is_count, size)):
        raise InvalidOption(
            f"render_size is {size!r}; expected width and height in pixels, e.g. (640, 480)"
        )
    return Window((int(size[0]), int(size[1]))).size
