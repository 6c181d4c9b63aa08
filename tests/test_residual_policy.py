"""A driver that is corrected where its gate is open."""

import numpy as np
import onnxruntime
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO
from toy import ToyRace

from sb3_torcs.agents.model_writing import RecordCallback, write_driver
from sb3_torcs.agents.models import load_driver
from sb3_torcs.callbacks import LeanUpdatesCallback
from sb3_torcs.errors import InvalidOption
from sb3_torcs.policies import BoundedPolicy, ResidualPolicy, export_actor

GATE = 5
SIZES = {"net_arch": [8], "driver_arch": [16, 12], "gate_features": GATE}


class ShortSighted(ToyRace):
    """It does not see the last features."""

    observation_space = spaces.Box(-1.0, 1.0, (29 - GATE,), np.float32)

    def _observe(self):
        return super()._observe()[:-GATE]


@pytest.fixture
def driver():
    return PPO(BoundedPolicy, ShortSighted(), policy_kwargs={"net_arch": [16, 12]}, seed=1)


@pytest.fixture
def model(driver):
    model = PPO(
        ResidualPolicy, ToyRace(), policy_kwargs=SIZES, n_steps=64, batch_size=16,
        learning_rate=0.01, seed=0,
    )  # fmt: skip
    model.policy.follow(driver.policy)
    return model


def observations(alone):
    seen = np.random.default_rng(0).uniform(-1, 1, (50, 29)).astype(np.float32)
    if alone:
        seen[:, -GATE:] = 0.0
    return seen


def decide(model, seen):
    return model.predict(seen, deterministic=True)[0]


@pytest.mark.parametrize("callbacks", [[], [LeanUpdatesCallback()]])
def test_behind_a_shut_gate_it_stays_the_driver(driver, model, callbacks):
    """To the bit, however long it learns."""
    alone, near = observations(alone=True), observations(alone=False)
    given = decide(driver, near[:, :-GATE])
    np.testing.assert_array_equal(decide(model, near), given)
    model.learn(640, callback=callbacks)
    np.testing.assert_array_equal(decide(model, alone), given)
    assert np.all(np.any(decide(model, near) != given, axis=1))


def test_a_gate_that_is_hardly_open_corrects_little(driver, model):
    model.learn(640)
    seen = observations(alone=True)
    seen[:, -1] = 1e-4
    given = decide(driver, seen[:, :-GATE])
    assert np.any(decide(model, seen) != given)
    np.testing.assert_allclose(decide(model, seen), given, atol=1e-3)


def test_saved_models_decide_as_before(tmp_path, model):
    model.learn(64, callback=RecordCallback())
    model.save(tmp_path / "model.zip")
    model.policy.save(tmp_path / "policy.pth")
    write_driver(tmp_path / "model.zip", tmp_path / "driver.zip")
    seen = observations(alone=False)
    wanted = decide(model, seen)
    copies = [PPO.load(tmp_path / "model.zip"), ResidualPolicy.load(tmp_path / "policy.pth")]
    for copy in (*copies, load_driver(tmp_path / "driver.zip", ToyRace())):
        np.testing.assert_array_equal(decide(copy, seen), wanted)


def test_its_graph_decides_as_it_does(tmp_path, model):
    model.learn(64)
    graph = onnxruntime.InferenceSession(str(export_actor(model, tmp_path / "driver.onnx")))
    seen = observations(alone=False)
    (actions,) = graph.run(None, {"observation": seen})
    np.testing.assert_allclose(actions, decide(model, seen), atol=1e-6)


@pytest.mark.parametrize("number", [0, 29, 2.5, True])
def test_gate_features_are_some_of_the_features(number):
    with pytest.raises(InvalidOption, match="expected a whole number from 1 to 28"):
        PPO(ResidualPolicy, ToyRace(), policy_kwargs={**SIZES, "gate_features": number})


def test_a_driver_of_another_size_is_refused(driver):
    model = PPO(ResidualPolicy, ToyRace(), policy_kwargs={**SIZES, "driver_arch": [16, 8]})
    before = decide(model, observations(alone=True))
    with pytest.raises(InvalidOption, match="the driver is a Sequential"):
        model.policy.follow(driver.policy)
    np.testing.assert_array_equal(decide(model, observations(alone=True)), before)
