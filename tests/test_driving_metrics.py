"""What is logged is what happened, for every algorithm, and looking changes nothing."""

import csv

import gymnasium as gym
import numpy as np
import pytest
from conftest import ScriptedBackend
from stable_baselines3 import DDPG, PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

import sb3_torcs  # noqa: F401
from sb3_torcs.callbacks import RewardCallback
from sb3_torcs.callbacks.driven_line import DrivenLine, drive_lap, line_image
from sb3_torcs.callbacks.metrics import MONITOR_KWARGS, DrivingMetricsCallback, mean_q
from sb3_torcs.callbacks.tree import callbacks_in
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.errors import InvalidOption

STILL = np.array([0.0, 0.0, 0.0], np.float32)


class Rows(KVWriter):
    """Keeps what the logger writes."""

    def __init__(self):
        self.rows = []

    def write(self, key_values, key_excluded, step=0):
        self.rows.append(dict(key_values))

    def close(self):
        pass


class Pictures(TensorBoardOutputFormat):
    """A TensorBoard that keeps what it gets."""

    def __init__(self):
        self.images, self.steps = [], []

    def write(self, key_values, key_excluded, step=0):
        if "driving/line" in key_values:
            self.images.append(key_values["driving/line"].image)
            self.steps.append(step)

    def close(self):
        pass


def small():
    """Made anew each time: the algorithms add to what they get."""
    return {"policy_kwargs": {"net_arch": [8]}, "device": "cpu", "seed": 0}


def lite(n_envs=1, vec_env_cls=DummyVecEnv, **options):
    return make_vec_env(
        "sb3_torcs:TorcsLite-v0", n_envs=n_envs, env_kwargs=options, seed=0, vec_env_cls=vec_env_cls
    )


def scripted_model(oval, *states, n_envs=1, **options):
    """A model that trains on a script; it is never asked to learn."""
    envs = [lambda: Monitor(RacingEnv(ScriptedBackend(oval, *states), **options))] * n_envs
    return PPO("MlpPolicy", DummyVecEnv(envs), n_steps=8, batch_size=8, **small())


def logged(model, actions, metrics=None, **options):
    """Take these actions; return what the callback would have the logger write."""
    metrics = metrics or DrivingMetricsCallback(**options)
    model.set_logger(Logger(None, [Rows()]))
    metrics.init_callback(model)
    scope = {"callback": metrics}
    metrics.on_training_start(scope, {})
    env = model.get_env()
    env.reset()
    for action in actions:
        batch = np.stack([action] * env.num_envs)
        _, rewards, dones, infos = env.step(batch)
        metrics.update_locals(dict(actions=batch, rewards=rewards, dones=dones, infos=infos))
        assert metrics.on_step()
    return dict(model.logger.name_to_value)


def test_an_episode_is_logged_with_distance_laps_and_how_it_ended(oval):
    """Without these nobody sees from TensorBoard why a car does not come round."""
    off = {"distance_from_axis": 6.0, "distance_raced": 70.0, "laps": 1, "best_lap_time": 42.0}
    values = logged(scripted_model(oval, {}, off), [STILL, STILL])
    assert (values["driving/distance"], values["driving/laps"]) == (70.0, 1.0)
    assert not [key for key in values if "lap_time" in key]
    ends = {key: value for key, value in values.items() if key.startswith("driving/end_")}
    others = ("backwards", "stuck", "damage", "lost", "laps", "race", "time_limit")
    assert ends == {"driving/end_off_track": 1.0, **{f"driving/end_{name}": 0.0 for name in others}}


def test_shares_of_ends_are_means_over_the_episodes_of_all_environments(oval):
    states = ({"distance_from_axis": 6.0, "distance_raced": 10.0}, {"heading_error": 3.0})
    values = logged(scripted_model(oval, *states, n_envs=2), [STILL, STILL])
    assert values["driving/end_off_track"] == 0.5
    assert values["driving/end_backwards"] == 0.5
    assert values["driving/distance"] == 5.0


def test_an_episode_cut_by_the_time_limit_is_called_so():
    env = make_vec_env(lambda: gym.make("TorcsLite-v0", max_episode_steps=3))
    values = logged(PPO("MlpPolicy", env, n_steps=8, batch_size=8, **small()), [STILL] * 3)
    assert values["driving/end_time_limit"] == 1.0


