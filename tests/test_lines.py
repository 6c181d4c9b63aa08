"""What evaluations drive is told at once, drawn now and then, and kept in a table."""

import io
import re
from contextlib import nullcontext

import numpy as np
import pytest
from conftest import ScriptedBackend
from matplotlib.image import imread
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_torcs.callbacks.display import bars
from sb3_torcs.callbacks.driven_line import DrivenLine
from sb3_torcs.callbacks.lines import DrivenLap, LinePicturesCallback, draw_learning, driven_laps
from sb3_torcs.callbacks.metrics import DrivingMetricsCallback
from sb3_torcs.callbacks.progress import RacingProgressCallback, spoken_moment
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.errors import InvalidOption, OutputNotWritable

EVERY = 16  # timesteps between two evaluations


class Terminal(io.StringIO):
    def isatty(self):
        return True


class Evaluations(EvalCallback):
    """Evaluations whose lines are given."""

    def __init__(self, env, metrics, lines):
        super().__init__(env, eval_freq=0, verbose=0)
        self.metrics, self.lines = metrics, list(lines)

    def _on_step(self):
        if self.n_calls % EVERY == 0 and self.lines:
            line = self.lines.pop(0)
            for listener in self.metrics.listeners:
                listener.take_line(line)
        return True


@pytest.fixture
def clock(monkeypatch):
    """A clock that a test sets."""
    now = [0.0]
    for module in ("progress", "lines"):
        monkeypatch.setattr(f"sb3_torcs.callbacks.{module}.time.monotonic", lambda: now[0])
    return now


def driven(oval, distance, lap_time=None):
    """A straight line with three places in it."""
    x = np.array([0.0, 0.5, 1.0]) * distance
    return DrivenLine(oval, x, np.zeros(3), np.full(3, 20.0), distance, lap_time)


def learned(oval, lines, *states, stream=None, callbacks=(), shown=True, before=0):
    env = DummyVecEnv([lambda: RacingEnv(ScriptedBackend(oval, *states))])
    model = PPO(
        "MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, policy_kwargs={"net_arch": [4]},
        device="cpu", seed=0,
    )  # fmt: skip
    metrics = DrivingMetricsCallback()
    progress = [RacingProgressCallback(stream=stream or io.StringIO())] if shown else []
    model.num_timesteps = before
    model.learn(
        64,
        [*progress, metrics, *callbacks, Evaluations(env, metrics, lines)],
        reset_num_timesteps=not before,
    )


# ------------------------------------------------------------------------------ told


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (59.0, "59 s"), (60.0, "1 min 00 s"), (72.4, "1 min 12 s")]
)
def test_moments_are_said_to_the_second(seconds, text):
    assert spoken_moment(seconds) == text


@pytest.mark.usefixtures("clock")
def test_each_evaluation_is_told_and_the_first_lap_and_the_best(oval):
    stream = io.StringIO()
    drives = (296.0, None), (900.0, 104.2), (900.0, 98.1), (900.0, 99.0)
    learned(oval, [driven(oval, *drive) for drive in drives], stream=stream)
    assert stream.getvalue().splitlines()[:4] == [
        "0 s: 296 m",
        "0 s: the first whole lap, 104.20 s",
        "0 s: a whole lap, 98.10 s, the best so far",
        "0 s: a whole lap, 99.00 s",
    ]


@pytest.mark.usefixtures("clock")
def test_who_showed_an_earlier_training_is_not_told_of_the_next(oval):
    metrics, old = DrivingMetricsCallback(), io.StringIO()
    env = DummyVecEnv([lambda: RacingEnv(ScriptedBackend(oval))])
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, device="cpu", seed=0)
    for stream, lines in ((old, 1), (io.StringIO(), 2)):
        drives = [driven(oval, 296.0)] * lines
        progress = RacingProgressCallback(stream=stream)
        second = DrivingMetricsCallback()  # which tells nobody once more
        model.learn(32, [progress, metrics, second, Evaluations(env, metrics, drives)])
        assert second.listeners == []
        assert stream.getvalue().count("296 m\n") == lines
    assert old.getvalue().count("296 m\n") == 1


@pytest.mark.usefixtures("clock")
def test_the_first_lap_of_a_car_that_learns_is_told_at_once(oval):
    stream = io.StringIO()
    lap = {"laps": 1, "last_lap_time": 61.2}
    learned(oval, [driven(oval, 900.0, 98.1)], {}, lap, stream=stream)
    assert stream.getvalue().splitlines()[:2] == [
        "0 s: the first whole lap, 61.20 s, by a car that learns",
        "0 s: a whole lap, 98.10 s",
    ]


def test_a_terminal_shows_curves_below_what_is_told(oval, monkeypatch):
    monkeypatch.setenv("TERM", "xterm-256color")
    stream = Terminal()
    learned(oval, [driven(oval, 296.0), driven(oval, 900.0, 104.2)], stream=stream)
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", stream.getvalue())
    frame = text[text.rindex("distance of evaluations [m]") :]
    assert text.count("the first whole lap, 104.20 s") == 1
    for part in ("914 ", "█", "time of their lap [s]", "104.2", "64/64 timesteps"):
        assert part in frame


def test_bars_are_as_high_as_their_values():
    drawn = bars([0.0, None, 50.0, 100.0, 200.0], 0.0, 100.0, 10)
    assert drawn == ["   ██", "   ██", "  ▄██", "  ███", "▁ ███"]


