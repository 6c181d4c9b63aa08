"""Races that are driven at once are those of SB3's own DummyVecEnv, to the bit."""

from __future__ import annotations

import gc
import multiprocessing
import pickle
import signal
import time
from collections.abc import Mapping
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor, load_results
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecMonitor, VecNormalize

import sb3_torcs  # noqa: F401  # registers the ids
from sb3_torcs import rewards
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.callbacks import DrivingMetricsCallback
from sb3_torcs.car import CAR_RECORD, car_from_record
from sb3_torcs.envs import batch
from sb3_torcs.envs.episode import car_of
from sb3_torcs.envs.torcs_lite import TorcsLiteEnv
from sb3_torcs.errors import (
    CarLost,
    EngineForked,
    EnvClosed,
    InvalidAction,
    InvalidOption,
    UnknownCar,
)
from sb3_torcs.vec_env import TorcsVecEnv, glance

GAS = np.array([0.0, 1.0, 0.0], np.float32)
LITE, TORCS = "TorcsLite-v0", "Torcs-v0"
EVERY_TERM = {name: 0.1 * (place + 1) for place, name in enumerate(rewards.TERMS)}


@pytest.fixture(params=[LITE, TORCS])
def env_id(request):
    if request.param == TORCS:
        request.getfixturevalue("game")
    return request.param


@pytest.fixture
def make():
    """Make races, and close them afterwards."""
    made = []

    def make(*args, **options):
        made.append(TorcsVecEnv(*args, **options))
        return made[-1]

    yield make
    for envs in made:
        envs.close()


def plain(races, env_id, **options):
    """What everything is held to."""
    return DummyVecEnv([lambda: Monitor(gym.make(env_id, **options))] * races)


def assert_same(one, other, where=""):
    """The same values, types, dtypes and order of names, all the way down; clocks differ."""
    if isinstance(other, Mapping):
        assert list(one) == list(other), where
        for name in set(other) - {"t"}:
            assert_same(one[name], other[name], f"{where} {name}")
    elif isinstance(other, np.ndarray):
        assert (one.dtype, one.shape) == (other.dtype, other.shape), where
        assert one.tobytes() == other.tobytes(), f"{where}: {one} != {other}"
    elif isinstance(other, (tuple, list)):
        assert len(one) == len(other), where
        for i, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_same(a, b, f"{where}[{i}]")
    else:
        assert type(one) is type(other), where
        assert one == other, f"{where}: {one} != {other}"


