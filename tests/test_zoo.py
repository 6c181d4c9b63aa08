import subprocess
import sys

import gymnasium as gym
import pytest
import yaml
from stable_baselines3 import DDPG

import sb3_torcs  # noqa: F401  registers the environments
from sb3_torcs.errors import ZooConfigError
from sb3_torcs.training import zoo
from sb3_torcs.training.zoo_data import check_data

SHIPPED = sorted(zoo.shipped_folder().glob("*.yml"))
ENTRIES = [(path, name) for path in SHIPPED for name in zoo.read_config(path)]
MODULE = "stable_baselines3.common.callbacks"
MINIMAL = {"n_timesteps": 100, "policy": "MlpPolicy"}
STACK = "gymnasium.wrappers.FrameStackObservation"
FLAT = "gymnasium.wrappers.FlattenObservation"
RATE = "a number >= 0 (for YAML 1e-3 is text, and 1.0e-3 a number), or lin_NUMBER to fall to 0"


def complaint(tmp_path, entry, algo="ddpg", env_id="TorcsLite-v0"):
    """What is said about an entry."""
    place = zoo.Place(tmp_path / "x.yml", "here")
    with pytest.raises(ZooConfigError) as caught:
        zoo.check_entry({**MINIMAL, **entry}, algo, env_id, place)
    assert str(caught.value).startswith(f"{tmp_path}/x.yml, entry 'here': ")
    return str(caught.value).partition("entry 'here': ")[2]


def accepted(entry, algo="ddpg"):
    zoo.check_entry({**MINIMAL, **entry}, algo, "TorcsLite-v0", zoo.Place(zoo.Path("x"), "here"))


@pytest.mark.parametrize(("path", "name"), ENTRIES, ids=lambda part: getattr(part, "stem", part))
def test_everything_in_the_shipped_files_is_read_by_something(path, name):
    """A key that nothing reads, a class that does not import, an argument that is not there."""
    for env_id in zoo.OURS if name == "default" else [name if name in zoo.OURS else "Torcs-v0"]:
        zoo.check_entry(zoo.read_entry(path, name), path.stem, env_id, zoo.Place(path, name))


def test_the_entries_are_few():
    """Each is one more recipe that has to be kept true."""
    assert len(ENTRIES) <= 12


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_each_shipped_file_has_an_entry_for_both_environments(path):
    """Other entries are named in words, so that they cannot be taken for an id."""
    assert all(zoo.read_entry(path, env_id) for env_id in zoo.OURS)
    names = set(zoo.read_config(path))
    assert [name for name in names - set(zoo.OURS) if "-v" in name] == []


@pytest.mark.parametrize(("path", "name"), ENTRIES, ids=lambda part: getattr(part, "stem", part))
def test_the_shipped_files_have_no_code_in_strings(path, name):
    """The zoo evaluates these as Python if they are strings."""
    entry = zoo.read_entry(path, name)
    check_data(entry, name)  # which lets activations be named, as in the zoo's own files
    for key in ("env_kwargs", "monitor_kwargs", "normalize"):
        assert not isinstance(entry.get(key), str)


def test_reading_an_entry_does_not_share_it_with_its_aliases():
    entry = zoo.read_entry(zoo.config_file("ddpg"), "TorcsLite-v0")
    entry["env_kwargs"]["track"] = "changed"
    again = zoo.read_entry(zoo.config_file("ddpg"), "Torcs-v0")
    assert again["env_kwargs"]["track"] != "changed"


def test_a_file_of_ones_own_is_taken_instead_of_the_shipped_one(tmp_path):
    path = tmp_path / "own.yml"
    path.write_text(yaml.safe_dump({"TorcsLite-v0": MINIMAL}))
    assert zoo.config_file("ddpg", path) == path
    assert zoo.read_entry(path, "TorcsLite-v0") == MINIMAL


def test_the_entry_called_default_is_for_every_environment(tmp_path):
    path = tmp_path / "own.yml"
    path.write_text(yaml.safe_dump({"default": MINIMAL}))
    assert zoo.read_entry(path, "TorcsLite-v0") == MINIMAL
    with pytest.raises(ZooConfigError, match="has no entry 'open'; it has: default"):
        zoo.read_entry(path, "open")


