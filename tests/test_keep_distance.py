"""Cars that keep their distance brake for the car ahead, whatever they are asked."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from conftest import car_state
from vectors import assert_they_see_the_same, both_kinds

from sb3_torcs.car import NO_RACE, RIVALS
from sb3_torcs.errors import InvalidOption
from sb3_torcs.rivals import needed_brake, see_rivals
from sb3_torcs.vec_env import TorcsVecEnv

GAS = np.array([0.0, 1.0, 0.0], np.float32)
LONG, WIDE = 4.5, 2.0


def race_with(along, across=0.0, faster=0.0, aside=0.0):
    """The numbers of a race in which the second of the nearest cars is somewhere."""
    race = NO_RACE.copy()
    race[5:].reshape(6, RIVALS)[:, 1] = along, across, faster, aside, LONG, WIDE
    return race


def brake(speed, *rival):
    return needed_brake(car_state(speed_x=speed, race=race_with(*rival)))


class TestTheRule:
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


def contacts(keep_distance):
    """Count the contacts of a car that drives faster than the one ahead of it."""
    envs = TorcsVecEnv(1, agents=2, track="g-track-1", keep_distance=keep_distance)
    try:
        envs.seed(0)
        envs.reset()
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
    finally:
        envs.close()


def test_a_car_that_is_asked_to_rams_nobody(game):
    assert contacts(keep_distance=False) > 0
    assert contacts(keep_distance=True) == 0


def test_races_driven_at_once_brake_as_single_ones_do(game):
    options = {"opponents": ["bt", "tita"], "keep_distance": True, "unstick": True}
    with both_kinds("Torcs-v0", track="g-track-1", action="pedal", **options) as (ours, theirs):
        ours.action_space.low[1] = theirs.action_space.low[1] = 0.9  # into those ahead
        assert_they_see_the_same(ours, theirs, steps=60)


@pytest.mark.parametrize("world", [{"id": "TorcsLite-v0"}, {"id": "Torcs-v0", "backend": "scr"}])
def test_a_world_without_races_has_nobody_to_keep_from(game, world):
    with pytest.raises(
        InvalidOption, match="other cars, which is needed for 'keep_distance'; use Torcs-v0 with"
    ):
        gym.make(**world, keep_distance=True)


def test_only_yes_or_no_is_an_answer():
    with pytest.raises(InvalidOption, match="keep_distance is 1; expected True or False"):
        gym.make("TorcsLite-v0", keep_distance=1)
