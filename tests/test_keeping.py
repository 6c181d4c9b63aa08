"""What a training keeps, whatever ends it."""

import argparse
import concurrent.futures
import errno
import os
import pickle
import random
import resource
import shlex
import signal
import sys
import time
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from processes import Program, raise_in_c
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3 import DDPG, PPO
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.save_util import load_from_pkl
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from toy import ToyRace

from sb3_torcs.agents import models
from sb3_torcs.agents.saved.record import STATISTICS
from sb3_torcs.cli import main
from sb3_torcs.errors import InvalidOption, TrainingDiverged
from sb3_torcs.training import manager as zoo_training
from sb3_torcs.training.keeping import (
    REPLAY_BUFFER,
    UNFINISHED,
    KeepCallback,
    WholeFiles,
)

ENTRY = {
    "n_timesteps": 60, "policy": "MlpPolicy", "learning_starts": 20, "buffer_size": 1000,
    "batch_size": 4, "policy_kwargs": {"net_arch": [4]},
    "env_kwargs": {"track": "aalborg", "start": "random"},
}  # fmt: skip


def words_of(tmp_path, **changes):
    """Words of a training with a tiny network."""
    conf_file = tmp_path / "own.yml"
    conf_file.write_text(yaml.safe_dump({"TorcsLite-v0": {**ENTRY, **changes}}))
    folder = str(tmp_path / "logs")
    return ["train", "--conf-file", str(conf_file), "--folder", folder, "--no-progress"]


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
    files = WholeFiles(tmp_path)
    (files.aside / "sub").mkdir(parents=True)
    (tmp_path / "a").write_text("before")
    (files.aside / "a").write_text("after")
    (files.aside / "sub" / "b").write_text("b")
    assert (tmp_path / "a").read_text() == "before"
    files.settle()
    assert ((tmp_path / "a").read_text(), (tmp_path / "sub" / "b").read_text()) == ("after", "b")
    assert files.unfinished() == []


def test_what_is_not_whole_never_comes_to_its_place(tmp_path):
    files = WholeFiles(tmp_path)
    files.aside.mkdir()
    (files.aside / "a").write_text("ha")
    assert [files.place(file) for file in files.unfinished()] == [tmp_path / "a"]
    files.drop()
    files.settle()
    files.close()
    assert list(tmp_path.iterdir()) == []


# The callback


def keeper(folder, every=5):
    return KeepCallback(WholeFiles(folder), "last", every)


def tiny(env=None, algorithm=DDPG, **kwargs):
    env = env or ToyRace()
    return algorithm("MlpPolicy", env, policy_kwargs={"net_arch": [4]}, device="cpu", **kwargs)


def test_the_model_is_kept_with_its_replay_buffer(tmp_path):
    model = tiny(buffer_size=50)
    model.learn(12, callback=keeper(tmp_path))
    assert models.saved_timesteps(tmp_path / "last.zip") == 10
    kept = load_from_pkl(tmp_path / REPLAY_BUFFER)
    assert kept.size() == 9  # SB3 stores a timestep after the callbacks
    np.testing.assert_array_equal(kept.actions[:9], model.replay_buffer.actions[:9])


def test_files_of_others_are_at_their_place_after_the_call_that_wrote_them(tmp_path):
    callback = KeepCallback(WholeFiles(tmp_path), "last", 50, others=[3])
    checkpoints = CheckpointCallback(3, str(callback.files.aside))
    tiny(buffer_size=50).learn(7, callback=[checkpoints, callback])
    assert {file.name for file in tmp_path.glob("*.zip")} == {
        "rl_model_3_steps.zip",
        "rl_model_6_steps.zip",
    }


def test_a_signal_whose_exception_was_lost_ends_the_training_with_the_next_timestep(tmp_path):
    signals = []
    callback = KeepCallback(WholeFiles(tmp_path), "last", 50, interrupts=signals)
    model = tiny(buffer_size=50).learn(3, callback=callback)
    signals.append(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt):
        model.learn(3, callback=callback, reset_num_timesteps=False)
    assert model.num_timesteps == 4


def test_a_rollout_that_was_not_learned_from_does_not_count(tmp_path):
    callback, counted = keeper(tmp_path), []
    callback._on_step = lambda: counted.append(callback.keep() or kept(tmp_path)) or True
    model = tiny(algorithm=PPO, n_steps=4, batch_size=4).learn(10, callback=callback)
    assert counted == [0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8]
    callback.keep()
    assert kept(tmp_path) == model.num_timesteps == 12