def test_an_algorithm_without_a_file_is_told_what_to_do():
    with pytest.raises(ZooConfigError, match=r"'dddpg'; did you mean 'ddpg'\? .*--conf-file"):
        zoo.config_file("dddpg")
    with pytest.raises(ZooConfigError, match=r"changed copy of .*sac\.yml: --conf-file FILE\.yml$"):
        zoo.config_file("tqc")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ZooConfigError, match=r"no hyperparameter file '.*none\.yml'"):
        zoo.config_file("ddpg", tmp_path / "none.yml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [1\nb: 2\n", r"x\.yml, line 2: not YAML"),
        ("- 1\n", r"x\.yml: expected entries"),
        ("", r"x\.yml: expected entries"),
        ("a: 1\n", r"x\.yml, entry 'a': expected a mapping, got 1"),
        ("null: {a: 1}", "an entry is called None; expected a word"),
        ("1.5: {a: 1}", "an entry is called 1.5; expected a word"),
        ("[" * 20_000, "not YAML"),
    ],
)
def test_a_broken_file_is_named_with_its_line(tmp_path, text, message):
    path = tmp_path / "x.yml"
    path.write_text(text)
    with pytest.raises(ZooConfigError, match=message):
        zoo.read_config(path)


def test_an_entry_that_is_not_there_is_told_the_near_miss():
    message = r"no entry 'open'; it has: .*; ppo\.yml has it, so add: --algo ppo$"
    with pytest.raises(ZooConfigError, match=message):
        zoo.read_entry(zoo.config_file("ddpg"), "open")
    with pytest.raises(ZooConfigError, match=r"no entry 'TorcsLight-v0'; did you mean 'TorcsLite"):
        zoo.read_entry(zoo.config_file("ddpg"), "TorcsLight-v0")


@pytest.mark.parametrize("key", ["n_timesteps", "policy"])
def test_a_missing_key_is_named(key):
    entry = {name: value for name, value in MINIMAL.items() if name != key}
    with pytest.raises(ZooConfigError, match=f"key '{key}' is missing"):
        zoo.check_entry(entry, "ddpg", "TorcsLite-v0", zoo.Place(zoo.Path("x"), "here"))


SPLIT_HEAD = {"policy": "sb3_torcs.policies.SplitHeadPolicy"}
CHECKPOINTS = f"{MODULE}.CheckpointCallback"
NOISE = {"noise_type": "normal", "noise_std": 0.1}
STACKS = {"normalize": True, "frame_stack": 2}


