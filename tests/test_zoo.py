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


def test_a_file_is_shipped_for_ddpg():
    assert "ddpg" in [path.stem for path in SHIPPED]


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


def test_an_unknown_key_is_told_the_near_miss(tmp_path):
    said = complaint(tmp_path, {"learning_rat": 0.1})
    assert said == "unknown key 'learning_rat'; did you mean 'learning_rate'?"


def test_a_key_of_another_algorithm_is_unknown(tmp_path):
    assert complaint(tmp_path, {"clip_range": 0.1}).startswith("unknown key 'clip_range'")
    accepted({"clip_range": 0.1}, algo="ppo")


def test_what_the_zoo_passes_itself_may_not_stand_in_an_entry(tmp_path):
    assert complaint(tmp_path, {"seed": 1}).startswith("unknown key 'seed'")


@pytest.mark.parametrize("key", ["n_timesteps", "policy"])
def test_a_missing_key_is_named(key):
    entry = {name: value for name, value in MINIMAL.items() if name != key}
    with pytest.raises(ZooConfigError, match=f"key '{key}' is missing"):
        zoo.check_entry(entry, "ddpg", "TorcsLite-v0", zoo.Place(zoo.Path("x"), "here"))


def test_an_unknown_algorithm_is_told_the_near_miss():
    with pytest.raises(ZooConfigError, match=r"no algorithm 'td33'; did you mean 'td3'\?"):
        accepted({}, algo="td33")


def test_an_unknown_policy_is_told_the_near_miss(tmp_path):
    said = complaint(tmp_path, {"policy": "MlpPolice"})
    assert said.startswith("unknown policy 'MlpPolice'; did you mean 'MlpPolicy'?")
    said = complaint(tmp_path, {"policy": ["MlpPolicy"]})
    assert said.startswith("unknown policy ['MlpPolicy']")


def test_a_policy_of_ppo_is_none_for_an_algorithm_with_critics(tmp_path):
    said = complaint(tmp_path, {"policy": "sb3_torcs.policies.BoundedPolicy"})
    assert said.startswith(
        "sb3_torcs.policies.BoundedPolicy is a policy for PPO and A2C; allowed: "
    )


def test_an_argument_of_the_policy_that_it_does_not_have_is_unknown(tmp_path):
    """Also where the policy hands what it does not know to its base class."""
    said = complaint(tmp_path, {"policy_kwargs": {"net_arc": [1]}})
    assert said == "unknown policy_kwargs: argument 'net_arc'; did you mean 'net_arch'?"
    ours = {"policy": "sb3_torcs.policies.SplitHeadPolicy"}
    said = complaint(tmp_path, {**ours, "policy_kwargs": {"head_bia": [0.0]}})
    assert said == "unknown policy_kwargs: argument 'head_bia'; did you mean 'head_bias'?"
    accepted({**ours, "policy_kwargs": {"head_bias": [0, 0, -1], "net_arch": [3, 6]}})


def test_a_callback_that_does_not_import_is_told_why(tmp_path):
    said = complaint(tmp_path, {"callback": "nowhere.Callback"})
    assert said == (
        "callback 'nowhere.Callback' does not import (No module named 'nowhere'); install the "
        "package that it is in"
    )


def test_a_callback_that_is_not_in_its_module_is_told_the_near_miss(tmp_path):
    said = complaint(tmp_path, {"callback": [f"{MODULE}.CheckpointCallbak"]})
    assert "has no 'CheckpointCallbak'; did you mean 'CheckpointCallback'? " in said


def test_an_argument_of_a_callback_that_it_does_not_have_is_unknown(tmp_path):
    path = f"{MODULE}.CheckpointCallback"
    said = complaint(tmp_path, {"callback": {path: {"save_frequ": 1}}})
    assert said == f"unknown callback {path}: argument 'save_frequ'; did you mean 'save_freq'?"
    accepted({"callback": [{path: {"save_freq": 1, "save_path": "x"}}]})


def test_a_callback_with_a_slip_of_indentation_is_told_so(tmp_path):
    said = complaint(tmp_path, {"callback": [{f"{MODULE}.CheckpointCallback": None, "a": 1}]})
    assert "check the indentation" in said


def test_an_argument_of_the_environment_that_it_does_not_have_is_unknown(tmp_path):
    said = complaint(tmp_path, {"env_kwargs": {"trak": "aalborg"}})
    assert said == "unknown env_kwargs: argument 'trak'; did you mean 'track'?"
    accepted({"env_kwargs": {"track": "aalborg"}})