def kept(folder):
    return models.saved_timesteps(folder / "last.zip")


def test_statistics_are_kept_where_the_zoo_looks_for_them(tmp_path):
    env = VecNormalize(DummyVecEnv([ToyRace]))
    tiny(env, PPO, n_steps=8, batch_size=8).learn(8, callback=keeper(tmp_path))
    statistics = pickle.loads((tmp_path / "last" / STATISTICS).read_bytes())
    assert statistics.obs_rms.count == pytest.approx(6.0001)  # the first reset and five timesteps
    assert not (tmp_path / REPLAY_BUFFER).exists()


def test_keeping_changes_nothing_of_what_is_learned(tmp_path):
    learned = [
        tiny(buffer_size=50, seed=1, learning_starts=4).learn(20, callback=callback)
        for callback in (None, keeper(tmp_path))
    ]
    one, other = (model.policy.parameters() for model in learned)
    assert all(mine.equal(theirs) for mine, theirs in zip(one, other, strict=True))


def test_a_full_disk_leaves_the_files_of_before(tmp_path, monkeypatch):
    model, callback = tiny(buffer_size=50), keeper(tmp_path)
    model.learn(5, callback=callback)
    before = (tmp_path / REPLAY_BUFFER).read_bytes()

    def half(file):
        file.write(before[:100])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(model, "save_replay_buffer", half)
    with pytest.raises(OSError, match="No space left"):
        callback.keep()
    assert (tmp_path / REPLAY_BUFFER).read_bytes() == before
    assert [file.name for file in callback.files.unfinished()] == [REPLAY_BUFFER]
    monkeypatch.undo()
    callback.keep()
    assert callback.files.unfinished() == []


def test_a_model_that_has_diverged_does_not_replace_a_good_one(tmp_path):
    callback = keeper(tmp_path)
    callback.init_callback(tiny(buffer_size=50))
    callback.keep()
    (model,) = tmp_path.glob("*.zip")
    before = model.read_bytes()
    next(callback.model.policy.parameters()).data[0, 0] = np.nan
    with pytest.raises(TrainingDiverged, match="after 0 timesteps its model computes no numbers"):
        callback.keep()
    assert model.read_bytes() == before


@pytest.mark.slow
def test_the_best_model_counts_as_kept_where_the_last_one_had_no_room(
    capsys, tmp_path, monkeypatch
):
    def full(self):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(KeepCallback, "keep", full)
    assert main([*words_of(tmp_path), "--eval-freq", "30"]) == 2
    said = capsys.readouterr().err
    best = run_folder(tmp_path) / "best_model.zip"
    assert f"kept: '{best}', 30 of 60 timesteps; make room" in said
    assert "--timesteps 30 " in said
    assert f"--resume {best}" in said


@pytest.mark.slow
def test_a_training_that_diverges_is_told(tmp_path, capfd):
    """The weights are numbers still, and what PPO's distribution gets is none."""
    file = tmp_path / "own.yml"
    file.write_text(
        "TorcsLite-v0: {n_timesteps: 4000, n_steps: 64, policy: MlpPolicy, learning_rate: 1.0e+9}"
    )
    words = ["--algo", "ppo", "--conf-file", str(file), "--folder", str(tmp_path / "logs")]
    assert main(["train", "--no-progress", *words]) == 2
    last = capfd.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("sb3-torcs: the training has diverged: after ")
    assert last.endswith("nothing was kept yet; lower the learning_rate, and start again")


@pytest.mark.parametrize("every", [0, -1, 1.5, True])
def test_the_interval_is_a_number_of_calls(tmp_path, every):
    with pytest.raises(InvalidOption, match=r"every is .*; expected a whole number >= 1"):
        keeper(tmp_path, every)


# The training


def test_trainings_that_begin_at_once_get_folders_of_their_own(tmp_path):
    def begin(_):
        words = argparse.Namespace()
        manager = zoo_training.Manager(words, "ddpg", "TorcsLite-v0", str(tmp_path), entry={})
        return manager.save_path

    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        assert len(set(pool.map(begin, range(4)))) == 4
    assert len(list((tmp_path / "ddpg").iterdir())) == 4


