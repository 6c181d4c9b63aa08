"""Races on threads are the races one after the other, to the bit."""

from __future__ import annotations

import copy
import gc
import multiprocessing
import pickle
import threading

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv

import sb3_torcs
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.envs.torcs_vector import TorcsVectorEnv
from sb3_torcs.errors import (
    CarLost,
    EngineForked,
    EnvClosed,
    InvalidAction,
    InvalidOption,
    TrackNotFound,
)

pytestmark = pytest.mark.usefixtures("game")

GAS = np.array([0.0, 1.0, 0.0], np.float32)
MILD = np.array([0.3, 1.0, 0.3], np.float32)  # of random actions: some races last, some do not


@pytest.fixture(autouse=True)
def gymnasiums_own_time_limit(monkeypatch):
    """Once imported, the RL Zoo has put one of its own there, which adds a key to infos."""
    classes = gym.wrappers.TimeLimit.__mro__
    own = next(cls for cls in classes if cls.__module__.startswith("gymnasium."))
    monkeypatch.setattr(gym.wrappers, "TimeLimit", own)


@pytest.fixture
def make():
    """Make vector environments, and close them afterwards."""
    made = []

    def make(**options):
        made.append(gym.make_vec("sb3_torcs:Torcs-v0", **options))
        return made[-1]

    yield make
    for envs in made:
        envs.close()


def drive(envs, seed, steps):
    """Everything that is seen, with random actions."""
    envs.action_space.seed(seed)
    yield envs.reset(seed=seed)
    for _ in range(steps):
        yield envs.step(envs.action_space.sample() * MILD)


def assert_same(one, other, where):
    """The same values, types, dtypes and order of names, all the way down."""
    assert type(one) is type(other), where
    if isinstance(one, dict):
        assert list(one) == list(other), where
        for name in one:
            assert_same(one[name], other[name], f"{where} {name}")
    elif isinstance(one, np.ndarray) and one.dtype != object:
        assert (one.dtype, one.shape) == (other.dtype, other.shape), where
        assert one.tobytes() == other.tobytes(), f"{where}: {one} != {other}"
    elif isinstance(one, (tuple, np.ndarray)):
        for i, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_same(a, b, f"{where}[{i}]")
    else:
        assert one == other, f"{where}: {one} != {other}"


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(
    ("seed", "options"),
    [
        (0, {"start": "grid", "max_episode_steps": 25}),
        (1, {"start": "random"}),
        (2, {"start": "random", "reward": "blog", "max_episode_steps": 40, "action_repeat": 2}),
        (3, {"start": "random", "conditions": {"sensor_noise": True}, "track": "michigan"}),
        (4, {"start": "random", "track": ["aalborg", "g-track-1"], "max_episode_steps": 20}),
        (5, {"start": "random", "car": ["car1-trb1", "baja-bug"]}),
    ],
)
def test_threads_change_nothing_but_the_time(make, threads, mode, seed, options):
    ours = make(num_envs=3, threads=threads, autoreset_mode=mode, **options)
    theirs = make(
        num_envs=3,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
        **options,
    )
    ends = 0
    for step, (one, other) in enumerate(
        zip(drive(ours, seed, 120), drive(theirs, seed, 120), strict=True)
    ):
        assert_same(one, other, f"step {step}")
        ends += 0 if step == 0 else int((one[2] | one[3]).sum())
    assert ends > 0, "no episode ended, so that no reset was compared"


def test_the_fallback_is_driven_at_once_too():
    options = {"num_envs": 3, "start": "random", "max_episode_steps": 30}
    kinds = [gym.make_vec("sb3_torcs:TorcsLite-v0", **options)]
    kinds.append(gym.make_vec("sb3_torcs:TorcsLite-v0", vectorization_mode="sync", **options))
    assert isinstance(kinds[0], TorcsVectorEnv)
    for step, answers in enumerate(zip(*(drive(envs, 2, 80) for envs in kinds), strict=True)):
        assert_same(*answers, f"step {step}")
    for envs in kinds:
        envs.close()


def test_laps_are_told_as_by_gymnasium(make):
    """A lap is completed in one race, and not in the other."""
    options = {"num_envs": 2, "track": "e-track-5"}
    seen = []
    for envs in (make(threads=2, **options), make(vectorization_mode="sync", **options)):
        envs.reset(seed=0)
        mask, driver = np.array([False, True]), ScriptedDriver()
        place = {"distance": -60.0, "speed": 50.0, "reset_mask": mask}
        answers = [envs.reset(options=place)]
        for _ in range(600):
            answers.append(envs.step(driver.predict(answers[-1][0])[0]))
        seen.append(answers)
    for step, (one, other) in enumerate(zip(*seen, strict=True)):
        assert_same(one, other, f"step {step}")
    lapped = [(answer[4]["lap_time"] > 0.0).tolist() for answer in seen[0][1:]]
    assert [True, False] in lapped or [False, True] in lapped