@pytest.mark.parametrize(("entry", "told"), [
    ({"learning_rat": 0.1}, "unknown key 'learning_rat'; did you mean 'learning_rate'?"),
    ({"clip_range": 0.1}, "unknown key 'clip_range'"),  # of PPO
    ({"seed": 1}, "unknown key 'seed'"),  # which the zoo passes itself
    ({"policy": "MlpPolice"}, "unknown policy 'MlpPolice'; did you mean 'MlpPolicy'?"),
    ({"policy": ["MlpPolicy"]}, "unknown policy ['MlpPolicy']"),
    ({"policy": "sb3_torcs.policies.BoundedPolicy"}, "is a policy for PPO and A2C; allowed: "),
    ({"policy_kwargs": {"net_arc": [1]}}, "argument 'net_arc'; did you mean 'net_arch'?"),
    ({**SPLIT_HEAD, "policy_kwargs": {"head_bia": [0.0]}}, "did you mean 'head_bias'?"),
    ({"callback": "nowhere.Callback"}, "does not import (No module named 'nowhere'); install the"),
    ({"callback": [f"{MODULE}.CheckpointCallbak"]}, "did you mean 'CheckpointCallback'? "),
    ({"callback": {CHECKPOINTS: {"save_frequ": 1}}}, "did you mean 'save_freq'?"),
    ({"callback": [{CHECKPOINTS: None, "a": 1}]}, "check the indentation"),
    ({"env_kwargs": {"trak": "aalborg"}}, "argument 'trak'; did you mean 'track'?"),
    ({"env_kwargs": {"max_episode_steps": 0.5}}, "expected a whole number of timesteps >= 1"),
    ({"env_kwargs": "dict(track='aalborg')"}, "expected '{key: value}'"),
    ({"monitor_kwargs": {"info_keywords": ["laps"]}}, "add the other one as []"),
    ({"monitor_kwargs": {"info_keyword": []}}, "did you mean 'info_keywords'?"),
    ({"normalize": {"norm_ob": True}}, "argument 'norm_ob'; did you mean 'norm_obs'?"),
    *[({"n_timesteps": steps}, f"n_timesteps is {steps!r}; expected a number >= 1")
      for steps in ("abc", 0, -5, True, None, float("inf"))],
    *[({"learning_rate": rate}, f"learning_rate is {rate!r}; expected {RATE}")
      for rate in ("abc", "1e-3", float("nan"))],
    *[({key: value}, f"{key} is {value!r}; expected a whole number >= 1, e.g. 64")
      for key, value in (("batch_size", 1.5), ("n_envs", 0), ("buffer_size", "1e5"))],
    *[({key: value}, f"{key} is {value!r}; expected a number from 0 to 1, e.g. 0.005")
      for key, value in (("gamma", "x"), ("gamma", float("nan")), ("tau", "1e-3"))],
    *[({"learning_starts": value}, f"is {value!r}; expected a whole number >= 0")
      for value in ("1e3", -1, False)],
    *[({"gradient_steps": value}, f"is {value!r}; expected a whole number >= 1, or -1")
      for value in (-1.0, 0)],
])  # fmt: skip
def test_a_wrong_entry_is_told(tmp_path, entry, told):
    assert told in complaint(tmp_path, entry)


@pytest.mark.parametrize(("entry", "algo"), [
    ({"clip_range": 0.1}, "ppo"), (STACKS, "ppo"), (NOISE, "ddpg"),
    ({**SPLIT_HEAD, "policy_kwargs": {"head_bias": [0, 0, -1], "net_arch": [3, 6]}}, "ddpg"),
    ({"callback": [{CHECKPOINTS: {"save_freq": 1, "save_path": "x"}}]}, "ddpg"),
    ({"env_kwargs": {"track": "aalborg", "max_episode_steps": 200}}, "ddpg"),
    ({"monitor_kwargs": {"info_keywords": ["laps"], "reset_keywords": []}}, "ddpg"),
    ({"normalize": {"norm_obs": True, "norm_reward": False}}, "ddpg"),
    ({"normalize": True}, "ddpg"), ({"learning_rate": "lin_1e-3"}, "ddpg"),
    ({"learning_rate": 0.001}, "ddpg"),
    *[({"n_timesteps": steps}, "ddpg") for steps in (100, 1e5, "1e5", "100000.0")],
])  # fmt: skip
def test_what_the_zoo_reads_is_accepted(entry, algo):
    accepted(entry, algo)


@pytest.mark.parametrize(("entry", "algo", "told"), [
    (STACKS, "sac", "cannot learn with both"), (NOISE, "ppo", "ppo takes no action noise; remove"),
])  # fmt: skip
def test_what_an_algorithm_cannot_do_is_told(tmp_path, entry, algo, told):
    assert told in complaint(tmp_path, entry, algo)


def test_an_unknown_algorithm_is_told_the_near_miss():
    with pytest.raises(ZooConfigError, match=r"no algorithm 'td33'; did you mean 'td3'\?"):
        accepted({}, algo="td33")


