"""The messages of the SCR protocol between the game and its clients, without sockets.

Functions turn bytes into records and back. The records are in SI units: the
protocol's km/h, degrees and "rpm", which are ten times rad/s, stay in this file. After the manual
of the Simulated Car Racing championship (arXiv:1304.1672) and the messages of its server.

A message is a row of ``(tag number ...)``, perhaps with a zero byte and anything behind it. Tags
come in any order, unknown ones are passed over, and what is missing has the default of its record.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from operator import itemgetter
from typing import Any, NamedTuple

from sb3_torcs.car import KMH, FloatArray, Start
from sb3_torcs.errors import MessageBroken
from sb3_torcs.sensors import SCR_RPM

__all__ = [
    "IDENTIFIED",
    "LONGEST_NAME",
    "NO_FOCUS",
    "RESTART",
    "SHUTDOWN",
    "MotorReading",
    "ScrAction",
    "ScrInit",
    "ScrState",
    "format_action",
    "format_init",
    "format_state",
    "parse_action",
    "parse_init",
    "parse_motor",
    "parse_state",
    "plain_name",
]

IDENTIFIED = b"***identified***"
"""The server's answer to the first message of a client."""
RESTART = b"***restart***"
"""The server's answer to the request to begin the race anew."""
SHUTDOWN = b"***shutdown***"
"""The server's last word: the race is over."""

NO_FOCUS = 360.0  # [degrees] outside the range of any server
CLIENT = b"SCR"  # beginning of a client's first message; servers check no more of it
DIGITS = 6  # of the server's numbers
EXACT_DIGITS = 17  # that identify a double
HIGHEST_GEAR = 8  # the game has room for no more
LONGEST_NAME = 31  # [characters] of a driver, in the game


class ScrState(NamedTuple):
    """The sensors of a driver, in the order of the server's message."""

    heading_error: float = 0.0  # [rad] road direction minus yaw
    lap_time: float = 0.0  # [s] in the current lap; negative during the countdown
    damage: float = 0.0  # [points]
    distance_from_start: float = 0.0  # [m] along the axis
    distance_raced: float = 0.0  # [m]
    fuel: float = 0.0  # [l]
    gear: int = 0  # [-] -1 reverse, 0 neutral
    last_lap_time: float = 0.0  # [s]
    opponents: tuple[float, ...] = (200.0,) * 36  # [m]
    race_position: int = 1
    engine_speed: float = 0.0  # [rad/s]
    speed_x: float = 0.0  # [m/s] along the car
    speed_y: float = 0.0  # [m/s] left positive
    speed_z: float = 0.0  # [m/s] upwards
    range_finders: tuple[float, ...] = (-1.0,) * 19  # [m] left to right; -1 off the road
    track_position: float = 0.0  # [-] 1 is the left edge, -1 the right edge
    wheel_speeds: tuple[float, ...] = (0.0,) * 4  # [rad/s]
    height: float = 0.0  # [m] of the mass centre above the road
    focus: tuple[float, ...] = (-1.0,) * 5  # [m] range finders in the direction asked for
    yaw_rate: float | None = None  # [rad/s] left positive; servers but ours do not tell it


class ScrAction(NamedTuple):
    """The action of a driver."""

    steering: float = 0.0  # [-] in [-1, 1], left positive
    throttle: float = 0.0  # [-] in [0, 1]
    brake: float = 0.0  # [-] in [0, 1]
    gear: int = 1  # [-] -1 reverse, 0 neutral, up to 8
    clutch: float = 0.0  # [-] in [0, 1], 1 is pressed
    focus: float | None = 0.0  # [rad] where to look, left negative; None for nowhere
    restart: bool = False  # whether to restart the race
    lap_time: float | None = None  # [s] of the state that it answers; servers but ours ignore it


class ScrInit(NamedTuple):
    """The first message of a client."""

    angles: tuple[float, ...]  # (19,) [rad] of the range finders, left negative
    start: Start | None = None  # where to begin; servers but ours ignore it
    exact: bool = False  # whether states shall have all digits and the yaw rate; as above
    name: str = ""  # of the driver; servers but ours ignore it


