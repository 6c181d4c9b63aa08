"""A mistake in a study file is told before anything starts, with what to type instead."""

import builtins
import sys
from pathlib import Path

import pytest
import yaml

from sb3_torcs.cli import main
from sb3_torcs.errors import StudyError
from sb3_torcs.studies.config import merged, read_study
from sb3_torcs.tracks.catalogue import available_tracks

STUDIES = sorted((Path(__file__).parent.parent / "examples" / "studies").glob("*.yml"))
VECTORS = "stable_baselines3.common.vec_env.VecExtractDictObs"
NOISE = "sb3_torcs.callbacks.NoiseCallback"
GOOD = {"name": "s", "env": "TorcsLite-v0", "seeds": 2, "eval_interval": 100}


def of_one(**changes):
    """A study of one variant."""
    return {"variants": {"a": changes}}


def written(tmp_path, **changes):
    said = {key: value for key, value in {**GOOD, **changes}.items() if value is not None}
    file = tmp_path / "s.yml"
    file.write_text(yaml.safe_dump(said, sort_keys=False))
    return file


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_the_shipped_studies_can_be_run(path):
    assert read_study(path).trials


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"seeds": 0}, "seeds is 0; expected how many"),
        ({"seeds": [1, 1]}, "a list of different whole numbers"),
        ({"seeds": [-1]}, "a list of different whole numbers"),
        ({"seeds": [2**32]}, "whole numbers from 0 to 2**32 - 1"),
        ({"seeds": True}, "seeds is True"),
        ({"seeds": 20240101}, "too many; one seed is a list: [20240101]"),
        ({"seeds": None}, "key 'seeds' is missing"),
        ({"sedes": 3}, "unknown key 'sedes'; did you mean 'seeds'?"),
        ({"eval_interval": 0}, "eval_interval is 0; expected timesteps, e.g. 5000"),
        ({"name": "..."}, "name is '...'; expected a word"),
        ({"final_tracks": ["aalbrg"]}, "s.yml: final_tracks: no track 'aalbrg'; did you mean"),
        (
            {"env": "Torcs-v0", "final_tracks": ["forza", "random"]},
            "takes the name of an installed",
        ),
        ({"env": "Torcs-v0", **of_one(eval_tracks=["own.csv"])}, "is a file for TorcsLite-v0"),
        ({"final_tracks": ["aalborg", "road/aalborg"]}, "one is there twice"),
        ({"final_tracks": 3}, "expected a list of tracks, or of 'road', 'oval', 'dirt'"),
        ({"env": "Torc-v0"}, "no environment 'Torc-v0' is registered; did you mean 'Torcs-v0'?"),
        ({"algo": "dpg"}, "no hyperparameters are shipped for the algorithm 'dpg'"),
        ({"algo": "tqc"}, "for the algorithm 'tqc'; shipped: a2c, ddpg"),
        ({"algo": "dqn"}, "/sac.yml: conf_file: FILE.yml"),
        ({"conf_file": "none.yml"}, "there is no hyperparameter file"),
        ({"entry": "as the pots"}, "did you mean 'as the post'?"),
        ({"n_timesteps": 0}, "n_timesteps is 0; expected a number >= 1"),
        ({"n_timesteps": float("inf")}, "n_timesteps is inf; expected a number >= 1"),
        ({"algo": 3}, "algo is 3; expected a word"),
        ({"entry": 3}, "entry is 3; expected a word"),
        ({"variants": ["a"]}, "expected 'NAME: {key: value}'"),
        ({"variants": {"a": 3}}, "variants: a': expected 'NAME: {key: value}'"),
        ({"variants": {"a b": {}, "a-b": {}}}, "names that differ in signs only"),
        ({"variants": {"a": {"gama": 0.9}}}, "unknown key 'gama'; did you mean 'gamma'?"),
        (of_one(callback={NOISE: {"knd": 1}}), "argument 'knd'; did you mean 'kind'?"),
        (of_one(env_kwargs={"track": "nowhere"}), "variants: a': no track 'nowhere'"),
        ({"variants": {"a": {"env_kwargs": 3}}}, "env_kwargs is 3; expected '{key: value}'"),
        ({"variants": {"a": {"env_kwargs": {"reward": "blgo"}}}}, "did you mean 'blog'?"),
        ({"variants": {"a": {"n_steps": None}}}, "null takes 'n_steps' away, but it is not there"),
        ({"final_tracks": []}, "final_tracks is []; expected a list of tracks"),
        (of_one(vec_env_wrapper=VECTORS), f"{VECTORS} changes vectors of environments"),
    ],
)
def test_a_mistake_is_told_before_anything_starts(tmp_path, capsys, changes, says):
    words = ["study", str(written(tmp_path, **changes)), "--folder", str(tmp_path / "out")]
    assert main(words) == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: [", "not YAML"),
        ("- 1", "expected 'key: value'"),
        ("variants:\n  a: {}\n  a: {}\n", r"s\.yml, line 3: .* key 'a' is there twice; rename one"),
        ("a:\n\t- 1", r"s\.yml, line 2: not YAML: .*cannot start any token"),
        ("name: " + 20_000 * "[", "not YAML: "),
    ],
)
def test_a_file_that_is_no_study_is_told(tmp_path, text, says):
    (tmp_path / "s.yml").write_text(text)
    with pytest.raises(StudyError, match=says):
        read_study(tmp_path / "s.yml")
    with pytest.raises(StudyError, match="there is no study file"):
        read_study(tmp_path / "none.yml")