def test_each_term_of_the_reward_is_summed_over_an_episode(oval):
    """An episode that still runs counts when it ends, from its beginning."""
    on, metrics = {"speed_x": 10.0}, DrivingMetricsCallback()
    off = {**on, "distance_from_axis": 6.0}
    model = scripted_model(oval, on, off, off, on, reward={"speed_along": 1.0, "crash": -8.0})
    values = logged(model, [STILL] * 4, metrics)
    # Episodes of two timesteps and of one, of 0.1 s each; the third one has not ended yet.
    assert values["reward/crash"] == -8.0
    assert values["reward/speed_along"] == pytest.approx(1.5, rel=1e-12)  # 0.1 is rounded
    assert sum(key.startswith("reward/") for key in values) == 2


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_the_logged_terms_add_up_to_the_return_also_of_a_reward_that_a_callback_gives(vec_env_cls):
    env = VecNormalize(lite(2, vec_env_cls, max_episode_steps=5))
    model = PPO("MlpPolicy", env, n_steps=5, batch_size=5, **small())
    rows = Rows()
    model.set_logger(Logger(None, [rows]))
    model.learn(10, [RewardCallback(reward="blog"), DrivingMetricsCallback()], log_interval=1)
    env.close()
    assert "driving/end_time_limit" in rows.rows[0]
    terms = {key: value for key, value in rows.rows[0].items() if key.startswith("reward/")}
    names = ("speed_along", "speed_across", "speed_off_axis", "crash")
    assert set(terms) == {f"reward/{name}" for name in names}
    # Monitor rounds returns to six digits.
    assert sum(terms.values()) == pytest.approx(rows.rows[0]["rollout/ep_rew_mean"], abs=1e-6)


def test_lap_times_are_averaged_and_the_best_is_kept(oval):
    laps = [{"laps": 1, "last_lap_time": 50.0}, {"laps": 2, "last_lap_time": 40.0}]
    metrics = DrivingMetricsCallback()
    states = [*laps, {"laps": 2, "distance_from_axis": 6.0}]
    values = logged(scripted_model(oval, *states), [STILL] * 3, metrics)
    assert values["driving/lap_time"] == 45.0
    assert values["driving/best_lap_time"] == 40.0
    assert metrics.best_lap_time == 40.0


def test_speed_braking_and_saturation_are_means_over_timesteps(oval):
    states = [{"speed_x": 10.0}, {"speed_x": 20.0}, {"speed_x": 30.0, "distance_from_axis": 6.0}]
    actions = np.array([[1.0, 0.5, 0.06], [-0.985, 0.995, 0.04], [0.9, 0.5, 0.0]], np.float32)
    values = logged(scripted_model(oval, *states), actions)
    saturation = [
        values[f"driving/saturation_{part}"] for part in ("steering", "throttle", "brake")
    ]
    assert (values["driving/speed"], values["driving/brake_share"]) == (20.0, 1 / 3)
    assert saturation == [2 / 3, 1 / 3, 1 / 3]


def test_means_over_timesteps_start_anew_with_each_row_of_the_logger(oval):
    ends = {"distance_from_axis": 6.0}
    metrics = DrivingMetricsCallback()
    model = scripted_model(oval, {"speed_x": 10.0, **ends}, {"speed_x": 30.0, **ends})
    assert logged(model, [STILL], metrics)["driving/speed"] == 10.0
    model.logger.dump()
    assert logged(model, [STILL], metrics)["driving/speed"] == 30.0


@pytest.mark.parametrize(
    ("algorithm", "normalize"), [(DDPG, False), (TD3, True), (SAC, False), (PPO, True)]
)
def test_every_algorithm_logs_the_same_keys(algorithm, normalize):
    """Off-policy ones know a Q besides."""
    env = lite(n_envs=2)
    env = VecNormalize(env) if normalize else env
    extra = {"n_steps": 32} if algorithm is PPO else {"learning_starts": 10, "buffer_size": 100}
    model = algorithm("MlpPolicy", env, batch_size=16, **extra, **small())
    rows = Rows()
    model.set_logger(Logger(None, [rows]))
    model.learn(128, callback=DrivingMetricsCallback(q_every=20), log_interval=1)
    keys = {key for row in rows.rows for key in row if key.startswith("driving/")}
    wanted = {"distance", "laps", "speed", "brake_share", "saturation_brake", "end_stuck"}
    assert {f"driving/{name}" for name in wanted} <= keys
    assert ("driving/q" in keys) == (algorithm is not PPO)


