"""A training that is resumed goes on as it began."""

import pytest
import yaml

from sb3_torcs.agents.model_record import _read_plain
from sb3_torcs.agents.models import find_model
from sb3_torcs.cli import main
from sb3_torcs.training.resuming import recorded_entry
from sb3_torcs.training.run import OF_ONE_RUN

INTERRUPT = {"test_cli.InterruptingCallback": {"at": 80}}
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
    """A training of an own entry that was interrupted after 80 of its 100 timesteps."""
    folder = tmp_path_factory.mktemp("begun")
    (folder / "own.yml").write_text(yaml.safe_dump({"mine": ENTRY}))
    words = ["train", "--algo", "ppo", "--conf-file", str(folder / "own.yml"), "--entry", "mine"]
    words += ["--folder", str(folder), "--pictures", str(folder / "pictures")]
    assert main(words) == 130
    return folder / "ppo" / "TorcsLite-v0_1"


def gone_on(run, tmp_path, *words):
    """Resume it, and read what the zoo has written of the entry."""
    words = ["train", "--resume", str(run), "--folder", str(tmp_path), "--no-progress", *words]
    assert main(words) == 0
    (folder,) = tmp_path.glob("ppo/*_1/*/")
    return _read_plain(folder / "config.yml")


def test_it_goes_on_with_its_own_entry_for_what_is_left(run, tmp_path, capsys):
    entry = gone_on(run, tmp_path)
    assert "learned from 20 of 20 timesteps" in capsys.readouterr().out
    assert entry == {**ENTRY, "n_timesteps": 20, "learning_rate": "lin_0.0002"} | {
        "env_wrapper": ["gymnasium.wrappers.FlattenObservation"]
    }


def test_what_is_given_replaces_what_was_recorded(run, tmp_path):
    entry = gone_on(run, tmp_path, "--track", "aalborg", "--timesteps", "20")
    assert entry["env_kwargs"] == {"track": "aalborg", "reward": {"progress": 1.0}}
    assert entry["n_envs"] == 2


def test_a_given_entry_is_all_that_counts(run, tmp_path):
    (tmp_path / "other.yml").write_text(
        yaml.safe_dump({"TorcsLite-v0": {**ENTRY, "n_envs": 1, "n_timesteps": 30}})
    )
    entry = gone_on(run, tmp_path, "--conf-file", str(tmp_path / "other.yml"))
    assert (entry["n_envs"], entry["n_timesteps"]) == (1, 30)


def test_options_of_one_run_are_not_those_of_the_next(run):
    model = find_model(run, prefer_last=True)
    written = recorded_entry(model, "ppo", "TorcsLite-v0")["callback"]
    assert len(written) == 4
    kept = recorded_entry(model, "ppo", "TorcsLite-v0", without=OF_ONE_RUN)
    assert kept["callback"] == [METRICS, INTERRUPT]


@pytest.mark.parametrize(("algo", "env_id"), [("ddpg", "TorcsLite-v0"), ("ppo", "Torcs-v0")])
def test_another_algorithm_or_world_has_entries_of_its_own(run, algo, env_id):
    assert recorded_entry(find_model(run, prefer_last=True), algo, env_id) == {}