@pytest.mark.slow
def test_a_file_that_cannot_be_written_is_named_and_the_training_goes_on_from_what_is_kept(
    capsys, tmp_path
):
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
        (
            "TrainingDiverged('no numbers')",
            "(add: -- --hyperparams learning_rate:NUMBER), and go on",
        ),
        ("EOFError()", "a process with a car of the training has ended; kept: "),
        ("ConnectionResetError(104, 'reset')", "a process with a car of the training has ended"),
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
        main([*words, "--eval-freq", "-1"])
    assert models.saved_timesteps(run_folder(tmp_path) / "TorcsLite-v0.zip") == 9
    assert not (run_folder(tmp_path) / "best_model.zip").exists()


def test_ctrl_c_before_the_first_timestep_leaves_no_folder(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(ExperimentManager, "create_callbacks", interrupted)
    assert main(words_of(tmp_path)) == 130
    assert list((tmp_path / "logs" / "ddpg").iterdir()) == []


def test_the_environments_of_evaluations_are_closed(tmp_path, monkeypatch):
    made, close = [], DummyVecEnv.close
    closed = []
    monkeypatch.setattr(DummyVecEnv, "__init__", noting(made, DummyVecEnv.__init__))
    monkeypatch.setattr(DummyVecEnv, "close", noting(closed, close))
    assert main([*words_of(tmp_path), "--eval-freq", "30"]) == 0
    assert len(made) >= 2
    assert {id(each) for each in made} == {id(each) for each in closed}


def noting(calls, method):
    def noted(self, *arguments):
        calls.append(self)
        return method(self, *arguments)

    return noted


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Argument ``multivariate``")  # of the zoo's sampler
def test_the_zoo_may_search_hyperparameters(capsys, tmp_path):
    """That leaves reports and no model."""
    search = ["-optimize", "--n-trials", "1", "--n-evaluations", "1", "--no-optim-plots"]
    assert main([*words_of(tmp_path, n_timesteps=30), "--", *search]) == 0
    (report,) = (tmp_path / "logs" / "ddpg").glob("report_*.csv")
    assert f"its reports: {report.with_name('report_*.csv')}" in capsys.readouterr().out


def test_a_search_that_the_zoo_cannot_make_is_told(capsys, tmp_path):
    words = [*words_of(tmp_path, n_timesteps=30), "--algo", "crossq", "--", "-optimize"]
    assert main(words) == 2
    assert "cannot search hyperparameters of crossq; it can of: a2c" in capsys.readouterr().err
    assert list((tmp_path / "logs" / "crossq").iterdir()) == []


def test_a_search_that_was_ended_before_its_first_trial_is_told(monkeypatch, tmp_path):
    def nothing(self):
        raise ValueError("No trials are completed yet.")

    monkeypatch.setattr(ExperimentManager, "hyperparameters_optimization", nothing)
    words = argparse.Namespace()
    manager = zoo_training.Manager(words, "ddpg", "TorcsLite-v0", str(tmp_path / "logs"), entry={})
    with pytest.raises(InvalidOption, match="no trial of the search has ended"):
        manager.hyperparameters_optimization()


def test_the_zoo_reads_the_words_of_the_training_not_those_of_the_process(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["own.py", "--own"])
    with pytest.raises(SystemExit):
        zoo_training.train("ddpg", "TorcsLite-v0", {}, ["--n-timesteps", "many"], [])
    assert "rl_zoo3.train: error: argument -n/--n-timesteps: invalid" in capsys.readouterr().err


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


class Interrupted:
    """A keeper that is interrupted while it saves."""

    def __init__(self, times):
        self.times, self.done = times, False

    def keep(self):
        for _ in range(self.times):
            signal.raise_signal(signal.SIGINT)
        self.done = True


@pytest.mark.parametrize(("times", "saved"), [(0, True), (1, True), (2, False)])
def test_only_a_second_interrupt_ends_the_saving_of_what_was_learned(
    tmp_path, capsys, times, saved
):
    manager = zoo_training.Manager.__new__(zoo_training.Manager)
    manager.files, manager.keeper = WholeFiles(tmp_path), Interrupted(times)
    manager.files.aside.mkdir()
    with nullcontext() if saved else pytest.raises(KeyboardInterrupt):
        manager.save_trained_model(SimpleNamespace())
    assert manager.keeper.done is saved
    assert ("Ctrl-C once more drops it" in capsys.readouterr().err) is (times > 0)
    assert not manager.files.aside.exists()
