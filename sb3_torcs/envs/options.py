"""The keyword arguments of the environments, in one table for each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypedDict, get_args

import numpy as np

from sb3_torcs.actions import ActionName, GearboxName
from sb3_torcs.car import (
    DEFAULT_CAR,
    RangeFinderName,
    StartName,
    checked_choice,
    checked_delay,
    checked_factor,
    checked_flag,
    checked_from_zero,
    checked_laps,
    checked_start,
    is_count,
)
from sb3_torcs.envs.arguments import Option, options_of, read_group
from sb3_torcs.errors import InvalidOption, near_miss
from sb3_torcs.rewards import RewardChoice
from sb3_torcs.sensors import SensorsName
from sb3_torcs.torcs.window import VIEWS, ViewName
from sb3_torcs.tracks.track import Track

__all__ = [
    "AIDS",
    "CONDITIONS",
    "ENDS",
    "LITE",
    "PICTURE",
    "RACING",
    "SCR",
    "TORCS",
    "AidName",
    "ConditionOptions",
    "EndOptions",
    "LiteOptions",
    "PictureOptions",
    "RacingOptions",
    "RenderMode",
    "ScrOptions",
    "TorcsOptions",
    "checked_aids",
    "picture_keys",
]

AidName = Literal["unstick", "keep_distance", "keep_clear", "catch_slides"]
BackendName = Literal["native", "scr"]
PictureName = Literal["above", "game"]
RenderMode = Literal["rgb_array", "human"]

AIDS: tuple[AidName, ...] = get_args(AidName)
"""The driver aids, in the order of compiled code."""

MAX_ACTION_REPEAT = 50_000  # [-] a timestep of 1,000 s
LONGEST_RECOVERY = 60.0  # [s] longer than any car needs that returns to the road at all
WIDEST_RUNOFF = 100.0  # [m] wider than any ground beside a road of the game


def _checked_runoff(name: str, value: Any) -> float:
    allowed = f"a number of metres from 0 to {WIDEST_RUNOFF:g}"
    return checked_from_zero(name, value, WIDEST_RUNOFF, allowed)


def _checked_recovery(name: str, value: Any) -> float:
    allowed = f"a number of seconds from 0 to {LONGEST_RECOVERY:g}"
    return checked_from_zero(name, value, LONGEST_RECOVERY, allowed)


def _nameless(check: Callable[[Any], Any]) -> Callable[[str, Any], Any]:
    """Let a check that knows the option's name take it."""
    return lambda _, value: check(value)


def _checked_action_repeat(name: str, value: Any) -> int:
    if not is_count(value) or value > MAX_ACTION_REPEAT:
        raise InvalidOption(
            f"{name} is {value!r}; expected a whole number from 1 to {MAX_ACTION_REPEAT}"
        )
    return int(value)


def checked_aids(name: str, value: Any) -> tuple[AidName, ...]:
    """
    Check a list of driver aids.

    :param name: of the option
    :param value: names of :data:`AIDS`
    :raises InvalidOption: if it is no such list
    """
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise InvalidOption(f"{name} is {value!r}; expected a list with any of {', '.join(AIDS)}")
    for aid in value:
        if aid not in AIDS:
            advice = f"the driver aids are {', '.join(AIDS)}"
            raise InvalidOption(f"{name} has {aid!r}{near_miss(aid, AIDS, advice)}")
    return tuple(value)


def _checked_backend(name: str, value: Any) -> str:
    return checked_choice(name, value, get_args(BackendName))


def _checked_view(name: str, value: Any) -> str:
    return checked_choice(name, value, VIEWS)


def _checked_size(name: str, value: Any) -> tuple[int, int]:
    is_pair = isinstance(value, (list, tuple, np.ndarray)) and len(value) == 2
    if not is_pair or not all(map(is_count, value)):
        raise InvalidOption(
            f"{name} is {value!r}; expected width and height in pixels, e.g. (640, 480)"
        )
    return int(value[0]), int(value[1])


def _checked_picture(name: str, value: Any) -> Any:
    if isinstance(value, Mapping):
        return read_group(name, PICTURE, value)
    return checked_choice(name, value, get_args(PictureName))


