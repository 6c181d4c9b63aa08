"""What every world owes every agent, over every id. A new world joins by one line in ``WORLDS``."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
from conftest import plainly_encoded
from gymnasium.utils.env_checker import check_env as check_gymnasium
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.wrappers import PassiveEnvChecker
from rollouts import rollout_digest
from stable_baselines3.common.env_checker import check_env as check_sb3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

import sb3_torcs
from sb3_torcs.actions import ACTIONS, GEARBOXES
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.car import CarState
from sb3_torcs.errors import BackendUnavailable, InvalidOption
from sb3_torcs.rewards import Reward


class World(NamedTuple):
    """An id, and the options that choose the world behind it."""

    id: str
    options: dict[str, Any] = {}  # noqa: RUF012

    def make(self, **options):
        return gym.make(self.id, **self.options, **options)


WORLDS = [World("TorcsLite-v0"), World("Torcs-v0"), World("Torcs-v0", {"backend": "scr"})]


@pytest.fixture(params=WORLDS, ids=lambda world: "-".join((world.id, *world.options.values())))
def world(request):
    if request.param.id == "Torcs-v0":
        request.getfixturevalue("game")  # which fails where there is none
    return request.param


def rollout(world, seed, steps=300, **options):
    """Drive with seeded random actions; return everything that was seen."""
    env = world.make(**options)
    env.action_space.seed(seed)
    seen = [env.reset(seed=seed)]
    for _ in range(steps):
        answer = env.step(env.action_space.sample())
        seen.append(answer)
        if answer[2] or answer[3]:
            seen.append(env.reset())
    env.close()
    return seen


def assert_equal(first, second):
    for step, (one, other) in enumerate(zip(first, second, strict=True)):
        assert data_equivalence(one, other, exact=True), f"timestep {step}: {one} != {other}"


def test_gymnasium_finds_nothing_to_warn_of(world):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = world.make(render_mode="rgb_array")
        check_gymnasium(env.unwrapped)
        env.close()


def test_stable_baselines3_finds_nothing_to_warn_of(world):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="We recommend you to use a symmetric")
        env = world.make()
        check_sb3(env.unwrapped)
        env.close()


@pytest.mark.parametrize("action", ACTIONS)
def test_both_checkers_accept_every_layout_of_the_action(world, action):
    """A signed pedal without any warning: both its ranges are symmetric, as SB3 wants them."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if action != "pedal":
            warnings.filterwarnings("ignore", message=".*recommend.* symmetric")
        env = world.make(action=action)
        check_sb3(env.unwrapped)
        check_gymnasium(env.unwrapped, skip_render_check=True)
        env.close()


@pytest.mark.parametrize("action", ACTIONS)
def test_every_layout_gives_the_same_bytes_again_and_in_a_copy(world, action):
    env = world.make(action=action, gearbox="automatic")
    assert_equal(rollout(world, 3, 60, action=action), rollout(world, 3, 60, action=action))
    env.reset(seed=0)
    asked = env.action_space.high
    env.step(asked)
    copy = pickle.loads(pickle.dumps(env.unwrapped))
    assert_equal([copy.step(asked) for _ in range(5)], [env.step(asked)[:5] for _ in range(5)])
    env.close()


def test_a_signed_pedal_drives_as_both_pedals_do(world):
    env, other = world.make(), world.make(action="pedal")
    answers = [env.reset(seed=0)], [other.reset(seed=0)]
    for pedal in [1.0] * 30 + [-0.5] * 10:
        both = np.array([0.01, max(pedal, 0.0), max(-pedal, 0.0)], np.float32)
        answers[0].append(env.step(both))
        answers[1].append(other.step(np.array([0.01, pedal], np.float32)))
    assert_equal(*answers)


def test_who_shifts_by_hand_drives_in_the_gear_that_was_asked_for(world):
    """Backwards, too; and a pressed clutch takes the drive away."""
    env = world.make(action="manual")

    def drive(gear, clutch):
        env.reset(seed=0)
        for _ in range(15):
            car = env.step(np.array([0.0, 0.6, 0.0, gear, clutch], np.float32))[4]["car"]
        return car

    assert [drive(gear, 0.0).gear for gear in (-1, 0, 1, 2)] == [-1, 0, 1, 2]
    assert drive(-1, 0.0).speed_x < -1.0
    assert drive(1, 0.0).speed_x > 1.0
    assert drive(1, 1.0).speed_x < 0.5  # it rolls down the slope
    env.close()


def time_to(metres, env):
    """How long a car at full throttle takes [s], and how often it shifts on the way."""
    _, info = env.reset(seed=0)
    gears = []
    while info["distance"] < metres:
        car = info["car"]
        gears.append(car.gear)
        steering = 2.0 * car.heading_error - 0.06 * car.distance_from_axis
        *_, info = env.step(np.array([steering, 1.0, 0.0], np.float32))
    env.close()
    return info["car"].time, int(np.count_nonzero(np.diff(gears)))