def test_measuring_changes_nothing_that_is_learned():
    """Q is looked up without drawing from anybody's random numbers."""

    def learned(*callbacks):
        env, eval_env = lite(), lite()
        model = DDPG("MlpPolicy", env, learning_starts=10, batch_size=8, **small())
        model.set_logger(Logger(None, [Pictures()]))
        evaluation = EvalCallback(eval_env, n_eval_episodes=1, eval_freq=40, verbose=0)
        model.learn(120, callback=[*callbacks, evaluation])
        return model.policy.state_dict()

    plain, measured = learned(), learned(DrivingMetricsCallback(q_every=7))
    for name, value in plain.items():
        np.testing.assert_array_equal(value.numpy(), measured[name].numpy(), name)


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_a_line_that_is_drawn_changes_no_later_evaluation(vec_env_cls, monkeypatch):
    """Of several tracks the evaluation draws one for each race."""
    monkeypatch.setattr("sb3_torcs.callbacks.metrics.line_image", lambda line: line)

    def races(*callbacks):
        tracks = ["aalborg", "alpine-1", "corkscrew", "g-track-1"]
        env = lite(2, vec_env_cls, track=tracks, start="random", max_episode_steps=5)
        model = DDPG("MlpPolicy", lite(1, vec_env_cls), learning_starts=1000, **small())
        model.set_logger(Logger(None, [Pictures()]))
        evaluation = EvalCallback(env, n_eval_episodes=4, eval_freq=10, verbose=0)
        model.learn(60, callback=[evaluation, *callbacks])
        for used in (env, model.get_env()):
            used.close()
        return evaluation.last_mean_reward, evaluation.best_mean_reward

    assert races(DrivingMetricsCallback(line_timesteps=10)) == races()


def test_it_measures_in_a_callback_that_is_no_list():
    class Own(BaseCallback):
        """Calls it by itself."""

        metrics = DrivingMetricsCallback()

        def _init_callback(self):
            self.metrics.init_callback(self.model)

        def _on_training_start(self):
            self.metrics.on_training_start(self.locals, self.globals)

        def _on_step(self):
            self.metrics.update_locals(self.locals)
            return self.metrics.on_step()

    model = DDPG("MlpPolicy", lite(1, max_episode_steps=5), learning_starts=1000, **small())
    model.learn(20, callback=Own())
    assert Own.metrics.n_calls == 20
    assert Own.metrics.listeners == []


def test_q_is_the_critics_value_of_the_stored_transitions():
    model = DDPG("MlpPolicy", lite(), learning_starts=0, batch_size=8, train_freq=4, **small())
    assert mean_q(model) is None
    model.learn(12)
    samples = model.replay_buffer._get_samples(np.arange(12))
    expected = model.critic(samples.observations, samples.actions)[0].mean().item()
    assert mean_q(model) == pytest.approx(expected, rel=1e-5)  # summed in another order


def test_the_scale_of_the_noise_is_logged(oval):
    class Noise:
        scale = 0.25

    model = scripted_model(oval, {"distance_from_axis": 6.0})
    model.action_noise = Noise()
    assert logged(model, [STILL])["driving/noise_scale"] == 0.25


@pytest.mark.parametrize("metrics_first", [True, False])
def test_a_line_is_drawn_once_after_each_evaluation(metrics_first, monkeypatch):
    """Also after the very last one, wherever the callback stands in the list."""
    monkeypatch.setattr("sb3_torcs.callbacks.metrics.line_image", lambda line: line)
    model = DDPG("MlpPolicy", lite(), learning_starts=1000, **small())
    pictures = Pictures()
    model.set_logger(Logger(None, [pictures]))
    evaluation = EvalCallback(lite(), n_eval_episodes=1, eval_freq=50, verbose=0)
    metrics = DrivingMetricsCallback(line_timesteps=10)
    callbacks = [metrics, evaluation] if metrics_first else [CallbackList([evaluation]), metrics]
    model.learn(100, callback=callbacks, log_interval=None)
    assert pictures.steps == ([51, 100] if metrics_first else [50, 100])
    assert [len(line.x) for line in pictures.images] == [10, 10]


def test_no_lap_is_driven_when_nobody_would_see_it(monkeypatch):
    monkeypatch.setattr("sb3_torcs.callbacks.metrics.drive_lap", None)
    model = DDPG("MlpPolicy", lite(), learning_starts=1000, **small())
    model.set_logger(Logger(None, [Rows()]))
    evaluation = EvalCallback(lite(), n_eval_episodes=1, eval_freq=20, verbose=0)
    model.learn(40, callback=[DrivingMetricsCallback(), evaluation])


