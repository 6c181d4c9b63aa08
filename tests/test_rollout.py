"""The loop in which drivers drive: what they are asked, when it ends, and what is told of it."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from conftest import ScriptedBackend

from sb3_torcs.agents.rollout import drive
from sb3_torcs.envs.racing import RacingEnv

OFF = {"distance_from_axis": 6.0}


class Counting:
    """A driver with a state: how often it was asked, since when."""

    def __init__(self):
        self.asked = []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.asked.append((state, episode_start.tolist(), deterministic))
        return np.array([0.0, 0.5, 0.0], np.float32), (state or 0) + 1


def test_an_episode_is_driven_to_its_end(oval):
    steps = list(drive(RacingEnv(ScriptedBackend(oval, {}, {}, OFF)), Counting()))
    assert [step.done for step in steps] == [False, False, True]
    assert [step.info["end"] for step in steps] == ["", "", "off_track"]
    assert [step.car.distance_from_axis for step in steps] == [0.0, 0.0, 6.0]


def test_each_step_holds_what_the_driver_saw_and_what_came_of_it(oval):
    steps = list(drive(RacingEnv(ScriptedBackend(oval, {"speed_x": 30.0}, OFF)), Counting()))
    np.testing.assert_array_equal(steps[0].next_observation, steps[1].observation)
    assert not np.array_equal(steps[0].observation, steps[1].observation)


def test_the_driver_is_asked_with_its_own_state(oval):
    driver = Counting()
    list(drive(RacingEnv(ScriptedBackend(oval, {}, {}, OFF)), driver))
    assert driver.asked == [(None, [True], True), (1, [False], True), (2, [False], True)]


def test_the_reset_is_seeded_and_has_its_options(oval):
    backend = ScriptedBackend(oval, OFF)
    list(drive(RacingEnv(backend), Counting(), seed=3, options={"distance": 50.0}))
    assert backend.calls[0][1].distance == 50.0


def test_who_says_when_it_is_over_drives_past_the_episodes_end(oval):
    """As an agent in somebody else's race has to, off the road or not."""
    asked = iter([False, False, False, True])
    steps = list(drive(RacingEnv(ScriptedBackend(oval, OFF)), Counting(), over=lambda: next(asked)))
    assert [step.terminated for step in steps] == [True, False, False]


def test_a_race_that_is_over_before_it_begins_asks_nobody(oval):
    driver = Counting()
    assert list(drive(RacingEnv(ScriptedBackend(oval)), driver, over=lambda: True)) == []
    assert driver.asked == []


@pytest.mark.parametrize("number", [1, 2])
def test_nothing_is_driven_that_nobody_asks_for(oval, number):
    backend = ScriptedBackend(oval)
    list(islice(drive(RacingEnv(backend), Counting()), number))
    assert [call[0] for call in backend.calls] == ["reset"] + ["step"] * number
