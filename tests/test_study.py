"""Studies run on Ray Tune, and come to the same results whatever happens to the machines."""

import contextlib
import csv
import dataclasses
import errno
import json
import math
import os
import shutil
import signal
import sys
import tempfile
from pathlib import Path

import pytest
import yaml
from processes import Program, processes_of
from stable_baselines3.common.callbacks import BaseCallback

from sb3_torcs.agents.saved.record import BEST_MODEL
from sb3_torcs.cli import main
from sb3_torcs.cli.study import Board
from sb3_torcs.errors import RayUnavailable, StudyError
from sb3_torcs.signals import keep_handlers
from sb3_torcs.studies import runner as study_module
from sb3_torcs.studies.config import FIELDS, read_study
from sb3_torcs.studies.report import write_report
from sb3_torcs.studies.runner import MARK, PRIVATE, SESSION, run_study, run_trial, with_patience
from sb3_torcs.studies.storage import StudyFolder

DECAY = "sb3_torcs.callbacks.NoiseDecayCallback"
CLOCKS = ("wall_s", "cpu_s")
HANDLED = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)


TINY = {
    "learning_starts": 100, "buffer_size": 1000, "batch_size": 16,
    "policy_kwargs": {"net_arch": [16, 16], "head_bias": [0.0, 1.0, -3.0]},
}  # fmt: skip


@pytest.fixture(autouse=True)
def impatient_workers(monkeypatch):
    """Ray's workers give way to all others, so that beside other tests they would hardly run."""
    monkeypatch.setenv("RAY_worker_niceness", "0")


def study_file(folder, **changes):
    said = {
        "name": "tiny", "env": "TorcsLite-v0", "seeds": 2, "n_timesteps": 1920,
        "eval_interval": 240, "final_tracks": ["g-track-1"],
        "variants": {"small nets": TINY},
        **changes,
    }  # fmt: skip
    file = folder / "tiny.yml"
    file.write_text(yaml.safe_dump(said))
    return file