def wait_until(true, seconds=600.0):
    """The system takes a moment to forget a thread that has ended."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.001)


def random_actions(envs, steps, seed=0):
    """Of which some races last, and some do not."""
    rng = np.random.default_rng(seed)
    low, high = envs.action_space.low, envs.action_space.high
    for _ in range(steps):
        asked = rng.uniform(low - 0.1, high + 0.1, (envs.num_envs, len(low)))
        asked[:, 0] *= 0.2
        yield asked.astype(np.float32)


def assert_same_drives(ours, theirs, steps, seed=0):
    """Drive both from a reset on; returns how many episodes ended."""
    assert_same(ours.reset(), theirs.reset(), "reset")
    ends = 0
    for step, asked in enumerate(random_actions(theirs, steps, seed)):
        one, other = ours.step(asked), theirs.step(asked)
        assert_same(one, other, f"step {step}")
        assert_same(ours.reset_infos, theirs.reset_infos, f"reset info of step {step}")
        ends += int(other[2].sum())
    return ends


OPTIONS = [
    {"start": "random"},
    {"start": "random", "reward": "blog", "max_episode_steps": 20, "action_repeat": 2},
    {"start": "random", "reward": {**EVERY_TERM, "crash": -3.0}, "laps": 1},
    {"start": "random", "ends": {"runoff": 3.0}},
    {
        "start": "random",
        "ends": {"runoff": 3.0, "recovery": 3.0},
        "aids": ["unstick"],
        "action": "pedal",
    },
    {"reward": "apex", "action": "manual", "gearbox": "automatic"},
    {"action": "pedal", "gearbox": "road_speed", "max_episode_steps": -1},
    {"start": "random", "track": ["aalborg", "g-track-1", "e-track-5"], "max_episode_steps": 15},
]


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: "-".join(options))
def test_it_does_what_a_dummy_does(env_id, make, options, threads):
    """Observations, rewards, ends, infos, records of monitors; also with tracks from a list."""
    ours = make(3, threads=threads, env_id=env_id, **options)
    theirs = plain(3, env_id, **options)
    for envs in (ours, theirs):
        envs.seed(7)
    assert assert_same_drives(ours, theirs, 160) > 0, "no episode ended: nothing was compared"
    for name in ("car", "total_steps", "episode_returns", "controls", "_elapsed_steps"):
        if name != "_elapsed_steps" or options.get("max_episode_steps") != -1:
            assert_same(ours.get_attr(name), theirs.get_attr(name), name)


@pytest.mark.usefixtures("game")
@pytest.mark.parametrize(
    "options",
    [
        {"car": ["car1-trb1", "baja-bug"], "track": ["aalborg", "dirt-1"], "start": "random"},
        {"conditions": {"sensor_noise": True}, "start": "random"},
        {"opponents": ["inferno"], "laps": 2},
    ],
    ids=lambda options: "-".join(options),
)
def test_cars_noise_and_opponents_are_those_of_a_dummy(make, options):
    ours, theirs = make(2, threads=2, **options), plain(2, TORCS, **options)
    for envs in (ours, theirs):
        envs.seed(3)
    assert_same_drives(ours, theirs, 120)
    assert_same(ours.get_attr("car"), theirs.get_attr("car"))


def test_each_episode_has_a_car_from_the_list(make, game):
    envs = make(1, car=["car1-trb1", "baja-bug"])
    envs.seed(0)
    cars = set()
    for _ in range(12):
        envs.reset()
        cars |= {backend.car for backend in envs.get_attr("backend")}
    assert cars == {"car1-trb1", "baja-bug"}


def test_laps_are_told(make):
    """A lap is completed in one race, and not in the other."""
    options = {"track": "e-track-5", "laps": 2}
    ours, theirs = make(2, env_id=LITE, **options), plain(2, LITE, **options)
    seen = []
    for envs in (ours, theirs):
        driver = ScriptedDriver()
        envs.seed(0)
        envs.set_options([{"distance": -60.0, "speed": 50.0}, {}])
        observations, answers = envs.reset(), []
        for _ in range(500):
            answers.append(envs.step(driver.predict(observations)[0]))
            observations = answers[-1][0]
        seen.append(answers)
    assert_same(*seen)
    assert any(infos[0]["lap_time"] for *_, infos in seen[0])


def test_what_was_returned_stays_as_it_was(env_id, make):
    envs = make(2, env_id=env_id)
    envs.reset()
    kept = [envs.step(np.stack([GAS, GAS])) for _ in range(3)]
    copies = pickle.dumps([answer[:3] for answer in kept])
    cars = [kept[0][3][0]["car"]]
    for _ in range(3):
        envs.step(np.stack([GAS, GAS]))
    assert pickle.dumps([answer[:3] for answer in kept]) == copies
    assert kept[1][3][0]["car"].time > cars[0].time, "made late, it is of its own timestep"
    assert not cars[0].range_finders.flags.writeable


def test_an_info_that_is_read_late_is_of_its_own_timestep(env_id, make):
    """Also if the episode has been ended from outside since."""
    early, late = (make(2, env_id=env_id) for _ in range(2))
    found = []
    for envs in (early, late):
        envs.seed(0)
        envs.reset()
        for _ in range(20):
            infos = envs.step([GAS, GAS])[3]
        if envs is late:
            envs.env_method("reset", indices=0)
            envs.step([GAS, GAS])
        found.append([dict(info) for info in infos])
    assert_same(*found)


def test_infos_are_made_when_somebody_asks(make, monkeypatch):
    made = []
    monkeypatch.setattr(batch, "car_of", lambda *place: made.append(1) or car_of(*place))
    envs = make(2, env_id=LITE)
    envs.reset()
    *_, infos = envs.step(np.stack([GAS, GAS]))
    asked = [infos[0].get(name, "none") for name in ("episode", "TimeLimit.truncated", "lap_time")]
    assert (asked, made) == (["none", False, 0.0], [])
    assert infos[0]["distance"] == infos[0]["car"].distance_raced
    assert made == [1]


def test_a_glance_reads_what_the_info_holds_and_makes_nothing(make, monkeypatch):
    made = []
    monkeypatch.setattr(batch, "car_of", lambda *place: made.append(1) or car_of(*place))
    envs = make(2, env_id=LITE)
    envs.reset()
    *_, infos = envs.step(np.stack([GAS, GAS]))
    seen = [glance(info) for info in infos]
    assert made == []
    for info, found in zip(infos, seen, strict=True):
        held = dict(info)
        assert found == (held["car"].speed_x, held["lap_time"], held["reward_terms"])
        assert glance(info) == glance(held) == found


def test_an_info_is_used_like_a_dict(make):
    envs = make(1, env_id=LITE)
    envs.reset()
    (info,) = envs.step(GAS[None])[3]
    copy = info.copy()
    assert type(copy) is dict
    assert (dict(info), len(info), list(info)) == (copy, len(copy), list(copy))
    assert ("laps" in info, "episode" in info) == (True, False)
    info["episode"] = 1
    assert info.pop("episode") == 1
    assert type(pickle.loads(pickle.dumps(info))) is dict
    for joined in (info | {"laps": -1}, {"laps": 0, "a": 1} | info, info | info):
        assert type(joined) is dict
    assert (info | {"laps": -1}) == {**copy, "laps": -1}
    assert ({"laps": -1, "a": 1} | info) == {"a": 1, **copy}
    before = info
    info |= {"episode": 2}
    assert info is before
    assert info.pop("episode") == 2
    with pytest.raises(TypeError):
        info | 1
    with pytest.raises(KeyError):
        info["episode"]


def test_a_record_says_what_the_car_does(make):
    """The order of the engine's numbers is that of CarState."""
    envs = make(1, env_id=LITE)
    envs.reset()
    (car,) = envs.get_attr("car")
    again = car_from_record(np.hstack(car))
    assert pickle.dumps(tuple(map(np.asarray, again))) == pickle.dumps(tuple(map(np.asarray, car)))
    assert [type(value) for value in again] == [type(value) for value in car]
    assert CAR_RECORD.itemsize == 8 * len(np.hstack(car))


