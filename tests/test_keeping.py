"""What a training keeps, whatever ends it."""

import concurrent.futures
import errno
import os
import pickle
import random
import resource
import shlex
import signal
import time
from contextlib import nullcontext

import gymnasium as gym
import numpy as np
import pytest
import yaml
from processes import Program, raise_in_c
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import load_from_pkl

from sb3_torcs.agents import models
from sb3_torcs.agents.saved.record import STATISTICS
from sb3_torcs.callbacks.driven_line import LineRecorder
from sb3_torcs.cli import main
from sb3_torcs.errors import TrainingDiverged
from sb3_torcs.training.keeping import REPLAY_BUFFER, UNFINISHED, Keeper, StagingFolder
from sb3_torcs.training.run import Run, TrainOptions, _explained, _new_run
from sb3_torcs.training.trial import Recipe, Training

ENTRY = {
    "n_timesteps": 60, "policy": "MlpPolicy", "learning_starts": 20, "buffer_size": 1000,
    "batch_size": 4, "policy_kwargs": {"net_arch": [4]},
    "env_kwargs": {"track": "aalborg", "start": "random"},
}  # fmt: skip


def words_of(tmp_path, **changes):
    """Words of a training with a tiny network."""
    conf_file = tmp_path / "own.yml"
    conf_file.write_text(yaml.safe_dump({"TorcsLite-v0": {**ENTRY, **changes}}))
    words = ["--conf-file", str(conf_file), "--folder", str(tmp_path / "logs"), "--no-progress"]
    return ["train", "--env", "TorcsLite-v0", *words]


def run_folder(tmp_path, number=1):
    return tmp_path / "logs" / "ddpg" / f"TorcsLite-v0_{number}"


class RaisingCallback(BaseCallback):
    """Meets an error."""

    def __init__(self, at, error):
        super().__init__()
        self.at, self.error = at, error

    def _on_step(self):
        if self.num_timesteps == self.at:
            raise eval(self.error)
        return True


class CompilingCallback(BaseCallback):
    """Fails as numba does after a Ctrl-C while it compiled."""

    def _on_step(self):
        if self.num_timesteps == 45:
            raise_in_c(signal.SIGINT)
            raise RuntimeError("no compiled object yet")
        return True


# Files


def test_a_file_is_at_its_place_when_it_is_whole(tmp_path):
    files = StagingFolder(tmp_path)
    (files.aside / "sub").mkdir(parents=True)
    (tmp_path / "a").write_text("before")
    (files.aside / "a").write_text("after")
    (files.aside / "sub" / "b").write_text("b")
    assert (tmp_path / "a").read_text() == "before"
    files.settle()
    assert ((tmp_path / "a").read_text(), (tmp_path / "sub" / "b").read_text()) == ("after", "b")
    assert files.unfinished() == []


def test_what_is_not_whole_never_comes_to_its_place(tmp_path):
    files = StagingFolder(tmp_path)
    files.aside.mkdir()
    (files.aside / "a").write_text("ha")
    assert [files.place(file) for file in files.unfinished()] == [tmp_path / "a"]
    files.drop()
    files.settle()
    files.close()
    assert list(tmp_path.iterdir()) == []


# What a run saves


PPO = {
    "n_timesteps": 8, "policy": "MlpPolicy", "n_steps": 4, "batch_size": 4,
    "policy_kwargs": {"net_arch": [4]},
}  # fmt: skip


def training_of(tmp_path, algo="ddpg", **changes):
    """A training that has not begun, and what saves it."""
    entry = {**PPO, **changes} if algo == "ppo" else {**ENTRY, "n_timesteps": 12, **changes}
    folder = tmp_path / "TorcsLite-v0_1"
    folder.mkdir()
    interval = 4 if algo == "ppo" else 5
    training = Training(Recipe(algo, "TorcsLite-v0", entry, 0, interval, ()), exact=False)
    return training, Keeper(training, folder)


def kept(keeper):
    return models.saved_timesteps(keeper.files.folder / "TorcsLite-v0.zip")


class EachStep(BaseCallback):
    """Does something after each timestep."""

    def __init__(self, do):
        super().__init__()
        self.do = do

    def _on_step(self):
        self.do()
        return True


def test_the_model_is_kept_with_its_replay_buffer(tmp_path):
    training, keeper = training_of(tmp_path, n_timesteps=10)
    keeper.learn([])
    assert kept(keeper) == 10
    buffer = load_from_pkl(keeper.files.folder / REPLAY_BUFFER)
    assert buffer.size() == 10
    np.testing.assert_array_equal(buffer.actions, training.model.replay_buffer.actions)


def test_a_signal_whose_exception_was_lost_ends_the_training_with_the_next_timestep(tmp_path):
    training, keeper = training_of(tmp_path)
    signals = []

    def interrupt():
        if training.model.num_timesteps == 3:
            signals.append(signal.SIGTERM)

    training.callbacks.append(EachStep(interrupt))
    keeper.learn(signals)
    assert kept(keeper) == training.model.num_timesteps == 3


