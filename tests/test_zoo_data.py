"""Hyperparameter and study files are data: nothing in one runs, and none is too much to read."""

from __future__ import annotations

import pytest
import yaml

from sb3_torcs.errors import StudyError, ZooConfigError
from sb3_torcs.files import plain_python, read_yaml
from sb3_torcs.studies.config import read_study
from sb3_torcs.training import zoo, zoo_data

ENTRY = {"n_timesteps": 10, "policy": "MlpPolicy"}
STUDY = {"name": "small", "seeds": 1, "eval_interval": 5, "env": "TorcsLite-v0", "n_timesteps": 10}


def study(folder, **variant):
    file = folder / "study.yml"
    file.write_text(yaml.safe_dump({**STUDY, "variants": {"own": variant}}))
    return read_study(file)


@pytest.mark.parametrize(("text", "value"), [
    ("dict(net_arch=[64, 64], log_std_init=-2)", {"net_arch": [64, 64], "log_std_init": -2}),
    ("{'norm_obs': True, 'norm_reward': False}", {"norm_obs": True, "norm_reward": False}),
    ("dict(net_arch=dict(pi=(8,), qf=[8]))", {"net_arch": {"pi": [8], "qf": [8]}}),
])  # fmt: skip
def test_the_strings_of_the_zoos_own_files_are_read_as_data(text, value):
    assert plain_python(text) == value
    assert zoo_data.as_data({"policy_kwargs": text}) == {"policy_kwargs": value}


@pytest.mark.parametrize("text", [
    "dict(activation_fn=nn.modules.ReLU)", "nn.ReLU()", "dict(a=nn.Module)",
    "__import__('os').mkdir('x')", "dict(**{})", "dict([])", "1 +",
    "os.dict(a=1)", "[x for x in ()]", "(" * 10_000, "{**{}}", "'a' * 10**9",
])  # fmt: skip
@pytest.mark.parametrize("key", zoo_data.EVALUATED)
def test_a_string_that_is_code_is_never_evaluated(tmp_path, text, key):
    with pytest.raises(ZooConfigError, match=f"{key} is .*no code is evaluated; write a mapping"):
        study(tmp_path, **{key: text})


def test_an_activation_may_be_named_as_in_the_zoos_own_files():
    zoo_data.check_data({"policy_kwargs": "dict(activation_fn=nn.ReLU, net_arch=[4])"}, "here")


@pytest.mark.parametrize(("key", "path"), [
    ("callback", "subprocess.Popen"),
    ("callback", "sb3_torcs.policies.SplitHeadPolicy"),
    ("env_wrapper", "os.system"),
    ("env_wrapper", "builtins.exec"),
    ("policy", "subprocess.Popen"),
    ("vec_env_wrapper", "stable_baselines3.common.vec_env.DummyVecEnv"),
])  # fmt: skip
def test_a_dotted_path_stands_for_what_its_key_needs(tmp_path, key, path):
    with pytest.raises(ZooConfigError, match=f"{key} '{path}' is not a subclass of"):
        study(tmp_path, **{key: path})


ALIASES = "a0: &a0 [x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 12)
)
MERGES = "a0: &a0 {x: 1}\n" + "".join(
    f"a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}]}}\n" for i in range(1, 40)
)
BOMBS = {
    "aliases": (ALIASES, "aliases stand for more than"),
    "merges": (MERGES, "aliases stand for more than"),
    "brackets": ("[" * 30_000 + "]" * 30_000, "nests too deep"),
    "depth": ("- " * 30_000, "nests too deep"),
    "itself": ("&a [*a]", "nests too deep|alias is within"),
    "length": ("a: b\n" * 10**6, "characters; at most"),
    "date": ("a: 2026-13-45", "month must be"),
    "digits": ("a: " + "9" * 5000, "limit"),
    "no digits": ("a: !!int ''", "a value does not fit its tag"),
    "no date": ("a: !!timestamp today", "a value does not fit its tag"),
    "neither": ("a: !!bool maybe", r"a value does not fit its tag, .*maybe"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_yaml_that_is_too_much_is_refused(tmp_path, name):
    """In a study and in a hyperparameter file, each in one line."""
    text, message = BOMBS[name]
    with pytest.raises(yaml.YAMLError, match=message):
        read_yaml(text)
    (tmp_path / "own.yml").write_text(text)
    with pytest.raises(StudyError, match=message):
        read_study(tmp_path / "own.yml")
    with pytest.raises(ZooConfigError, match=message):
        zoo.read_config(tmp_path / "own.yml")


def test_yaml_with_aliases_is_read_as_before():
    text = "a: &a {x: 1}\nb: {<<: *a, y: [*a, *a]}\n"
    assert read_yaml(text) == yaml.safe_load(text)
    assert read_yaml("") is None
