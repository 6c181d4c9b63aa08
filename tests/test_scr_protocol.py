"""The texts of the SCR protocol: literal ones, any ones, broken ones."""

from __future__ import annotations

import math
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_torcs import _engine
from sb3_torcs.car import Start
from sb3_torcs.errors import MessageBroken
from sb3_torcs.scr.protocol import (
    ScrAction,
    ScrState,
    format_action,
    format_init,
    format_state,
    parse_action,
    parse_init,
    parse_motor,
    parse_state,
    plain_name,
)

FUZZ = runpy.run_path(str(Path(__file__).parent.parent / "tools" / "fuzz_scr.py"))

# As a server of the championship sends it.
LITERAL = (
    b"(angle 0.00283453)(curLapTime -0.982)(damage 0)(distFromStart 2033.1)(distRaced 0)(fuel 94)"
    b"(gear 1)(lastLapTime 83.394)(opponents 200 200 200 200 200 200 200 200 200 200 200 200 200 "
    b"200 200 200 200 200 12.5 200 200 200 200 200 200 200 200 200 200 200 200 200 200 200 200 200)"
    b"(racePos 2)(rpm 942.478)(speedX 36)(speedY -3.6)(speedZ 0.00196266)(track 4.00001 4.06172 "
    b"4.25672 4.61881 5.22164 6.22291 8.00001 11.6952 23.0351 200 46.0701 23.3904 16 12.4458 "
    b"10.4433 9.23762 8.51342 8.12341 7.99999)(trackPos 0.333332)"
    b"(wheelSpinVel 67.9393 68.8267 71.4009 71.7363)(z 0.336726)"
    b"(focus -1 -1 -1 -1 -1)\x00junk(angle 1)"
)

numbers = st.floats(-1e9, 1e9, allow_nan=False)
SIZES = {"opponents": 36, "range_finders": 19, "wheel_speeds": 4, "focus": 5}
states = st.builds(
    ScrState,
    **{name: numbers for name, value in ScrState()._asdict().items() if type(value) is float},
    gear=st.integers(-1, 8),
    race_position=st.integers(1, 40),
    **{name: st.tuples(*[numbers] * size) for name, size in SIZES.items()},
    yaw_rate=st.none() | numbers,
)
units = st.floats(0.0, 1.0)
actions = st.builds(
    ScrAction,
    steering=st.floats(-1.0, 1.0),
    throttle=units,
    brake=units,
    gear=st.integers(-1, 8),
    clutch=units,
    focus=st.none() | st.integers(-90, 90).map(math.radians),
    restart=st.booleans(),
    lap_time=st.none() | numbers,
)


# ---- Literal messages ----------------------------------------------------------------------------


def test_a_literal_packet_gives_literal_numbers():
    state = parse_state(LITERAL)
    assert state.heading_error == 0.00283453
    assert state.lap_time == -0.982
    assert state.distance_from_start == 2033.1
    assert state.fuel == 94.0
    assert state.gear == 1
    assert state.last_lap_time == 83.394
    assert state.opponents == (200.0,) * 18 + (12.5,) + (200.0,) * 17
    assert state.race_position == 2
    assert state.engine_speed == 94.2478  # a tenth of what is called rpm
    assert (state.speed_x, state.speed_y) == (10.0, -1.0)  # from km/h
    assert state.range_finders[0] == 4.00001
    assert state.range_finders[9] == 200.0
    assert state.range_finders[18] == 7.99999
    assert state.track_position == 0.333332
    assert state.wheel_speeds == (67.9393, 68.8267, 71.4009, 71.7363)
    assert state.height == 0.336726
    assert state.focus == (-1.0,) * 5
    assert parse_motor(LITERAL) == (-0.982, 1, 94.2478, 10.0)


def test_a_literal_action_is_written_and_read():
    action = ScrAction(-0.25, 0.7, 0.0, 3, focus=None, lap_time=12.34)
    text = (
        b"(accel 0.7)(brake 0.0)(gear 3)(steer -0.25)(clutch 0.0)(focus 360)(meta 0)"
        b"(curLapTime 12.34)\0"
    )
    assert format_action(action) == text
    assert parse_action(text) == action


