"""Conditions that episodes draw: late controls, the grip of the ground, the mass of the car."""

from __future__ import annotations

import copy

import gymnasium as gym
import numpy as np
import pytest
from conftest import ScriptedBackend
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from vectors import assert_they_see_the_same, both_kinds

import sb3_torcs  # noqa: F401  # registers the ids
from sb3_torcs.callbacks import RandomStartCallback
from sb3_torcs.car import RESTING, controls_from_record
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
    env = RacingEnv(ScriptedBackend(oval), conditions={"delay": delay})
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
    env = RacingEnv(ScriptedBackend(oval), conditions={"delay": 5})
    env.reset(seed=0)
    env.step(GAS)
    assert env.controls.throttle == 1.0
    assert controls_from_record(env.episode["waiting"][0, 0]) == RESTING


def test_each_episode_draws_its_delay_from_the_seed(oval):
    """All within the bounds occur; one number draws nothing, so starts stay what they were."""
    late = {"conditions": {"delay": (0, 3)}}
    env, other = (RacingEnv(ScriptedBackend(oval), **late) for _ in range(2))
    drawn = []
    for race in (env, other):
        race.reset(seed=4)
        rows = [race.episode["delay"].item()]
        for _ in range(40):
            race.reset()
            rows.append(race.episode["delay"].item())
        drawn.append(rows)
    assert drawn[0] == drawn[1]
    assert set(drawn[0]) == {0, 1, 2, 3}
    plain, late = (
        RacingEnv(ScriptedBackend(oval), conditions={"delay": n}, start="random") for n in (0, 4)
    )
    for race in (plain, late):
        race.reset(seed=9)
    assert plain.backend.calls == late.backend.calls


def test_a_late_car_drives_as_one_that_is_told_later(env_id):
    """Ten ticks of two late ones are those of an environment whose timestep is one tick."""
    late, fine = gym.make(env_id, conditions={"delay": 2}), gym.make(env_id, action_repeat=1)
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
    options = {"conditions": {"delay": [0, 7]}, "start": "random", "max_episode_steps": 15}
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
            waiting = [[env.episode["waiting"].tobytes() for env in envs.get_attr("unwrapped")]
                       for envs in (ours, theirs)]  # fmt: skip
            assert waiting[0] == waiting[1]
    ours.close()
    theirs.close()


@pytest.mark.usefixtures("game")
def test_a_vector_of_gymnasium_is_late_too():
    options = {"conditions": {"delay": 3}, "start": "random"}
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
    env = gym.make(env_id, conditions={"delay": (1, 4)})
    env.reset(seed=1)
    for _ in range(3):
        env.step(GAS)
    twin = copy.deepcopy(env.unwrapped)
    brake = np.array([0.0, 0.0, 1.0], np.float32)
    for _ in range(3):
        assert env.step(brake)[0].tobytes() == twin.step(brake)[0].tobytes()
    env.close()
    twin.close()


# ---------------------------------------------------------------------------------- grip and mass


def speeds(env_id, action, **conditions):
    """Along a straight of forza from 40 m/s, for a second."""
    env = gym.make(env_id, track="forza", conditions=conditions)
    env.reset(seed=0, options={"distance": 4200.0, "speed": 40.0})
    driven = [env.step(np.array(action, np.float32))[4]["car"].speed_x for _ in range(10)]
    env.close()
    return driven


def test_less_grip_brakes_less(env_id):
    """Fully: the tyres are at their limit."""
    full = [0.0, 0.0, 1.0]
    as_it_is, slippery = speeds(env_id, full), speeds(env_id, full, grip=0.6)
    assert slippery[-1] > as_it_is[-1] + 1.0
    assert speeds(env_id, full, grip=1.0) == as_it_is


@pytest.mark.usefixtures("game")
def test_a_heavier_car_gathers_speed_more_slowly():
    gained = [speeds("Torcs-v0", [0.0, 1.0, 0.0], mass=mass)[-1] - 40.0 for mass in (0.8, 1.0, 1.2)]
    assert gained[0] > gained[1] > gained[2] > 0.0


@pytest.mark.parametrize("options", [{}, {"options": {"distance": 900.0, "speed": 20.0}}])
def test_conditions_end_with_their_episode(env_id, options):
    """The next one has its own, and the same seed gives the same drive, from both starts."""
    env = gym.make(env_id, conditions={"grip": (0.7, 0.8)})
    drives, grips = [], []
    for seed in (1, 2, 1):
        rows = [env.reset(seed=seed, **options)[0]]
        rows += [env.step(np.array([0.02, 0.7, 0.0], np.float32))[0] for _ in range(25)]
        drives.append(np.array(rows).tobytes())
        grips.append(env.unwrapped.conditions.grip)
    assert drives[0] == drives[2] != drives[1]
    assert grips[0] == grips[2] != grips[1]
    env.unwrapped.set_conditions({"delay": 2})  # from the next episode on
    assert env.unwrapped.conditions.grip == grips[2]
    env.close()


