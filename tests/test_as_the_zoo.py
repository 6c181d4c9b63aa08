"""Each shipped entry trains the same agent by our command and by the RL Zoo's own script."""

import runpy
import sys

import pytest
import torch as th
import yaml

from sb3_torcs.agents.saved.file import saved_weights
from sb3_torcs.training import zoo
from sb3_torcs.training.run import TrainOptions, train

FILES = sorted(zoo.shipped_folder().glob("*.yml"))
ENTRIES = [(file.stem, name) for file in FILES for name in zoo.read_config(file)]
OFF_POLICY = 120  # timesteps
UPDATES = 2  # of an algorithm without a replay buffer


def world_of(name):
    """The world that an entry is for; the one called default is for both."""
    return name if name in zoo.OURS else "Torcs-v0"


def shortened(algo, entry):
    """Changes with which an entry learns something within few timesteps."""
    n_envs = entry.get("n_envs", 1)
    if "buffer_size" in entry:
        return {"n_timesteps": OFF_POLICY, "learning_starts": 40, "buffer_size": 1000}
    n_steps = max(entry.get("batch_size", 0) // n_envs, 16)
    return {"n_timesteps": UPDATES * n_steps * n_envs, "n_steps": n_steps}


def trained_by_the_zoo(monkeypatch, folder, algo, env_id, entry):
    folder.mkdir()
    file = folder / "entry.yml"
    file.write_text(yaml.safe_dump({env_id: entry}))
    words = ["--algo", algo, "--env", env_id, "--gym-packages", "sb3_torcs", "--seed", "7"]
    words += ["--conf-file", str(file), "-f", str(folder), "--num-threads", "1"]
    words += ["--device", "cpu", "--eval-freq", "-1", "--verbose", "0"]
    monkeypatch.setattr(sys, "argv", ["rl_zoo3.train", *words])
    runpy.run_module("rl_zoo3.train", run_name="__main__", alter_sys=True)
    return folder / algo / f"{env_id}_1" / f"{env_id}.zip"


@pytest.mark.slow
@pytest.mark.parametrize(("algo", "name"), ENTRIES)
def test_both_end_with_equal_weights(tmp_path, monkeypatch, algo, name):
    th.set_num_threads(1)  # as the zoo's script does below
    env_id = world_of(name)
    entry = zoo.read_entry(zoo.config_file(algo), name)
    changes = shortened(algo, entry)
    options = TrainOptions(
        algo, env_id, name, hyperparams=changes, seed=7, folder=tmp_path / "ours", progress=False,
        eval_freq=changes["n_timesteps"] // 2,
    )  # fmt: skip
    ours = saved_weights(train(options) / f"{env_id}.zip")
    theirs = saved_weights(
        trained_by_the_zoo(monkeypatch, tmp_path / "zoo", algo, env_id, {**entry, **changes})
    )
    assert ours.keys() == theirs.keys()
    assert [part for part in ours if not ours[part].equal(theirs[part])] == []