def test_a_symmetric_policy_needs_observations_that_have_a_mirror_image(tmp_path):
    symmetric = {
        "policy": "sb3_torcs.policies.SplitHeadPolicy", "policy_kwargs": {"symmetric": True}
    }  # fmt: skip
    one_sided = {"env_kwargs": {"range_finders": list(range(0, 38, 2))}}
    accepted(symmetric)
    accepted({**symmetric, "env_kwargs": {"range_finders": "narrow"}, "normalize": False})
    accepted({**symmetric, **one_sided, "policy_kwargs": {"symmetric": False}})
    assert "whose middle is 0" in complaint(tmp_path, {**symmetric, "normalize": True})
    text = {**symmetric, "policy_kwargs": "dict(symmetric=True, activation_fn=nn.ReLU)"}
    assert "whose middle is 0" in complaint(tmp_path, {**text, "normalize": True})
    accepted({**text, "normalize": {"norm_obs": False}})
    assert "unknown policy_kwargs: argument 'symmetrical'" in complaint(
        tmp_path, {**text, "policy_kwargs": "dict(symmetrical=True, activation_fn=nn.ReLU)"}
    )
    assert "and frame_stack is 2" in complaint(tmp_path, {**symmetric, "frame_stack": 2})
    assert "set range_finders to scr or narrow" in complaint(tmp_path, {**symmetric, **one_sided})
    ppo = {**symmetric, "policy": "sb3_torcs.policies.BoundedPolicy"}
    accepted(ppo, "ppo")
    assert "whose middle is 0" in complaint(tmp_path, {**ppo, "normalize": True}, "ppo")


def zoo_script(*words):
    command = [sys.executable, "-m", "sb3_torcs.rl_zoo", *words]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.mark.rare
def test_the_script_for_videos_knows_our_environments(tmp_path):
    """It has no --gym-packages."""
    run = tmp_path / "ddpg" / "TorcsLite-v0_1"
    run.mkdir(parents=True)
    DDPG("MlpPolicy", gym.make("TorcsLite-v0"), buffer_size=1).save(run / "TorcsLite-v0")
    words = ["--algo", "ddpg", "--env", "TorcsLite-v0", "-f", str(tmp_path), "-n", "5"]
    done = zoo_script("record_video", *words)
    assert done.returncode == 0, done.stderr
    (video,) = run.glob("videos/*.mp4")
    assert video.stat().st_size > 1000


def test_another_script_is_told():
    done = zoo_script("../x")
    assert done.returncode == 1
    assert done.stderr.startswith("the RL Zoo has no script '")
    assert "it has enjoy, " in done.stderr


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frame_stack": 0}, "frame_stack is 0; expected a whole number >= 1"),
        ({"learning_rate": -1}, "learning_rate is -1; expected a number >= 0"),
        ({"ent_coef": "1e-3"}, "ent_coef is '1e-3'; expected a number, e.g. 1.0e-3 .*auto"),
        ({"train_freq": 0}, "train_freq is 0; expected a whole number >= 1, or e.g. .1, episode."),
        ({"train_freq": [1, "lap"]}, "expected a whole number >= 1, or e.g. .1, episode."),
        ({"target_update_interval": 0}, "target_update_interval is 0; expected a whole number"),
        ({"noise_type": "foo"}, "noise_type is 'foo'; expected one of normal, ornstein-uhlenbeck"),
        ({"noise_type": "normal"}, "needs a noise_std, and that is None; expected a number >= 0"),
        ({"noise_type": "normal", "noise_std": -0.1}, "that is -0.1; expected a number >= 0"),
        ({"policy": "CnnPolicy"}, "reads pictures, .* gives rows of numbers; use MlpPolicy"),
        ({"policy": "MultiInputPolicy"}, "reads dicts, .* gives rows of numbers; use MlpPolicy"),
        ({"policy": "stable_baselines3.sac.policies.CnnPolicy"}, "use MlpPolicy"),
        ({"env_wrapper": [{STACK: {"stack_size": 2}}, FLAT], "policy": "CnnPolicy"}, "use Mlp"),
        ({"env_wrapper": STACK}, "'stack_size'.*give its arguments below its dotted path"),
    ],
)
def test_what_would_end_a_training_at_its_begin_is_told(change, message):
    path = zoo.config_file("sac")
    entry = {**zoo.read_entry(path, "Torcs-v0"), **change}

    def begin():
        place = zoo.Place(path, "Torcs-v0")
        zoo.check_entry(entry, "sac", "Torcs-v0", place)
        zoo.checked_env(entry, "Torcs-v0", place)

    with pytest.raises(ZooConfigError, match=message):
        begin()