def test_a_time_limit_is_among_the_arguments_of_the_environment(tmp_path):
    """``gym.make`` itself takes it."""
    accepted({"env_kwargs": {"track": "aalborg", "max_episode_steps": 200}})
    said = complaint(tmp_path, {"env_kwargs": {"max_episode_steps": 0.5}})
    assert said == "max_episode_steps is 0.5; expected a whole number of timesteps >= 1"


def test_monitor_gets_both_of_its_lists_or_none(tmp_path):
    """Monitor adds the two together, and a tuple is its default: it would fail later."""
    said = complaint(tmp_path, {"monitor_kwargs": {"info_keywords": ["laps"]}})
    assert said.endswith("add the other one as []")
    accepted({"monitor_kwargs": {"info_keywords": ["laps"], "reset_keywords": []}})
    said = complaint(tmp_path, {"monitor_kwargs": {"info_keyword": []}})
    assert said == "unknown monitor_kwargs: argument 'info_keyword'; did you mean 'info_keywords'?"


def test_an_argument_of_the_normalization_that_it_does_not_have_is_unknown(tmp_path):
    said = complaint(tmp_path, {"normalize": {"norm_ob": True}})
    assert said == "unknown normalize: argument 'norm_ob'; did you mean 'norm_obs'?"
    accepted({"normalize": {"norm_obs": True, "norm_reward": False}})
    accepted({"normalize": True})


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("null: {a: 1}", "an entry is called None; expected a word"),
        ("1.5: {a: 1}", "an entry is called 1.5; expected a word"),
        ("[" * 20_000, "not YAML"),
    ],
)
def test_a_damaged_file_is_told(tmp_path, text, said):
    file = tmp_path / "x.yml"
    file.write_text(text)
    with pytest.raises(ZooConfigError, match=said):
        zoo.read_entry(file, "Torcs-v0")


@pytest.mark.parametrize("steps", ["abc", 0, -5, True, None, float("inf")])
def test_the_budget_must_be_a_number(tmp_path, steps):
    said = complaint(tmp_path, {"n_timesteps": steps})
    assert said == f"n_timesteps is {steps!r}; expected a number >= 1"


@pytest.mark.parametrize("steps", [100, 1e5, "1e5", "100000.0"])
def test_the_budget_may_be_written_as_people_do(steps):
    accepted({"n_timesteps": steps})


def test_a_schedule_must_be_one_that_the_zoo_reads(tmp_path):
    said = complaint(tmp_path, {"learning_rate": "abc"})
    assert said == f"learning_rate is 'abc'; expected {RATE}"
    assert complaint(tmp_path, {"learning_rate": "1e-3"}).endswith(RATE)
    accepted({"learning_rate": "lin_1e-3"})
    accepted({"learning_rate": 0.001})


@pytest.mark.parametrize(("key", "value", "expected"), [
    ("learning_rate", float("nan"), RATE),
    ("batch_size", 1.5, "a whole number >= 1, e.g. 64"),
    ("n_envs", 0, "a whole number >= 1, e.g. 64"),
    ("buffer_size", "1e5", "a whole number >= 1, e.g. 64"),
    ("gamma", "x", "a number from 0 to 1, e.g. 0.005"),
    ("gamma", float("nan"), "a number from 0 to 1, e.g. 0.005"),
    ("tau", "1e-3", "a number from 0 to 1, e.g. 0.005"),
    ("learning_starts", "1e3", "a whole number >= 0"),
    ("learning_starts", -1, "a whole number >= 0"),
    ("learning_starts", False, "a whole number >= 0"),
    ("gradient_steps", -1.0, "a whole number >= 1, or -1"),
    ("gradient_steps", 0, "a whole number >= 1, or -1"),
    ("env_kwargs", "dict(track='aalborg')", "'{key: value}'"),
])  # fmt: skip
def test_a_number_that_none_can_train_with_is_told(tmp_path, key, value, expected):
    assert complaint(tmp_path, {key: value}) == f"{key} is {value!r}; expected {expected}"


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


def test_normalized_stacks_are_for_algorithms_without_a_replay_buffer(tmp_path):
    both = {"normalize": True, "frame_stack": 2}
    assert "cannot learn with both" in complaint(tmp_path, both, algo="sac")
    accepted(both, algo="ppo")


def test_an_algorithm_without_action_noise_is_told(tmp_path):
    noise = {"noise_type": "normal", "noise_std": 0.1}
    accepted(noise)
    said = complaint(tmp_path, noise, algo="ppo")
    assert said.startswith("noise_type is 'normal', and ppo takes no action noise; remove it")
