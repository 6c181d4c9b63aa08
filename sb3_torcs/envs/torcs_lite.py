"""``TorcsLite-v0``: the racing environment with no TORCS installed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

from sb3_torcs.actions import ActionName, GearboxName, used_gearbox
from sb3_torcs.backends.lite.backend import LiteBackend
from sb3_torcs.backends.several import one_or_several
from sb3_torcs.car import DEFAULT_CAR, RangeFinderName, StartName
from sb3_torcs.envs.racing import RacingEnv, RenderMode
from sb3_torcs.errors import InvalidOption, keywords_of, unknown_argument
from sb3_torcs.rewards import RewardChoice
from sb3_torcs.sensors import SensorsName
from sb3_torcs.tracks.track import Track

__all__ = ["OF_THE_GAME", "TorcsLiteEnv"]

OF_THE_GAME = (
    "backend",
    "opponents",
    "grid_place",
    "sensor_noise",
    "mass",
    "view",
    "boards",
    "render_size",
    "host",
    "port",
)
"""Options that only ``Torcs-v0`` has."""


class TorcsLiteEnv(RacingEnv):
    """
    A planar ``car1-trb1`` on a TORCS track, with no TORCS installed.

    Action space
        ``Box([-1, 0, 0], [1, 1, 1], (3,), float32)``: steering (1 is full lock to the left),
        throttle, brake. With ``action="pedal"``, ``Box(-1, 1, (2,), float32)``: steering, and one
        pedal that is throttle above 0 and brake below. With ``action="manual"`` gear and clutch
        come after the first three. Values outside their range are clipped; NaN is an error.

    Observation space
        ``Box(29,), float32``: the 29 numbers of the original post, scaled as there;
        :data:`sb3_torcs.sensors.SENSORS` is the table.

    Rewards
        See :data:`sb3_torcs.rewards.PRESETS`; ``info["reward_terms"]`` sums to the reward.

    Starting state
        ``"grid"``: standing in the first grid slot. ``"random"``: anywhere, moving, and one
        time in ten on the grid.
        ``reset(options={"distance": 100.0, "speed": 20.0})`` starts at a given point.

    Episode end
        Terminated: ``"off_track"`` (the mass centre is more than ``runoff`` beside the road),
        ``"backwards"`` (more than 90 degrees off its direction, without ``recovery``), ``"stuck"``
        (below 5 km/h for 1.5 s; 3 s after a standing start), ``"damage"`` (10,000 points),
        ``"lost"`` (the car has no position any more).
        Truncated: ``"laps"`` driven, or the time limit of the registration. ``info["end"]`` says
        which.

    Units are SI and radians; left is positive.

    :param track: ``"aalborg"``, ``"road/aalborg"``, the path of a track file, a ``Track``, or
        ``"random"`` for a new closed track each episode, drawn from the seed; or a list: each
        episode is on one of them
    :param car: ``"car1-trb1"``
    :param reward: ``"progress"``, ``"blog"``, ``"apex"``, or a dict of weights
    :param action_repeat: control ticks of 0.02 s per timestep
    :param range_finders: ``"scr"``, ``"narrow"``, or 19 angles in degrees, left to right
    :param sensors: groups of sensors in an observation: ``"base"``, the 29 numbers, and any of
        ``"preview"``, the road ahead, ``"limits"``, the speeds that it allows, ``"line"``, the
        racing line, ``"opponents"``, and ``"motion"``, how the car turns and jumps
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
    :param keep_distance: ``False``; there are no other cars here
    :param keep_clear: ``False``; there are no other cars here
    :param catch_slides: whether a car that slides steers against it by itself, before it spins
    :param delay: control ticks of 0.02 s from an observation until the controls that answer it
        arrive; or a pair, e.g. ``(0, 5)``, between which each episode draws
    :param grip: factor on the friction of all ground; or a pair, e.g. ``(0.8, 1.1)``, between which
        each episode draws
    :param render_mode: ``"rgb_array"`` or ``"human"``
    :param picture: ``"above"``
    :param of_the_game: options of ``Torcs-v0`` alone, which are refused by name
    """

    def __init__(
        self,
        *,
        track: str | Path | Track | Sequence[str | Path | Track] = "aalborg",
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
        render_mode: RenderMode | None = None,
        picture: Literal["above"] = "above",
        **of_the_game: Any,
    ) -> None:
        drawn: dict[str, str | None] = {"picture": picture, "render_mode": render_mode}
        for name, choice in drawn.items():
            if isinstance(choice, str) and choice == "game":
                raise InvalidOption(
                    f"{name} is 'game', which needs the installed game, so it is for Torcs-v0; "
                    "TorcsLite-v0 has render_mode 'rgb_array' or 'human' with picture 'above'"
                )
        if not isinstance(picture, str) or picture != "above":
            raise InvalidOption(f"picture is {picture!r}; expected 'above'")
        _refuse(of_the_game)

        box = used_gearbox(gearbox, action)
        make = partial(LiteBackend, range_finders=range_finders, gearbox=box)
        super().__init__(
            one_or_several(make, track, car),
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
            render_mode=render_mode,
        )


def _refuse(options: Mapping[str, Any]) -> None:
    """
    Refuse unknown options.

    :param options: that this world does not have
    :raises InvalidOption: if one of them is for the real game
    :raises TypeError: if one of them is for neither
    """
    for name, value in options.items():
        if name not in OF_THE_GAME:
            raise unknown_argument("TorcsLiteEnv", name, keywords_of(TorcsLiteEnv))
        raise InvalidOption(
            f"{name} is {value!r}, which needs the installed game, so it is for Torcs-v0; leave it "
            "out for TorcsLite-v0"
        )
