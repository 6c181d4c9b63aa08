"""What a model's own file tells, and that reading it runs nothing and takes no more than it has."""

from __future__ import annotations

import io
import json
import pickle
import re
import subprocess
import sys
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import ARS, QRDQN, TQC, TRPO, CrossQ, RecurrentPPO
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from torch import nn

import sb3_torcs  # noqa: F401  (registers the environments)
from sb3_torcs.agents import models
from sb3_torcs.agents.saved import file as model_file
from sb3_torcs.agents.saved import policy as model_policy
from sb3_torcs.agents.saved.writing import RecordCallback, recipe, write_driver
from sb3_torcs.agents.wrapping import wrap_env
from sb3_torcs.cli import main
from sb3_torcs.errors import (
    InvalidAction,
    InvalidOption,
    ModelMismatch,
    ModelNotTrusted,
    OutputNotWritable,
)
from sb3_torcs.evaluation.protocol import evaluate
from sb3_torcs.policies import BoundedPolicy, SplitHeadPolicy
from sb3_torcs.tracks.catalogue import load_track
from sb3_torcs.training.resuming import check_resumable

OBSERVATIONS = np.linspace(-0.5, 0.5, 4 * 29, dtype=np.float32).reshape(4, 29)
SPLIT = {"net_arch": [8, 8], "ema_decay": 0.9, "symmetric": True}
OFF_POLICY = {"buffer_size": 100, "learning_starts": 2, "batch_size": 2}


@pytest.fixture(scope="module")
def env():
    with gym.make("TorcsLite-v0") as made:
        yield made


def load_plainly(file, env, monkeypatch):
    """Load a driver; whoever unpickles on the way fails."""

    def refuse(*args, **kwargs):
        raise AssertionError("something was unpickled")

    with monkeypatch.context() as patch:
        for function in ("pickle.loads", "pickle.load", "cloudpickle.loads", "cloudpickle.load"):
            patch.setattr(function, refuse)
        return models.load_driver(file, env)


def trained(algorithm, policy, where, steps=6, **kwargs):
    """Train a little with the record, and save."""
    model = algorithm(policy, where, device="cpu", seed=0, **kwargs)
    return model.learn(steps, callback=RecordCallback())


def rewritten(path, **changes):
    """Change parts of a saved model: data by key, ``policy.pth`` by the whole."""
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    if "policy_pth" in changes:
        parts["policy.pth"] = changes.pop("policy_pth")
    parts["data"] = json.dumps({**json.loads(parts["data"]), **changes}).encode()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(name, content)


def saved_state(weights):
    """What ``torch.save`` makes of something."""
    buffer = io.BytesIO()
    th.save(weights, buffer)
    return buffer.getvalue()


def data_of(path):
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read("data"))


@pytest.mark.parametrize(("algorithm", "policy", "kwargs"), [
    (DDPG, SplitHeadPolicy, {**OFF_POLICY, "policy_kwargs": SPLIT}),
    (TD3, "MlpPolicy", {**OFF_POLICY, "policy_kwargs": {"activation_fn": nn.ELU}}),
    (SAC, "MlpPolicy", {**OFF_POLICY, "use_sde": True}),
    (PPO, "MlpPolicy", {"n_steps": 4, "batch_size": 2, "policy_kwargs": {"net_arch": [8]}}),
    (A2C, "MlpPolicy", {}),
    (TQC, "MlpPolicy", OFF_POLICY),
    (TRPO, "MlpPolicy", {"n_steps": 4, "batch_size": 2}),
    (CrossQ, "MlpPolicy", OFF_POLICY),
    (ARS, "LinearPolicy", {"n_delta": 1}),
    (RecurrentPPO, "MlpLstmPolicy", {"n_steps": 4, "batch_size": 2}),
])  # fmt: skip
def test_a_model_drives_to_the_bit_without_unpickling(
    env, tmp_path, monkeypatch, algorithm, policy, kwargs
):
    """Every stock algorithm for our actions."""
    with gym.make("TorcsLite-v0", max_episode_steps=3) as short:
        model = trained(algorithm, policy, short, **kwargs)
        model.save(tmp_path / "m.zip")
    driver = load_plainly(tmp_path / "m.zip", env, monkeypatch)
    state = expected_state = None
    for observation in OBSERVATIONS:
        found, state = driver.predict(observation, state, deterministic=True)
        expected, expected_state = model.predict(observation, expected_state, deterministic=True)
        np.testing.assert_array_equal(found, expected)