def test_changes_through_methods_and_attributes_count(env_id, make):
    """In the midst of an episode, and in some races only."""
    ours, theirs = make(3, env_id=env_id), plain(3, env_id)
    for envs in (ours, theirs):
        envs.seed(5)
    assert_same(ours.reset(), theirs.reset())
    changes = [
        lambda envs: envs.env_method("set_reward", {"damage": 1, "steering": -1.0}, indices=[1]),
        lambda envs: envs.env_method("set_start", "random"),
        lambda envs: envs.env_method("reset", indices=[2], options={"speed": 30.0})[0][0],
        lambda envs: [env.unwrapped.step(GAS)[0] for env in envs.envs],
        lambda envs: envs.set_attr("rewards", [], 0),
        lambda envs: envs.env_is_wrapped(Monitor),
        lambda envs: envs.reset(),
    ]
    for change in changes:
        for asked in random_actions(theirs, 12):
            assert_same(ours.step(asked), theirs.step(asked))
        assert_same(change(ours), change(theirs))


def test_to_look_at_a_standing_car_does_not_let_it_stand_longer(env_id, make):
    """It drove first, so that it may stand for less long than at the start."""
    for envs in (make(1, env_id=env_id), plain(1, env_id)):
        envs.reset()
        for timestep in range(100):
            envs.get_attr("car")
            _, _, dones, infos = envs.step([[0, 1, 0] if timestep < 25 else [0, 0, 1]])
            if dones[0]:
                break
        assert (timestep, infos[0]["end"]) == (44 if env_id == LITE else 46, "stuck")


