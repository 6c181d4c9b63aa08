"""Drivers as ONNX graphs: they drive what ``predict`` drives."""

from __future__ import annotations

import subprocess
import sys

import gymnasium as gym
import numpy as np
import onnxruntime
import pytest
import torch as th
from rl_zoo3.utils import ALGOS
from stable_baselines3 import DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from toy import ToyRace

from sb3_torcs.agents.models import ModelDriver
from sb3_torcs.errors import ModelMismatch, OutputNotWritable, PackageMissing
from sb3_torcs.noise import SetPointNoise, bind
from sb3_torcs.policies import export
from sb3_torcs.policies.export import export_actor

OBSERVATIONS = np.random.default_rng(0).uniform(-1, 1, (200, 29)).astype(np.float32)

ROUNDING = float(np.finfo(np.float32).eps)
"""
[-] of actions. Both sides compute a policy in the same precision but may add in another order; what
is left of that is in the last bit of a single-precision number, and actions are at most 1.
"""

SINGLE = 10.0 * ROUNDING
"""[-] where the networks themselves are in single precision, as those of stock policies are."""


def race():
    return DummyVecEnv([ToyRace])


def split_heads(algorithm=DDPG, env=None, **policy_kwargs):
    """A model that has learned a little."""
    model = algorithm(
        "SplitHeadPolicy", env or race(), learning_starts=5, batch_size=8, buffer_size=100, seed=0,
        policy_kwargs={"net_arch": [16, 24], "init_std": 0.5, **policy_kwargs}, device="cpu",
    )  # fmt: skip
    return model.learn(20)


def run(file, observations):
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    (actions,) = session.run([export.OUTPUT], {export.INPUT: observations})
    return actions


def assert_equal(model, folder, atol=ROUNDING):
    """An export drives what the model drives, for any number of rows."""
    file = export_actor(model, folder / "driver.onnx")
    for seen in (OBSERVATIONS, OBSERVATIONS[:1]):
        expected, _ = model.predict(seen, deterministic=True)
        np.testing.assert_allclose(run(file, seen), expected, rtol=0.0, atol=atol)
    return file


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_the_export_is_the_driver(tmp_path, algorithm, symmetric):
    """Averaged and mirrored, in environment units."""
    model = split_heads(algorithm, layer_norm=True, ema_decay=0.9, symmetric=symmetric)
    file = assert_equal(model, tmp_path)
    learner = model.policy.actor(th.as_tensor(OBSERVATIONS)).detach().numpy()
    assert np.abs(learner - run(file, OBSERVATIONS)).max() > 0.01


@pytest.mark.parametrize("symmetric", [False, True])
def test_a_bounded_policy_is_exported(tmp_path, symmetric):
    kwargs = {"net_arch": [16], "symmetric": symmetric}
    model = PPO("BoundedPolicy", race(), policy_kwargs=kwargs, device="cpu", seed=0)
    with th.no_grad():
        model.policy.action_net.linear.weight *= 100.0
    assert_equal(model, tmp_path)


@pytest.mark.parametrize("algo", ["ars", "crossq", "ppo", "sac", "td3", "sde"])
def test_stock_policies_are_exported(tmp_path, algo):
    """One algorithm of each kind of policy, and one without its exploration that sees the state."""
    own = {"use_sde": True, "buffer_size": 1} if algo == "sde" else {}
    kind = SAC if algo == "sde" else ALGOS[algo]
    assert_equal(kind("MlpPolicy", race(), device="cpu", seed=0, **own), tmp_path, SINGLE)


def test_the_statistics_of_the_observations_are_in_the_graph(tmp_path):
    """It takes raw observations, from a model that learns and from one that was loaded."""
    env = VecNormalize(race(), clip_obs=0.5)
    model = split_heads(env=env)
    expected, _ = model.predict(env.normalize_obs(OBSERVATIONS), deterministic=True)
    for number, driver in enumerate((model, *(ModelDriver(m, env) for m in (model, model.policy)))):
        found = run(export_actor(driver, tmp_path / f"{number}.onnx"), OBSERVATIONS)
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=ROUNDING)


