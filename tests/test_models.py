import pickle
import re
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium import spaces
from stable_baselines3 import DDPG, PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_torcs  # noqa: F401  registers the environments
from sb3_torcs.agents import models
from sb3_torcs.agents.saved import record as model_record
from sb3_torcs.agents.saved.writing import recipe, write_record
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.cli import main
from sb3_torcs.errors import InvalidOption, ModelMismatch, ModelNotTrusted
from sb3_torcs.training.resuming import check_resumable

SMALL = {"device": "cpu", "seed": 0}


@pytest.fixture(scope="module")
def env():
    with gym.make("TorcsLite-v0") as made:
        yield made


@pytest.fixture
def saved(env, tmp_path):
    """An untrained DDPG, and its file."""
    model = DDPG("MlpPolicy", env, buffer_size=1, **SMALL)
    model.save(tmp_path / "TorcsLite-v0.zip")
    return model, tmp_path / "TorcsLite-v0.zip"


@pytest.fixture
def recorded(env, tmp_path):
    """An untrained DDPG with a record, and its file."""
    model = DDPG("MlpPolicy", env, buffer_size=1, **SMALL)
    write_record(model, recipe("ddpg", "TorcsLite-v0", {}))
    model.save(tmp_path / "m.zip")
    return model, tmp_path / "m.zip"


def zoo_record(folder, algo="ddpg", **env_kwargs):
    """Write down a training as the zoo does."""
    (folder / "TorcsLite-v0").mkdir()
    ordered = "!!python/object/apply:collections.OrderedDict\n"
    words = [["algo", algo], ["env", "TorcsLite-v0"], ["seed", 1]]
    (folder / "TorcsLite-v0" / "args.yml").write_text(ordered + yaml.safe_dump([words]))
    config = [["env_kwargs", env_kwargs], ["gamma", 0.98]]
    (folder / "TorcsLite-v0" / "config.yml").write_text(ordered + yaml.safe_dump([config]))


def observation(env):
    return np.linspace(-0.5, 0.5, env.observation_space.shape[0], dtype=np.float32)


@pytest.mark.parametrize("algorithm", [DDPG, SAC, PPO])
def test_a_model_without_a_record_needs_trust_and_its_algorithm(env, tmp_path, algorithm):
    kwargs = {} if algorithm is PPO else {"buffer_size": 1}
    model = algorithm("MlpPolicy", env, **kwargs, **SMALL)
    model.save(tmp_path / "m.zip")
    with pytest.raises(ModelNotTrusted, match=r"no record of its training.*--trust"):
        models.load_driver(tmp_path / "m.zip", env)
    with pytest.raises(ModelMismatch, match=r"give it, .* --algo ddpg"):
        models.load_driver(tmp_path / "m.zip", env, trust=True)
    algo = algorithm.__name__.lower()
    driver = models.load_driver(tmp_path / "m.zip", env, algo, trust=True)
    expected = model.predict(observation(env), deterministic=True)[0]
    np.testing.assert_array_equal(driver.predict(observation(env), deterministic=True)[0], expected)


def test_the_record_of_the_zoo_names_the_algorithm_and_the_environment(saved, env):
    _, path = saved
    zoo_record(path.parent, track="alpine-1", range_finders="narrow")
    record = models.training_record(path)
    assert (record.algo, record.env_id) == ("ddpg", "TorcsLite-v0")
    assert record.env_kwargs == {"track": "alpine-1", "range_finders": "narrow"}
    assert record.hyperparameters == {"env_kwargs": record.env_kwargs, "gamma": 0.98}