def test_random_tracks_are_drawn_as_one_after_the_other(make):
    kwargs = {"track": ["g-track-1", "random"], "start": "random"}
    for seed in range(6):
        ours, theirs = make(2, env_id=LITE, **kwargs), plain(2, LITE, **kwargs)
        for envs in (ours, theirs):
            envs.seed(seed)
        for _ in range(3):
            assert_same(ours.reset(), theirs.reset())
            assert_same(ours.step(np.stack([GAS, GAS])), theirs.step(np.stack([GAS, GAS])))


def test_a_term_that_somebody_adds_is_asked(make, monkeypatch):
    """Beside terms that are compiled, and in its place among them."""

    def gentle(before, after, controls):
        return -abs(controls.steering) * float(after.wheel_speeds[0]) - after.gear

    monkeypatch.setitem(rewards.TERMS, "gentle", gentle)
    options = {"reward": {"progress": 1.0, "gentle": 0.3, "steering": -0.1}, "start": "random"}
    ours, theirs = make(2, env_id=LITE, **options), plain(2, LITE, **options)
    for envs in (ours, theirs):
        envs.seed(0)
    assert_same_drives(ours, theirs, 60)


def test_a_term_with_a_state_is_asked_once_for_each_timestep(make, monkeypatch):
    """At the end of an episode, too, which the environment finishes by itself."""
    calls = []

    def counts(before, after, controls):
        calls.append(after.time)
        return len(calls)

    monkeypatch.setitem(rewards.TERMS, "counts", counts)
    options = {"reward": {"counts": 1.0, "crash": -1.0}, "max_episode_steps": 20}
    asked = []
    for envs in (make(2, env_id=LITE, **options), plain(2, LITE, **options)):
        calls.clear()
        envs.seed(0)
        envs.reset()
        asked.append([envs.step([GAS, GAS])[1].tolist() for _ in range(50)])
        assert len(calls) == 100
    assert asked[0] == asked[1]


def test_after_a_term_that_fails_each_timestep_is_paid_once(make, monkeypatch):
    """The cars have driven on, and the next timestep begins where they are."""
    fails = [False]

    def careless(before, after, controls):
        return 1 / (not fails[0])

    monkeypatch.setitem(rewards.TERMS, "careless", careless)
    ours, theirs = (
        make(2, env_id=LITE, reward={"progress": 1.0, "careless": 1.0}, conditions={"delay": 3})
        for _ in range(2)
    )
    for envs in (ours, theirs):
        envs.seed(0)
        envs.reset()
        envs.step([GAS, GAS])
    fails[0] = True
    with pytest.raises(ZeroDivisionError):
        ours.step([GAS, GAS])
    fails[0] = False
    theirs.step([GAS, GAS])
    assert_same(ours.step([GAS, GAS]), theirs.step([GAS, GAS]))


def test_others_make_it_in_the_place_of_a_dummy(env_id, make, tmp_path):
    """As ``make_vec_env`` and the RL Zoo do, with files of monitors."""
    seen = []
    for kind, options in ((TorcsVecEnv, {"threads": 2}), (DummyVecEnv, {})):
        folder = tmp_path / kind.__name__
        envs = make_vec_env(
            env_id,
            n_envs=2,
            seed=3,
            monitor_dir=str(folder),
            env_kwargs={"start": "random", "max_episode_steps": 10},
            monitor_kwargs={"reset_keywords": [], "info_keywords": ["distance", "end"]},
            vec_env_cls=kind,
            vec_env_kwargs=options,
        )
        answers = [envs.reset()] + [envs.step(np.stack([GAS, GAS])) for _ in range(25)]
        envs.close()
        rows = load_results(str(folder)).sort_values(["index", "r"])
        seen.append((answers, rows[["r", "l", "distance"]].to_numpy()))
    assert_same(*seen)