def test_make_vec_makes_one_environment_with_the_registered_limit(make):
    envs = make(num_envs=3)
    assert isinstance(envs, VectorEnv)
    assert isinstance(envs, TorcsVectorEnv)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert envs.spec.kwargs["max_episode_steps"] == sb3_torcs.MAX_EPISODE_STEPS
    assert 1 <= envs.threads <= 3
    assert envs.observation_space.shape == (3, 29)
    assert envs.action_space.shape == (3, 3)


@pytest.mark.parametrize(("limit", "cut_at"), [(3, 3), (-1, None), (None, None)])
def test_the_limit_is_that_of_gym_make(make, limit, cut_at):
    envs = make(num_envs=1, max_episode_steps=limit)
    envs.reset(seed=0)
    cuts = [bool(envs.step(GAS[None])[3][0]) for _ in range(5)]
    assert cuts == [step == cut_at for step in range(1, 6)]


def test_all_races_may_begin_an_episode_at_once(make):
    envs = make(num_envs=2, max_episode_steps=1)
    first = envs.reset(seed=0)[0]
    assert envs.step([GAS, GAS])[3].all()
    seen, rewards, _, truncated, _ = envs.step([GAS, GAS])
    np.testing.assert_array_equal(seen, first)
    assert not rewards.any()
    assert not truncated.any()


def test_what_was_returned_stays_as_it_was(make):
    envs = make(num_envs=2, threads=2)
    kept = [envs.reset(seed=0)[0]] + [envs.step(np.stack([GAS, GAS]))[0] for _ in range(3)]
    copies = [observations.copy() for observations in kept]
    envs.step(np.stack([GAS, GAS]))
    envs.reset(seed=1)
    for one, copied in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(one, copied)


def test_pictures_are_taken_of_each_race(make):
    envs = make(num_envs=2, render_mode="rgb_array")
    envs.reset(seed=0)
    frames = envs.render()
    assert len(frames) == 2
    assert frames[0].dtype == np.uint8
    assert envs.render_mode == "rgb_array"


def test_attributes_and_methods_of_the_races_can_be_used(make):
    envs = make(num_envs=2)
    assert envs.call("set_start", "random") == ("grid", "grid")
    envs.reset(seed=0)
    assert [car.time for car in envs.get_attr("car")] == [0.0, 0.0]


def test_a_race_can_be_copied_out_of_the_fleet(make):
    """What the threads did is remembered as what a step does."""
    envs = make(num_envs=2, threads=2)
    envs.reset(seed=0)
    for _ in range(5):
        envs.step(np.stack([GAS, GAS]))
    copy = pickle.loads(pickle.dumps(envs.envs[1]))
    expected = envs.step(np.stack([GAS, GAS]))
    assert copy.step(GAS)[0].tobytes() == expected[0][1].tobytes()
    copy.close()


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"num_envs": 0}, InvalidOption, "num_envs is 0; expected a whole number >= 1"),
        ({"threads": 0}, InvalidOption, "threads is 0; expected a whole number >= 1, or None"),
        ({"threads": 1.5}, InvalidOption, "threads is 1.5"),
        ({"max_episode_steps": 0}, InvalidOption, "max_episode_steps is 0; .* or -1 for no limit"),
        ({"track": "aalburg"}, TrackNotFound, "aalborg"),
        ({"reward": {"speed": 1.0}}, LookupError, "no reward term 'speed'"),
        ({"opponents": np.array(["bt", "tita"])}, InvalidOption, "opponents is .*expected a list"),
    ],
)
def test_a_wrong_option_is_told_as_by_a_single_environment(make, options, error, message):
    with pytest.raises(error, match=message):
        make(**{"num_envs": 2, **options})


def test_a_wrong_action_is_told_and_leaves_the_races_usable(make):
    envs = make(num_envs=2, threads=2)
    envs.reset(seed=0)
    times = [env.backend.engine.read(0).time for env in envs.envs]
    with pytest.raises(InvalidAction, match="environment 1: throttle is nan"):
        envs.step(np.array([GAS, [0.0, np.nan, 0.0]], np.float32))
    assert [env.backend.engine.read(0).time for env in envs.envs] == times  # nobody has driven
    with pytest.raises(InvalidAction, match="3 actions for 2 environments"):
        envs.step(np.stack([GAS, GAS, GAS]))
    first = envs.reset(seed=5)[0]
    np.testing.assert_array_equal(first, envs.reset(seed=5)[0])
    envs.step(np.stack([GAS, GAS]))