def test_only_the_folder_that_the_zoo_lays_beside_a_model_tells_of_it(saved):
    """A neighbour, and a folder of any other name, are of another model."""
    _, path = saved
    zoo_record(path.parent, track="alpine-1")
    for name in ("TorcsLite-v0.zip", "best_model.zip", "rl_model_500_steps.zip"):
        copy = path.rename(path.with_name(name))
        assert models.training_record(copy).env_kwargs == {"track": "alpine-1"}, name
        path = copy
    other = path.rename(path.with_name("downloaded.zip"))
    assert not models.training_record(other).known
    best = other.rename(path.with_name("best_model.zip"))
    (path.parent / "TorcsLite-v0").rename(path.parent / "other-run")
    assert not models.training_record(best).known


@pytest.mark.parametrize(("name", "text", "message"), [
    ("config.yml", "a: [", "cannot be read"),
    ("config.yml", "env_kwargs: narrow", "env_kwargs is 'narrow'"),
    ("args.yml", "algo: 3", "algo is 3"),
    ("args.yml", "{env: [Torcs-v0]}", r"env is \['Torcs-v0'\]"),
])  # fmt: skip
def test_a_record_that_is_broken_is_told(saved, name, text, message):
    """Without it the model would drive in another environment than the one it learned in."""
    _, path = saved
    (path.parent / name).write_text(text)
    with pytest.raises(ModelMismatch, match=f"(?s){name}.*{message}.*repair or remove it"):
        models.training_record(path)


def test_a_record_builds_no_objects(tmp_path):
    """A record may come from anywhere; reading it must not run what it names."""
    marker = tmp_path / "ran"
    text = f"a: !!python/object/apply:os.mkdir ['{marker}']"
    (tmp_path / "config.yml").write_text(text)
    model_record.record_beside(tmp_path / "m.zip")
    assert not marker.exists()


def test_the_word_scripted_is_the_scripted_driver(env):
    assert isinstance(models.load_driver("scripted", env), ScriptedDriver)


def test_the_scripted_driver_looks_around_in_its_own_way():
    assert models.driver_record("scripted") == models.TrainingRecord()
    with (
        gym.make("TorcsLite-v0", range_finders="narrow") as narrow,
        pytest.raises(InvalidOption, match=r"'scr', not with .*leave --range-finders out"),
    ):
        models.load_driver("scripted", narrow)


def test_a_folder_stands_for_its_best_model(saved):
    _, path = saved
    (path.parent / "TorcsLite-v0").mkdir()
    assert models.find_model(path.parent) == path
    (path.parent / "best_model.zip").write_bytes(path.read_bytes())
    assert models.find_model(path.parent) == path.parent / "best_model.zip"
    assert models.find_model(path.parent, prefer_last=True) == path


def test_the_folder_may_be_the_present_one(saved, monkeypatch):
    monkeypatch.chdir(saved[1].parent)
    saved[1].rename("best_model.zip")
    assert models.find_model(".").resolve() == saved[1].parent / "best_model.zip"


def test_the_suffix_may_be_left_out(saved):
    _, path = saved
    assert models.find_model(path.with_suffix("")) == path


def test_a_missing_model_is_told_the_near_miss(saved):
    _, path = saved
    with pytest.raises(InvalidOption, match=r"there is no model .*did you mean 'TorcsLite-v0.zip'"):
        models.find_model(path.parent / "TorcsLite-v00.zip")


@pytest.mark.parametrize("name", [None, 3, b"ddpg-aalborg", ["ddpg-aalborg"]])
def test_what_is_no_name_of_a_model(name):
    for find in (
        models.find_model,
        models.driver_record,
        lambda name: models.load_driver(name, None),
    ):
        with pytest.raises(InvalidOption, match=f"{re.escape(repr(name))} names no model; give"):
            find(name)


@pytest.mark.parametrize("name", ["", " "])
def test_an_empty_name_is_not_the_working_folder(saved, name, monkeypatch):
    _, path = saved
    monkeypatch.chdir(path.parent)
    with pytest.raises(InvalidOption, match=f"'{name}' names no model; give the .zip"):
        models.find_model(name)