def test_each_file_of_a_training_tells_of_it(tmp_path):
    """Also a checkpoint, with the statistics of that moment, and under any name anywhere."""
    with gym.make("TorcsLite-v0", track="alpine-1", range_finders="narrow") as env:
        normalized = VecNormalize(DummyVecEnv([lambda: env]), clip_obs=3.0)
        model = DDPG("MlpPolicy", normalized, device="cpu", seed=0, **OFF_POLICY)
        checkpoints = CheckpointCallback(3, tmp_path, "part")
        entry = {"env_kwargs": {"track": "alpine-1"}, "frame_stack": 1, "train_freq": (1, "step")}
        asked = recipe("ddpg", "TorcsLite-v0", entry)
        model.learn(6, callback=[RecordCallback(asked), checkpoints])
        model.save(tmp_path / "last.zip")
        early, last = (
            models.training_record(tmp_path / name) for name in ("part_3_steps.zip", "last.zip")
        )
        assert (last.algo, last.env_id) == ("ddpg", "TorcsLite-v0")
        assert last.env_kwargs == {"track": "alpine-1"}
        assert last.hyperparameters == {**entry, "train_freq": [1, "step"]}
        assert early.statistics.mean != last.statistics.mean
        driver = models.load_driver(tmp_path / "last.zip", env)
        for observation in 4.0 * OBSERVATIONS:
            expected, _ = model.predict(normalized.normalize_obs(observation), deterministic=True)
            np.testing.assert_array_equal(driver.predict(observation)[0], expected)
        normalized.close()


@pytest.mark.parametrize("several", [False, True])
def test_a_track_that_was_given_as_such_is_recorded_by_its_name(tmp_path, several):
    road = load_track("alpine-1")
    with gym.make("TorcsLite-v0", track=[road, "aalborg"] if several else road) as env:
        trained(DDPG, "MlpPolicy", env, **OFF_POLICY).save(tmp_path / "m.zip")
    record = models.training_record(tmp_path / "m.zip")
    assert record.env_kwargs["track"] == (["alpine-1", "aalborg"] if several else "alpine-1")


def test_without_a_recipe_the_environment_tells(tmp_path):
    with gym.make("sb3_torcs:TorcsLite-v0", track="alpine-1", action_repeat=10) as env:
        trained(DDPG, "MlpPolicy", env, **OFF_POLICY).save(tmp_path / "m.zip")
    record = models.training_record(tmp_path / "m.zip")
    assert (record.algo, record.env_id) == ("ddpg", "TorcsLite-v0")
    assert record.select(("track", "action_repeat")) == {"track": "alpine-1", "action_repeat": 10}


def test_arrays_among_the_arguments_of_an_environment_are_recorded_as_lists(tmp_path):
    """Left out, an evaluation would show the policy other beams."""
    angles = np.linspace(-60, 60, 19)
    made = {"range_finders": angles, "conditions": {"delay": np.array([0, 3])}, "laps": np.int64(2)}
    with gym.make("TorcsLite-v0", **made) as env:
        trained(DDPG, "MlpPolicy", env, **OFF_POLICY).save(tmp_path / "m.zip")
    record = models.training_record(tmp_path / "m.zip")
    assert record.env_kwargs == {
        "range_finders": angles.tolist(),
        "conditions": {"delay": [0, 3]},
        "laps": 2,
    }


