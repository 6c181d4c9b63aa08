"""What was trained behind wrappers drives behind the same wrappers."""

from __future__ import annotations

import json
import sys

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium.wrappers import RescaleAction
from sb3_contrib.common.wrappers import TimeFeatureWrapper
from scr_loopback import Loopback
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

import sb3_torcs  # noqa: F401  (registers the environments)
from sb3_torcs.agents import remote as driving
from sb3_torcs.agents.models import ModelDriver, load_driver
from sb3_torcs.agents.wrapping import normalizes, wrap_env
from sb3_torcs.cli import main
from sb3_torcs.errors import ModelMismatch, ModelNotTrusted, PackageMissing
from sb3_torcs.evaluation.protocol import evaluate

# RescaleAction says so of its own limits.
pytestmark = pytest.mark.filterwarnings("ignore:.*precision lowered by casting:UserWarning")

TIME = {"sb3_contrib.common.wrappers.TimeFeatureWrapper": {"max_steps": 40}}
RESCALE = {"gymnasium.wrappers.RescaleAction": {"min_action": -1.0, "max_action": 1.0}}
STEPS = 40
ENTRY = {"n_timesteps": 64, "policy": "MlpPolicy", "n_steps": 32, "batch_size": 32}


def lite(**options):
    return gym.make("TorcsLite-v0", **options)


def ppo(env):
    """A model that sets off and steers by all that it sees."""
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu")
    model.policy.action_net.weight.data *= 100.0
    model.policy.action_net.bias.data[1] += 1.0
    return model


def returns(model, env, episodes=2):
    """What SB3 measures behind its own wrappers."""
    env.seed(0)
    return evaluate_policy(model, env, episodes, return_episode_rewards=True, warn=False)[0]


def close_to(expected):
    return pytest.approx(expected, rel=1e-5)  # SB3 adds rewards in single precision


def test_stacked_frames_are_those_of_the_training():
    env = VecFrameStack(make_vec_env(lambda: lite(max_episode_steps=STEPS)), 3)
    model = ppo(env)
    with lite(max_episode_steps=STEPS) as bare:
        races = evaluate(bare, ModelDriver(model, frames=3), episodes=2)
    assert [race.episode_return for race in races] == close_to(returns(model, env))


def test_frames_are_stacked_after_they_are_normalized():
    """As the zoo does: what is not there yet is 0 and not what a 0 is normalized to."""
    inner = VecNormalize(make_vec_env(lambda: lite(max_episode_steps=STEPS)), norm_reward=False)
    inner.obs_rms.mean[:] = 0.3
    inner.training = False
    env = VecFrameStack(inner, 3)
    model = ppo(env)
    with lite(max_episode_steps=STEPS) as bare:
        races = evaluate(bare, ModelDriver(model, inner, 3), episodes=2)
    assert [race.episode_return for race in races] == close_to(returns(model, env))