def test_changes_are_merged_into_an_entry():
    noise, brake = "x.Noise", "x.Brake"
    entry = {"gamma": 0.9, "kwargs": {"a": 1, "b": 2}, "callback": ["x.First", {noise: {"dt": 1}}]}
    changes = {
        "gamma": 0.95,
        "kwargs": {"b": None, "c": [3]},
        "callback": {noise: {"kind": "ou"}, brake: {}, "x.First": None},
    }
    assert merged(entry, changes) == {
        "gamma": 0.95,
        "kwargs": {"a": 1, "c": [3]},
        "callback": [{noise: {"dt": 1, "kind": "ou"}}, brake],
    }
    assert merged(entry, {"callback": ["x.Only"]})["callback"] == ["x.Only"]
    assert entry["kwargs"] == {"a": 1, "b": 2}


def test_a_callback_that_is_there_twice_stays_so_and_is_not_changed():
    """Two rewards, one after the other: a change of one would not say of which."""
    twice = [{"x.Reward": {"timesteps": 1000}}, "x.First", {"x.Reward": {"timesteps": 5000}}]
    changed = merged({"callback": twice}, {"callback": {"x.Mirror": {}, "x.First": {"a": 1}}})
    assert changed["callback"] == [twice[0], {"x.First": {"a": 1}}, twice[2], "x.Mirror"]
    for change in ({"timesteps": 9}, None):
        with pytest.raises(StudyError, match=r"'x.Reward', which the entry has 2 times; give the"):
            merged({"callback": twice}, {"callback": {"x.Reward": change}})
    with pytest.raises(StudyError, match=r"null takes 'x.None' away, but it is not"):
        merged({"callback": twice}, {"callback": {"x.None": None}})


def test_a_study_is_its_variants_by_its_seeds(tmp_path):
    changes = {"algo": "sac", "n_timesteps": 50, "eval_interval": 25, "gamma": 0.5}
    variants = {"one": {}, "Two!": changes}
    study = read_study(written(tmp_path, variants=variants, n_timesteps=200, seeds=[4, 7]))
    names = [trial.name for trial in study.trials]
    assert names == ["one-seed4", "one-seed7", "two-seed4", "two-seed7"]
    assert [trial.budget for trial in study.trials] == [200, 200, 50, 50]
    assert [trial.algo for trial in study.trials] == ["ddpg", "ddpg", "sac", "sac"]
    assert [trial.eval_interval for trial in study.trials] == [100, 100, 25, 25]
    assert study.trials[2].entry["gamma"] == 0.5
    assert study.trials[0].final_tracks == study.trials[0].eval_tracks == ("aalborg",)


def test_the_budget_may_be_written_as_people_do(tmp_path):
    study = read_study(written(tmp_path, n_timesteps="2e2"))
    assert study.trials[0].budget == study.trials[0].entry["n_timesteps"] == 200


def test_a_file_of_hyperparameters_lies_beside_the_study(tmp_path):
    entry = {"n_timesteps": 10, "policy": "MlpPolicy"}
    (tmp_path / "own.yml").write_text(yaml.safe_dump({"mine": entry}))
    study = read_study(written(tmp_path, conf_file="own.yml", entry="mine"))
    assert study.trials[0].entry == entry


def test_road_stands_for_all_road_tracks(tmp_path):
    study = read_study(written(tmp_path, final_tracks="road"))
    road = {f"road/{t.name}" for t in available_tracks() if t.category == "road"}
    assert set(study.trials[0].final_tracks) == road
    assert len(road) >= 3


def test_categories_and_tracks_stand_side_by_side(tmp_path):
    study = read_study(written(tmp_path, final_tracks=["oval", "dirt-1"]))
    others = {t.name for t in available_tracks() if t.category == "oval"}
    assert {name.rpartition("/")[2] for name in study.trials[0].final_tracks} == {
        "aalborg", "dirt-1", *others,
    }  # fmt: skip


def test_without_ray_it_is_said_what_to_type(tmp_path, capsys, monkeypatch):
    def blocked(name, *rest, **more):
        if name.partition(".")[0] == "ray":
            raise ImportError("No module named 'ray'")
        return importer(name, *rest, **more)

    importer = builtins.__import__
    for name in [name for name in sys.modules if name.partition(".")[0] == "ray"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(builtins, "__import__", blocked)
    assert main(["study", str(written(tmp_path))]) == 2
    assert 'type: pip install "sb3-torcs[study]"' in capsys.readouterr().err
