"""Driver aids make room for others, whatever is asked: by the brake, and by steering."""

from __future__ import annotations

from contextlib import contextmanager

import gymnasium as gym
import numpy as np
import pytest
from conftest import car_state
from vectors import assert_they_see_the_same, both_kinds

from sb3_torcs.car import NO_RACE, RIVALS
from sb3_torcs.errors import InvalidOption
from sb3_torcs.rivals import needed_brake, needed_turn, see_rivals
from sb3_torcs.vec_env import TorcsVecEnv

GAS = np.array([0.0, 1.0, 0.0], np.float32)
LONG, WIDE = 4.5, 2.0
AIDS = ("keep_distance", "keep_clear")


def race_with(along, across=0.0, faster=0.0, aside=0.0):
    """The numbers of a race in which the second of the nearest cars is somewhere."""
    race = NO_RACE.copy()
    race[5:].reshape(6, RIVALS)[:, 1] = along, across, faster, aside, LONG, WIDE
    return race


def brake(speed, *rival):
    return needed_brake(car_state(speed_x=speed, race=race_with(*rival)))


def turn(*rival, **car):
    return needed_turn(car_state(**{"speed_x": 20.0, **car}, race=race_with(*rival)))


class TestBraking:
    @pytest.mark.parametrize(
        "rival",
        [
            (),
            (60.0, 0.0, 0.0),  # as fast, and far
            (60.0, 0.0, -10.0),  # 25 m are enough for 50² - 40² m²/s²
            (-6.0, 0.0, -10.0),  # behind
            (8.0, 2.4, -10.0),  # beside the way
            (8.0, -2.4, -10.0),
            (6.0, 0.0, 2.0),  # draws away
            (90.0, 0.0, -50.0),  # not seen
        ],
    )
    def test_who_has_room_goes_on(self, rival):
        race = race_with(*rival) if rival else NO_RACE
        assert needed_brake(car_state(speed_x=50.0, race=race)) == 0.0

    @pytest.mark.parametrize("rival", [
        (10.0, 0.0, 0.0), (40.0, 0.0, -30.0), (8.0, 2.4, -10.0, -5.0), (30.0, -1.0, -20.0),
    ])  # fmt: skip
    def test_who_has_none_brakes(self, rival):
        assert 0.0 < brake(50.0, *rival) <= 0.6

    def test_the_closer_the_harder(self):
        forces = [brake(40.0, along, 0.0, -20.0) for along in range(60, 2, -2)]
        assert forces == sorted(forces)
        assert (forces[0], forces[-1]) == (0.0, 0.6)

    def test_of_several_the_worst_counts(self):
        race = race_with(20.0, 0.0, -10.0)
        race[5:].reshape(6, RIVALS)[:, 3] = 6.0, 0.0, -10.0, 0.0, LONG, WIDE
        car = car_state(speed_x=30.0, race=race)
        assert needed_brake(car) == brake(30.0, 6.0, 0.0, -10.0) > brake(30.0, 20.0, 0.0, -10.0)

    def test_a_car_that_stands_need_not_brake(self):
        assert brake(0.0, 5.0) == 0.0

    def test_it_is_a_plain_number(self):
        assert type(brake(50.0, 10.0)) is float


class TestSteering:
    @pytest.mark.parametrize(
        "rival",
        [
            (),
            (0.0, WIDE + 1.6),  # beside, and far enough
            (0.0, WIDE + 1.6, 0.0, 2.0),  # goes away
            (6.0, 0.5),  # ahead, which is for the brake
            (10.0, 2.5),
            (-6.0, 2.5, -5.0),  # behind, and falls back
        ],
    )
    def test_who_has_room_goes_on(self, rival):
        race = race_with(*rival) if rival else NO_RACE
        assert needed_turn(car_state(speed_x=20.0, race=race)) == 0.0

    @pytest.mark.parametrize(
        "rival",
        [
            (0.0, 2.5),
            (3.0, 2.5),
            (-5.0, 2.5),
            (0.0, 1.5),  # already touched
            (0.0, 4.5, 0.0, -2.0),  # comes near
            (-7.0, 2.5, 10.0),  # will be beside in no time
        ],
    )
    def test_who_has_none_turns_away(self, rival):
        along, across, *speeds = rival
        assert -0.25 <= turn(*rival) < 0.0
        mirrored = along, -across, *speeds[:1], *(-speed for speed in speeds[1:])
        assert turn(*mirrored) == -turn(*rival)

    def test_the_nearer_the_harder(self):
        turns = [turn(0.0, 0.1 * across) for across in range(40, 10, -1)]
        assert turns == sorted(turns, reverse=True)
        assert turns[0] == 0.0 > turns[-1]

    def test_it_turns_as_fast_at_each_speed(self):
        rates = [speed * turn(0.0, 3.0, speed_x=speed) for speed in (10.0, 30.0, 70.0)]
        assert rates == pytest.approx([rates[0]] * 3)
        assert turn(0.0, 2.1, speed_x=0.0) == turn(0.0, 2.1, speed_x=5.0) == -0.25

    def test_nobody_is_driven_off_the_road(self):
        """Of 10 m, with 1.94 m of car: from 4.03 m on it would be beside it."""
        assert turn(0.0, 2.5, track_width=10.0, distance_from_axis=-4.03) == 0.0
        some = turn(0.0, 2.5, track_width=10.0, distance_from_axis=-3.78)
        assert some == pytest.approx(0.5 * turn(0.0, 2.5, track_width=10.0, distance_from_axis=0.0))

    def test_between_two_it_stays_in_the_middle(self):
        race = race_with(0.0, 2.5)
        race[5:].reshape(6, RIVALS)[:, 3] = 0.0, -2.5, 0.0, 0.0, LONG, WIDE
        assert needed_turn(car_state(speed_x=20.0, race=race)) == 0.0

    def test_it_is_a_plain_number(self):
        assert type(turn(0.0, 2.5)) is float