def results(folder):
    with (Path(folder) / "results.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if k not in CLOCKS} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def undisturbed_folder(tmp_path_factory):
    """The same study without Ray: one trial after the other, in this process."""
    folder = tmp_path_factory.mktemp("undisturbed")
    study = read_study(study_file(folder))
    store = StudyFolder(folder / "out", study)
    store.begin()
    for trial in study.trials:
        run_trial(trial, store, lambda row: None)
    return folder / "out"


@pytest.fixture(scope="module")
def undisturbed(undisturbed_folder):
    return results(undisturbed_folder)


def test_the_table_has_every_evaluation_of_every_trial(undisturbed):
    for seed in "01":
        rows = [row for row in undisturbed if row["seed"] == seed]
        assert [row["decisions"] for row in rows[:-2]] == [str(240 * n) for n in range(1, 9)]
        assert [row["phase"] for row in rows] == ["train"] * 8 + ["final"] * 2
        assert {row["track"] for row in rows[:-2]} == {"aalborg"}
        assert [row["track"] for row in rows[-2:]] == ["aalborg", "g-track-1"]
        assert len({row["return"] for row in rows[:-2]}) == 8  # each drives what was learned


def evaluated(trial):
    """A row of its first evaluation."""
    words = {"study": "tiny", "variant": trial.variant, "phase": "train", "track": "aalborg"}
    rest = {"completes": False, "kept": False, "lap_times_s": [], "end": "stuck", "ladder": ""}
    row = {**dict.fromkeys(FIELDS, 0), **words, **rest}
    return {**row, "seed": trial.seed, "decisions": 240}


@pytest.fixture
def begun(tmp_path):
    """A study of two trials, of which the first has one evaluation."""
    study = read_study(study_file(tmp_path))
    store = StudyFolder(tmp_path / "out", study)
    store.begin()
    files = {"state.json": b"1", BEST_MODEL: b"2"}
    store.put(study.trials[0], files, [evaluated(study.trials[0])])
    return study, store


class PoisonCallback(BaseCallback):
    """Lets a model compute no numbers any more."""

    def __init__(self, at):
        super().__init__()
        self.at = at

    def _on_step(self):
        if self.num_timesteps >= self.at:
            next(self.model.policy.parameters()).data.fill_(math.nan)
        return True


def poisoned(tmp_path, at):
    """Run a study of one agent that diverges after so many timesteps."""
    callback = {f"{__name__}.PoisonCallback": {"at": at}}
    variants = {"poisoned": {**TINY, "callback": callback}}
    study = read_study(study_file(tmp_path, seeds=1, variants=variants))
    store = StudyFolder(tmp_path / "out", study)
    store.begin()
    (trial,) = study.trials
    run_trial(trial, store, lambda row: None)
    return store, trial


def test_an_agent_that_diverges_is_measured_by_its_best_model_of_before(tmp_path, capsys):
    store, trial = poisoned(tmp_path, at=500)
    assert store.ended(trial)
    rows = results(tmp_path / "out")
    assert [row["decisions"] for row in rows[:2]] == ["240", "480"]
    assert [row["phase"] for row in rows] == ["train"] * 2 + ["final"] * 2
    assert store.diverged(trial).startswith("the training has diverged: after ")
    assert store.checkpoint(trial) is None
    write_report(tmp_path / "out", tmp_path / "report")
    report = (tmp_path / "report" / "report.md").read_text()
    assert "poisoned-seed0: the training has diverged: after " in report


def test_an_agent_that_diverges_before_its_first_evaluation_counts_as_one_without_a_lap(tmp_path):
    store, trial = poisoned(tmp_path, at=150)
    assert store.ended(trial)
    rows = results(tmp_path / "out")
    assert [(row["phase"], row["end"], row["completes"]) for row in rows] == [
        ("train", "diverged", "0"), ("final", "diverged", "0"), ("final", "diverged", "0"),
    ]  # fmt: skip
    store.begin()
    write_report(tmp_path / "out", tmp_path / "report")
    assert "0 of 1" in (tmp_path / "report" / "report.md").read_text()
    more = dataclasses.replace(trial, final_tracks=(*trial.final_tracks, "alpine-1"))
    run_trial(more, store, lambda row: None)
    assert store.ended(more)
    assert results(tmp_path / "out")[-1]["end"] == "diverged"


def test_the_table_shows_how_far_everybody_is_and_the_best_so_far(begun, monkeypatch, capsys):
    for name, value in (("FORCE_COLOR", "1"), ("TERM", "xterm"), ("COLUMNS", "100")):
        monkeypatch.setenv(name, value)
    study, _ = begun
    row = {"phase": "train", "decisions": 240, "kept": True, "laps": 3, "completes": True}
    board = Board(study)
    with board.shown():
        board.update(study.trials[0], {**row, "best_flying_lap_s": 83.5})
        board.update(study.trials[0], {**row, "decisions": 480, "kept": False})
        board.update(study.trials[1], {"state": "failed", "error": "why"})
    lines = [" ".join(line.split()) for line in capsys.readouterr().err.splitlines()]
    assert "small nets 0 480 / 1920 3 83.500 yes waits" in lines
    assert "small nets 1 0 / 1920 failed" in lines
    assert board.errors() == {"small-nets-seed1": "why"}


def test_without_a_terminal_trials_that_begin_and_end_print_a_line(begun, capsys):
    study, _ = begun
    board = Board(study)
    row = {"phase": "train", "decisions": 240, "kept": True, "laps": 3, "completes": True}
    with board.shown():
        board.update(study.trials[0], {"state": "running"})
        board.update(study.trials[0], {**row, "best_flying_lap_s": 83.5})
        board.update(study.trials[0], {"state": "done"})
        board.update(study.trials[0], {"state": "done"})
    assert capsys.readouterr().err.splitlines() == [
        "small-nets-seed0: running, 0 of 1920 timesteps",
        "small-nets-seed0: done, 240 of 1920 timesteps, laps 3, best lap 83.500 s",
    ]


def test_who_reads_what_trials_print_may_leave(begun, monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)
    study, _ = begun
    board = Board(study)
    with os.fdopen(writer, "w", buffering=1) as gone, monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", gone)
        with board.shown():
            board.update(study.trials[0], {"state": "failed", "error": "why"})
        with contextlib.suppress(BrokenPipeError):
            gone.close()
    assert board.errors() == {"small-nets-seed0": "why"}


def test_a_full_disk_is_told_and_leaves_everything_as_it_was(begun, tmp_path, monkeypatch, capsys):
    study, store = begun
    before = store.rows(study.trials[0])

    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left on device; make room"):
        store.put(study.trials[0], {"state.json": b"2"}, [*before, {"decisions": 480}])
    assert store.rows(study.trials[0]) == before
    assert (store.checkpoint(study.trials[0]) / "state.json").read_bytes() == b"1"
    assert main(["study", str(study.path), "--folder", str(store.path.parent / "new")]) == 2
    assert "make room, or give another folder" in capsys.readouterr().err
    assert not [file for file in tmp_path.rglob(".*") if file.name != ".lock"]


def complaint(study, store, capsys):
    """What the command says, in one line."""
    assert main(["study", str(study.path), "--folder", str(store.path)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    return err


@pytest.mark.parametrize(
    ("name", "contents"),
    [
        ("rows.json", [b"{\xff", b'{"a": 1}', b"[1]", b"[{}]", b"[" * 200_000]),
        ("recipe.yml", [b"[" * 20_000, b"{\xff", b""]),
    ],
)
def test_a_damaged_folder_is_told(begun, capsys, name, contents):
    study, store = begun
    for content in contents:
        (store.of(study.trials[0]) / name).write_bytes(content)
        said = complaint(study, store, capsys)
        assert f"small-nets-seed0/{name}' cannot be read (" in said


def test_a_row_with_a_wrong_value_is_told(begun, capsys):
    study, store = begun
    file = store.of(study.trials[0]) / "rows.json"
    (row,) = json.loads(file.read_text())
    for field, value in (
        ("decisions", "240"), ("decisions", None), ("phase", 1), ("completes", "yes"),
        ("lap_times_s", 90.0), ("distance_m", [1]), ("best_flying_lap_s", "fast"),
        ("track", {"a": 1}),
    ):  # fmt: skip
        file.write_text(json.dumps([{**row, field: value}]))
        said = complaint(study, store, capsys)
        assert f"(row 0: {field} is {value!r}); repair it, or remove" in said


@pytest.mark.parametrize("content", [b"\xff", b"a\0b", b"/" + b"x" * 5000, b"", b"/tmp"])
def test_a_damaged_record_of_temporary_files_removes_nothing(tmp_path, content):
    session = tmp_path / SESSION
    session.write_bytes(content)
    study_module._remove_scratch(session)
    assert not session.exists()
    assert Path("/tmp").is_dir()


def test_what_was_lost_of_a_folder_is_told(begun, capsys):
    study, store = begun
    shutil.rmtree(store.checkpoint(study.trials[0]))
    assert "small-nets-seed0' has lost its checkpoint-*" in complaint(study, store, capsys)


def test_a_damaged_checkpoint_is_reported(begun):
    study, store = begun
    with pytest.raises(StudyError, match=r"checkpoint cannot be read .*; remove its folder"):
        run_trial(study.trials[0], store, lambda row: None)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"callback": [{DECAY: {"timesteps": -1}}]}, "timesteps is -1; expected a whole number"),
        ({"learning_rate": "fast"}, "learning_rate is 'fast'"),
        ({"policy_kwargs": {"head_bias": [0.0]}}, "head_bias"),
    ],
)
def test_a_wrong_value_is_told_before_anything_is_trained(tmp_path, capsys, change, told):
    file = study_file(tmp_path, variants={"good": {}, "bad": change})
    assert main(["study", str(file), "--folder", str(tmp_path / "out"), "--jobs", "1"]) == 2
    error = capsys.readouterr().err
    assert "bad" in error
    assert told in error
    assert not list((tmp_path / "out").rglob("recipe.yml"))  # or the corrected file were another


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"eval_interval": 100}, r"another eval_interval \(it was 240\); give another"),
        (
            {"variants": {"small nets": {"policy_kwargs": {"net_arch": [8, 8]}}}},
            "policy_kwargs: .*net_a",
        ),
        ({"variants": {"small nets": {"tau": 0.1}}}, r"entry: .*buffer_size \(it was 1000\)"),
        ({"name": "other"}, "holds the study 'tiny'; give another --folder for 'other'"),
        ({"name": "other", "variants": {"new": {}}}, "holds the study 'tiny'"),
    ],
)
def test_another_recipe_is_told_by_what_is_different(begun, tmp_path, changes, told):
    _, store = begun
    with pytest.raises(StudyError, match=told):
        StudyFolder(store.path, read_study(study_file(tmp_path, **changes))).begin()