def test_a_rollout_that_was_not_learned_from_does_not_count(tmp_path):
    training, keeper = training_of(tmp_path, "ppo")
    counted = []
    training.callbacks.append(EachStep(lambda: counted.append(keeper.keep() or kept(keeper))))
    keeper.learn([])
    assert counted == [0, 0, 0, 0, 4, 4, 4, 4]
    assert kept(keeper) == training.model.num_timesteps == 8


def test_statistics_are_kept_where_the_zoo_looks_for_them(tmp_path):
    _, keeper = training_of(tmp_path, "ppo", normalize=True)
    keeper.learn([])
    file = keeper.files.folder / "TorcsLite-v0" / STATISTICS
    assert pickle.loads(file.read_bytes()).obs_rms.count == pytest.approx(9.0001)
    assert not (keeper.files.folder / REPLAY_BUFFER).exists()


def test_a_full_disk_leaves_the_files_of_before(tmp_path, monkeypatch):
    training, keeper = training_of(tmp_path)
    keeper.learn([])
    file = keeper.files.folder / REPLAY_BUFFER
    before = file.read_bytes()

    def half(file):
        file.write(before[:100])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(training.model, "save_replay_buffer", half)
    with pytest.raises(OSError, match="No space left"):
        keeper.keep()
    assert file.read_bytes() == before
    assert [begun.name for begun in keeper.files.unfinished()] == [REPLAY_BUFFER]
    monkeypatch.undo()
    keeper.keep()
    assert keeper.files.unfinished() == []


def test_a_model_that_has_diverged_does_not_replace_a_good_one(tmp_path):
    training, keeper = training_of(tmp_path)
    keeper.learn([])
    (model,) = keeper.files.folder.glob("*.zip")
    before = model.read_bytes()
    next(training.model.policy.parameters()).data[0, 0] = np.nan
    with pytest.raises(TrainingDiverged, match="after 12 timesteps its model computes no numbers"):
        keeper.keep()
    assert model.read_bytes() == before


@pytest.mark.parametrize(("times", "saved"), [(1, True), (2, False)])
def test_only_a_second_interrupt_ends_the_saving(tmp_path, capsys, monkeypatch, times, saved):
    training, keeper = training_of(tmp_path)
    keep = keeper.keep

    def interrupt():
        if training.model.num_timesteps == 3:
            raise KeyboardInterrupt

    def interrupted():
        for _ in range(times):
            signal.raise_signal(signal.SIGINT)
        keep()

    training.callbacks.append(EachStep(interrupt))
    monkeypatch.setattr(keeper, "keep", interrupted)
    with nullcontext() if saved else pytest.raises(KeyboardInterrupt):
        keeper.learn([])
    assert list(keeper.files.folder.glob("*.zip")) != [] if saved else True
    assert "Ctrl-C once more drops it" in capsys.readouterr().err
    assert not keeper.files.aside.exists()


def test_the_best_model_counts_as_kept_where_the_last_one_had_no_room(tmp_path):
    Keeper(training_of(tmp_path)[0], tmp_path / "TorcsLite-v0_1").learn([])
    best = (tmp_path / "TorcsLite-v0_1" / "TorcsLite-v0.zip").rename(tmp_path / "best_model.zip")
    run = Run(tmp_path, 0, 60, None, tmp_path / "TorcsLite-v0.zip", {})
    error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    said = str(_explained(error, run, TrainOptions()))
    assert f"kept: '{best}', 12 of 60 timesteps; make room" in said
    assert f"--resume {best}" in said


@pytest.mark.slow
def test_a_training_that_diverges_is_told(tmp_path, capfd):
    """The weights are numbers still, and what PPO's distribution gets is none."""
    file = tmp_path / "own.yml"
    file.write_text(
        "TorcsLite-v0: {n_timesteps: 4000, n_steps: 64, policy: MlpPolicy, learning_rate: 1.0e+9}"
    )
    words = ["--algo", "ppo", "--conf-file", str(file), "--folder", str(tmp_path / "logs")]
    assert main(["train", "--env", "TorcsLite-v0", "--no-progress", *words]) == 2
    last = capfd.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("sb3-torcs: the training has diverged: after ")
    assert last.endswith("nothing was kept yet; lower the learning_rate, and start again")


# The training


def test_trainings_that_begin_at_once_get_folders_of_their_own(tmp_path):
    def begin(_):
        with _new_run(tmp_path / "ddpg", "TorcsLite-v0") as folder:
            return folder

    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        assert len(set(pool.map(begin, range(4)))) == 4
    assert len(list((tmp_path / "ddpg").iterdir())) == 4