class MotorReading(NamedTuple):
    """The part of a state that a gearbox needs."""

    lap_time: float  # [s]
    gear: int
    engine_speed: float  # [rad/s]
    speed_x: float  # [m/s] along the car


class _Tag(NamedTuple):
    """A tag of the server's message."""

    name: bytes
    size: int  # how many numbers
    scale: float = 1.0  # from SI to the server's unit
    whole: bool = False  # a whole number


_TAGS = (
    _Tag(b"angle", 1),
    _Tag(b"curLapTime", 1),
    _Tag(b"damage", 1),
    _Tag(b"distFromStart", 1),
    _Tag(b"distRaced", 1),
    _Tag(b"fuel", 1),
    _Tag(b"gear", 1, whole=True),
    _Tag(b"lastLapTime", 1),
    _Tag(b"opponents", 36),
    _Tag(b"racePos", 1, whole=True),
    _Tag(b"rpm", 1, SCR_RPM),
    _Tag(b"speedX", 1, KMH),
    _Tag(b"speedY", 1, KMH),
    _Tag(b"speedZ", 1, KMH),
    _Tag(b"track", 19),
    _Tag(b"trackPos", 1),
    _Tag(b"wheelSpinVel", 4),
    _Tag(b"z", 1),
    _Tag(b"focus", 5),
)
_YAW_RATE = _Tag(b"yawRate", 1)  # what our server adds for our client
_ALL_TAGS = (*_TAGS, _YAW_RATE)
_BY_NAME = {tag.name: (place, tag) for place, tag in enumerate(_ALL_TAGS)}

# Positions of the words in a message in the server's order, so that no search is needed.
_BEGINS = [sum(1 + tag.size for tag in _TAGS[:place]) for place in range(len(_TAGS) + 1)]
_WORDS = _BEGINS.pop()
_NAMES: tuple[bytes, ...] = tuple(b"(" + tag.name for tag in _TAGS)
_pick_names = itemgetter(*_BEGINS)
_pick_numbers = itemgetter(*(word for word in range(_WORDS) if word not in _BEGINS))

_YAW_RATE_BEGINS = b"(" + _YAW_RATE.name + b" "
_GROUP = re.compile(rb"\s*\(([^()]*)\)")
_STRANGE = re.compile(r"[^A-Za-z0-9_.:+@ -]")
_SPACE = re.compile(rb"\s*")
_ENGINE = (b"(curLapTime ", b"(gear ", b"(rpm ", b"(speedX ")


# ---- From the server -----------------------------------------------------------------------------


def parse_state(message: bytes) -> ScrState:
    """
    Read a state of the server.

    :param message: a datagram
    :return: the state
    :raises MessageBroken: if it is not a row of tags, if a tag has the wrong number of values or
        comes twice, or if a value is not a finite number
    """
    text = message.partition(b"\0")[0]
    ordered = _parse_ordered(text)
    if ordered is not None:
        return ordered
    found: dict[str, Any] = {}
    for name, words in _groups(text):
        if name in _BY_NAME:
            place, tag = _BY_NAME[name]
            found[ScrState._fields[place]] = _value(tag, words)
    return ScrState(**found)


def parse_motor(message: bytes) -> MotorReading:
    """
    Read only the values that a gearbox needs, for the states between two timesteps.

    :param message: as of :func:`parse_state`
    :return: a part of the state
    :raises MessageBroken: if one of these numbers is none
    """
    end = message.find(b"\0")
    with suppress(ValueError):  # the general way gives the precise error
        words = []
        for opening in _ENGINE:
            begin = message.index(opening, 0, end) + len(opening)
            words.append(message[begin : message.index(b")", begin)])
        lap_time, gear, revs, speed = map(float, words)
        if math.isfinite(lap_time + revs + speed) and gear.is_integer() and b"_" not in message:
            return MotorReading(lap_time, int(gear), revs / SCR_RPM, speed / KMH)
    state = parse_state(message)
    return MotorReading(state.lap_time, state.gear, state.engine_speed, state.speed_x)


