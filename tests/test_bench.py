import os
import tempfile

import pytest
import torch as th

from sb3_torcs.bench import environments as bench
from sb3_torcs.bench import on_policy as bench_on_policy
from sb3_torcs.bench import scr as bench_scr
from sb3_torcs.bench import torcs as bench_torcs
from sb3_torcs.bench.learning import training_share
from sb3_torcs.bench.on_policy import ppo
from sb3_torcs.bench.stages import KEYS, stages
from sb3_torcs.bench.updates import default_updates, products_of_an_update
from sb3_torcs.bench.vec_env import race, vec_env
from sb3_torcs.errors import BackendUnavailable


def test_every_figure_is_measured_once_or_empty(monkeypatch):
    """The keys are what other tools read."""
    monkeypatch.setattr(bench, "RESETS", 2)
    measurements = stages(0.01)
    figures = measurements["resets"]()
    assert list(figures) == ["lite_reset_ms"]
    assert len(set(KEYS)) == len(KEYS) == 24


def test_the_environments_are_measured_in_the_same_run(monkeypatch):
    monkeypatch.setattr(bench, "TICKS_PER_TURN", 50)
    monkeypatch.setattr(bench, "RACETRACK_STEPS_PER_TURN", 2)
    figures = bench.environments(0.0001)
    assert list(figures) == ["lite_ticks_per_s", "racetrack_v1_steps_per_s"]
    assert min(figures.values()) > 0.0


def test_the_measured_actions_keep_the_car_moving():
    """A car that stands is cheaper than one that drives."""
    env = bench.gym.make(bench.LITE, action_repeat=1)
    actions = bench_torcs.scripted_actions(env, 500)
    env.reset(seed=0)
    speeds = [env.step(action)[4]["car"].speed_x for action in actions]
    env.close()
    assert len(actions) == 500
    assert speeds[-1] > 10.0


@pytest.fixture
def short(game, monkeypatch):
    """Turns of a fraction of a second."""
    monkeypatch.setattr(bench_torcs, "TICKS_PER_TURN", 100)
    monkeypatch.setattr(bench_torcs, "RESETS", 2)
    monkeypatch.setattr(bench_torcs, "LOADS", 1)
    monkeypatch.setattr(bench_torcs, "RACES", 2)
    monkeypatch.setattr(bench_torcs, "BATCHES", 5)
    monkeypatch.setattr(bench_torcs, "SLICE", 0.01)
    monkeypatch.setattr(bench_scr, "TICKS_PER_TURN", 100)
    monkeypatch.setattr(bench_scr, "RESETS", 2)
    monkeypatch.setattr(bench_scr, "PICTURES", 2)
    monkeypatch.setattr(bench_scr, "SIZE", (160, 120))


GAME = [
    "torcs_limit_ticks_per_s", "torcs_cpp_ticks_per_s", "torcs_env_ticks_per_s",
    "torcs_env_repeat5_ticks_per_s", "torcs_reset_ms", "torcs_load_ms",
]  # fmt: skip


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize(("measure", "names"), [
    (lambda: {**bench_scr.ticks(0.0001), **bench_scr.resets(), **bench_scr.pictures()},
     ["scr_ticks_per_s", "scr_reset_ms", "game_frames_per_s"]),
    (lambda: {**bench_torcs.ticks(0.0001), **bench_torcs.resets(), **bench_torcs.loads()}, GAME),
    (lambda: vec_env(0.0001), ["vec_env_timesteps_per_s", "vec_env_two_threads_ratio"]),
], ids=["its own process", "this process", "races at once"])  # fmt: skip
def test_the_game_is_measured_by_its_names(monkeypatch, measure, names):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1})
    figures = measure()
    assert list(figures) == names
    assert min(figures.values()) > 0.0
    assert set(figures) < set(KEYS)


@pytest.mark.usefixtures("short")
def test_the_second_thread_is_measured_against_a_second_process(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1})
    assert bench_torcs.vector(0.0001)["torcs_vector2_ratio"] > 0.0


@pytest.mark.usefixtures("game")
def test_a_race_is_measured_by_its_name():
    (rate,) = (race(0.0001, agents=2)[key] for key in KEYS if key.startswith("race_"))
    assert rate > 0.0


@pytest.mark.rare
@pytest.mark.usefixtures("game")
def test_learning_is_measured_on_two_cores_and_leaves_them_as_they_were(monkeypatch, tmp_path):
    cores, threads = os.sched_getaffinity(0), th.get_num_threads()
    monkeypatch.setattr(bench_on_policy, "ROLLOUTS", 2)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    figures = ppo(0.0001)
    assert list(tmp_path.iterdir()) == []
    assert list(figures) == ["ppo_timesteps_per_s", "ppo_dummy_timesteps_per_s"]
    assert min(figures.values()) > 0.0
    assert set(figures) < set(KEYS)
    assert (os.sched_getaffinity(0), th.get_num_threads()) == (cores, threads)


def test_one_core_has_no_second_thread_to_measure(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0})
    assert set(ppo(1.0).values()) == {None}
    assert bench_torcs.vector(1.0) == {"torcs_vector2_ratio": None}
    assert vec_env(0.0001)["vec_env_two_threads_ratio"] is None


@pytest.mark.usefixtures("game")
def test_the_drive_of_the_limit_is_the_same_each_turn():
    """Saving and restoring in between leaves no trace in it."""
    env = bench_torcs.gym.make(bench_torcs.TORCS, action_repeat=1)
    actions = bench_torcs.scripted_actions(env, 200)
    engine = env.unwrapped.backend.engine
    controls = bench_torcs.np.array(actions, float)
    bench_torcs._limit(engine, controls)
    place = engine.read(0)
    engine.start()
    engine.replay(controls, False)
    expected = engine.read(0)
    env.close()
    assert place.speed_x > 10.0
    assert place[:23] == expected[:23]


def test_without_the_game_its_figures_stay_empty(monkeypatch):
    def missing(*args):
        raise BackendUnavailable("no TORCS")

    for name in ("ticks", "resets", "loads", "vector"):
        monkeypatch.setattr(bench_torcs, name, missing)
    measurements = stages(1.0)
    assert [measurements[name]() for name in measurements if name.startswith("game")] == [{}] * 4


def test_an_update_is_counted_by_its_matrix_products():
    """One actor and one critic of one unit per layer, 29 observations, 3 actions; by hand."""
    counted = products_of_an_update({"net_arch": {"pi": [1, 1], "qf": [1, 1]}, "n_critics": 1})
    actor, critic = 29 + 1 + 3, 29 + 1 + 3 + 1 + 1
    assert counted == 3 * critic + (1 + 1 + 1) + critic + (3 + 1 + 1) + 3 * actor + (1 + 3)


def test_updates_and_products_are_measured_in_one_run():
    figures = default_updates(0.001)
    assert list(figures) == [
        "core_gflops", "ddpg_updates_per_s", "ddpg_update_gflop", "ddpg_two_threads_ratio",
    ]  # fmt: skip
    assert figures["ddpg_update_gflop"] == pytest.approx(0.177, abs=0.001)
    assert min(figures["core_gflops"], figures["ddpg_updates_per_s"]) > 0.0


@pytest.mark.rare
def test_environment_and_callbacks_are_a_small_part_of_a_training_timestep(monkeypatch, tmp_path):
    """Whoever trains waits for the networks, not for the simulator. No folder stays behind."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    share = training_share(100)["training_env_share"]
    assert list(tmp_path.iterdir()) == []
    assert 0.0 < share <= 0.3
