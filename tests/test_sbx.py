"""Algorithms of SBX. A module in its place serves SB3's, which take the same arguments."""

import sys
import types

import pytest
from stable_baselines3 import SAC

from sb3_torcs.agents import models
from sb3_torcs.agents.saved.algorithm import algorithm_class
from sb3_torcs.cli import main
from sb3_torcs.errors import InvalidOption, PackageMissing, StudyError, ZooConfigError
from sb3_torcs.studies.config import read_study
from sb3_torcs.training import zoo


@pytest.fixture
def sbx(monkeypatch):
    """A policy of this SBX is one of SB3's SAC; all other policies are not."""
    base = types.SimpleNamespace(BaseJaxPolicy=SAC.policy_aliases["MlpPolicy"])
    monkeypatch.setitem(sys.modules, "sbx", types.SimpleNamespace(SAC=SAC))
    monkeypatch.setitem(sys.modules, "sbx.common.policies", base)


@pytest.mark.slow
@pytest.mark.usefixtures("sbx")
def test_it_trains_by_the_shipped_entry(capsys, tmp_path):
    words = ["train", "--algo", "sbx_sac", "--env", "TorcsLite-v0", "--timesteps", "40"]
    words += ["--hyperparams", "learning_starts=20", "--no-progress", "--folder", str(tmp_path)]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert out.rstrip().endswith("--env TorcsLite-v0 --track aalborg --trust")
    record = models.training_record(tmp_path / "sbx_sac" / "TorcsLite-v0_1" / "TorcsLite-v0.zip")
    assert record.algo == "sbx_sac"


@pytest.mark.usefixtures("sbx")
def test_an_unknown_algorithm_of_it_is_told():
    with pytest.raises(InvalidOption, match="no algorithm 'sbx_sa'; did you mean 'sbx_sac'"):
        algorithm_class("sbx_sa")


def test_without_it_the_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "sbx", None)
    with pytest.raises(PackageMissing, match=r"'sbx_sac' is an algorithm of SBX.*sb3-torcs\[sbx\]"):
        algorithm_class("sbx_sac")


@pytest.mark.usefixtures("sbx")
@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"policy": "sb3_torcs.policies.SplitHeadPolicy"}, "policy"),
        ({"policy_kwargs": "dict(activation_fn=nn.ReLU)"}, "policy_kwargs"),
    ],
)
def test_what_is_of_pytorch_is_refused(change, named):
    path = zoo.config_file("sbx_sac")
    entry = {**zoo.read_entry(path, "Torcs-v0"), **change}
    with pytest.raises(ZooConfigError, match=f"{named} is of PyTorch, and SBX computes with JAX"):
        zoo.check_entry(entry, "sbx_sac", "Torcs-v0", zoo.Place(path, "Torcs-v0"))


def test_a_study_refuses_it(tmp_path):
    file = tmp_path / "study.yml"
    file.write_text("name: s\nseeds: 1\neval_interval: 100\nalgo: sbx_sac\n")
    with pytest.raises(StudyError, match="give sac, or type: sb3-torcs train --algo sbx_sac"):
        read_study(file)