class Follows:
    """A driver that presses nothing."""

    def predict(self, observation, state, episode_start, deterministic):
        assert deterministic
        return np.zeros((len(observation), 3), np.float32), None


def test_a_driven_lap_ends_with_the_lap(oval):
    states = [{"x": 1.0}, {"x": 2.0, "laps": 1, "last_lap_time": 60.0}, {"x": 3.0, "laps": 1}]
    env = DummyVecEnv([lambda: RacingEnv(ScriptedBackend(oval, *states))])
    line = drive_lap(Follows(), env)
    np.testing.assert_array_equal(line.x, [1.0, 2.0])
    assert line.lap_time == 60.0


def test_a_driven_line_is_on_the_track_that_it_was_driven_on():
    """The environment is on another one as soon as the lap has ended."""

    def make():
        return gym.make("TorcsLite-v0", track=["aalborg", "alpine-1"], max_episode_steps=3)

    alone, env = make(), DummyVecEnv([make])
    drawn = [alone.reset(seed=0 if first else None) and alone.unwrapped.track.name
             for first in (True, *[False] * 11)]  # fmt: skip
    env.seed(0)
    lines = [drive_lap(Follows(), env) for _ in range(6)]
    assert [len(line.x) for line in lines] == [3] * 6
    assert [line.track.name for line in lines] == drawn[::2] != drawn[1::2]


def test_a_driven_lap_that_never_ends_is_given_up(oval):
    env = DummyVecEnv([lambda: RacingEnv(ScriptedBackend(oval))])
    line = drive_lap(Follows(), env, limit=5)
    assert len(line.x) == 5
    assert line.lap_time is None


def test_the_picture_shows_the_line_in_colours(oval):
    turn = np.linspace(0.0, 1.0, 50)
    fast = DrivenLine(oval, 300.0 * turn, 0.0 * turn, 20.0 + 30.0 * turn, 300.0, None)
    picture = line_image(fast)
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
    assert picture.shape[2] == 3
    assert not np.array_equal(picture, line_image(fast._replace(speed=fast.speed[::-1])))


def test_callbacks_are_found_wherever_they_hang():
    inner, best = DrivingMetricsCallback(), DrivingMetricsCallback()
    tree = CallbackList([CallbackList([inner]), EvalCallback(lite(), callback_on_new_best=best)])
    found = list(callbacks_in(tree))
    assert inner in found
    assert best in found
    assert list(callbacks_in(None)) == []


def test_monitor_writes_each_episode_into_its_file(tmp_path, oval):
    """By its own info_keywords: nothing of ours stands between it and its file."""
    off = {"distance_from_axis": 6.0, "distance_raced": 70.0, "laps": 1, "best_lap_time": 42.0}
    env = Monitor(RacingEnv(ScriptedBackend(oval, off)), str(tmp_path / "0"), **MONITOR_KWARGS)
    env.reset()
    env.step(STILL)
    env.close()
    (row,) = monitor_rows(tmp_path / "0.monitor.csv")
    assert {name: row[name] for name in MONITOR_KWARGS["info_keywords"]} == {
        "laps": "1", "best_lap_time": "42.0", "distance": "70.0", "damage": "0.0",
        "end": "off_track",
    }  # fmt: skip


def test_monitor_writes_an_episode_that_the_time_limit_cut(tmp_path):
    """TimeLimit cuts outside of the environment: every key must be there without its doing."""
    env = gym.make("TorcsLite-v0", max_episode_steps=3)
    env = Monitor(env, str(tmp_path / "0"), **MONITOR_KWARGS)
    env.reset(seed=0)
    for _ in range(3):
        env.step(STILL)
    env.close()
    (row,) = monitor_rows(tmp_path / "0.monitor.csv")
    assert row["best_lap_time"] == "0.0"
    assert row["laps"] == "0"


def monitor_rows(path):
    with open(path) as file:
        next(file)  # the header that Monitor puts above the table
        return list(csv.DictReader(file))


def test_an_environment_that_is_no_racing_one_is_refused():
    for name in ("q_every", "q_size", "line_timesteps"):
        with pytest.raises(InvalidOption, match=f"{name} is 0"):
            DrivingMetricsCallback(**{name: 0})
    model = DDPG("MlpPolicy", "Pendulum-v1", **small())
    with pytest.raises(InvalidOption, match=r"shape \(1,\).*TorcsLite-v0"):
        model.learn(10, callback=DrivingMetricsCallback())