def format_state(state: ScrState) -> bytes:
    """
    Write a state as the server does: six significant digits, a zero byte at the end.

    :param state: finite numbers
    :return: a datagram
    """
    groups = []
    for tag, value in zip(_ALL_TAGS, state, strict=True):
        if value is None:  # the yaw rate
            continue
        numbers = value if isinstance(value, tuple) else (value,)
        words = " ".join(f"{number * tag.scale:g}" for number in numbers)
        groups.append(f"({tag.name.decode()} {words})")
    return "".join(groups).encode() + b"\0"


# ---- From the client -----------------------------------------------------------------------------


def format_init(
    angles: FloatArray | Sequence[float],
    start: Start | None = None,
    exact: bool = False,
    name: str = "",
) -> bytes:
    """
    Write the first message of a client.

    :param angles: (19,) of the range finders [rad], left negative
    :param start: where to begin, if not on the grid; only our own server does that
    :param exact: ask for all digits, not six, and for the yaw rate; only our own server does that
    :param name: of the driver, for boards and results; only our own server shows it
    :return: a datagram
    """
    words = " ".join(f"{math.degrees(angle):.12g}" for angle in angles)
    where = "" if start is None else " (start {!r} {!r} {!r} {!r})".format(*map(float, start))
    digits = f" (digits {EXACT_DIGITS})" if exact else ""
    own = f" (name {plain_name(name)})" if name else ""
    return f"SCR(init {words}){where}{digits}{own}".encode() + b"\0"


def plain_name(name: str) -> str:
    """
    Write a driver's name with characters that the game can draw.

    :param name: any text
    :return: at most 31 letters, digits, spaces and ``-_.:+@``; others become ``_``
    """
    return _STRANGE.sub("_", " ".join(name.split()))[:LONGEST_NAME].strip()


def parse_init(message: bytes) -> ScrInit:
    """
    Read the first message of a client.

    :param message: a datagram
    :return: its options; the default angles are those of the championship, every 10 degrees
    :raises MessageBroken: if it is none, or has numbers that are none
    """
    if not message.startswith(CLIENT):
        raise _broken("expected SCR(init ...)", message)
    _, opening, text = message.partition(b"\0")[0].partition(b"(")
    degrees: Sequence[float] = range(-90, 91, 10)
    start, exact, own = None, False, ""
    for name, words in _groups(opening + text) if opening else ():
        if name == b"init" and words:
            degrees = _numbers(name, words, 19)
        elif name == b"start":
            start = Start(*_numbers(name, words, 4))
        elif name == b"digits":
            exact = _numbers(name, words, 1)[0] > DIGITS
        elif name == b"name":
            own = plain_name(b" ".join(words).decode(errors="replace"))
    return ScrInit(tuple(map(math.radians, degrees)), start, exact, own)


def format_action(action: ScrAction) -> bytes:
    """
    Write an action with all digits, so that the server gets the same numbers.

    :param action: finite numbers
    :return: a datagram
    """
    gear, focus, restart, lap_time = action.gear, action.focus, action.restart, action.lap_time
    # Numbers of NumPy would write more than their digits.
    steering, throttle, brake, clutch = map(float, (*action[:3], action.clutch))
    degrees = NO_FOCUS if focus is None else math.degrees(focus)
    answers = "" if lap_time is None else f"(curLapTime {lap_time!r})"
    text = (
        f"(accel {throttle!r})(brake {brake!r})(gear {gear})(steer {steering!r})"
        f"(clutch {clutch!r})(focus {degrees:.12g})(meta {restart:d}){answers}\0"
    )
    return text.encode()


def parse_action(message: bytes) -> ScrAction:
    """
    Read an action; numbers out of range are clipped.

    Of several numbers in a tag the first one counts, since some clients ask for ``focus`` with a
    list.

    :param message: a datagram
    :return: the action
    :raises MessageBroken: if it is none, or has numbers that are none
    """
    known = {b"accel", b"brake", b"gear", b"steer", b"clutch", b"focus", b"meta", b"curLapTime"}
    found = {
        name: _numbers(name, words[:1], 1)[0]
        for name, words in _groups(message.partition(b"\0")[0])
        if name in known
    }
    degrees = found.get(b"focus", 0.0)
    return ScrAction(
        min(max(found.get(b"steer", 0.0), -1.0), 1.0),
        min(max(found.get(b"accel", 0.0), 0.0), 1.0),
        min(max(found.get(b"brake", 0.0), 0.0), 1.0),
        int(min(max(found.get(b"gear", 1.0), -1.0), float(HIGHEST_GEAR))),
        min(max(found.get(b"clutch", 0.0), 0.0), 1.0),
        math.radians(degrees) if abs(degrees) <= 90.0 else None,
        found.get(b"meta") == 1.0,
        found.get(b"curLapTime"),
    )