@pytest.mark.parametrize(
    "wrap",
    [VecMonitor, VecNormalize, partial(VecFrameStack, n_stack=3)],
    ids=["sum", "norm", "stack"],
)
def test_wrappers_of_vector_environments_fit(make, wrap):
    options = {"start": "random", "max_episode_steps": 9}
    ours, theirs = make(2, env_id=LITE, **options), plain(2, LITE, **options)
    for envs in (ours, theirs):
        envs.seed(1)
    with np.errstate(all="ignore"), pytest.MonkeyPatch.context() as patch:
        patch.setattr("warnings.warn", lambda *_, **__: None)  # VecMonitor's, of two monitors
        assert assert_same_drives(wrap(ours), wrap(theirs), 30) > 0


def test_learning_is_the_same_and_so_is_what_callbacks_write(make, tmp_path):
    seen = []
    options = {"start": "random", "max_episode_steps": 40}
    for envs in (make(2, env_id=LITE, **options), plain(2, LITE, **options)):
        model = PPO("MlpPolicy", envs, n_steps=64, batch_size=64, seed=0, device="cpu")
        model.set_logger(configure(str(tmp_path), []))
        model.learn(256, callback=DrivingMetricsCallback(line=False))
        weights = [value.numpy() for value in model.policy.state_dict().values()]
        records = [(record["r"], record["l"]) for record in model.ep_info_buffer]
        seen.append((weights, records, model.logger.name_to_value.get("driving/speed")))
    assert_same(*seen)


def test_a_race_can_be_copied_out(env_id, make):
    envs = make(2, env_id=env_id, threads=2)
    envs.reset()
    for _ in range(5):
        envs.step(np.stack([GAS, GAS]))
    copy = pickle.loads(pickle.dumps(envs.envs[1].unwrapped))
    expected = envs.step(np.stack([GAS, GAS]))
    assert copy.step(GAS)[0].tobytes() == expected[0][1].tobytes()
    copy.close()


def test_a_window_shows_each_timestep_once(make, monkeypatch):
    shown = []
    monkeypatch.setattr(TorcsLiteEnv, "render", lambda env: shown.append(env.car.time))
    options = {"render_mode": "human", "max_episode_steps": 3}
    seen = []
    for envs in (make(2, env_id=LITE, **options), plain(2, LITE, **options)):
        envs.reset()
        for _ in range(5):
            envs.step(np.stack([GAS, GAS]))
        seen.append(sorted(shown))
        shown.clear()
    assert seen[0] == seen[1]


def test_pictures_are_taken_of_the_present_moment(make):
    ours, theirs = (f(1, env_id=LITE, render_mode="rgb_array") for f in (make, plain))
    for envs in (ours, theirs):
        envs.reset()
        for _ in range(5):
            envs.step(GAS[None])
    assert_same(ours.render(), theirs.render())
    assert_same(ours.get_images(), theirs.get_images())


class Own(TorcsLiteEnv):
    def step(self, action):
        return super().step(-action)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"races": 0}, "races is 0; expected a whole number >= 1"),
        ({"races": "two"}, "races is 'two'"),
        ({"races": 10**9}, "races is 1000000000; expected at most 10000"),
        ({"agents": 0}, "agents is 0; expected a whole number >= 1"),
        ({"threads": 0}, "threads is 0; expected a whole number >= 1, or None"),
        ({"races": [partial(gym.make, LITE)], "laps": 1}, "laps is for races made here"),
        ({"races": [partial(gym.make, "CartPole-v1")]}, "is no racing environment"),
        (
            {"races": [lambda: gym.wrappers.RecordEpisodeStatistics(gym.make(LITE))]},
            "wrapped in RecordEpisodeStatistics.* use DummyVecEnv",
        ),
        ({"races": [Own]}, "Own has a step of its own"),
        ({"races": [None]}, "races has None in it; give functions that make environments"),
        ({"env_id": None}, "env_id is None; expected 'Torcs-v0' or 'TorcsLite-v0'"),
        ({"max_episode_steps": np.array([3, 4])}, "max_episode_steps is array"),
        ({"races": 2, "max_episode_steps": []}, "max_episode_steps is an empty list"),
        (
            {"races": [partial(gym.make, LITE), partial(gym.make, LITE, action="pedal")]},
            "read actions in 2 ways",
        ),
    ],
)
def test_a_wrong_option_is_told(options, message):
    with pytest.raises(InvalidOption, match=message):
        TorcsVecEnv(**{"env_id": LITE, **options})