def test_gears_by_road_speed_do_not_hunt(world):
    """At full throttle from the grid, the wheels spin in first gear."""
    drives = {
        gearbox: time_to(100.0, world.make(track="e-track-5", gearbox=gearbox))
        for gearbox in GEARBOXES
    }
    seconds, shifts = drives["road_speed"]
    assert shifts <= 3  # first, second and third gear
    assert seconds < drives["automatic"][0] - 0.5


@pytest.mark.parametrize("start", ["grid", "random"])
def test_the_same_seed_gives_the_same_bytes(world, start):
    assert_equal(rollout(world, 3, start=start), rollout(world, 3, start=start))


def test_the_same_seed_gives_the_same_bytes_in_another_process(world):
    code = (
        "import json, sys\nfrom rollouts import rollout_digest\n"
        "print(rollout_digest(sys.argv[1], json.loads(sys.argv[2])))"
    )

    def digest(hash_seed):
        tests = str(Path(__file__).parent)
        return subprocess.run(
            [sys.executable, "-c", code, world.id, json.dumps(world.options)],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "PYTHONHASHSEED": hash_seed, "PYTHONPATH": tests},
        ).stdout

    here = rollout_digest(world.id, world.options)
    assert digest("1").strip() == digest("2").strip() == here
    assert len(here) == hashlib.sha256().digest_size * 2


def test_another_seed_gives_another_drive(world):
    one, other = rollout(world, 1, 5, start="random"), rollout(world, 2, 5, start="random")
    assert not np.array_equal(one[0][0], other[0][0])


def test_environments_side_by_side_do_not_share_state(world):
    alone = rollout(world, 5, 100)
    first, second = world.make(), world.make()
    first.action_space.seed(5)
    seen = [first.reset(seed=5)]
    second.reset(seed=99)
    for _ in range(100):
        action = first.action_space.sample()
        answer = first.step(action)
        seen.append(answer)
        if second.step(np.array([0.3, 1.0, 0.0], np.float32))[2]:
            second.reset()
        if answer[2] or answer[3]:
            seen.append(first.reset())
    assert_equal(alone, seen)


def test_observations_stay_in_their_space(world):
    env = world.make()
    for answer in rollout(world, 11, 500, start="random"):
        assert env.observation_space.contains(answer[0]), answer[0]


def test_an_observation_is_what_the_sensor_table_makes_of_the_car(world):
    """Sensor by sensor, by other code than the environment's."""
    for answer in rollout(world, 6, 200, start="random"):
        assert plainly_encoded(answer[-1]["car"]).tobytes() == answer[0].tobytes()


def test_no_checker_stands_between_the_agent_and_the_world(world):
    """It would be asked at every timestep; both libraries' checks above look at more."""
    env = world.make()
    while env is not env.unwrapped:
        assert not isinstance(env, PassiveEnvChecker)
        env = env.env


def test_no_memory_is_shared_between_timesteps(world):
    env = world.make()
    first, info = env.reset(seed=0)
    kept, car = first.copy(), info["car"]
    beams = car.range_finders.copy()
    second = env.step(np.array([0.1, 1.0, 0.0], np.float32))[0]
    second[:] = 0.5
    env.step(np.array([0.1, 1.0, 0.0], np.float32))
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(car.range_finders, beams)
    assert not car.range_finders.flags.writeable


def test_no_sensor_is_dead(world):
    driver, env = ScriptedDriver(), world.make(start="random")
    rows = []
    for seed in range(4):
        observation, _ = env.reset(seed=seed)
        for _ in range(100):
            rows.append(observation)
            observation, _, terminated, _, _ = env.step(driver.predict(observation)[0])
            if terminated:
                break
    assert np.flatnonzero(np.ptp(rows, axis=0) == 0.0).tolist() == []


def test_the_reward_is_the_sum_of_its_terms(world):
    for _, reward, _, _, info in (s for s in rollout(world, 2, reward="blog") if len(s) == 5):
        assert sum(info["reward_terms"].values()) == reward


def kinds(info):
    """The names in ``info``, with the types of their values."""
    return {
        name: kinds(value) if name == "reward_terms" else type(value)
        for name, value in info.items()
    }