# ---- Tags and numbers ----------------------------------------------------------------------------


def _parse_ordered(text: bytes) -> ScrState | None:
    """
    Read a state in the server's own format, in a fifth of the time of the general way.

    :param text: without what follows a zero byte
    :return: the state; ``None`` if the format differs, or the message is broken
    """
    if b"_" in text:
        return None
    text, has_rate, rate = text.partition(_YAW_RATE_BEGINS)
    if has_rate and not rate.endswith(b")"):
        return None
    words = text[:-1].replace(b")(", b" (").split(b" ")
    if len(words) != _WORDS or _pick_names(words) != _NAMES:
        return None
    tags = len(_TAGS)
    brackets = text.endswith(b")") and text.count(b")(") == tags - 1
    if not brackets or text.count(b"(") != tags or text.count(b")") != tags:
        return None
    try:
        n = tuple(map(float, _pick_numbers(words)))
        yaw_rate = float(rate[:-1]) if has_rate else None
    except ValueError:
        return None
    gear, position = n[6], n[44]
    if not (
        math.isfinite(sum(n) + (yaw_rate or 0.0)) and gear.is_integer() and position.is_integer()
    ):
        return None
    state = (
        *n[:6], int(gear), n[7], n[8:44], int(position), n[45] / SCR_RPM,
        n[46] / KMH, n[47] / KMH, n[48] / KMH, n[49:68], n[68], n[69:73], n[73], n[74:], yaw_rate,
    )  # fmt: skip
    return tuple.__new__(ScrState, state)


def _groups(text: bytes) -> Iterator[tuple[bytes, list[bytes]]]:
    """
    Split a message into tags.

    :param text: without what follows a zero byte
    :return: tags, each with its words
    """
    seen = set()
    place = 0
    while group := _GROUP.match(text, place):
        place = group.end()
        name, *words = group[1].split() or (b"",)
        if name in seen:
            raise _broken(f"says {name.decode(errors='replace')} twice", text)
        seen.add(name)
        yield name, words
    if not seen or _SPACE.fullmatch(text, place) is None:
        raise _broken(f"expected (tag numbers) at character {place}", text)


def _value(tag: _Tag, words: list[bytes]) -> Any:
    """
    Read the numbers of a tag, and turn them into SI units.

    :param tag: of the server's message
    :param words: that follow it
    :return: a number, or a tuple of them
    """
    numbers = _numbers(tag.name, words, tag.size)
    if tag.size > 1:
        return numbers
    if tag.whole:
        if not numbers[0].is_integer():
            raise _broken(f"{tag.name.decode()} is no whole number", words[0])
        return int(numbers[0])
    return numbers[0] / tag.scale


def _numbers(name: bytes, words: list[bytes], size: int) -> tuple[float, ...]:
    """
    Read the numbers of a tag.

    :param name: of the tag
    :param words: that follow it
    :param size: how many there have to be
    :return: the numbers
    """
    try:
        numbers = tuple(map(float, words))
    except ValueError:
        raise _broken(f"{name.decode()} is no number", b" ".join(words)) from None
    if len(numbers) != size:
        raise _broken(f"{name.decode()} has {len(numbers)} numbers, not {size}", b" ".join(words))
    # An underscore between digits is Python's, not the protocol's.
    if not all(map(math.isfinite, numbers)) or any(b"_" in word for word in words):
        raise _broken(f"{name.decode()} is no finite number", b" ".join(words))
    return numbers


def _broken(what: str, text: bytes) -> MessageBroken:
    """Build the error."""
    shown = text[:60] + (b"..." if len(text) > 60 else b"")
    return MessageBroken(f"a message of the SCR protocol {what}: {shown!r}")