@pytest.mark.parametrize("agents", [1, 2])
def test_a_list_of_time_limits_goes_round_the_races(make, game, agents):
    envs = make(3, agents=agents, max_episode_steps=[2, 4])
    envs.reset()
    ends = [envs.step(np.stack([GAS] * envs.num_envs))[2] for _ in range(4)]
    first, second, third = ([bool(end[race * agents]) for end in ends] for race in range(3))
    assert first == third == [False, True, False, True]
    assert second == [False, False, False, True]


@pytest.mark.usefixtures("game")
@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"opponents": None}, InvalidOption, "opponents is None; expected a list"),
        ({"opponents": 5}, InvalidOption, "opponents is 5; expected a list"),
        (
            {"conditions": {"sensor_noise": "off"}},
            InvalidOption,
            "sensor_noise is 'off'; expected True or False",
        ),
        ({"car": 5}, InvalidOption, "car is 5; expected the name of"),
        ({"car": "car5"}, UnknownCar, "no car 'car5'"),
    ],
)
def test_a_wrong_option_of_the_game_is_told(options, error, message):
    with pytest.raises(error, match=message):
        TorcsVecEnv(1, **options)


@pytest.mark.usefixtures("game")
def test_a_game_of_its_own_is_refused():
    with pytest.raises(InvalidOption, match="are of ScrBackend; others drive in DummyVecEnv"):
        TorcsVecEnv(2, backend="scr")


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (np.array([GAS, [0.0, np.nan, 0.0]], np.float32), "throttle is nan"),
        (np.stack([GAS] * 3), "3 actions for 2 environments; expected shape"),
        (None, "1 actions for 2 environments; expected shape"),
        (np.zeros((2, 2), np.float32), "action has shape"),
        ([GAS, "full throttle"], "action has shape"),
    ],
)
def test_a_wrong_action_is_told_before_anybody_drives(env_id, make, asked, message):
    envs = make(2, env_id=env_id, threads=2)
    envs.reset()
    envs.step(np.stack([GAS, GAS]))
    times = [car.time for car in envs.get_attr("car")]
    with pytest.raises(InvalidAction, match=message):
        envs.step(asked)
    assert [car.time for car in envs.get_attr("car")] == times
    envs.step([GAS.tolist(), GAS.tolist()])


def test_a_car_that_is_lost_ends_its_own_race_only(make):
    seen = []
    for envs in (make(2, env_id=LITE, threads=2), plain(2, LITE)):
        envs.seed(0)
        answers = [envs.reset(), envs.step(np.stack([GAS, GAS]))]
        envs.env_method("get_wrapper_attr", "backend", indices=1)[0]._state[4] = np.nan
        answers += [envs.step(np.stack([GAS, GAS])) for _ in range(3)]
        seen.append(answers)
    assert_same(*seen)
    assert [answer[2].tolist() for answer in seen[0][2:]] == [[False, True], *[[False, False]] * 2]
    assert seen[0][2][3][1]["end"] == "lost"


@pytest.mark.usefixtures("game")
@pytest.mark.parametrize("threads", [1, 2])
def test_a_race_that_fails_is_told_and_the_others_drive_on(make, threads):
    envs = make(3, threads=threads)
    envs.reset()
    envs.step(np.stack([GAS] * 3))
    engines = [backend.engine for backend in envs.get_attr("backend")]
    envs.step(np.stack([GAS] * 3))
    engines[1].close()
    for _ in range(2):
        with pytest.raises(EnvClosed, match="this engine is closed"):
            envs.step(np.stack([GAS] * 3))
    assert envs.get_attr("total_steps") == [4, 2, 4]
    first, second, third = (car.time for car in envs.get_attr("car"))
    assert first == third > second