class TestWhatIsSeen:
    def seen(self, *rival):
        return see_rivals(race_with(*rival)[5:]).reshape(6, RIVALS)[:, 1]

    def test_braking_is_urgent_where_the_rest_of_the_way_is_needed(self):
        """3.75 m are lost from 10.6 m/s by 15 m/s²; half a metre is kept."""
        assert self.seen(8.75, 0.0, -10.6066)[4] == pytest.approx(1.0, abs=1e-4)
        assert self.seen(8.75, 0.0, 9.3934)[4] == pytest.approx(0.0, abs=1e-4)

    def test_who_is_beside_the_way_or_behind_is_not_urgent(self):
        assert self.seen(8.0, 4.5, -10.0)[4] == self.seen(-8.0, 0.0, 10.0)[4] == 0.0

    def test_the_sides_have_signs(self):
        assert self.seen(1.0, 2.0)[5] == 1.0
        assert self.seen(-1.0, -3.0)[5] == -0.5
        assert self.seen(0.0, 4.0)[5] == self.seen(9.0, 2.0)[5] == 0.0

    def test_nothing_jumps_where_a_car_comes_into_sight(self):
        near = self.seen(79.999, 1.0, -5.0, 1.0)
        assert np.abs(near - self.seen(80.001, 1.0, -5.0, 1.0)).max() < 1e-3


@contextmanager
def two_agents(track, aids):
    """Two cars on the grid, and nobody else."""
    envs = TorcsVecEnv(1, agents=2, track=track, aids=aids)
    try:
        envs.seed(0)
        envs.reset()
        yield envs
    finally:
        envs.close()


def contacts(aids):
    """Count the contacts of a car that drives faster than the one ahead of it."""
    with two_agents("g-track-1", aids) as envs:
        ahead = np.argmin([car.race_position for car in envs.get_attr("car")])
        actions = np.stack([0.3 * GAS, 0.3 * GAS])
        for step in range(200):
            envs.step(actions)
            cars = envs.get_attr("car")
            for i, car in enumerate(cars):  # both to the middle, one behind the other
                actions[i, 0] = 0.5 * car.heading_error - 0.02 * car.distance_from_axis
            if step > 100:
                actions[:, 1] = 0.7
                actions[ahead, 1] = 0.1
        return cars[1 - ahead].contacts


def test_a_car_that_is_asked_to_rams_nobody(game):
    assert contacts([]) > 0
    assert contacts(["keep_distance"]) == 0


def contacts_beside(aids):
    """Count the contacts of two cars that are side by side, and both want to the middle."""
    with two_agents("b-speedway", aids) as envs:
        actions = np.stack([0.5 * GAS, 0.5 * GAS])
        aims = np.array([4.0, -4.0])
        for step in range(200):
            envs.step(actions)
            cars = envs.get_attr("car")
            ahead, behind = (car.distance_from_start for car in cars)
            lead = (ahead - behind + 100.0) % envs.get_attr("backend")[0].track.length - 100.0
            lack = 0.05 * lead + 0.1 * (cars[0].speed_x - cars[1].speed_x)
            if step > 60 and abs(lack) < 0.05:
                aims[:] = 0.0
            for i, car in enumerate(cars):
                off = np.clip(car.distance_from_axis - aims[i], -3.0, 3.0)
                actions[i, 0] = 0.5 * car.heading_error - 0.02 * off
                actions[i, 1] = np.clip(0.5 - lack * (1 - 2 * i), 0.1, 0.9)
        assert (aims == 0.0).all()
        return cars[0].contacts


def test_a_car_that_keeps_clear_touches_nobody_beside_it(game):
    assert contacts_beside([]) > 0
    assert contacts_beside(["keep_clear"]) == 0


def test_races_driven_at_once_make_room_as_single_ones_do(game):
    aids = ["keep_distance", "keep_clear", "unstick"]
    options = {"opponents": ["bt", "tita"], "aids": aids}
    with both_kinds("Torcs-v0", track="g-track-1", action="pedal", **options) as (ours, theirs):
        ours.action_space.low[1] = theirs.action_space.low[1] = 0.9  # into those ahead
        assert_they_see_the_same(ours, theirs, steps=60)


@pytest.mark.parametrize("world", [{"id": "TorcsLite-v0"}, {"id": "Torcs-v0", "backend": "scr"}])
@pytest.mark.parametrize("aid", AIDS)
def test_a_world_without_races_has_nobody_to_keep_from(game, world, aid):
    with pytest.raises(InvalidOption, match=f"is needed for '{aid}'; use Torcs-v0 with"):
        gym.make(**world, aids=[aid])