@pytest.mark.parametrize("reward", ["blog", {"damage": -1, "crash": -1}])
def test_info_has_the_same_names_and_types_from_the_reset_to_the_end(world, reward):
    """Recorders make one column of each, and have no place for None or for a later name."""
    infos = [answer[-1] for answer in rollout(world, 4, reward=reward)]
    assert kinds(infos[0]) == {
        **dict.fromkeys(("distance", "lap_time", "best_lap_time", "damage"), float),
        "laps": int,
        "off_track": bool,
        "end": str,
        "car": CarState,
        "reward_terms": dict.fromkeys([*Reward(reward).names, "crash"], float),
    }
    assert [kinds(info) for info in infos] == [kinds(infos[0])] * len(infos)
    assert "" in {info["end"] for info in infos} > {""}


def test_actions_out_of_range_are_clipped(world):
    def first_step(action):
        env = world.make(disable_env_checker=True)
        env.reset(seed=0)
        return env.step(np.array(action, np.float32))[:2]

    assert_equal([first_step([9.0, 5.0, -3.0])], [first_step([1.0, 1.0, 0.0])])


def test_a_closed_environment_can_be_closed_again(world):
    env = world.make()
    env.reset()
    env.close()
    env.close()


def test_a_pickled_environment_goes_on_where_it_was(world):
    env = world.make(render_mode="rgb_array", start="random").unwrapped
    env.reset(seed=0)
    action = np.array([0.02, 0.6, 0.0], np.float32)
    for _ in range(5):
        env.step(action)
    env.render()
    copy = pickle.loads(pickle.dumps(env))
    assert_equal([copy.step(action) for _ in range(5)], [env.step(action) for _ in range(5)])
    assert_equal([copy.reset()], [env.reset()])
    env.close()


def test_action_repeat_holds_the_controls(world):
    action = np.array([0.05, 0.8, 0.0], np.float32)
    fine, coarse = world.make(action_repeat=1), world.make(action_repeat=5)
    fine.reset(seed=0)
    coarse.reset(seed=0)
    for _ in range(5):
        last = fine.step(action)[0]
    np.testing.assert_array_equal(last, coarse.step(action)[0])


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_vector_environments_drive_as_one_alone(world, vec_env_cls):
    """Also where the children must import the package themselves: with each way to start them."""
    start = {"start_method": "forkserver" if world.id == "Torcs-v0" else "spawn"}
    choice = {
        "vec_env_cls": vec_env_cls, "vec_env_kwargs": {} if vec_env_cls is DummyVecEnv else start,
    }  # fmt: skip
    vector = make_vec_env(
        f"sb3_torcs:{world.id}", n_envs=2, seed=5, env_kwargs=world.options, **choice
    )
    try:
        single = world.make()
        observations, expected = vector.reset(), single.reset(seed=6)[0]
        np.testing.assert_array_equal(observations[1], expected)
        action = np.array([0.1, 0.7, 0.0], np.float32)
        for _ in range(10):
            observations = vector.step(np.stack([action, action]))[0]
            expected = single.step(action)[0]
        np.testing.assert_array_equal(observations[1], expected)
    finally:
        vector.close()


def test_nothing_graphical_loads_before_the_first_picture(world):
    code = (
        "import sys, gymnasium as gym\n"
        f"env = gym.make('sb3_torcs:{world.id}', render_mode='rgb_array', **{world.options})\n"
        "env.reset(seed=0); env.step(env.action_space.sample())\n"
        "print([m for m in ('pygame', 'matplotlib', 'highway_env', 'torch') if m in sys.modules])"
    )
    python = [sys.executable, "-c", code]
    answer = subprocess.run(python, capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"


def test_importing_the_package_twice_registers_once():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sb3_torcs.register_envs()


def test_the_real_game_is_never_replaced_in_silence(monkeypatch):
    """Without the engine it is an error that names the other world, for whoever wants that."""
    monkeypatch.setitem(sys.modules, "sb3_torcs._engine", None)
    monkeypatch.delattr("sb3_torcs._engine", raising=False)
    with pytest.raises(BackendUnavailable, match="TorcsLite-v0"):
        gym.make("sb3_torcs:Torcs-v0", track="aalborg")


def test_a_model_of_one_world_drives_in_the_other():
    """They share their spaces to the bit; so a policy of one loads in the other."""
    envs = [world.make(track="g-track-1") for world in WORLDS]
    driver = ScriptedDriver()
    for env in envs:
        assert env.observation_space == envs[0].observation_space
        assert env.action_space == envs[0].action_space
        observation, _ = env.reset(seed=0)
        for _ in range(100):
            observation, *_, info = env.step(driver.predict(observation)[0])
        assert info["distance"] > 50.0
        assert info["end"] == ""


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"action": "pedel"}, "did you mean 'pedal'"),
        ({"gearbox": "manual"}, "expected 'automatic' or 'road_speed'"),
        ({"gearbox": "road_speed", "action": "manual"}, "leave one of the two out"),
    ],
)
def test_a_wrong_layout_or_gearbox_is_refused(world, options, message):
    with pytest.raises(InvalidOption, match=message):
        world.make(**options)