@pytest.mark.parametrize("normalized", [False, True])
def test_a_frame_stack_of_a_script_is_recorded(env, tmp_path, normalized):
    where = DummyVecEnv([lambda: gym.make("TorcsLite-v0")])
    where = VecFrameStack(VecNormalize(where) if normalized else where, 3)
    model = trained(PPO, "MlpPolicy", where, n_steps=8, batch_size=8)
    model.save(tmp_path / "m.zip")
    assert models.training_record(tmp_path / "m.zip").hyperparameters["frame_stack"] == 3
    driver = models.load_driver(tmp_path / "m.zip", env)
    seen = where.venv.normalize_obs(OBSERVATIONS[:1]) if normalized else OBSERVATIONS[:1]
    stacked = np.concatenate([np.zeros((1, 58), np.float32), seen], axis=1)
    found, _ = driver.predict(OBSERVATIONS[:1], deterministic=True)
    np.testing.assert_array_equal(found, model.predict(stacked, deterministic=True)[0])
    where.close()


def test_a_frame_stack_within_statistics_cannot_be_driven_and_says_so(env, tmp_path):
    where = VecNormalize(VecFrameStack(DummyVecEnv([lambda: gym.make("TorcsLite-v0")]), 3))
    trained(PPO, "MlpPolicy", where, n_steps=8, batch_size=8).save(tmp_path / "m.zip")
    where.close()
    with pytest.raises(ModelMismatch, match=r"has observations \(87,\) .* but TorcsLite-v0 has"):
        models.load_driver(tmp_path / "m.zip", env)


def test_stock_sb3_reads_the_file_as_before_and_a_later_training_makes_the_record_void(tmp_path):
    with gym.make("TorcsLite-v0", track="alpine-1") as env:
        trained(DDPG, "MlpPolicy", env, **OFF_POLICY).save(tmp_path / "m.zip")
    with gym.make("TorcsLite-v0", track="corkscrew") as env:
        model = DDPG.load(tmp_path / "m.zip", env, device="cpu")
        model.save(tmp_path / "again.zip")
        model.learn(6).save(tmp_path / "elsewhere.zip")
    tracks = [
        models.training_record(tmp_path / f"{name}.zip").env_kwargs.get("track")
        for name in ("m", "again", "elsewhere")
    ]
    assert tracks == ["alpine-1", "alpine-1", None]


@pytest.fixture
def file(env, tmp_path):
    trained(DDPG, "MlpPolicy", env, **OFF_POLICY, policy_kwargs={"net_arch": [8]}).save(
        tmp_path / "m.zip"
    )
    return tmp_path / "m.zip"


class Bomb:
    """Makes a folder when it is unpickled."""

    def __init__(self, marker):
        self.marker = str(marker)

    def __reduce__(self):
        return __import__("os").mkdir, (self.marker,)


def test_nothing_in_a_model_runs(env, file, tmp_path):
    marker = tmp_path / "ran"
    payload = {
        ":type:": "<class 'abc.ABCMeta'>",
        ":serialized:": "gASVHgAAAAAAAACMAm9zlIwFbWtkaXI=",
    }
    for key in data_of(file):
        rewritten(file, **{key: payload} if key not in ("sb3_torcs", "num_timesteps") else {})
    rewritten(file, start_time=data_of(file)["sb3_torcs"]["start_time"])
    models.load_driver(file, env)
    rewritten(file, policy_pth=saved_state({"actor.mu.0.weight": Bomb(marker)}))
    with pytest.raises(ModelMismatch, match="has no weights that can be read"):
        models.load_driver(file, env)
    (tmp_path / "vecnormalize.pkl").write_bytes(pickle.dumps(Bomb(marker)))
    with pytest.raises(ModelMismatch):
        models.load_driver(file, env)
    assert not marker.exists()


def forged(file, **changes):
    """Change the record in a file."""
    rewritten(file, sb3_torcs={**data_of(file)["sb3_torcs"], **changes})


class OwnPolicy(ActorCriticPolicy):
    """Somebody's own."""


