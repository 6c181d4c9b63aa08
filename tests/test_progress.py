"""The live line says what it should, where it should, and disturbs nothing."""

import io

import numpy as np
import pytest
from conftest import ScriptedBackend
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_torcs.callbacks.metrics import DrivingMetricsCallback
from sb3_torcs.callbacks.progress import RacingProgressCallback, spoken_time
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.errors import InvalidOption

OFF = {"distance_from_axis": 6.0, "distance_raced": 70.0}


class Terminal(io.StringIO):
    def isatty(self):
        return True


def learned(oval, *states, stream, callbacks=(), timesteps=64):
    env = DummyVecEnv([lambda: RacingEnv(ScriptedBackend(oval, *states))])
    model = PPO(
        "MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, policy_kwargs={"net_arch": [4]},
        device="cpu", seed=0,
    )  # fmt: skip
    progress = RacingProgressCallback(stream=stream)
    model.learn(timesteps, callback=[progress, *callbacks])
    return model, progress


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0 s"), (99.0, "99 s"), (119.0, "2 min"), (3600.0, "60 min"), (7500.0, "2 h 05 min")],
)
def test_durations_are_said_as_people_say_them(seconds, text):
    assert spoken_time(seconds) == text


def test_a_terminal_shows_steps_episode_distance_lap_and_time_left(oval):
    stream = Terminal()
    learned(oval, {"laps": 1, "last_lap_time": 61.234}, OFF, stream=stream)
    last = stream.getvalue().rpartition("\x1b[2K")[2]  # from where the display was erased
    for part in ("64/64 timesteps", "episode 1", "last 70 m", "best lap 61.23 s", "0 s left"):
        assert part in last


def test_a_log_file_gets_whole_lines_and_no_bar(oval):
    stream = io.StringIO()
    learned(oval, OFF, stream=stream)
    assert "\r" not in stream.getvalue()
    assert (
        stream.getvalue()
        == "100% 64/64 timesteps, episode 1, last 70 m, no whole lap yet, 0 s left\n"
    )


@pytest.mark.parametrize("kind", [io.StringIO, Terminal])
def test_a_reader_that_leaves_does_not_end_the_training(oval, kind):
    class Broken(kind):
        def write(self, text):
            raise BrokenPipeError

    model, _ = learned(oval, OFF, stream=Broken())
    assert model.num_timesteps == 64


def test_lines_come_at_their_interval(oval, monkeypatch):
    """The clock is scripted: one second per look."""
    ticks = iter(range(10_000))
    monkeypatch.setattr("sb3_torcs.callbacks.progress.time.monotonic", lambda: float(next(ticks)))
    stream = io.StringIO()
    learned(oval, stream=stream)
    lines = stream.getvalue().splitlines()
    shares = [line.split(" timesteps")[0] for line in lines]
    assert shares == ["46% 30/64", "93% 60/64", "100% 64/64"]
    assert lines[0].endswith("34 s left")


def test_a_lap_of_an_evaluation_counts(oval):
    class Evaluated(DrivingMetricsCallback):
        def _on_training_start(self):
            super()._on_training_start()
            self.best_evaluation_lap_time = 55.0

    metrics = Evaluated()
    stream = io.StringIO()
    lap = {"laps": 1, "last_lap_time": 60.0}
    _, progress = learned(oval, lap, stream=stream, callbacks=[metrics])
    assert progress.best_lap_time == 55.0
    assert "best lap 55.00 s" in stream.getvalue()


def test_a_second_training_is_counted_anew(oval):
    metrics = DrivingMetricsCallback()
    lap = {"laps": 1, "last_lap_time": 60.0}
    model, progress = learned(oval, lap, OFF, stream=io.StringIO(), callbacks=[metrics])
    model.learn(64, callback=[progress, metrics], reset_num_timesteps=False)
    assert (progress.best_lap_time, metrics.best_lap_time) == (60.0, 60.0)
    model.learn(1, callback=[progress, metrics])
    assert (progress.best_lap_time, metrics.best_lap_time) == (None, None)


def test_ending_twice_does_no_harm(oval):
    """The RL Zoo ends its first callback once more than Stable-Baselines3 does."""
    stream = Terminal()
    _, progress = learned(oval, stream=stream)
    shown = stream.getvalue()
    progress.on_training_end()
    assert stream.getvalue() == shown


def test_watching_changes_nothing_that_is_learned(oval):
    bar, _ = learned(oval, stream=Terminal())
    lines, _ = learned(oval, stream=io.StringIO())
    for name, value in bar.policy.state_dict().items():
        np.testing.assert_array_equal(value.numpy(), lines.policy.state_dict()[name].numpy(), name)


def test_an_interval_of_nothing_is_refused():
    with pytest.raises(InvalidOption, match="every is 0"):
        RacingProgressCallback(every=0)
