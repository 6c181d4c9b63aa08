"""``Torcs-v0``: the racing environment on the real game."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from sb3_torcs.backends.native import NativeBackend
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.errors import InvalidOption

__all__ = ["TorcsEnv"]

BACKENDS = ("native",)


class TorcsEnv(RacingEnv):
    """
    A car of the real TORCS, alone or among its robots, in this process.

    Action space, observation space, rewards, starting states and the end of an episode are those
    of :class:`~sb3_torcs.envs.torcs_lite.TorcsLiteEnv`. What differs is the world: the game's own
    physics with fuel, damage, walls and slopes, and its rules; laps with a cut corner or a touched
    wall do not count as ``best_lap_time``.

    With ``opponents`` the race is the game's "quick race". A start elsewhere than on the grid
    moves the whole field along the road, at the agent's speed.

    Units are SI and radians; left is positive.

    :param track: ``"aalborg"``, ``"road/aalborg"``, or the path of a TORCS XML file
    :param car: any of the game's, e.g. ``"car1-trb1"``
    :param reward: ``"progress"``, ``"blog"``, ``"apex"``, or a dict of weights
    :param action_repeat: control ticks of 0.02 s per decision
    :param range_finders: ``"scr"``, ``"narrow"``, or 19 angles in degrees, left to right
    :param start: ``"grid"`` or ``"random"``
    :param laps: whole laps after which the episode is truncated; ``None`` drives on
    :param render_mode: ``"rgb_array"`` or ``"human"``, from above
    :param backend: ``"native"``, the game in this process
    :param opponents: robots of the game, e.g. ``("inferno", "berniw:3")``
    :param grid_place: of the agent on the grid, 1 in front; ``None`` is behind all opponents
    :param sensor_noise: range finders and opponent sensors err by 10 % and 2 %, as those of the
        SCR server's ``-noisy``
    :raises BackendUnavailable: if the game or the extension is missing, or not as expected
    """

    def __init__(
        self,
        *,
        track: str | Path = "aalborg",
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
    ) -> None:
        if backend not in BACKENDS:
            raise InvalidOption(f"backend is {backend!r}; expected {' or '.join(BACKENDS)}")
        super().__init__(
            NativeBackend(
                track,
                car=car,
                range_finders=range_finders,
                opponents=opponents,
                laps=laps,
                grid_place=grid_place,
                sensor_noise=sensor_noise,
            ),
            reward=reward,
            action_repeat=action_repeat,
            start=start,
            laps=laps,
            render_mode=render_mode,
        )
