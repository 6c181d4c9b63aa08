"""``TorcsLite-v0``: the racing environment with no TORCS installed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from sb3_torcs.backends.base import Backend
from sb3_torcs.backends.lite import LiteBackend
from sb3_torcs.backends.several import SeveralTracks, is_several
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.errors import InvalidOption
from sb3_torcs.tracks import Track

__all__ = ["TorcsLiteEnv"]


class TorcsLiteEnv(RacingEnv):
    """
    A planar ``car1-trb1`` on a TORCS track, with no TORCS installed.

    Action space
        ``Box([-1, 0, 0], [1, 1, 1], (3,), float32)``: steering (1 is full lock to the left),
        throttle, brake. What lies outside is clipped; NaN is an error. The gearbox is automatic.

    Observation space
        ``Box(29,), float32``: the 29 numbers of the original post, scaled as there;
        :data:`sb3_torcs.sensors.SENSORS` is the table.

    Rewards
        See :data:`sb3_torcs.rewards.PRESETS`; ``info["reward_terms"]`` sums to the reward.

    Starting state
        ``"grid"``: standing on the first place of the grid. ``"random"``: anywhere, moving.
        ``reset(options={"distance": 100.0, "speed": 20.0})`` puts the car where one wants it.

    Episode end
        Terminated: ``"off_track"`` (the mass centre leaves the road), ``"backwards"`` (more than
        90 degrees off its direction), ``"stuck"`` (1.5 s below 5 km/h), ``"damage"`` (10,000
        points). Truncated: ``"laps"`` driven, or the time limit of the registration.
        ``info["end"]`` says which.

    Units are SI and radians; left is positive.

    :param track: ``"aalborg"``, ``"road/aalborg"``, the path of a track file, a ``Track``, or
        ``"random"`` for a new closed track each episode, drawn from the seed; or a list: each
        episode is on one of them
    :param car: ``"car1-trb1"``
    :param reward: ``"progress"``, ``"blog"``, ``"apex"``, or a dict of weights
    :param action_repeat: control ticks of 0.02 s per decision
    :param range_finders: ``"scr"``, ``"narrow"``, or 19 angles in degrees, left to right
    :param start: ``"grid"`` or ``"random"``
    :param laps: whole laps after which the episode is truncated; ``None`` drives on
    :param render_mode: ``"rgb_array"`` or ``"human"``
    """

    def __init__(
        self,
        *,
        track: str | Path | Track | Sequence[str | Path | Track] = "aalborg",
        car: str = "car1-trb1",
        reward: str | Mapping[str, float] = "progress",
        action_repeat: int = 5,
        range_finders: str | Sequence[float] = "scr",
        start: str = "grid",
        laps: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode == "game":
            raise InvalidOption(
                "render_mode is 'game', which draws the game's own picture: that is for Torcs-v0; "
                "expected None, 'rgb_array' or 'human'"
            )
        make: Callable[[Any], Backend] = partial(LiteBackend, car=car, range_finders=range_finders)
        super().__init__(
            SeveralTracks(map(make, track)) if is_several(track) else make(track),
            reward=reward,
            action_repeat=action_repeat,
            start=start,
            laps=laps,
            render_mode=render_mode,
        )