@pytest.mark.usefixtures("game")
def test_a_native_car_that_is_lost_begins_anew(make):
    envs = make(2)
    envs.reset()
    envs.step(np.stack([GAS, GAS]))
    fleet = envs._batch._fleet

    class Losing:
        def __getattr__(self, name):
            return getattr(fleet, name)

        def step(self, *order):
            fleet.step(*order)
            return [1]

        def failure(self, world):
            return CarLost("the car is nowhere")

    envs._batch._fleet = Losing()
    _, _, dones, infos = envs.step(np.stack([GAS, GAS]))
    assert (dones.tolist(), infos[1]["end"]) == ([False, True], "lost")
    envs._batch._fleet = fleet
    first, second = (car.time for car in envs.get_attr("car"))
    assert second < 0.1 < first
    assert envs.get_attr("total_steps") == [2, 2]


def test_an_interrupt_leaves_races_that_can_be_reset(env_id, make, monkeypatch):
    envs, fresh = make(2, env_id=env_id, threads=2), make(2, env_id=env_id)
    envs.reset()
    envs.step(np.stack([GAS, GAS]))

    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(batch, "end_episodes", interrupt)
        with pytest.raises(KeyboardInterrupt):
            envs.step(np.stack([GAS, GAS]))
    assert_same(envs.reset(), fresh.reset())
    assert_same(envs.step(np.stack([GAS, GAS])), fresh.step(np.stack([GAS, GAS])))


@pytest.mark.parametrize("method", ["_finish", "_go_on"])
def test_an_interrupt_between_two_episodes_waits(env_id, make, monkeypatch, method):
    """All begin their next one, and drive on."""
    envs = make(3, env_id=env_id, max_episode_steps=2)
    envs.reset()
    envs.step(np.stack([GAS] * 3))
    step = getattr(envs, method)

    def interrupted(number, answer):
        if number == 1:
            signal.raise_signal(signal.SIGINT)
        return step(number, answer)

    monkeypatch.setattr(envs, method, interrupted)
    with pytest.raises(KeyboardInterrupt):
        envs.step(np.stack([GAS] * 3))
    assert not envs.step(np.stack([GAS] * 3))[2].any()


def test_a_race_that_fails_to_close_does_not_keep_the_others_open():
    cars = TorcsVecEnv(2, env_id=LITE, threads=1)
    cars.reset()
    first, second = (env.unwrapped for env in cars._envs)
    first.backend.close = lambda: 1 / 0
    with pytest.raises(ZeroDivisionError):
        cars.close()
    assert second._closed
    cars.close()


def test_before_a_reset_and_after_close_there_is_no_step(env_id, make):
    envs = make(2, env_id=env_id)
    with pytest.raises(EnvClosed, match="step before reset; call reset first"):
        envs.step(np.stack([GAS, GAS]))
    envs.close()
    envs.close()
    with pytest.raises(EnvClosed, match="step after close"):
        envs.step(np.stack([GAS, GAS]))


def test_threads_end_with_the_races(env_id, make):
    def threads():
        with open("/proc/self/status", encoding="ascii") as status:
            return next(int(line.split()[1]) for line in status if line.startswith("Threads:"))

    def drive(number):
        envs = TorcsVecEnv(number, threads=3, env_id=env_id)
        envs.reset()
        envs.step(np.stack([GAS] * number))
        return envs

    drive(1).close()
    before = threads()
    envs = drive(4)
    assert before < threads() <= before + 2
    envs.close()
    wait_until(lambda: threads() == before)
    envs = drive(2)
    assert (envs.threads, threads()) == (2, before + 1), "one thread per race at most"
    del envs  # forgotten without close
    gc.collect()
    wait_until(lambda: threads() == before)


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # of forks beside threads
def test_a_forked_child_is_told_to_make_its_own(env_id, make):
    envs = make(2, env_id=env_id, threads=2)
    envs.reset()
    envs.step(np.stack([GAS, GAS]))

    def child(pipe):
        try:
            envs.step(np.stack([GAS, GAS]))
        except EngineForked as error:
            pipe.send(str(error))

    here, there = multiprocessing.Pipe()
    process = multiprocessing.get_context("fork").Process(target=child, args=(there,))
    process.start()
    try:
        assert here.poll(30.0), "the child hangs"
        assert "make the environment after the fork" in here.recv()
    finally:
        process.kill()
        process.join()
    envs.step(np.stack([GAS, GAS]))
