"""Conditions that episodes draw: controls that arrive late."""

from __future__ import annotations

import copy

import gymnasium as gym
import numpy as np
import pytest
from conftest import ScriptedBackend
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

import sb3_torcs  # noqa: F401  # registers the ids
from sb3_torcs.envs.conditions import RESTING, Delay
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.errors import InvalidOption
from sb3_torcs.vec_env import TorcsVecEnv

GAS = np.array([0.0, 1.0, 0.0], np.float32)


@pytest.fixture(params=["TorcsLite-v0", "Torcs-v0"])
def env_id(request):
    if request.param == "Torcs-v0":
        request.getfixturevalue("game")
    return request.param


def held(oval, delay, actions):
    """The throttle that the car gets, and for how long, in timesteps of five ticks."""
    env = RacingEnv(ScriptedBackend(oval), delay=delay)
    env.reset(seed=0)
    for throttle in actions:
        env.step(np.array([0.0, throttle, 0.0], np.float32))
    calls = [call[1:] for call in env.backend.calls if call[0] == "step"]
    return [(controls.throttle, ticks) for controls, ticks in calls]


@pytest.mark.parametrize(
    ("delay", "expected"),
    [
        (0, [(0.25, 5), (0.5, 5), (1.0, 5)]),
        (2, [(0.0, 2), (0.25, 3), (0.25, 2), (0.5, 3), (0.5, 2), (1.0, 3)]),
        (5, [(0.0, 5), (0.25, 5), (0.5, 5)]),
        (7, [(0.0, 5 - 3), (0.0, 3), (0.0, 2), (0.25, 3), (0.25, 2), (0.5, 3)]),
    ],
)
def test_controls_arrive_after_the_delay(oval, delay, expected):
    """Also within a timestep, and timesteps later; until the first ones come the car rolls."""
    assert held(oval, delay, (0.25, 0.5, 1.0)) == expected


def test_the_reward_and_the_picture_know_what_was_asked(oval):
    env = RacingEnv(ScriptedBackend(oval), delay=5)
    env.reset(seed=0)
    env.step(GAS)
    assert env.controls.throttle == 1.0
    assert env.delay.waiting[0] == RESTING


def test_each_episode_draws_its_delay_from_the_seed(oval):
    """All within the bounds occur; one number draws nothing, so starts stay what they were."""
    env, other = (RacingEnv(ScriptedBackend(oval), delay=(0, 3)) for _ in range(2))
    drawn = []
    for race in (env, other):
        race.reset(seed=4)
        rows = [race.delay.ticks]
        for _ in range(40):
            race.reset()
            rows.append(race.delay.ticks)
        drawn.append(rows)
    assert drawn[0] == drawn[1]
    assert set(drawn[0]) == {0, 1, 2, 3}
    plain, late = (RacingEnv(ScriptedBackend(oval), delay=n, start="random") for n in (0, 4))
    for race in (plain, late):
        race.reset(seed=9)
    assert plain.backend.calls == late.backend.calls


def test_a_late_car_drives_as_one_that_is_told_later(env_id):
    """Ten ticks of two late ones are those of an environment whose timestep is one tick."""
    late, fine = gym.make(env_id, delay=2), gym.make(env_id, action_repeat=1)
    late.reset(seed=0)
    fine.reset(seed=0)
    actions = [np.array([0.1 * n, 1.0, 0.0], np.float32) for n in range(4)]
    for number, action in enumerate(actions):
        earlier = actions[number - 1] if number else np.zeros(3, np.float32)
        for asked in [earlier] * 2 + [action] * 3:
            expected = fine.step(asked)[0]
        assert late.step(action)[0].tobytes() == expected.tobytes()
    late.close()
    fine.close()


@pytest.mark.parametrize("threads", [1, 2])
def test_late_races_driven_at_once_drive_as_single_ones(env_id, threads):
    """To the bit, with another delay in each, across episodes, and after others used them."""
    options = {"delay": [0, 7], "start": "random", "max_episode_steps": 15}
    ours = TorcsVecEnv(3, threads=threads, env_id=env_id, **options)
    theirs = DummyVecEnv([lambda: Monitor(gym.make(env_id, **options))] * 3)
    for envs in (ours, theirs):
        envs.seed(2)
    theirs.action_space.seed(2)
    assert ours.reset().tobytes() == theirs.reset().tobytes()
    for step in range(60):
        actions = np.array([theirs.action_space.sample() for _ in range(3)])
        for one, other in zip(ours.step(actions)[:3], theirs.step(actions)[:3], strict=True):
            assert one.tobytes() == other.tobytes(), step
        if step % 7 == 0:
            assert ours.get_attr("controls") == theirs.get_attr("controls")
            waiting = [[env.delay.waiting for env in envs.get_attr("unwrapped")]
                       for envs in (ours, theirs)]  # fmt: skip
            assert waiting[0] == waiting[1]
    ours.close()
    theirs.close()


@pytest.mark.usefixtures("game")
def test_a_vector_of_gymnasium_is_late_too():
    options = {"delay": 3, "start": "random"}
    together = gym.make_vec("Torcs-v0", num_envs=2, **options)
    alone = gym.make("Torcs-v0", **options)
    seen, _ = together.reset(seed=[4, 5])
    expected, _ = alone.reset(seed=5)
    for _ in range(8):
        assert seen[1].tobytes() == expected.tobytes()
        seen, expected = together.step([GAS, GAS])[0], alone.step(GAS)[0]
    together.close()
    alone.close()


def test_a_copy_goes_on_with_the_controls_on_their_way(env_id):
    env = gym.make(env_id, delay=(1, 4))
    env.reset(seed=1)
    for _ in range(3):
        env.step(GAS)
    twin = copy.deepcopy(env.unwrapped)
    brake = np.array([0.0, 0.0, 1.0], np.float32)
    for _ in range(3):
        assert env.step(brake)[0].tobytes() == twin.step(brake)[0].tobytes()
    env.close()
    twin.close()


@pytest.mark.parametrize("choice", [-1, 51, 1.5, "2", (3, 1), (0, 1, 2), (0, np.inf), None, True])
def test_other_delays_are_refused(choice):
    with pytest.raises(InvalidOption, match=r"delay is .* expected whole control ticks"):
        gym.make("TorcsLite-v0", delay=choice)


def test_no_delay_waits_for_nothing():
    delay = Delay(0, 5)
    assert delay.hold(RESTING._replace(throttle=1.0)) == [(RESTING._replace(throttle=1.0), 5)]