def test_what_takes_more_than_plain_data_asks_for_trust(env, tmp_path):
    trained(PPO, OwnPolicy, env, n_steps=4, batch_size=2).save(tmp_path / "m.zip")
    with pytest.raises(ModelNotTrusted, match=r"OwnPolicy' is none of SB3's.*add --trust"):
        models.load_driver(tmp_path / "m.zip", env)
    assert isinstance(models.load_driver(tmp_path / "m.zip", env, trust=True).model, PPO)


@pytest.mark.parametrize("path", [
    "os.mkdir", "subprocess.Popen", "sb3_torcs.policies.os", "sb3_torcs.cli.main", "DDPG", "",
    "stable_baselines3.common.policies.nn", "torch.nn.modules.activation.torch",
])  # fmt: skip
@pytest.mark.parametrize("where", ["policy", "activation_fn"])
def test_a_record_names_known_classes_only(env, file, path, where):
    said = data_of(file)["sb3_torcs"]["policy"]
    kwargs = {**said["kwargs"], "activation_fn": {"class": path}}
    forged(
        file, policy={**said, "class": path} if where == "policy" else {**said, "kwargs": kwargs}
    )
    with pytest.raises(ModelNotTrusted, match="--trust"):
        models.load_driver(file, env)


@pytest.mark.parametrize(("changes", "message"), [
    ({"version": 2}, "upgrade sb3_torcs"),
    ({"version": None}, "the record in .* cannot be read"),
    ({"env_kwargs": ["track"]}, "env_kwargs is a list"),
    ({"action_space": {"kind": "Box", "shape": [2**40], "low": 0, "high": 1, "dtype": "f4"}},
     "the record in"),
    ({"action_space": {"kind": "Text"}}, "the record in"),
    ({"statistics": {"mean": [float("nan")], "var": [1.0], "epsilon": 0.0, "clip_obs": 1.0}},
     "statistics of VecNormalize are not finite"),
])  # fmt: skip
def test_a_broken_record_is_told(env, file, changes, message):
    """Without it the model would drive in another environment than the one it learned in."""
    forged(file, **changes)
    with pytest.raises(ModelMismatch, match=message):
        models.load_driver(file, env)


def test_a_network_that_fills_the_memory_is_not_built(env, file):
    said = data_of(file)["sb3_torcs"]["policy"]
    for kwargs in ({"net_arch": [10**9]}, {"net_arch": [9000, 9000]}, {"n_critics": 10**6}):
        forged(file, policy={**said, "kwargs": kwargs})
        with pytest.raises(ModelNotTrusted, match=r"more than \d+ numbers"):
            models.load_driver(file, env)


def test_a_zip_that_unpacks_to_too_much_is_refused(env, file, monkeypatch):
    """Within limits that no real model comes near; the test lowers them."""
    monkeypatch.setattr(model_file, "MAX_WEIGHTS", 100)
    with pytest.raises(ModelMismatch, match=r"policy.pth' unpacks to more than"):
        models.load_driver(file, env)
    monkeypatch.setattr(model_file, "MAX_DATA", 100)
    with pytest.raises(ModelMismatch, match="'data' unpacks to more than"):
        models.load_driver(file, env)


def test_weights_are_tensors_by_name_and_nothing_else(env, file):
    deflated = io.BytesIO()
    with zipfile.ZipFile(deflated, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(10**6))
    for content in (
        saved_state([th.zeros(3)]),
        saved_state({"a": 1}),
        saved_state({"a": nn.Parameter(th.zeros(3))}),
        saved_state({"a": bytearray(3)}),
        deflated.getvalue(),
        pickle.dumps({}),
    ):
        rewritten(file, policy_pth=content)
        with pytest.raises(ModelMismatch, match="has no weights that can be read"):
            models.load_driver(file, env)


def test_weights_that_are_no_numbers_are_told_by_name(env, file):
    """Those that drive; a critic is not asked."""
    weights = load_from_zip_file(file, device="cpu")[1]["policy"]
    for name in ("critic.qf0.0.weight", "actor.mu.0.weight"):
        weights[name][0, 0] = float("nan")
        rewritten(file, policy_pth=saved_state(weights))
        for trust in (False, True):
            if name.startswith("critic"):
                models.load_driver(file, env, trust=trust)
                continue
            with pytest.raises(ModelMismatch, match=r"'actor.mu.0.weight' of .* are not finite"):
                models.load_driver(file, env, trust=trust)