def test_each_car_of_several_has_its_own_frames():
    """An episode that begins has none yet."""
    driver = ModelDriver(PPO("MlpPolicy", VecFrameStack(DummyVecEnv([lite] * 2), 2)), frames=2)
    one, two = np.full((2, 29), 1.0, np.float32), np.full((2, 29), 2.0, np.float32)
    _, state = driver.predict(one, None, np.array([True, True]))
    _, (stack, _) = driver.predict(two, state, np.array([False, True]))
    assert stack[:, [0, -1]].tolist() == [[1.0, 2.0], [0.0, 2.0]]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A training of the zoo behind wrappers, and its folder."""
    folder = tmp_path_factory.mktemp("run")
    entry = {
        **ENTRY, "env_wrapper": [TIME, RESCALE], "frame_stack": 2, "normalize": True,
        "env_kwargs": {"track": "g-track-1", "max_episode_steps": STEPS},
    }  # fmt: skip
    conf_file = folder / "own.yml"
    conf_file.write_text(yaml.safe_dump({"TorcsLite-v0": entry}))
    words = [
        "train",
        "--algo",
        "ppo",
        "--env",
        "TorcsLite-v0",
        "--conf-file",
        str(conf_file),
        "--no-progress",
    ]
    assert main([*words, "--folder", str(folder / "logs"), "--eval-freq", "1000"]) == 0
    return folder / "logs" / "ppo" / "TorcsLite-v0_1"


def test_a_run_is_judged_behind_its_wrappers(run, capsys):
    capsys.readouterr()
    assert main(["evaluate", str(run), "--json", "--laps", "1"]) == 0
    (episode,) = json.loads(capsys.readouterr().out)["episodes"]

    def make():
        return lite(track="g-track-1", laps=1, max_episode_steps=100_000)

    def behind(env):
        return RescaleAction(TimeFeatureWrapper(env, max_steps=40), -1.0, 1.0)

    env = make_vec_env(make, wrapper_class=behind)
    env = VecNormalize.load(str(run / "TorcsLite-v0" / "vecnormalize.pkl"), env)
    env.training = env.norm_reward = False
    env = VecFrameStack(env, 2)
    model = PPO.load(run / "TorcsLite-v0.zip", device="cpu")
    assert [episode["return"]] == close_to(returns(model, env, 1))


def test_what_the_car_did_is_recorded_and_drawn(run, tmp_path):
    """Behind RescaleAction the actions of the model are other ones."""
    video, line = tmp_path / "lap.mp4", tmp_path / "line.png"
    words = ["evaluate", str(run), "--laps", "1", "--video", str(video), "--line", str(line)]
    assert main(words) == 0
    assert video.stat().st_size > 1000
    assert line.stat().st_size > 1000


def test_a_run_is_gone_on_with_behind_its_wrappers(run, tmp_path, capsys):
    words = ["train", "--resume", str(run), "--conf-file", str(run.parents[2] / "own.yml")]
    words += ["--folder", str(tmp_path), "--no-progress", "--eval-freq", "1000"]
    assert main(words) == 0, capsys.readouterr().err


def test_in_somebody_elses_race_the_wrappers_are_there(run):
    with Loopback(ticks=60) as server:
        agent = driving.Agent(str(run), {"scr": server.address})
        agent.drive()
    assert agent.env.action_space.low.tolist() == [-1.0, -1.0, -1.0]
    assert agent.distance > 0.0


def test_a_wrapper_from_elsewhere_is_imported_only_if_it_is_trusted(tmp_path, monkeypatch):
    (tmp_path / "from_elsewhere.py").write_text(
        "import gymnasium\n\nclass Marked(gymnasium.Wrapper):\n    pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    entry = {"env_wrapper": "from_elsewhere.Marked"}
    with lite() as env:
        with pytest.raises(ModelNotTrusted, match=r"from_elsewhere\.Marked.*add --trust"):
            wrap_env(env, entry)
        assert "from_elsewhere" not in sys.modules
        assert type(wrap_env(env, entry, trust=True)).__module__ == "from_elsewhere"


@pytest.mark.parametrize(("path", "error", "says"), [
    ("nowhere.Wrapper", PackageMissing, "install the package that it is in"),
    ("gymnasium.wrappers.Nothing", PackageMissing, "does not import"),
    ("gymnasium.spaces.Box", ModelMismatch, "is not a gymnasium.Wrapper"),
    ("gymnasium.wrappers.RescaleAction", ModelMismatch, "does not go around the car"),
    ("gymnasium.wrappers.TimeAwareObservation", ModelMismatch, "a race has another; train without"),
    (3, ModelMismatch, "env_wrapper of a training has 3; expected a dotted path"),
])  # fmt: skip
def test_what_cannot_be_put_around_is_told(path, error, says):
    with lite() as env, pytest.raises(error, match=says):
        wrap_env(env, {"env_wrapper": path}, trust=True)


def test_what_only_ends_or_writes_down_a_training_is_left_out():
    entry = {"env_wrapper": [{"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 3}}]}
    with lite(max_episode_steps=9) as env:
        (race,) = evaluate(wrap_env(env, entry), ModelDriver(PPO("MlpPolicy", env, device="cpu")))
    assert race.end == "time_limit"
    assert wrap_env(env, {}) is env


@pytest.mark.parametrize(("entry", "says"), [
    ({"vec_env_wrapper": "a.VecMine"}, "vec_env_wrapper a.VecMine changes vectors"),
    ({"frame_stack": 0}, "frame_stack of a training is 0"),
    ({"frame_stack": 2}, r"has observations \(29,\).*has \(58,\)"),
    ({"normalize": True}, "learned from normalized observations.*vecnormalize.pkl"),
])  # fmt: skip
def test_a_model_that_would_see_something_else_is_refused(tmp_path, entry, says):
    with lite() as env:
        PPO("MlpPolicy", env, device="cpu").save(tmp_path / "m.zip")
        (tmp_path / "config.yml").write_text(yaml.safe_dump(entry))
        (tmp_path / "args.yml").write_text(yaml.safe_dump({"algo": "ppo", "env": "TorcsLite-v0"}))
        with pytest.raises(ModelMismatch, match=says):
            load_driver(tmp_path / "m.zip", env, trust=True)


def test_what_normalizes_may_be_written_as_python():
    for said in (True, {"norm_obs": True}, "True", "dict(norm_reward=False)", "{'norm_obs': True}"):
        assert normalizes(said)
    for said in (None, False, {"norm_obs": False}, "False", "dict(norm_obs=False)"):
        assert not normalizes(said)


@pytest.mark.parametrize(
    "path", ["stable_baselines3.common.vec_env.VecCheckNan", "sb3_torcs.vec_env.MirrorVecEnv"]
)
def test_a_vector_wrapper_that_passes_on_is_no_obstacle(tmp_path, path):
    with lite() as env:
        PPO("MlpPolicy", env, device="cpu").save(tmp_path / "m.zip")
        entry = {"vec_env_wrapper": path}
        (tmp_path / "config.yml").write_text(yaml.safe_dump(entry))
        assert isinstance(load_driver(tmp_path / "m.zip", env, "ppo", trust=True), ModelDriver)