def test_of_more_values_than_columns_the_newest_is_drawn():
    assert bars([0.0] * 99 + [100.0], 0.0, 100.0, 4)[-1] == "▁▁▁█"


# ------------------------------------------------------------------------------ drawn and kept


def test_the_first_line_and_the_first_lap_are_drawn_and_all_are_kept(oval, clock, tmp_path):
    folder = tmp_path / "lines"
    stream = io.StringIO()
    drives = (296.0, None), (300.0, None), (900.0, 104.2), (900.0, 98.1)
    pictures = LinePicturesCallback(folder=str(folder))
    learned(oval, [driven(oval, *drive) for drive in drives], stream=stream, callbacks=[pictures])
    assert driven_laps(folder) == [
        DrivenLap(0.0, 16, 296.0, None, "001.png"),
        DrivenLap(0.0, 32, 300.0, None, ""),
        DrivenLap(0.0, 48, 900.0, 104.2, "002.png"),
        DrivenLap(0.0, 64, 900.0, 98.1, ""),
    ]
    assert sorted(path.name for path in folder.iterdir()) == ["001.png", "002.png", "laps.csv"]
    assert imread(folder / "002.png").ndim == 3
    assert f"0 s: the line it drives, {folder / '001.png'}" in stream.getvalue().splitlines()


def test_pictures_come_at_their_interval(oval, clock, tmp_path):
    class Ticks(BaseCallback):
        def _on_step(self):
            clock[0] += 30.0 / EVERY  # half a minute from one evaluation to the next
            return True

    callbacks = [Ticks(), LinePicturesCallback(folder=str(tmp_path), every=60.0)]
    learned(oval, [driven(oval, 296.0)] * 4, callbacks=callbacks)
    assert [lap.picture for lap in driven_laps(tmp_path)] == ["001.png", "", "002.png", ""]


@pytest.mark.parametrize("before", [0, 16])
def test_a_training_that_goes_on_continues_the_series(oval, clock, tmp_path, before):
    for timesteps in (0, before):
        pictures = [LinePicturesCallback(folder=str(tmp_path))]
        learned(oval, [driven(oval, 900.0, 104.2)], callbacks=pictures, before=timesteps)
    assert driven_laps(tmp_path) == [
        DrivenLap(0.0, 16, 900.0, 104.2, "001.png"),
        DrivenLap(0.0, 32, 900.0, 104.2, "002.png"),
    ]


def test_no_picture_of_a_series_is_overwritten(oval, tmp_path):
    """Also if somebody has taken some away."""
    (tmp_path / "004.png").write_text("theirs")
    pictures = LinePicturesCallback(folder=str(tmp_path))
    learned(oval, [driven(oval, 296.0)], callbacks=[pictures])
    assert [lap.picture for lap in driven_laps(tmp_path)] == ["005.png"]
    assert (tmp_path / "004.png").read_text() == "theirs"


def test_half_a_row_is_left_out(tmp_path):
    (tmp_path / "laps.csv").write_text(
        "seconds,timesteps,distance,lap_time,picture\n1.0,16,296.0,,001.png\n2.0,32,30"
    )
    assert driven_laps(tmp_path) == [DrivenLap(1.0, 16, 296.0, None, "001.png")]


@pytest.mark.parametrize("shown", [True, False])
def test_a_full_disk_ends_the_series_and_not_the_training(oval, monkeypatch, tmp_path, shown):
    def full(*arguments, **keywords):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", full)
    stream, drives = io.StringIO(), [driven(oval, 296.0)] * 2
    callbacks = [LinePicturesCallback(folder=str(tmp_path))]
    told = "no more pictures: .*No space left"
    with nullcontext() if shown else pytest.warns(UserWarning, match=told):
        learned(oval, drives, stream=stream, callbacks=callbacks, shown=shown)
    if shown:
        assert len(re.findall(f"^{told}", stream.getvalue(), re.MULTILINE)) == 1
        assert "64/64 timesteps" in stream.getvalue()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_ends_the_training_before_it_begins(oval, tmp_path):
    (tmp_path / "file.py").touch()
    pictures = LinePicturesCallback(folder=str(tmp_path / "file.py"), every=0)
    with pytest.raises(OutputNotWritable, match=r"cannot write to the folder '.*file.py'"):
        learned(oval, [], callbacks=[pictures])


def test_an_interval_below_zero_is_refused(tmp_path):
    with pytest.raises(InvalidOption, match="every is -1"):
        LinePicturesCallback(folder=str(tmp_path), every=-1)


def test_the_picture_of_a_learning_holds_curves_and_lines(oval, tmp_path):
    with pytest.raises(InvalidOption, match="train for longer"):
        draw_learning(tmp_path, tmp_path / "learning.png")
    pictures = [LinePicturesCallback(folder=str(tmp_path), every=0.0)]
    learned(oval, [driven(oval, 296.0), driven(oval, 900.0, 104.2)], callbacks=pictures)
    draw_learning(tmp_path, tmp_path / "learning.png")
    assert imread(tmp_path / "learning.png").shape == (1056, 1800, 4)
    for picture in tmp_path.glob("00*.png"):
        picture.unlink()
    draw_learning(tmp_path, tmp_path / "learning.png")
    assert imread(tmp_path / "learning.png").shape == (528, 1800, 4)