def test_a_wrong_action_does_not_arrive_late(make):
    envs = make(num_envs=2, conditions={"delay": 6})
    envs.reset(seed=0)
    waiting = [env.episode["waiting"].tobytes() for env in envs.envs]
    with pytest.raises(InvalidAction, match="throttle is nan"):
        envs.step(np.array([GAS, [0.0, np.nan, 0.0]], np.float32))
    assert [env.episode["waiting"].tobytes() for env in envs.envs] == waiting


@pytest.mark.parametrize("threads", [1, 2])
def test_a_fault_of_one_engine_is_raised_with_its_class(make, threads):
    envs = make(num_envs=3, threads=threads)
    envs.reset(seed=0)
    envs.envs[1].backend.engine.close()
    with pytest.raises(EnvClosed, match="this engine is closed"):
        envs.step(np.stack([GAS] * 3))
    assert np.isfinite(envs.envs[2].step(GAS)[0]).all()  # no thread holds it any more


def test_a_car_that_is_lost_ends_its_own_race_only(make):
    envs = make(num_envs=2)
    envs.reset(seed=0)
    fleet = envs._batch._fleet

    class Losing:
        def __getattr__(self, name):
            return getattr(fleet, name)

        def step(self, *order):
            fleet.step(*order)
            return [1]

        def failure(self, place):
            return CarLost("the car is nowhere")

    envs._batch._fleet = Losing()
    _, _, terminated, truncated, infos = envs.step(np.stack([GAS] * 2))
    assert (terminated.tolist(), truncated.tolist()) == ([False, True], [False, False])
    assert infos["end"].tolist() == ["", "lost"]


def test_before_a_reset_and_after_close_there_is_no_step(make):
    envs = make(num_envs=2)
    with pytest.raises(EnvClosed, match="step before reset"):
        envs.step(np.stack([GAS, GAS]))
    envs.close()
    envs.close()
    with pytest.raises(EnvClosed, match="step after close"):
        envs.step(np.stack([GAS, GAS]))
    assert all(env._closed for env in envs.envs)


def test_all_of_them_cannot_be_copied(make):
    for copied in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(InvalidOption, match=r"TorcsVectorEnv, whose threads .* make another"):
            copied(make(num_envs=1))


def test_without_autoreset_an_ended_episode_has_to_be_reset(make):
    envs = make(num_envs=2, autoreset_mode=AutoresetMode.DISABLED, max_episode_steps=1)
    envs.reset(seed=0)
    ended = envs.step(np.stack([GAS, GAS]))[3]
    with pytest.raises(ResetNeeded, match="reset_mask"):
        envs.step(np.stack([GAS, GAS]))
    envs.reset(options={"reset_mask": ended})
    envs.step(np.stack([GAS, GAS]))


def test_threads_end_with_the_environment(make):
    def threads():
        with open("/proc/self/status", encoding="ascii") as status:
            return next(int(line.split()[1]) for line in status if line.startswith("Threads:"))

    before = threads()
    envs = make(num_envs=4, threads=3)
    assert threads() == before + 2
    envs.close()
    assert threads() == before
    forgotten = TorcsVectorEnv(2, threads=2)
    del forgotten
    gc.collect()
    assert threads() == before


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # of forks beside threads
def test_a_forked_child_is_told_to_make_its_own(make):
    """It has the memory of the threads, but not the threads; it must not wait for them."""
    envs = make(num_envs=2, threads=2)
    envs.reset(seed=0)

    def child(pipe):
        try:
            envs.step(np.stack([GAS, GAS]))
        except EngineForked as error:
            pipe.send(str(error))
        envs.close()
        pipe.send("closed")

    here, there = multiprocessing.Pipe()
    process = multiprocessing.get_context("fork").Process(target=child, args=(there,))
    process.start()
    try:
        assert here.poll(30.0), "the child hangs"
        assert "make the environment after the fork" in here.recv()
        assert here.poll(30.0), "the child hangs"
        assert here.recv() == "closed"
    finally:
        process.kill()
        process.join()
    envs.step(np.stack([GAS, GAS]))


def test_two_threads_of_python_may_drive_two_vector_environments(make):
    def results(envs):
        return [answer[0].tobytes() for answer in drive(envs, 4, 60)]

    alone = results(make(num_envs=2, threads=2, start="random"))
    seen = [[], []]

    def run(i, envs):
        seen[i] = results(envs)

    workers = [
        threading.Thread(target=run, args=(i, make(num_envs=2, threads=2, start="random")))
        for i in range(2)
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert seen == [alone, alone]