def test_statistics_that_are_not_used_are_not_in_the_graph(tmp_path):
    """Those of rewards alone."""
    model = split_heads(env=VecNormalize(race(), norm_obs=False))
    assert_equal(model, tmp_path)


def test_a_driver_is_exported_beside_a_noise_that_listens(tmp_path):
    """Its hook on the actor must not follow into the graph."""
    model = DDPG("MlpPolicy", race(), buffer_size=1, device="cpu", seed=0)
    model.action_noise = SetPointNoise()
    bind(model)
    assert_equal(model, tmp_path, SINGLE)


def test_an_export_changes_nothing_in_the_process(tmp_path):
    checks = th.distributions.Distribution._validate_args
    model = PPO("MlpPolicy", race(), device="cpu", seed=0)
    before, _ = model.predict(OBSERVATIONS, deterministic=True)
    export_actor(model, tmp_path / "driver.onnx")
    np.testing.assert_array_equal(model.predict(OBSERVATIONS, deterministic=True)[0], before)
    assert th.distributions.Distribution._validate_args == checks
    assert [file.name for file in tmp_path.iterdir()] == ["driver.onnx"]


def test_an_export_needs_nothing_but_a_runtime(tmp_path):
    """Neither PyTorch nor this package."""
    export_actor(split_heads(), tmp_path / "driver.onnx")
    code = (
        "import sys, numpy, onnxruntime\n"
        "drive = onnxruntime.InferenceSession(sys.argv[1], providers=['CPUExecutionProvider'])\n"
        "print(drive.run(None, {'observation': numpy.zeros((1, 29), numpy.float32)})[0].shape)\n"
        "assert not {'torch', 'stable_baselines3', 'sb3_torcs'} & set(sys.modules)"
    )
    call = [sys.executable, "-c", code, str(tmp_path / "driver.onnx")]
    output = subprocess.run(call, check=True, capture_output=True, text=True)
    assert output.stdout == "(1, 3)\n"


def test_a_file_that_cannot_be_written_is_told(tmp_path):
    with pytest.raises(OutputNotWritable, match="existing folder"):
        export_actor(split_heads(), tmp_path / "nowhere" / "driver.onnx")
    with pytest.raises(OutputNotWritable, match="existing folder"):
        export_actor(split_heads(), tmp_path)
    assert list(tmp_path.parent.glob(f".{tmp_path.name}*")) == []


def test_a_policy_that_remembers_is_refused(tmp_path):
    model = ALGOS["ppo_lstm"]("MlpLstmPolicy", race(), device="cpu", seed=0)
    with pytest.raises(ModelMismatch, match="remembers what it saw, and an export keeps no state"):
        export_actor(model, tmp_path / "driver.onnx")


def test_frames_that_are_normalized_one_by_one_are_refused(tmp_path):
    model = PPO("MlpPolicy", VecFrameStack(VecNormalize(race()), 2), device="cpu")
    with pytest.raises(ModelMismatch, match="sees stacked frames that are normalized one by one"):
        export_actor(model, tmp_path / "driver.onnx")


def test_what_is_no_driver_is_refused(tmp_path):
    model = DQN("MlpPolicy", gym.make("CartPole-v1"), buffer_size=1, device="cpu")
    with pytest.raises(ModelMismatch, match=r"Discrete\(2\); an export needs spaces of numbers"):
        export_actor(model, tmp_path / "driver.onnx")
    with pytest.raises(ModelMismatch, match="str has no PyTorch network to export"):
        export_actor("ddpg-aalborg", tmp_path / "driver.onnx")
    assert list(tmp_path.iterdir()) == []


def test_without_its_packages_an_export_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(PackageMissing, match=r'needs onnx, .* "sb3-torcs\[export\]"'):
        export_actor(split_heads(), tmp_path / "driver.onnx")