def test_a_literal_introduction_is_written_and_read():
    degrees = [-45, -19, -12, -7, -4, -2.5, -1.7, -1, -0.5, 0, 0.5, 1, 1.7, 2.5, 4, 7, 12, 19, 45]
    text = (
        b"SCR(init -45 -19 -12 -7 -4 -2.5 -1.7 -1 -0.5 0 0.5 1 1.7 2.5 4 7 12 19 45)"
        b" (start 100.5 0.25 -0.1 30.0)\0"
    )
    start = Start(100.5, 0.25, -0.1, 30.0)
    assert format_init(np.radians(degrees), start) == text
    init = parse_init(text)
    assert init.start == start
    np.testing.assert_allclose(init.angles, np.radians(degrees), rtol=1e-12)


def test_without_angles_they_are_ten_degrees_apart():
    expected = tuple(math.radians(angle) for angle in range(-90, 91, 10))
    for text in (b"SCR", b"SCR(init)", b"SCR\0", b"SCRAPHEAP"):
        assert parse_init(text) == (expected, None, False, "")


@pytest.mark.parametrize(
    ("given", "plain"),
    [
        ("ddpg-aalborg", "ddpg-aalborg"),
        ("  Ann\tOther ", "Ann Other"),
        ("Zoë (1)", "Zo_ _1_"),
        ("x" * 40, "x" * 31),
        ("", ""),
    ],
)
def test_a_name_is_written_as_the_game_can_draw_it(given, plain):
    assert plain_name(given) == plain
    assert parse_init(format_init(np.zeros(19), name=given)).name == plain


def test_tags_come_in_any_order_and_unknown_ones_are_passed_over():
    groups = LITERAL.partition(b"\0")[0][1:-1].split(b")(")
    backwards = b"(" + b") (".join([*groups[::-1], b"totalDistFromStart 12.5", b"img 1 2"]) + b")\n"
    assert parse_state(backwards) == parse_state(LITERAL)
    assert parse_motor(backwards) == parse_motor(LITERAL)


def test_what_is_missing_has_its_default():
    assert parse_state(b"(gear 2)") == ScrState(gear=2)
    assert ScrState().opponents == (200.0,) * 36
    assert ScrState().range_finders == (-1.0,) * 19
    assert parse_action(b"(steer 0.5)") == ScrAction(steering=0.5)
    assert ScrAction() == (0.0, 0.0, 0.0, 1, 0.0, 0.0, False, None)


def test_actions_out_of_range_are_clipped():
    text = b"(accel 9)(brake -1)(gear 99)(steer -7)(clutch 2)(focus -90 -45 0)(meta 2)"
    assert parse_action(text) == ScrAction(-1.0, 1.0, 0.0, 8, 1.0, math.radians(-90), False)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"(z 0.336726)", b"(z nan)", "z is no finite number: b'nan'"),
        (b"(z 0.336726)", b"(z 1e999)", "z is no finite number"),
        (b"(z 0.336726)", b"(z 0.3_3)", "z is no finite number"),
        (b"(z 0.336726)", b"(z 0,336)", "z is no number"),
        (b"(z 0.336726)", b"(z)", "z has 0 numbers, not 1"),
        (b"(z 0.336726)", b"(z 1 2)", "z has 2 numbers, not 1"),
        (b"(z 0.336726)", b"(z 1)(z 2)", "says z twice"),
        (b"(z 0.336726)", b"(z 1", r"expected \(tag numbers\) at character"),
        (b"(z 0.336726)", b"z 1)", "expected"),
        (b"(gear 1)", b"(gear 1.5)", "gear is no whole number"),
        (b" 71.7363)", b")", "wheelSpinVel has 3 numbers, not 4"),
        (LITERAL, b"", "expected"),
        (LITERAL, b"***identified***\0", "expected"),
    ],
)
def test_a_broken_state_is_told(old, new, message):
    assert old in LITERAL
    with pytest.raises(MessageBroken, match=message):
        parse_state(LITERAL.replace(old, new))