@pytest.mark.parametrize("space", [
    spaces.Box(-1.0, 1.0, (29,), np.float32),
    spaces.Box(np.float32([-1.0, 0.1, -np.inf]), np.float32([1.0, 1 / 3, np.inf])),
    spaces.Box(0, 255, (2, 3, 3), np.uint8),
    spaces.Discrete(5, start=2),
])  # fmt: skip
def test_a_space_comes_back_from_plain_data(space):
    said = json.loads(json.dumps(model_policy.plain_space(space)))
    assert model_policy.restore_space(said) == space


def test_a_model_of_discrete_actions_keeps_its_spaces(tmp_path):
    class Steer(gym.ActionWrapper):
        def __init__(self, env):
            super().__init__(env)
            self.action_space = spaces.Discrete(3)

        def action(self, action):
            return np.array([action - 1.0, 0.5, 0.0], np.float32)

    with Steer(gym.make("TorcsLite-v0")) as env:
        trained(QRDQN, "MlpPolicy", env, **OFF_POLICY).save(tmp_path / "m.zip")
        driver = models.load_driver(tmp_path / "m.zip", env)
        assert driver.predict(OBSERVATIONS[0])[0] in (0, 1, 2)


def test_a_driver_alone_drives_the_same_and_learns_nothing(env, tmp_path):
    """In stock SB3, too; a training that goes on from it has no silent start from nothing."""
    options = {**OFF_POLICY, "learning_starts": 0}
    model = trained(DDPG, SplitHeadPolicy, env, **options, policy_kwargs=SPLIT)
    model.save(tmp_path / "whole.zip")
    write_driver(tmp_path / "whole", tmp_path / "driver.zip")  # as model.save takes it
    assert models.training_record(tmp_path / "driver.zip").driver_only
    stock = DDPG.load(tmp_path / "driver.zip", env, device="cpu")
    expected, _ = model.predict(OBSERVATIONS, deterministic=True)
    for driver in (stock, models.load_driver(tmp_path / "driver.zip", env)):
        np.testing.assert_array_equal(driver.predict(OBSERVATIONS, deterministic=True)[0], expected)
    with pytest.raises(InvalidAction, match="nan"):
        stock.learn(20)


def test_a_model_without_a_record_makes_no_driver(env, tmp_path):
    PPO("MlpPolicy", env, device="cpu").save(tmp_path / "m.zip")
    with pytest.raises(ModelMismatch, match="RecordCallback"):
        write_driver(tmp_path / "m.zip", tmp_path / "driver.zip")


def test_a_subclass_is_recorded_as_the_algorithm_that_the_zoo_knows(env, tmp_path):
    class OwnPPO(PPO):
        """With something of its own."""

    trained(OwnPPO, "MlpPolicy", env, n_steps=4, batch_size=4).save(tmp_path / "own.zip")
    record = models.training_record(tmp_path / "own.zip")
    assert record.algo == "ppo"
    assert record.subclass.endswith("OwnPPO")
    with pytest.raises(ModelMismatch, match=r"has learned by .*OwnPPO, and would go on by plain"):
        check_resumable(tmp_path / "own.zip", env, "ppo", {})