@pytest.mark.slow
def test_a_file_that_cannot_be_written_is_named_and_the_training_goes_on(capsys, tmp_path):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))  # the buffer has 250 kB
        status = main([*words_of(tmp_path), "--eval-freq", "30"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    folder, said = run_folder(tmp_path), capsys.readouterr().err
    assert status == 2
    assert said.startswith(f"sb3-torcs: cannot write '{folder / REPLAY_BUFFER}': File too large")
    assert f"kept: '{folder / 'TorcsLite-v0.zip'}', 30 of 60 timesteps; make room" in said
    assert said.count("\n") == 1
    assert not (folder / REPLAY_BUFFER).exists()
    assert not (folder / UNFINISHED).exists()
    command = said.partition("go on with: ")[2]
    assert main(shlex.split(command)[1:]) == 0
    assert models.saved_timesteps(run_folder(tmp_path, 2) / "TorcsLite-v0.zip") == 30


@pytest.mark.slow
@pytest.mark.parametrize(
    ("error", "said"),
    [
        ("OSError(28, 'No space left on device')", "cannot write '{folder}': No space left"),
        ("TrainingDiverged('no numbers')", "(add: --hyperparams learning_rate=NUMBER), and go on"),
    ],
)
def test_what_was_learned_until_an_error_is_kept(capsys, tmp_path, error, said):
    callback = {f"{__name__}.RaisingCallback": {"at": 45, "error": error}}
    status = main([*words_of(tmp_path, callback=[callback]), "--eval-freq", "30"])
    folder, err = run_folder(tmp_path), capsys.readouterr().err
    assert status == 2
    assert said.format(folder=folder) in err
    assert "45 of 60 timesteps" in err
    assert models.saved_timesteps(folder / "TorcsLite-v0.zip") == 45
    assert load_from_pkl(folder / REPLAY_BUFFER).size() == 44


def test_an_interrupt_that_python_ignored_ends_a_training_as_any_other(capsys, tmp_path):
    callback = f"{__name__}.CompilingCallback"
    assert main([*words_of(tmp_path, callback=[callback]), "--eval-freq", "30"]) == 130
    assert models.saved_timesteps(run_folder(tmp_path) / "TorcsLite-v0.zip") == 45
    assert "go on with" in capsys.readouterr().out


@pytest.mark.slow
def test_a_training_without_evaluations_is_kept_too(tmp_path):
    words = words_of(
        tmp_path, callback=[{f"{__name__}.RaisingCallback": {"at": 9, "error": "1/0"}}]
    )
    with pytest.raises(ZeroDivisionError):
        main([*words, "--eval-freq", "0"])
    assert models.saved_timesteps(run_folder(tmp_path) / "TorcsLite-v0.zip") == 9
    assert not (run_folder(tmp_path) / "best_model.zip").exists()


def test_ctrl_c_before_the_first_timestep_leaves_no_folder(tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("sb3_torcs.training.run.Training", interrupted)
    assert main(words_of(tmp_path)) == 130
    assert list((tmp_path / "logs" / "ddpg").iterdir()) == []


def test_the_environments_of_evaluations_are_closed(tmp_path, monkeypatch):
    closed, close = [], gym.Wrapper.close
    monkeypatch.setattr(LineRecorder, "close", lambda self: closed.append(self) or close(self))
    assert main([*words_of(tmp_path), "--eval-freq", "30"]) == 0
    assert len(closed) == 1


def whole(folder):
    """Read all that a training leaves; a truncated file raises."""
    steps = 0
    for file in folder.glob("*.zip"):
        DDPG.load(file)
        steps = max(steps, models.saved_timesteps(file))
    if (folder / REPLAY_BUFFER).is_file():
        load_from_pkl(folder / REPLAY_BUFFER)
    if (folder / "evaluations.npz").is_file():
        with np.load(folder / "evaluations.npz") as evaluations:
            assert len(evaluations["timesteps"]) > 0
    return steps


@pytest.mark.slow
@pytest.mark.parametrize("kills", [1, pytest.param(4, marks=pytest.mark.rare)])
def test_a_training_that_was_killed_goes_on(tmp_path, kills):
    """At any moment, also while it saves: with a large buffer it does little else."""
    rng, resumed = random.Random(kills), []
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    for number in range(1, kills + 1):
        words = words_of(tmp_path, n_timesteps=10**6, buffer_size=200_000)
        words = [*words, *resumed, "--eval-freq", "40"]
        folder = run_folder(tmp_path, number)
        with Program.of_ours(*words, env={**os.environ, "TMPDIR": str(scratch)}) as program:
            program.wait_for((folder / REPLAY_BUFFER).is_file)
            time.sleep(rng.uniform(0.0, 1.0))
            assert program.end(signal.SIGKILL) == -signal.SIGKILL
        assert list(scratch.iterdir()) == []
        assert whole(folder) >= 40
        resumed = ["--resume", str(folder)]
    words = words_of(tmp_path, buffer_size=200_000)
    assert main([*words, *resumed, "--timesteps", "30"]) == 0
    assert models.saved_timesteps(run_folder(tmp_path, kills + 1) / "TorcsLite-v0.zip") == 30
