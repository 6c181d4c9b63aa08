"""Rewards: known numbers, exact sums, clear refusals."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from conftest import car_state

from sb3_torcs.car import NO_RACE, RIVALS, Controls
from sb3_torcs.envs.episode import new_episodes
from sb3_torcs.errors import InvalidOption, UnknownRewardTerm
from sb3_torcs.rewards import PRESETS, TERMS, Reward, Rewards

GAS = Controls(0.0, 1.0, 0.0)
BEFORE = car_state(time=1.0)
AFTER = car_state(
    time=1.5, speed_x=10.0, heading_error=math.pi / 6.0, distance_from_axis=-2.5, distance_raced=4.0
)


def value(choice, before=BEFORE, after=AFTER, end=None):
    """Value one timestep of full throttle: the weighted terms by name."""
    reward = Reward(choice)
    first, then = new_episodes(1), new_episodes(1)
    first["car"], then["car"], then["controls"] = before, after, GAS
    return reward.explain(*Rewards([reward]).value(first, then), end)


@pytest.mark.parametrize(
    ("term", "expected"),
    [
        ("speed_along", 10.0 * math.cos(math.pi / 6.0)),
        ("speed_across", 10.0 * math.sin(math.pi / 6.0)),
        ("speed_off_axis", 5.0),
        ("progress", 8.0),
        ("damage", 0.0),
        ("pedals", 0.0),
        ("steering", 0.0),
        ("sliding", 0.0),
        ("overspeed", 0.0),
        ("places", 0.0),
        ("contact", 0.0),
        ("fault", 0.0),
    ],
)
def test_a_term_has_its_known_value(term, expected):
    assert TERMS[term](BEFORE, AFTER, GAS) == expected
    assert value({term: 1.0})[term] == 0.5 * expected


def test_steering_counts_either_way_and_more_at_speed():
    for steering in (-0.5, 0.5):
        assert TERMS["steering"](BEFORE, AFTER, GAS._replace(steering=steering)) == 2.5
    assert TERMS["steering"](BEFORE, AFTER._replace(speed_x=-20.0), Controls(1.0, 0.0, 0.0)) == 20.0


@pytest.mark.parametrize(
    ("along", "across", "value"),
    [(20.0, 1.0, 0.0), (20.0, 2.0, 0.0), (20.0, -5.0, 3.0), (-10.0, 4.0, 3.0), (0.0, 2.0, 2.0)],
)
def test_sliding_is_speed_across_beyond_that_of_a_bend(along, across, value):
    car = AFTER._replace(speed_x=along, speed_y=across)
    assert TERMS["sliding"](BEFORE, car, GAS) == value


@pytest.mark.parametrize(
    ("sight", "speed", "value"),
    [(12.8, 30.0, 10.0), (12.8, 20.0, 0.0), (200.0, 64.0, 0.0), (-1.0, 20.0, 8.0)],
)
def test_overspeed_is_what_cannot_be_lost_within_sight(sight, speed, value):
    """12² + 2 · 10 · 12.8 is 20²; off the road nothing is seen."""
    beams = np.full(19, -1.0)
    beams[9] = sight
    car = AFTER._replace(speed_x=speed, range_finders=beams)
    assert TERMS["overspeed"](BEFORE, car, GAS) == value


def in_a_race(car, place, ahead, contacts=0.0, faults=0.0):
    race = np.array([ahead, 50.0, 3.0, contacts, faults, *NO_RACE[5:]])
    return car._replace(race_position=place, race=race)


def test_a_place_gained_counts_once_however_long_the_timestep():
    before, after = in_a_race(BEFORE, 5, 10.0), in_a_race(AFTER, 3, 10.0)
    assert value({"places": 1.0}, before, after)["places"] == 2.0
    lost = value({"places": 1.0}, after._replace(time=0.0), before._replace(time=0.5))
    assert lost["places"] == pytest.approx(-2.0)


def test_a_contact_is_told_from_one_s_own_fault():
    before, after = in_a_race(BEFORE, 4, 9.0, 1.0, 0.0), in_a_race(AFTER, 4, 9.0, 3.0, 1.0)
    terms = value({"contact": -1.0, "fault": -1.0}, before, after)
    assert (terms["contact"], terms["fault"]) == (-2.0, -1.0)


@pytest.mark.parametrize(("offset", "over"), [(0.0, 0.0), (4.0, 0.0), (-4.53, 0.5), (5.03, 1.0)])
def test_off_line_is_how_far_the_side_is_over_the_edge(offset, over):
    """Of a car of 1.94 m on a road of 10 m."""
    car = AFTER._replace(distance_from_axis=offset, speed_x=20.0, track_width=10.0)
    assert TERMS["off_line"](BEFORE, car, GAS) == pytest.approx(20.0 * over)


@pytest.mark.parametrize(
    ("rivals", "gained"),
    [
        ({0: (0.0, -5.0)}, 5.0),  # beside it
        ({0: (40.0, -5.0)}, 2.5),
        ({0: (-40.0, 3.0)}, -1.5),  # it catches up
        ({0: (-20.0, -2.0), 3: (60.0, -8.0)}, 1.5 + 2.0),
        ({0: (80.0, -50.0)}, 0.0),
        ({0: (-120.0, -50.0)}, 0.0),
        ({}, 0.0),
    ],
)
def test_passing_is_the_speed_against_cars_nearby(rivals, gained):
    race = NO_RACE.copy()
    for rival, (along, faster) in rivals.items():
        race[5 + rival] = along
        race[5 + 2 * RIVALS + rival] = faster
    assert TERMS["passing"](BEFORE, AFTER._replace(race=race), GAS) == pytest.approx(gained)


def test_squares_are_products_as_in_compiled_code():
    """Python's power rounds about one of a thousand squares otherwise."""
    speeds = np.random.default_rng(0).uniform(1.0, 90.0, 10_000)
    odd = [float(speed) for speed in speeds if float(speed) ** 2 != float(speed) * float(speed)]
    assert odd
    for speed in odd:
        car = car_state(speed_x=speed, distance_from_axis=100.0)
        assert TERMS["leaving"](BEFORE, car, GAS) == speed * speed


