"""Trainings of several cars drive on threads or in processes, and learn what they would without."""

import numpy as np
import pytest
import yaml
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_torcs.training.manager import build
from sb3_torcs.training.run import TrainOptions, train
from sb3_torcs.training.workers import WorkersVecEnv
from sb3_torcs.vec_env import TorcsVecEnv

ENTRY = {
    "n_timesteps": 96,
    "n_envs": 3,
    "policy": "MlpPolicy",
    "policy_kwargs": {"net_arch": [8]},
    "n_steps": 16,
    "batch_size": 16,
    "env_kwargs": {"track": "aalborg", "start": "random"},
}


def learned(world, **changes):
    """What a training comes to, and in which environments it drives."""
    model, callbacks, _ = build("ppo", world, {**ENTRY, **changes}, seed=3)
    envs = model.get_env()
    model.learn(96, callback=callbacks)
    envs.close()
    return type(envs), [weights.tolist() for weights in model.policy.parameters()]


@pytest.mark.parametrize("world", ["Torcs-v0", "TorcsLite-v0"])
def test_the_same_is_learned_on_threads_and_one_car_after_the_other(world, monkeypatch):
    kind, on_threads = learned(world)
    monkeypatch.setattr("sb3_torcs.training.manager.TorcsVecEnv", DummyVecEnv)
    other, in_turn = learned(world)
    assert (kind, other) == (TorcsVecEnv, DummyVecEnv)
    assert on_threads == in_turn


@pytest.mark.parametrize(
    "changes",
    [{"n_envs": 1}, {"env_wrapper": "gymnasium.wrappers.NormalizeReward"}],
    ids=["one car", "a wrapper"],
)
def test_what_threads_cannot_drive_or_need_not_drives_as_before(changes):
    model, *_ = build("ppo", "TorcsLite-v0", {**ENTRY, **changes})
    assert type(model.get_env()) is DummyVecEnv
    model.get_env().close()


def test_workers_close_wherever_an_interrupt_has_come():
    """Ctrl-C may come after one worker has answered, and before the next one has."""
    made = make_vec_env(
        "sb3_torcs:TorcsLite-v0", 3, vec_env_cls=WorkersVecEnv,
        env_kwargs={"track": "aalborg"},
    )  # fmt: skip
    made.reset()
    made.step_async(np.zeros((3, *made.action_space.shape)))
    made.remotes[0].recv()
    made.close()
    made.close()  # does no harm
    assert [process.exitcode for process in made.processes] == [0, 0, 0]


def test_workers_close_if_one_has_ended():
    made = make_vec_env("sb3_torcs:TorcsLite-v0", 2, vec_env_cls=WorkersVecEnv)
    made.processes[1].kill()
    made.processes[1].join()
    made.close()
    assert [process.exitcode for process in made.processes] == [0, -9]


def test_a_training_in_processes_has_such_workers(tmp_path, monkeypatch):
    made = []

    class Noted(WorkersVecEnv):
        def __init__(self, *arguments, **keywords):
            super().__init__(*arguments, **keywords)
            made.append(self.num_envs)

    monkeypatch.setattr("sb3_torcs.training.manager.WorkersVecEnv", Noted)
    conf_file = tmp_path / "own.yml"
    conf_file.write_text(yaml.safe_dump({"TorcsLite-v0": ENTRY}))
    train(TrainOptions(
        algo="ppo", conf_file=conf_file, folder=tmp_path, eval_freq=48, progress=False,
        zoo_args=("--vec-env", "subproc"),
    ))  # fmt: skip
    assert made == [1, 3]  # for evaluations, and to learn