def test_a_link_to_nothing_is_not_told_its_own_name(tmp_path):
    (tmp_path / "ppo.zip").symlink_to(tmp_path / "gone.zip")
    with pytest.raises(InvalidOption, match="there is no model") as caught:
        models.find_model(tmp_path / "ppo.zip")
    assert "did you mean 'ppo.zip'" not in str(caught.value)


def test_a_folder_that_hides_a_shipped_agent_is_told_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ppo-aalborg").mkdir()
    with pytest.raises(InvalidOption, match=r"holds no model; .* hides a shipped agent"):
        models.find_model("ppo-aalborg")


def test_an_empty_folder_holds_no_model(tmp_path):
    with pytest.raises(InvalidOption, match="holds no model"):
        models.find_model(tmp_path)


def test_a_file_that_is_no_model_is_refused(tmp_path, env):
    (tmp_path / "m.zip").write_text("not a zip")
    with pytest.raises(ModelMismatch, match="is not a model that Stable-Baselines3 saved"):
        models.load_driver(tmp_path / "m.zip", env)


def rewritten(path, **changes):
    """Put other contents into a saved model; ``None`` takes a part away."""
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    parts |= {name.replace("_pth", ".pth"): content for name, content in changes.items()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in parts.items():
            if content is not None:
                archive.writestr(name, content)


@pytest.mark.parametrize(("changes", "message"), [
    ({"data": b"[1]"}, "is not a model that Stable-Baselines3 saved"),
    ({"data": b"{}"}, "is not a model that Stable-Baselines3 saved"),
    ({"data": None}, "is not a model that Stable-Baselines3 saved"),
    ({"data": b'{"a":' * 200_000 + b"1" + b"}" * 200_000}, "its data nests too deep"),
    ({"policy_pth": None}, "has no weights that can be read"),
    ({"policy_pth": b"PK half of it"}, "has no weights that can be read"),
])  # fmt: skip
def test_a_damaged_model_is_refused(recorded, env, changes, message):
    rewritten(recorded[1], **changes)
    with pytest.raises(ModelMismatch, match=message):
        models.load_driver(recorded[1], env)


@pytest.mark.parametrize("algo", ["sac", "ppo", "dqn"])
def test_a_model_of_another_algorithm_is_refused(recorded, env, algo):
    with pytest.raises(ModelMismatch, match=f"a model of ddpg, not of {algo}; give --algo ddpg"):
        models.load_driver(recorded[1], env, algo=algo)


@pytest.mark.parametrize("content", [b"", b"no pickle", pickle.dumps({"mean": 0.0})])
def test_statistics_that_are_none_are_refused(saved, env, content):
    _, path = saved
    (path.parent / "vecnormalize.pkl").write_bytes(content)
    with pytest.raises(ModelMismatch, match="holds no statistics of VecNormalize"):
        models.load_driver(path, env, "ddpg", trust=True)


@pytest.fixture
def learned(saved, env):
    """A model with replay buffer and record, and what `check_resumable` is asked about it."""
    model, path = saved
    zoo_record(path.parent)
    model.save_replay_buffer(path.parent / "replay_buffer.pkl")

    def check(env=env, algo="ddpg", trust=False, **entry):
        return check_resumable(path, env, algo, entry, trust=trust)

    return path, check


def test_what_belongs_together_is_gone_on_with(learned):
    path, check = learned
    assert check() is True
    (path.parent / "replay_buffer.pkl").unlink()
    assert check(n_envs=4) is False


def test_what_does_not_belong_together_is_not_gone_on_with(learned):
    path, check = learned
    with pytest.raises(ModelMismatch, match="a model of ddpg, not of sac; give --algo ddpg"):
        check(algo="sac")
    with pytest.raises(ModelMismatch, match="a model of ddpg, not of td3"):
        check(algo="td3")  # which can drive it
    with (
        gym.make("TorcsLite-v0", range_finders="narrow") as narrow,
        pytest.raises(ModelMismatch, match="learned with range_finders 'scr'"),
    ):
        check(narrow)
    with pytest.raises(
        ModelMismatch, match="learned with frame_stack None, and would go on with 3"
    ):
        check(frame_stack=3)
    with pytest.raises(ModelMismatch, match=r"learned with normalize False.* go on with True"):
        check(normalize=True)
    with pytest.raises(ModelMismatch, match=r"replay_buffer.*of 1 cars .* give n_envs 1, or rem"):
        check(n_envs=4)
    buffer = path.parent / "replay_buffer.pkl"
    buffer.write_bytes(buffer.read_bytes()[:-10])
    with pytest.raises(ModelMismatch, match=r"replay_buffer.pkl' is not a replay buffer"):
        check()


def test_an_unknown_algorithm_is_told_the_near_miss(saved, env):
    with pytest.raises(InvalidOption, match=r"no algorithm 'dpg'; did you mean 'ddpg'\?"):
        models.load_driver(saved[1], env, algo="dpg", trust=True)


class OtherEnv(gym.Env):
    """65 numbers, and the same three actuators."""

    observation_space = spaces.Box(-1.0, 1.0, (65,), np.float32)

    def __init__(self, env):
        self.action_space = env.action_space


def test_a_model_of_another_observation_layout_is_refused_with_both_named(env, tmp_path):
    DDPG("MlpPolicy", OtherEnv(env), buffer_size=1, **SMALL).save(tmp_path / "m.zip")
    with pytest.raises(ModelMismatch) as caught:
        models.load_driver(tmp_path / "m.zip", env, "ddpg", trust=True)
    message = str(caught.value)
    assert "observations (65,) float32 within [-1, 1], but TorcsLite-v0 has (29,)" in message
    assert "sb3-torcs train --env TorcsLite-v0" in message


def test_a_model_that_is_given_other_options_is_told_its_own(capsys):
    words = ["evaluate", "ppo-aalborg", "--env-kwargs", "action=pedals"]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "it learned with action_repeat=5, range_finders='narrow', " in said
    assert "action='pedal'" in said
    assert "; give it the same" in said


def test_a_model_is_told_its_own_options_in_the_other_world_too(env):
    with pytest.raises(
        ModelMismatch, match=r"it learned with .*'line', 'motion'\], action='pedal'"
    ):
        models.load_driver("ppo-aalborg", env)


def test_a_model_that_is_given_other_sensors_is_told_the_usual_ones(capsys):
    words = ["evaluate", "ddpg-aalborg", "--env-kwargs", "sensors=[base,line]"]
    assert main(words) == 2
    assert "sensors=['base'], action='pedals'; give it the same" in capsys.readouterr().err


def test_the_statistics_beside_a_model_are_applied(saved, env):
    """A model that learned from normalized numbers would drive blindly without."""
    model, path = saved
    zoo_record(path.parent)
    wrapped = VecNormalize(DummyVecEnv([lambda: gym.make("TorcsLite-v0")]))
    wrapped.obs_rms.mean = np.full(29, 0.25)
    wrapped.save(path.parent / "TorcsLite-v0" / "vecnormalize.pkl")
    with pytest.raises(ModelNotTrusted, match="--trust"):
        models.load_driver(path, env)
    driver = models.load_driver(path, env, trust=True)
    normalized = wrapped.normalize_obs(observation(env))
    expected = model.predict(normalized, deterministic=True)[0]
    np.testing.assert_array_equal(driver.predict(observation(env), deterministic=True)[0], expected)
    assert not np.array_equal(expected, model.predict(observation(env), deterministic=True)[0])
    wrapped.close()


def test_the_steps_of_a_training_are_read_from_its_model(env, tmp_path):
    model = DDPG("MlpPolicy", env, buffer_size=8, learning_starts=100, **SMALL)
    model.learn(7)
    model.save(tmp_path / "m.zip")
    assert models.saved_timesteps(tmp_path / "m.zip") == 7