def test_a_weight_multiplies_duration_and_scale():
    assert value({"speed_off_axis": -2.0, "scale": 0.1}) == {
        "speed_off_axis": -2.0 * 0.1 * 0.5 * 5.0,
        "crash": 0.0,
    }


def test_the_post_is_the_sum_of_its_three_terms():
    along, across = 10.0 * math.cos(math.pi / 6.0), 10.0 * math.sin(math.pi / 6.0)
    terms = value("blog")
    assert sum(terms.values()) == pytest.approx(0.05 * (along - across - 5.0), rel=1e-15)


@pytest.mark.parametrize("end", ["off_track", "backwards", "stuck", "damage"])
def test_a_crash_costs_once(end):
    assert value("progress", end=end)["crash"] == -1.0


@pytest.mark.parametrize("end", [None, "laps"])
def test_a_good_end_costs_nothing(end):
    assert value("progress", end=end)["crash"] == 0.0


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_uses_known_terms(preset):
    assert set(PRESETS[preset]) <= {*TERMS, "scale", "crash"}


def test_an_unknown_name_offers_the_near_miss():
    with pytest.raises(UnknownRewardTerm, match=r"no reward 'progres'; did you mean 'progress'\?"):
        Reward("progres")
    with pytest.raises(UnknownRewardTerm, match=r"'speed_alon'; did you mean 'speed_along'\?"):
        Reward({"speed_alon": 1.0})
    with pytest.raises(UnknownRewardTerm, match="no reward term '3'; terms: speed_along"):
        Reward({3: 1.0})


@pytest.mark.parametrize("weight", [math.nan, math.inf, "1", None, True, 1e308])
def test_a_weight_must_be_a_number(weight):
    with pytest.raises(InvalidOption, match="expected a number from -1e\\+09 to 1e\\+09"):
        Reward({"progress": weight})


@pytest.mark.parametrize("returned", [None, "1", np.ones(1), math.nan, math.inf, -1e30])
def test_a_term_that_somebody_adds_returns_a_finite_number(monkeypatch, returned):
    """So it is the same in one environment and in a batch of them, and the message names it."""
    monkeypatch.setitem(TERMS, "odd", lambda *_: returned)
    message = f"reward term 'odd' returned {re.escape(repr(returned))}; expected a finite number"
    with pytest.raises(InvalidOption, match=message):
        value({"odd": 1.0})


def test_a_term_that_somebody_adds_is_a_function_and_has_a_name_of_its_own(monkeypatch):
    monkeypatch.setitem(TERMS, "odd", 3)
    with pytest.raises(InvalidOption, match="reward term 'odd' is 3; expected a function"):
        Reward({"odd": 1.0})
    monkeypatch.setitem(TERMS, "odd", lambda *_: np.float32(0.5))
    valued = value({"odd": 2.0})["odd"]
    assert (valued, type(valued)) == (0.5, float)
    monkeypatch.setitem(TERMS, "scale", TERMS["pedals"])
    with pytest.raises(InvalidOption, match=r"called 'scale', .* by another name"):
        Reward("progress")


def test_a_reward_must_be_a_name_or_weights():
    with pytest.raises(InvalidOption, match="reward is 3"):
        Reward(3)
