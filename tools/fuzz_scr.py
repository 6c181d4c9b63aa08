"""Break messages of the SCR protocol, and check what is read against a slow, obvious reader.

A message is either refused with MessageBroken or gives the numbers that stand in it; actions give
those that the game's side reads, too. A million messages take some minutes.
"""

from __future__ import annotations

import argparse
import math
import re

import numpy as np
from rich.progress import track as progress

from sb3_torcs import _engine
from sb3_torcs.errors import MessageBroken
from sb3_torcs.scr.protocol import (
    ScrAction,
    ScrState,
    format_action,
    format_state,
    parse_action,
    parse_motor,
    parse_state,
)

NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
STATE = (  # tag, how many, from SI
    ("angle", 1, 1.0), ("curLapTime", 1, 1.0), ("damage", 1, 1.0), ("distFromStart", 1, 1.0),
    ("distRaced", 1, 1.0), ("fuel", 1, 1.0), ("gear", 1, 1.0), ("lastLapTime", 1, 1.0),
    ("opponents", 36, 1.0), ("racePos", 1, 1.0), ("rpm", 1, 10.0), ("speedX", 1, 3.6),
    ("speedY", 1, 3.6), ("speedZ", 1, 3.6), ("track", 19, 1.0), ("trackPos", 1, 1.0),
    ("wheelSpinVel", 4, 1.0), ("z", 1, 1.0), ("focus", 5, 1.0),
    ("yawRate", 1, 1.0),
)  # fmt: skip
BITS = (b"(", b")", b" ", b"\0", b"-", b".", b"e", b"_", b"nan", b"inf", b"9" * 400, b"(gear 3)",
        b")(", b"0x1", b"+", b",", b"\xff", b"(rpm ", b"1e5", b"\t")  # fmt: skip


def plain(text: bytes) -> dict[str, list[str]]:
    """Read a message character by character; raise ValueError where it is none."""
    groups: dict[str, list[str]] = {}
    inside = None
    for letter in text.decode("latin-1").split("\0")[0]:
        if inside is None:
            if letter == "(":
                inside = ""
            elif letter not in " \t\n\r\v\f":
                raise ValueError(letter)
        elif letter == "(":
            raise ValueError(letter)
        elif letter == ")":
            name, *words = re.split(r"[ \t\n\r\v\f]+", inside.strip(" \t\n\r\v\f"))
            if name in groups:
                raise ValueError(name)
            groups[name] = words
            inside = None
        else:
            inside += letter
    if inside is not None or not groups:
        raise ValueError(text)
    return groups


def plain_numbers(words: list[str], size: int) -> list[float]:
    """Turn words into numbers; raise ValueError if one is none."""
    if len(words) != size or not all(NUMBER.fullmatch(word) for word in words):
        raise ValueError(words)
    numbers = [float(word) for word in words]
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError(words)
    return numbers


def plain_state(text: bytes) -> ScrState:
    """Read a state as slowly as it takes."""
    groups = plain(text)
    values = list(ScrState())
    for place, (name, size, scale) in enumerate(STATE):
        if name in groups:
            numbers = plain_numbers(groups[name], size)
            values[place] = tuple(numbers) if size > 1 else numbers[0] / scale
            if name in ("gear", "racePos") and not numbers[0].is_integer():
                raise ValueError(name)
    return ScrState._make(values)


def check_state(text: bytes) -> bool:
    """Read a message, hold it to the slow reader, and say whether it was a state."""
    try:
        expected = plain_state(text)
    except ValueError:
        expected = None
    try:
        state = parse_state(text)
    except MessageBroken:
        assert expected is None, text
        return False
    assert expected == state, text
    read = (state.lap_time, state.gear, state.engine_speed, state.speed_x)
    assert parse_motor(text) == read, text
    return True


def check_action(text: bytes) -> bool:
    """Read a message, hold it to the server's own reader, and say whether it was an action."""
    server = _engine.scr_parse_action(text)  # which makes something of everything
    try:
        action = parse_action(text)
    except MessageBroken:
        return False
    throttle, brake, gear, steering, clutch, restart, focus, lap_time = server
    expected = ScrAction(steering, throttle, brake, gear, clutch, focus, restart, lap_time)
    assert action == expected, text
    return True


def mutations(seed: int, number: int):
    """Yield pairs of a state and an action, most of them broken somewhere."""
    chance = np.random.default_rng(seed)
    while number > 0:
        state = format_state(random_state(chance))
        action = format_action(ScrAction(*chance.uniform(-1.0, 1.0, 3), gear=2, lap_time=1.5))
        for _ in range(min(100, number)):
            number -= 1
            yield mutated(chance, state), mutated(chance, action)


def random_state(chance: np.random.Generator) -> ScrState:
    """Any numbers of any size, so that all forms of writing them come up."""

    def some(size: int):
        values = chance.normal(size=size) * 10.0 ** chance.integers(-8, 8, size)
        return tuple(values.tolist())

    values = [some(size) if size > 1 else some(1)[0] for _, size, _ in STATE]
    state = ScrState._make(values)._replace(gear=int(chance.integers(-1, 8)), race_position=1)
    return state if chance.random() < 0.5 else state._replace(yaw_rate=None)


def mutated(chance: np.random.Generator, text: bytes) -> bytes:
    """Cut, double, swap and replace parts of a message; or make up bytes."""
    kinds = chance.integers(0, 8, chance.integers(0, 4))
    for kind, first, second in zip(kinds, *chance.integers(0, len(text), (2, 3)), strict=False):
        begin, end = sorted((int(first), int(second)))
        bit = BITS[int(chance.integers(len(BITS)))]
        if kind == 0:
            text = text[:begin]
        elif kind == 1:
            text = text[:begin] + text[min(end, begin + 8) :]
        elif kind == 2:
            text = text[:begin] + bit + text[begin:]
        elif kind == 3:
            text = text[:begin] + bit + text[begin + 1 :]
        elif kind == 4:
            groups = text.split(b")(")
            order = chance.permutation(len(groups))
            text = b")(".join(groups[place] for place in order)
        elif kind == 5:
            text = text[:begin] + bytes([int(chance.integers(256))]) + text[begin + 1 :]
        elif kind == 6:
            text = text[:end] + text[begin:end] + text[end:]
        elif chance.random() < 0.1:
            text = chance.bytes(int(chance.integers(0, 60)))
    return text


def main() -> None:
    """Check as many messages as asked for; a wrong number ends it with the message."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--messages", type=int, default=1_000_000, help="states and actions")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    number = options.messages // 2
    states = actions = 0
    for state, action in progress(mutations(options.seed, number), total=number):
        states += check_state(state)
        actions += check_action(action)
    print(
        f"{2 * number} messages: {states} states and {actions} actions read, all numbers right; "
        f"{2 * number - states - actions} refused"
    )


if __name__ == "__main__":
    main()