@pytest.mark.parametrize("text", [b"nan", b"inf", b"x", b"", b"1 2", b"0_1", b"(1"])
def test_a_broken_yaw_rate_is_told(text):
    whole = LITERAL.partition(b"\0")[0] + b"(yawRate 0.5)"
    assert parse_state(whole) == parse_state(LITERAL)._replace(yaw_rate=0.5)
    with pytest.raises(MessageBroken):
        parse_state(whole.replace(b"0.5)", text + b")"))


def test_a_broken_engine_reading_is_told():
    with pytest.raises(MessageBroken, match="rpm is no number"):
        parse_motor(LITERAL.replace(b"(rpm 942.478)", b"(rpm x)"))


# ---- Any messages --------------------------------------------------------------------------------


@given(states)
def test_a_state_comes_back_with_six_digits(state):
    """And once written, it is written the same for ever."""
    text = format_state(state)
    once = parse_state(text)
    assert (once.yaw_rate is None) == (state.yaw_rate is None)
    for value, expected in zip(once, state, strict=True):
        if expected is not None:
            np.testing.assert_allclose(value, expected, rtol=1e-5)
    assert parse_motor(text) == (once.lap_time, once.gear, once.engine_speed, once.speed_x)


@given(actions)
def test_an_action_comes_back_with_all_digits(action):
    back = parse_action(format_action(action))
    assert back._replace(focus=None) == action._replace(focus=None)
    if action.focus is None:
        assert back.focus is None
    else:
        assert back.focus == pytest.approx(action.focus, rel=1e-11)


@given(st.lists(numbers, min_size=80, max_size=80))
def test_both_ends_write_the_same_state(numbers):
    numbers[6], numbers[44] = 3.0, 1.0
    parts = [*numbers[:6], 3, numbers[7], tuple(numbers[8:44]), 1, *numbers[45:49]]
    parts += [tuple(numbers[49:68]), numbers[68], tuple(numbers[69:73]), numbers[73]]
    state = ScrState(*parts, tuple(numbers[74:79]), numbers[79])
    assert format_state(state._replace(yaw_rate=None)) == _engine.scr_format_state(numbers)
    exact = parse_state(_engine.scr_format_state(numbers, exact=True))
    for value, expected in zip(exact, state, strict=True):
        assert value == pytest.approx(expected, rel=1e-15)


@given(actions)
def test_both_ends_read_the_same_action(action):
    text = format_action(action)
    assert server_action(text) == parse_action(text)


def server_action(text):
    throttle, brake, gear, steering, clutch, *rest = _engine.scr_parse_action(text)
    restart, focus, lap_time = rest
    return ScrAction(steering, throttle, brake, gear, clutch, focus, restart, lap_time)


@given(
    st.lists(st.floats(-90.0, 90.0), min_size=19, max_size=19),
    st.tuples(*[numbers] * 4),
    st.text(max_size=40),
)
def test_both_ends_read_the_same_introduction(degrees, start, own):
    text = format_init(np.radians(degrees), Start(*start), name=own)
    init = parse_init(text)
    angles, where, _exact, name = _engine.scr_parse_init(text)
    assert name == init.name == plain_name(own)
    assert init.start == where == start
    np.testing.assert_allclose(init.angles, angles, rtol=1e-15)
    np.testing.assert_allclose(angles, np.radians(degrees), rtol=1e-11, atol=1e-300)


@given(st.binary(max_size=200))
@settings(max_examples=500)
def test_no_bytes_do_harm(text):
    FUZZ["check_state"](text)
    FUZZ["check_action"](text)


def test_no_broken_message_gives_a_wrong_number():
    """The same as ``tools/fuzz_scr.py``, which does more of it."""
    for state, action in FUZZ["mutations"](seed=1, number=3000):
        FUZZ["check_state"](state)
        FUZZ["check_action"](action)


def test_the_example_counts_what_it_has_checked(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["fuzz_scr.py", "--messages", "600"])
    FUZZ["main"]()
    assert re.search(r"600 messages: \d+ states and \d+ actions read, all", capsys.readouterr().out)