def test_what_the_file_names_no_more_stays_in_the_table(begun, tmp_path):
    """Fewer seeds, or another variant: nothing that was measured gets lost."""
    study, store = begun
    store.put(study.trials[1], {"state.json": b"1", BEST_MODEL: b"2"}, [evaluated(study.trials[1])])
    fewer = StudyFolder(store.path, read_study(study_file(tmp_path, seeds=[1, 2])))
    fewer.begin()
    fewer.write_results()
    assert [row["seed"] for row in results(store.path)] == ["1", "0"]


def test_a_worker_that_is_behind_is_not_needed(begun):
    study, store = begun
    with pytest.raises(StudyError, match="another worker has taken small-nets-seed0 farther"):
        store.put(study.trials[0], {}, [evaluated(study.trials[0])])


def test_two_runs_do_not_share_a_folder(begun, capsys):
    study, store = begun
    with store.locked():
        assert "another process runs the study" in complaint(study, store, capsys)


def test_where_ray_does_not_start_nothing_else_is_removed(begun, tmp_path, monkeypatch):
    """Its sockets lie in the folder for temporary files, and their paths must not be long."""
    study, store = begun
    far = tmp_path / ("far" * 20)
    far.mkdir()
    (store.path / SESSION).write_text(str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", str(far))
    with pytest.raises(RayUnavailable, match=r"Ray does not start in .* TMPDIR=/tmp"):
        run_study(study, store.path, jobs=1)
    assert study.path.is_file()
    assert not list(far.iterdir())
    assert not (store.path / SESSION).exists()


def test_an_address_for_clients_outside_of_a_cluster_is_refused(begun):
    study, store = begun
    with pytest.raises(RayUnavailable, match=r"type the command on one of its machines"):
        run_study(study, store.path, address="ray://somewhere:10001")


@pytest.fixture
def short_folder(monkeypatch):
    """Ray's sockets lie in it, and their paths must not be long."""
    with tempfile.TemporaryDirectory(prefix="st-") as folder:
        monkeypatch.setenv("RAY_TMPDIR", folder)  # where a cluster writes down its address
        (Path(folder) / "ray").mkdir()
        yield folder


@pytest.fixture
def cluster(short_folder):
    """Starts Ray for a study to join, with its head in this process."""
    from ray.cluster_utils import Cluster

    started = []

    def start(**head):
        node = {"num_cpus": 1, "include_dashboard": False, "temp_dir": short_folder}
        arguments = {"initialize_head": True, "head_node_args": {**node, **head}}
        started.append(with_patience(lambda: Cluster(**arguments)))
        return started[0], lambda: with_patience(lambda: started[0].add_node(**node))

    with keep_handlers(*HANDLED):
        yield start
        for each in started:
            each.shutdown()


@pytest.mark.slow
def test_a_killed_study_loses_a_machine_too(undisturbed, tmp_path, short_folder, cluster):
    """
    It goes on from what it has stored: first nothing is left of its processes, then one of two
    machines is lost with a trial on each.
    """
    words = words_of(tmp_path, "--jobs", "2")
    with Program.of_ours(*words, env={**os.environ, "TMPDIR": short_folder}) as program:
        program.wait_for(lambda: seeds_so_far(tmp_path / "out"))
        assert program.end(signal.SIGKILL) == -signal.SIGKILL
    scratch = Path((tmp_path / "out" / SESSION).read_text())
    assert scratch.is_dir()
    assert len(results(tmp_path / "out")) < len(undisturbed)

    head, add_node = cluster()
    second = add_node()
    handlers = [signal.getsignal(number) for number in HANDLED]
    reports, running, trained = [], set(), set()

    def watch(trial, row):
        if row.get("state") == "running":
            running.add(trial.seed)
        if "phase" in row:
            reports.append((trial.seed, row["phase"], row["decisions"]))
            trained.update({trial.seed} & running)
        if len(trained) == 2 and second in head.worker_nodes:
            head.remove_node(second, allow_graceful=False)

    run_study(read_study(tmp_path / "tiny.yml"), tmp_path / "out", address=head.address,
              progress=watch)  # fmt: skip
    assert second not in head.worker_nodes
    assert results(tmp_path / "out") == undisturbed
    assert sorted(seed for seed, phase, _ in reports if phase == "final") == [0, 1]
    assert len(reports) == len(set(reports))  # no evaluation was done twice
    # Tune leaves its own behind, which would swallow the next Ctrl-C of this process.
    assert [signal.getsignal(number) for number in HANDLED] == handlers
    assert not scratch.exists()
    assert not processes_of(scratch)
    assert not (tmp_path / "out" / SESSION).exists()
    assert not list((tmp_path / "out").rglob("*checkpoint-*"))


def test_a_study_that_has_ended_starts_no_ray(undisturbed_folder, tmp_path, monkeypatch, capsys):
    """Killed after the last result, it has left its temporary files."""
    monkeypatch.setattr(study_module, "_ray", None)
    shutil.copytree(undisturbed_folder, tmp_path / "out")
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    (scratch / MARK).touch()
    (tmp_path / "out" / SESSION).write_text(str(scratch))
    assert main([*words_of(tmp_path), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert {(line["seed"], line["state"]) for line in said["trials"]} == {(0, "done"), (1, "done")}
    assert not scratch.exists()
    assert main(words_of(tmp_path)) == 0
    assert "2 of 2 agents" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "whole_group"),
    [
        (signal.SIGINT, False),
        pytest.param(signal.SIGTERM, False, marks=pytest.mark.rare),
        # As of `timeout`. Ray's processes have it, too, and Ray would wait for them without end.
        pytest.param(signal.SIGTERM, True, marks=pytest.mark.rare),
    ],
)
def test_a_signal_keeps_everything(tmp_path, short_folder, number, whole_group):
    """Also while a trial still waits for its turn."""
    words = words_of(tmp_path, "--jobs", "1")
    variables = {**os.environ, "TMPDIR": short_folder}
    with Program.of_ours(*words, env=variables, start_new_session=True) as program:
        program.wait_for(lambda: seeds_so_far(tmp_path / "out"))
        (os.killpg if whole_group else os.kill)(program.pid, number)
        status = program.end()
        out, err = program.printed()
    assert status == 128 + number, err
    if not whole_group:
        assert "0 of 2 agents trained and measured" in out
        assert f"go on with:\n  sb3-torcs {' '.join(words)}" in out
        assert "Traceback" not in err
    assert not (tmp_path / "out" / SESSION).exists()
    assert list(Path(short_folder).glob("st-*")) == []


@pytest.mark.rare
def test_the_ray_of_another_study_is_not_joined(begun, cluster):
    head, _ = cluster(resources={PRIVATE: 1})
    with pytest.raises(RayUnavailable, match="belongs to another study, and ends with it"):
        run_study(begun[0], begun[1].path, address=head.address)


@pytest.mark.rare
def test_without_a_damaged_folder_the_study_goes_on(undisturbed, begun, tmp_path, capsys):
    assert main(words_of(tmp_path, "--jobs", "2")) == 1
    out = capsys.readouterr().out
    assert "small-nets-seed0 failed: its checkpoint cannot be read (" in out
    shutil.rmtree(begun[1].of(begun[0].trials[0]))
    assert main(words_of(tmp_path, "--jobs", "2")) == 0
    assert results(tmp_path / "out") == undisturbed


def test_ray_is_started_again_where_the_machine_was_too_busy():
    attempts = []

    def start():
        attempts.append(len(attempts))
        if len(attempts) < 3:
            raise Exception("The current node timed out during startup.")
        return "started"

    assert with_patience(start) == "started"
    assert attempts == [0, 1, 2]
    with pytest.raises(ValueError, match="wrong"):
        with_patience(lambda: int("wrong"))


def words_of(folder, *words):
    return ["study", str(study_file(folder)), "--folder", str(folder / "out"), *words]


def seeds_so_far(folder):
    return {row["seed"] for row in results(folder)} if (folder / "results.csv").is_file() else set()