def test_recording_does_not_import_the_zoo_which_patches_gymnasium():
    code = (
        "import sys; from stable_baselines3 import PPO;"
        "from sb3_torcs.callbacks import RecordCallback;"
        "PPO('MlpPolicy', 'Pendulum-v1', n_steps=4, batch_size=4).learn(4, RecordCallback());"
        "print('rl_zoo3' in sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == "False\n"


def test_who_writes_a_driver_of_nothing_is_told(tmp_path):
    for nothing in ("", ".", "/"):
        with pytest.raises(ModelMismatch, match="is not a model that Stable-Baselines3 saved"):
            write_driver(nothing, tmp_path / "driver.zip")


def test_a_driver_may_take_the_place_of_its_model(env, file):
    """Paths may be words; nothing is lost."""
    before = models.load_driver(file, env).predict(OBSERVATIONS, deterministic=True)[0]
    write_driver(str(file), str(file))
    assert models.training_record(file).driver_only
    after = models.load_driver(file, env).predict(OBSERVATIONS, deterministic=True)[0]
    np.testing.assert_array_equal(before, after)


def test_a_driver_that_cannot_be_written_leaves_the_file_that_was_there(
    file, tmp_path, monkeypatch
):
    old = tmp_path / "driver.zip"
    old.write_bytes(b"old")

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(zipfile.ZipFile, "writestr", full)
        with pytest.raises(OutputNotWritable, match="No space left"):
            write_driver(file, old)
    assert old.read_bytes() == b"old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["driver.zip", "m.zip"]


def test_a_driver_is_written_from_a_file_and_not_from_a_model(tmp_path):
    with pytest.raises(InvalidOption, match=r"model is a PPO; .*model.save\('model.zip'\)"):
        write_driver(PPO.__new__(PPO), tmp_path / "driver.zip")


@pytest.mark.parametrize("kept", [True, False])
def test_a_driver_of_ppo_keeps_its_value_function_if_asked(env, tmp_path, kept):
    """It drives the same without, and nothing stays of what the training saw last."""
    model = trained(PPO, "MlpPolicy", env, n_steps=8, batch_size=8)
    model.save(tmp_path / "whole.zip")
    write_driver(tmp_path / "whole.zip", tmp_path / "driver.zip", value_function=kept)
    stock = PPO.load(tmp_path / "driver.zip", env, device="cpu")
    expected, _ = model.predict(OBSERVATIONS, deterministic=True)
    for driver in (stock, models.load_driver(tmp_path / "driver.zip", env)):
        np.testing.assert_array_equal(driver.predict(OBSERVATIONS, deterministic=True)[0], expected)
    values = stock.policy.predict_values(th.as_tensor(OBSERVATIONS))
    assert bool(values.isfinite().all()) is kept
    learned = model_file.learned_weights(tmp_path / "driver.zip")
    assert all(weights.equal(model.policy.state_dict()[name]) for name, weights in learned.items())
    left_out = model.policy.state_dict().keys() - learned.keys()
    expected_out = () if kept else model_file.VALUES
    assert left_out == {n for n in model.policy.state_dict() if n.startswith(expected_out)}
    assert stock._last_obs is None


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("net_arch", [[8], []])
def test_a_driver_of_ppo_leaves_out_what_only_its_value_function_saw(tmp_path, net_arch, symmetric):
    """In stock SB3, too, it then drives where there are no such sensors."""
    with gym.make("TorcsLite-v0", sensors=["base", "line"]) as env:
        scale = {"speed_x": 2.0, "line_margins": 0.1}  # the latter is seen by the value function
        kwargs = {
            "net_arch": net_arch, "actor_sensors": ["base"], "symmetric": symmetric,
            "input_scale": scale,
        }  # fmt: skip
        model = trained(PPO, BoundedPolicy, env, n_steps=8, batch_size=8, policy_kwargs=kwargs)
        env.observation_space.seed(0)
        seen = np.stack([env.observation_space.sample() for _ in range(4)])
    model.save(tmp_path / "whole.zip")
    expected, _ = model.predict(seen, deterministic=True)
    for kept, sensors in ((True, ["base", "line"]), (False, ["base"])):
        write_driver(tmp_path / "whole.zip", tmp_path / "driver.zip", value_function=kept)
        record = models.training_record(tmp_path / "driver.zip")
        assert record.env_kwargs["sensors"] == sensors
        assert record.hyperparameters["env_kwargs"]["sensors"] == ["base", "line"]
        with gym.make("TorcsLite-v0", **record.select(["sensors"])) as env:
            stock = PPO.load(tmp_path / "driver.zip", env, device="cpu")
            own = seen[:, : env.observation_space.shape[0]]
            for driver in (stock, models.load_driver(tmp_path / "driver.zip", env)):
                found, _ = driver.predict(own, deterministic=True)
                np.testing.assert_array_equal(found, expected)


def test_a_driver_keeps_the_statistics_of_what_it_sees(tmp_path):
    """Those of the other sensors go with them."""
    where = DummyVecEnv([lambda: gym.make("TorcsLite-v0", sensors=["base", "line"])])
    env, kwargs = VecNormalize(where), {"net_arch": [8], "actor_sensors": ["base"]}
    model = trained(PPO, BoundedPolicy, env, n_steps=8, batch_size=8, policy_kwargs=kwargs)
    env.observation_space.seed(0)
    seen = np.stack([env.observation_space.sample() for _ in range(4)])
    expected, _ = model.predict(env.normalize_obs(seen), deterministic=True)
    env.close()
    model.save(tmp_path / "whole.zip")
    write_driver(tmp_path / "whole.zip", tmp_path / "driver.zip", value_function=False)
    with gym.make("TorcsLite-v0") as env:
        driver = models.load_driver(tmp_path / "driver.zip", env)
        found, _ = driver.predict(seen[:, :29], deterministic=True)
    np.testing.assert_array_equal(found, expected)


class Sideways(gym.ActionWrapper):
    """A wrapper of a script, which no command can import."""

    def action(self, action):
        return action[::-1]


class Doubled(gym.RewardWrapper):
    """A wrapper that changes the reward only, of which a driver needs to know nothing."""

    def reward(self, reward):
        return 2.0 * reward


def behind(*wrappers):
    """A short race behind wrappers, the innermost first."""
    env = gym.make("TorcsLite-v0", action="pedal", max_episode_steps=20)
    for wrapper in wrappers:
        env = wrapper(env)
    return env


def test_gymnasium_s_wrappers_of_a_script_are_rebuilt(tmp_path):
    """The innermost first, so that the model drives to the bit as behind them."""
    wrappers = (
        lambda env: gym.wrappers.FrameStackObservation(env, 3),
        gym.wrappers.FlattenObservation,
        lambda env: gym.wrappers.RescaleAction(env, -2, 3),
        Doubled,
    )
    with behind(*wrappers) as env:
        model = trained(PPO, "MlpPolicy", env, n_steps=8, batch_size=4)
        model.save(tmp_path / "m.zip")
        observation, _ = env.reset(seed=0)
        for _ in range(20):
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
    assert terminated or truncated
    record = models.training_record(tmp_path / "m.zip")
    names = [
        path.rpartition(".")[2] for item in record.hyperparameters["env_wrapper"] for path in item
    ]
    assert names == ["FrameStackObservation", "FlattenObservation", "RescaleAction"]
    with behind() as bare:
        env = wrap_env(bare, record.hyperparameters)
        (race,) = evaluate(env, models.load_driver(tmp_path / "m.zip", env))
    assert race.distance == info["car"].distance_raced


@pytest.mark.parametrize(("wrapper", "says"), [
    (Sideways, "Sideways, a wrapper of a script, which nothing else can import"),
    (gym.wrappers.NormalizeObservation, "learns statistics, which no model keeps; train with"),
    (gym.wrappers.TimeAwareObservation, "a race has another; train without it"),
])  # fmt: skip
def test_wrappers_that_cannot_be_rebuilt_are_told(tmp_path, monkeypatch, capsys, wrapper, says):
    monkeypatch.setattr(Sideways, "__module__", "__main__")
    monkeypatch.setitem(sys.modules, "__main__", sys.modules[__name__])
    with behind(wrapper) as env:
        trained(PPO, "MlpPolicy", env, n_steps=8, batch_size=4).save(tmp_path / "m.zip")
    status = main(["evaluate", str(tmp_path / "m.zip"), "--laps", "1"])
    assert status == 2
    assert re.search(says, capsys.readouterr().err)