class EndOptions(TypedDict, total=False):
    """
    When an episode ends.

    :param runoff: how far the mass centre may be beside the road [m]
    :param recovery: how long a car may stand, or face backwards [s]; 0 ends the episode after 1.5 s
        of standing, 3 s after a standing start, and at once if the car faces backwards
    """

    runoff: Annotated[float, Option(0.0, _checked_runoff)]
    recovery: Annotated[float, Option(0.0, _checked_recovery)]


class ConditionOptions(TypedDict, total=False):
    """
    The conditions of an episode. Of a pair of numbers, each episode draws one between them.

    :param delay: control ticks of 0.02 s from an observation until the controls that answer it
        arrive; or a pair, e.g. ``(0, 5)``
    :param grip: factor on the friction of all ground; or a pair, e.g. ``(0.8, 1.1)``
    :param mass: factor on the mass of the agent's car; or a pair
    :param sensor_noise: range finders and opponent sensors err by 10 % and 2 %, as those of the SCR
        server's ``-noisy``
    """

    delay: Annotated[int | Sequence[int], Option(0, _nameless(checked_delay))]
    grip: Annotated[float | Sequence[float], Option(1.0, checked_factor)]
    mass: Annotated[float | Sequence[float], Option(1.0, checked_factor)]
    sensor_noise: Annotated[bool, Option(False, checked_flag)]


class PictureOptions(TypedDict, total=False):
    """
    The game's own 3D picture.

    :param view: the camera: ``"behind"``, ``"close"``, ``"far"``, ``"front"``, ``"cockpit"``,
        ``"hood"``, ``"road"``, ``"side"``, ``"above"``, ``"track"``, ``"helicopter"`` or ``"tv"``
    :param boards: whether lap times, instruments and a map are drawn over the picture
    :param size: width and height [pixels]
    """

    view: Annotated[ViewName, Option("behind", _checked_view)]
    boards: Annotated[bool, Option(True, checked_flag)]
    size: Annotated[tuple[int, int], Option((640, 480), _checked_size)]


class ScrOptions(TypedDict, total=False):
    """
    Where an SCR server runs.

    :param host: its name or address
    :param port: of the driver there; ``None`` is 3001, the first one
    """

    host: Annotated[str | None, Option(None)]
    port: Annotated[int | None, Option(None)]


ENDS, CONDITIONS, PICTURE, SCR = (
    options_of(kind) for kind in (EndOptions, ConditionOptions, PictureOptions, ScrOptions)
)


def _checked_ends(name: str, value: Any) -> dict[str, Any]:
    return read_group(name, ENDS, value)


def _checked_conditions(name: str, value: Any) -> dict[str, Any]:
    return read_group(name, CONDITIONS, value)


def _checked_scr(name: str, value: Any) -> dict[str, Any]:
    return read_group(name, SCR, value)


class WorldOptions(TypedDict, total=False):
    """
    The world of both environments.

    :param track: ``"aalborg"``, ``"road/aalborg"``, or the path of a track file; or a list of them:
        each episode is on one, drawn from the seed. In ``TorcsLite-v0`` also a ``Track``, or
        ``"random"`` for a new closed track each episode. With ``scr`` also ``None``, if it is not
        known
    :param car: any of the game's, or a list of them, as for the track; ``TorcsLite-v0`` has
        ``"car1-trb1"`` alone
    :param range_finders: ``"scr"``, ``"narrow"``, or 19 angles in degrees, left to right
    :param gearbox: ``"automatic"``, by motor speed; or ``"road_speed"``, which does not shift back
        and forth while the wheels spin, and slips the clutch to set off
    """

    track: Annotated[str | Path | Track | Sequence[str | Path | Track] | None, Option("aalborg")]
    car: Annotated[str | Sequence[str], Option(DEFAULT_CAR)]
    range_finders: Annotated[RangeFinderName | Sequence[float], Option("scr")]
    gearbox: Annotated[GearboxName, Option("automatic")]