@pytest.mark.usefixtures("game")
def test_a_copy_and_a_restored_race_have_the_conditions_of_their_episode():
    conditions = {"grip": (0.6, 0.9), "mass": (0.9, 1.1)}
    env = gym.make("Torcs-v0", conditions=conditions, start="random")
    env.reset(seed=3)
    for _ in range(3):
        env.step(GAS)
    backend = env.unwrapped.backend
    twin, moment = copy.deepcopy(env.unwrapped), backend.save()
    expected = [env.step(np.array([0.1, 0.0, 1.0], np.float32))[0].tobytes() for _ in range(5)]
    again = [twin.step(np.array([0.1, 0.0, 1.0], np.float32))[0].tobytes() for _ in range(5)]
    assert again == expected
    env.reset()
    car = backend.restore(moment)
    for _ in range(5):
        car = backend.step(twin.controls, 5)
    assert twin.view.encode(car, backend).tobytes() == expected[-1]
    env.close()
    twin.close()


def test_races_driven_at_once_have_their_own_grip(env_id):
    options = {"conditions": {"grip": [0.6, 1.2]}, "start": "random", "max_episode_steps": 9}
    options["track"] = ["aalborg", "g-track-1"]
    with both_kinds(env_id, seed=2, **options) as (ours, theirs):
        assert_they_see_the_same(ours, theirs, steps=30)
        assert len({drawn.grip for drawn in ours.get_attr("conditions")}) == 3


@pytest.mark.parametrize(("name", "choices", "expected"), [
    ("delay", [-1, 51, 1.5, "2", (3, 1), (0, 1, 2), (0, np.inf), None, True],
     "whole control ticks"),
    ("grip", [0, 0.4, 2.1, "1", (1.1, 0.9), (1.0,), None], "a factor from 0.5 to 2"),
])  # fmt: skip
def test_other_conditions_are_refused(name, choices, expected):
    for choice in choices:
        with pytest.raises(InvalidOption, match=f"{name} is .* expected {expected}"):
            gym.make("TorcsLite-v0", conditions={name: choice})


def test_a_world_that_cannot_change_says_so(oval):
    with pytest.raises(InvalidOption, match=r"grip is 0\.9, .* cannot change; leave it out"):
        RacingEnv(ScriptedBackend(oval), conditions={"grip": 0.9})
    with pytest.raises(InvalidOption, match=r"mass is 1\.1, .* use backend 'native' of Torcs-v0"):
        gym.make("TorcsLite-v0", conditions={"mass": 1.1})


def test_noise_stays_what_it_was():
    env = gym.make("TorcsLite-v0").unwrapped
    with pytest.raises(InvalidOption, match="sensor_noise was False when the environment was made"):
        env.set_conditions({"sensor_noise": True})
    with pytest.raises(InvalidOption, match="sensor_noise is True, which this world cannot change"):
        gym.make("TorcsLite-v0", conditions={"sensor_noise": True})


@pytest.mark.usefixtures("game")
def test_cars_of_one_race_have_no_delays_of_their_own():
    """The engine moves all of them at once, for as many ticks."""
    env = TorcsVecEnv(1, agents=2, track="g-track-1")
    for choice in (3, (0, 4)):
        with pytest.raises(InvalidOption, match=r"delay is .* the cars of one race move at once"):
            env.env_method("set_conditions", {"delay": choice})
    env.env_method("set_conditions", {"delay": 0})
    env.close()
    alone = TorcsVecEnv(1, track="g-track-1")
    alone.env_method("set_conditions", {"delay": 3})
    alone.close()


def test_conditions_of_a_training_are_those_of_its_environments_alone(game):
    """They begin with the next episode; what was before comes back, also to the world."""
    del game
    env = TorcsVecEnv(2, threads=1, track=["aalborg", "g-track-1"], conditions={"mass": 0.9})
    drawn = []

    class Grips(BaseCallback):
        def _on_step(self):
            if any(self.locals["dones"]):
                drawn.extend(self.training_env.env_method("get_wrapper_attr", "conditions"))
            return True

    model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, device="cpu", seed=0)
    grip = RandomStartCallback(conditions={"grip": (0.7, 0.8), "delay": 1})
    model.learn(600, callback=[grip, Grips()])
    assert drawn
    assert {0.7 <= each.grip <= 0.8 for each in drawn[-2:]} == {True}
    assert {each.mass for each in drawn} == {0.9}  # what the callback does not name stays
    env.reset()
    conditions = env.env_method("get_wrapper_attr", "conditions")
    assert [each.grip for each in conditions] == [1.0, 1.0]
    assert [each.choice["delay"] for each in conditions] == [0, 0]
    env.close()


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ({"grip": 3.0}, "expected a factor from 0.5 to 2"),
        ({"mass": "heavy"}, "expected a factor"),
        ({"delay": 0.5}, "whole control ticks"),
    ],
)
def test_bad_conditions_of_a_training_are_refused(oval, choice, message):
    """When the callback is made; an environment says the same, and which names there are."""
    with pytest.raises(InvalidOption, match=message):
        RandomStartCallback(conditions=choice)
    env = RacingEnv(ScriptedBackend(oval))
    with pytest.raises(InvalidOption, match=message):
        env.set_conditions(choice)
    with pytest.raises(InvalidOption, match="conditions has no key 'gripp'; did you mean 'grip'"):
        env.set_conditions({"gripp": 1.0})


def test_a_road_is_told_as_its_file_says_whatever_the_grip(game):
    """What an agent sees of a road goes by its profile, which all races on it share."""
    del game
    env = gym.make("Torcs-v0", track="g-track-1", conditions={"grip": 0.5}).unwrapped
    before = env.backend.engine.road()
    env.reset(seed=0)
    np.testing.assert_array_equal(env.backend.engine.road(), before)
    assert env.backend.profile.frictions.min() > 1.1
    env.close()
