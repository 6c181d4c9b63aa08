"""A training that is resumed goes on as it began."""

import dataclasses
import pickle
import shlex
import shutil
import signal

import pytest
import yaml

from sb3_torcs.agents.models import find_model, saved_timesteps
from sb3_torcs.agents.saved.record import _read_plain
from sb3_torcs.cli import main
from sb3_torcs.training.resuming import recorded_entry
from sb3_torcs.training.run import Run, TrainOptions, continuing_command

INTERRUPT = {"test_cli.InterruptingCallback": {"at": 70}}
LITE = ["--env", "TorcsLite-v0"]
METRICS = "sb3_torcs.callbacks.DrivingMetricsCallback"
ENTRY = {
    "n_timesteps": 100,
    "policy": "MlpPolicy",
    "n_envs": 2,
    "n_steps": 10,
    "batch_size": 10,
    "learning_rate": "lin_0.001",
    "env_kwargs": {"track": "alpine-1", "reward": {"progress": 1.0}},
    "env_wrapper": "gymnasium.wrappers.FlattenObservation",
    "callback": [METRICS, INTERRUPT],
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A training of an own entry that was interrupted in the fourth of its five rollouts."""
    folder = tmp_path_factory.mktemp("begun")
    (folder / "own.yml").write_text(yaml.safe_dump({"mine": ENTRY}))
    words = [
        "train",
        *LITE,
        "--algo",
        "ppo",
        "--conf-file",
        str(folder / "own.yml"),
        "--entry",
        "mine",
    ]
    words += ["--folder", str(folder), "--pictures", str(folder / "pictures")]
    assert main(words) == 130
    return folder / "ppo" / "TorcsLite-v0_1"


def gone_on(run, tmp_path, *words):
    """Resume it, and read what was written of the entry."""
    words = ["train", "--resume", str(run), "--folder", str(tmp_path), "--no-progress", *words]
    assert main(words) == 0
    (folder,) = tmp_path.glob("ppo/*_1/*/")
    return _read_plain(folder / "config.yml")


def test_it_goes_on_with_its_own_entry_for_what_is_left(run, tmp_path, capsys):
    assert saved_timesteps(run / "TorcsLite-v0.zip") == 60  # it has learned from three rollouts
    entry = gone_on(run, tmp_path)
    assert "learned from 40 of 40 timesteps" in capsys.readouterr().out
    assert entry == {**ENTRY, "n_timesteps": 40, "learning_rate": "lin_0.0004"}


def test_what_is_given_replaces_what_was_recorded(run, tmp_path):
    entry = gone_on(run, tmp_path, "--track", "aalborg", "--timesteps", "20")
    assert entry["env_kwargs"] == {"track": "aalborg", "reward": {"progress": 1.0}}
    assert entry["n_envs"] == 2


def test_the_command_that_continues_leaves_out_what_is_recorded(run, tmp_path):
    options = TrainOptions("ppo", entry="mine", conf_file=run.parents[1] / "own.yml")
    changes = {"hyperparams": {"gamma": 0.5}, "folder": tmp_path, "progress": False}
    options = dataclasses.replace(options, **changes)
    model = run / "TorcsLite-v0.zip"
    command = continuing_command(options, Run(run, 60, 100, signal.SIGINT, model, {}))
    assert shlex.split(command) == [
        "sb3-torcs", "train", "--resume", str(model), "--seed", "0", "--folder", str(tmp_path),
        "--no-progress",
    ]  # fmt: skip


def test_a_given_entry_is_all_that_counts(run, tmp_path):
    other = {"TorcsLite-v0": {**ENTRY, "n_envs": 1, "n_timesteps": 30}}
    (tmp_path / "other.yml").write_text(yaml.safe_dump(other))
    entry = gone_on(run, tmp_path, "--conf-file", str(tmp_path / "other.yml"))
    assert (entry["n_envs"], entry["n_timesteps"]) == (1, 30)


def test_another_world_has_entries_of_its_own(run):
    assert recorded_entry(find_model(run, prefer_last=True), "ppo", "Torcs-v0") == {}


@pytest.mark.parametrize("beside", [True, False])
def test_the_statistics_of_the_observations_go_on(run, tmp_path, beside):
    """Those in the run's folder, or else those in the record of a model that was copied."""
    own = {"TorcsLite-v0": {**ENTRY, "normalize": True, "n_timesteps": 60, "callback": []}}
    (tmp_path / "own.yml").write_text(yaml.safe_dump(own))
    words = ["train", *LITE, "--algo", "ppo", "--no-progress", "--folder", str(tmp_path / "one")]
    assert main([*words, "--conf-file", str(tmp_path / "own.yml")]) == 0
    first = tmp_path / "one" / "ppo" / "TorcsLite-v0_1"
    model = tmp_path / "copied.zip"
    shutil.copy(first / "TorcsLite-v0.zip", model)
    gone_on(first if beside else model, tmp_path / "two", "--timesteps", "20")
    files = [
        folder / "TorcsLite-v0" / "vecnormalize.pkl"
        for folder in (first, tmp_path / "two" / "ppo" / "TorcsLite-v0_1")
    ]
    before, after = (pickle.loads(file.read_bytes()).obs_rms.count for file in files)
    assert after == pytest.approx(before + 22, abs=2.01)


def test_a_folder_without_its_last_model_goes_on_from_the_best_and_says_so(run, tmp_path, capsys):
    copied = tmp_path / "run"
    shutil.copytree(run, copied)
    (copied / "TorcsLite-v0.zip").rename(copied / "best_model.zip")
    gone_on(copied, tmp_path / "two", "--timesteps", "20")
    assert "has no last model; going on from the best one" in capsys.readouterr().err


def test_a_replay_buffer_that_is_missing_is_told(tmp_path, capsys):
    own = {"n_timesteps": 40, "policy": "MlpPolicy", "learning_starts": 10, "buffer_size": 100}
    (tmp_path / "own.yml").write_text(yaml.safe_dump({"TorcsLite-v0": own}))
    words = ["train", *LITE, "--no-progress", "--folder", str(tmp_path)]
    assert main([*words, "--conf-file", str(tmp_path / "own.yml")]) == 0
    begun = tmp_path / "ddpg" / "TorcsLite-v0_1"
    resumed = [*words, "--resume", str(begun)]
    assert main([*resumed, "--hyperparams", "buffer_size=50"]) == 2
    assert "keeps 100 timesteps, and the training would keep 50" in capsys.readouterr().err
    (begun / "replay_buffer.pkl").unlink()
    capsys.readouterr()
    said = "there is no replay_buffer.pkl beside"
    for folder, told in ((begun, True), (tmp_path / "ddpg" / "TorcsLite-v0_2", False)):
        assert main([*words, "--resume", str(folder), "--timesteps", "20"]) == 0
        assert (said in capsys.readouterr().err) == told


def test_what_is_left_of_a_warm_up_goes_on(tmp_path):
    own = {"n_timesteps": 60, "policy": "MlpPolicy", "learning_starts": 30, "buffer_size": 100}
    (tmp_path / "own.yml").write_text(yaml.safe_dump({"TorcsLite-v0": own}))
    words = ["train", *LITE, "--no-progress", "--folder", str(tmp_path), "--timesteps", "20"]
    assert main([*words, "--conf-file", str(tmp_path / "own.yml")]) == 0
    assert main([*words, "--resume", str(tmp_path / "ddpg" / "TorcsLite-v0_1")]) == 0
    resumed = tmp_path / "ddpg" / "TorcsLite-v0_2" / "TorcsLite-v0" / "config.yml"
    assert _read_plain(resumed)["learning_starts"] == 10


def test_what_changes_how_it_sees_is_refused(run, tmp_path, capsys):
    words = ["train", "--resume", str(run), "--folder", str(tmp_path / "none"), "--no-progress"]
    assert main([*words, "--hyperparams", "normalize=true"]) == 2
    assert "has learned with normalize False, and would go on with True" in capsys.readouterr().err
    for change in ("policy_kwargs={net_arch: [8]}", "policy=sb3_torcs.policies.BoundedPolicy"):
        assert main([*words, "--hyperparams", change]) == 2
        assert f"has learned with {change.partition('=')[0]} " in capsys.readouterr().err
    assert main([*words, "--algo", "a2c"]) == 2
    assert "is a model of ppo, not of a2c; give --algo ppo" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_a_callback_that_refuses_to_begin_leaves_no_run(run, tmp_path, capsys):
    bad = {"TorcsLite-v0": {**ENTRY, "callback": ["sb3_torcs.callbacks.replay.MirrorCallback"]}}
    (tmp_path / "own.yml").write_text(yaml.safe_dump(bad))
    words = ["train", *LITE, "--algo", "ppo", "--no-progress", "--folder", str(tmp_path)]
    assert main([*words, "--conf-file", str(tmp_path / "own.yml")]) == 2
    assert "MirrorCallback mirrors samples" in capsys.readouterr().err
    assert list((tmp_path / "ppo").iterdir()) == []