class RacingOptions(TypedDict, total=False):
    """
    What :class:`~sb3_torcs.envs.racing.RacingEnv` takes in any world.

    :param reward: ``"progress"``, ``"blog"``, ``"apex"``, or a dict of weights
    :param action_repeat: control ticks of 0.02 s per timestep
    :param sensors: groups of sensors in an observation: ``"base"`` has the 29 numbers of the
        original post, and :mod:`sb3_torcs.sensors` lists them all
    :param action: ``"pedals"``: steering, throttle, brake; ``"pedal"``: steering and one signed
        pedal; or ``"manual"``: steering, throttle, brake, gear, clutch
    :param start: ``"grid"``; or ``"random"``: anywhere on the track, moving, and one time in ten on
        the grid
    :param laps: whole laps after which the episode is truncated; ``None`` drives on
    :param ends: when an episode ends; a dict with any keys of
        :class:`~sb3_torcs.envs.options.EndOptions`, e.g. ``{"runoff": 8.0, "recovery": 10.0}``
    :param aids: what the car does by itself: ``"unstick"``: if it is stuck across the road or
        beside it, it frees itself as the game's robots do, and ignores actions meanwhile;
        ``"keep_distance"``: it brakes where it is too close to the car ahead; ``"keep_clear"``: it
        steers away from cars beside it; ``"catch_slides"``: it steers against a slide, before it
        spins. The second and third need the backend ``"native"``
    :param conditions: delay, grip, mass and noise; a dict with any keys of
        :class:`~sb3_torcs.envs.options.ConditionOptions`, e.g. ``{"delay": 2, "grip": (0.8, 1.1)}``
    :param render_mode: ``"rgb_array"``, ``"human"`` or ``None``
    """

    reward: Annotated[RewardChoice, Option("progress")]
    action_repeat: Annotated[int, Option(5, _checked_action_repeat)]
    sensors: Annotated[Sequence[SensorsName], Option(("base",))]
    action: Annotated[ActionName, Option("pedals")]
    start: Annotated[StartName, Option("grid", _nameless(checked_start))]
    laps: Annotated[int | None, Option(None, _nameless(checked_laps))]
    ends: Annotated[EndOptions | None, Option(None, _checked_ends)]
    aids: Annotated[Sequence[AidName], Option((), checked_aids)]
    conditions: Annotated[ConditionOptions | None, Option(None, _checked_conditions)]
    render_mode: Annotated[RenderMode | None, Option(None)]


class LiteOptions(WorldOptions, RacingOptions, total=False):
    """The keyword arguments of ``TorcsLite-v0``."""


class TorcsOptions(LiteOptions, total=False):
    """
    The keyword arguments of ``Torcs-v0``: those of ``TorcsLite-v0``, and more.

    :param backend: ``"native"``, the game in this process; or ``"scr"``, the game in a process of
        its own, by the protocol of the Simulated Car Racing championship
    :param opponents: robots of the game, e.g. ``("inferno", "berniw:3")``; with ``"native"`` also
        agents, by name or path
    :param grid_place: of the agent on the grid, 1 in front; ``None`` is behind all opponents
    :param picture: of ``render_mode="rgb_array"``: ``"above"``, the road and the car from above;
        ``"game"``, the game's own 3D picture, which needs Xvfb; or a dict with any keys of
        :class:`~sb3_torcs.envs.options.PictureOptions` for the game's picture, e.g.
        ``{"view": "tv", "boards": False, "size": (320, 240)}``
    :param scr: where the server of ``backend="scr"`` runs, e.g. ``{"host": "localhost", "port":
        3001}``: its race is driven as it is, and each episode starts on the grid. With ``None`` the
        environment starts a game of its own
    """

    backend: Annotated[BackendName, Option("native", _checked_backend)]
    opponents: Annotated[Sequence[str] | Sequence[Sequence[str]], Option(())]
    grid_place: Annotated[int | Sequence[int] | None, Option(None)]
    picture: Annotated[PictureName | PictureOptions, Option("above", _checked_picture)]
    scr: Annotated[ScrOptions | None, Option(None, _checked_scr)]


RACING = options_of(RacingOptions)
LITE = {**options_of(WorldOptions), **RACING}
TORCS = {**options_of(TorcsOptions), **LITE}


def picture_keys(picture: Any) -> dict[str, Any] | None:
    """
    Resolve the option ``picture``.

    :param picture: after its check
    :return: all keys of :class:`PictureOptions`; ``None`` if it is the one from above
    """
    if picture == "above":
        return None
    return read_group("picture", PICTURE, None if picture == "game" else picture)
