"""``sb3-torcs compare``: agents, robots and saved drives on one page, and errors that help."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from made_agents import copied_agent
from made_drives import drive, log_of

from sb3_torcs.agents.ghosts import Ghost
from sb3_torcs.agents.rollout import drive as rollout
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.cli import main
from sb3_torcs.errors import InvalidOption, ModelMismatch
from sb3_torcs.evaluation import comparing
from sb3_torcs.evaluation.comparing import compare
from sb3_torcs.telemetry import DriveLog, read_drives
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.track_names import BUNDLED_FOLDER, find_track
from sb3_torcs.tracks.catalogue import load_track

TRACK = "g-track-1"


@pytest.fixture
def saved(tmp_path):
    """Two drivers of one track, in one file."""
    track = load_track(TRACK)
    log = DriveLog()
    for name, pace in (("ana", 25.0), ("ben", 20.0)):
        drive(log, track, name, speed=lambda place, pace=pace: pace, track=TRACK)
    path = tmp_path / "drives.parquet"
    log.write(path)
    return path


def run(capsys, *words):
    status = main(["compare", *map(str, words)])
    out, err = capsys.readouterr()
    return status, out, err


@pytest.mark.usefixtures("game")
def test_an_agent_a_robot_and_a_saved_drive_are_compared(tmp_path, capsys):
    """And the robot as it was saved drives as the robot does."""
    saved = tmp_path / "inferno.parquet"
    assert main(["evaluate", "inferno", "--laps", "2", "--telemetry", str(saved)]) == 0
    capsys.readouterr()
    page = tmp_path / "report.html"
    words = ["scripted", "inferno", saved, "--track", "aalborg", "--laps", "2", "--html", page]
    status, out, _ = run(capsys, *words, "--json")
    report = json.loads(out)
    assert (status, report["track"], report["html"]) == (0, "aalborg", str(page))
    names = ["scripted", "inferno", "inferno (2)"]
    assert [driver["driver"] for driver in report["drivers"]] == names
    first, robot, again = report["drivers"]
    assert robot["lap_time"] == again["lap_time"]
    assert robot["corners"] == again["corners"]
    assert robot["delta_at_end"] == pytest.approx(robot["lap_time"] - first["lap_time"], abs=1e-9)
    assert len(robot["corners"]) == 17
    assert set(robot["corners"][0]) == {
        "distance", "braking_point", "entry_speed", "apex_speed", "exit_speed", "time_lost",
    }  # fmt: skip
    assert page.read_text().startswith("<!DOCTYPE html>")


@pytest.mark.usefixtures("game")
def test_a_ghost_drives_as_it_did(tmp_path):
    """Its actions give the drive that they were taken from."""
    kwargs = {"track": "a-speedway", "car": "car1-trb1", "action_repeat": 5, "laps": 1}
    with gym.make("sb3_torcs:Torcs-v0", **kwargs) as env:
        actions = np.array([step.action for step in rollout(env, ScriptedDriver(), seed=0)])
    ghost = Ghost(kwargs, actions, (), "scripted", "scripted", 0).write(tmp_path / "lap.npz")
    first, second = compare("scripted", ghost, track="a-speedway", laps=1).comparison.drivers
    assert second.lap.time == first.lap.time
    assert not second.delta.any()


def test_the_documented_json_is_what_it_prints(saved, tmp_path, capsys):
    page = Path(__file__).parent.parent / "docs" / "compare.md"
    example = json.loads(page.read_text("utf-8").split("```json\n")[1].split("```")[0])
    _, out, _ = run(capsys, saved, "--html", tmp_path / "page.html", "--json")
    printed = json.loads(out)
    assert list(example) == list(printed)
    (documented,), driver = example["drivers"], printed["drivers"][0]
    assert list(documented) == list(driver)
    assert list(documented["corners"][0]) == list(driver["corners"][0])


def test_it_prints_what_the_page_shows(saved, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    status, out, _ = run(capsys, saved)
    assert status == 0
    lines = out.splitlines()
    assert lines[0] == TRACK
    assert lines[3].split() == ["ana", "82.302", "0.000"]
    assert lines[4].split() == ["ben", "102.878", "20.576"]
    assert lines[-2].startswith("ben is 20.576 s slower than ana")
    assert lines[-1] == "page: report.html"
    assert (tmp_path / "report.html").is_file()


def test_an_agent_drives_the_track_of_a_saved_drive(saved):
    report = compare(saved, "scripted", laps=1)
    assert report.comparison.track.name == TRACK
    assert report.comparison.drivers[-1].drive.track == TRACK


def test_the_track_is_that_of_the_training(monkeypatch):
    asked = []
    monkeypatch.setattr(comparing, "_ready", lambda *words: lambda: asked.append(words[1]) or [])
    monkeypatch.setattr(comparing, "compare_drives", lambda drives, track: None)
    compare("ppo-league")
    compare("scripted")
    compare("ppo-league", track="forza")
    assert asked == ["corkscrew", "aalborg", "forza"]


def test_an_agent_that_learned_several_cars_drives_the_usual_one(tmp_path, game):
    agent = copied_agent("ppo-any-road", tmp_path / "agent.zip", car=["p406", "car1-trb1"])
    report = compare(agent, track="aalborg", laps=1)
    assert {drive.car for drive in report.comparison.drives} == {"car1-trb1"}


def test_what_is_wrong_with_a_later_driver_is_told_before_the_first_one_drives(monkeypatch, game):
    def refuse(driver, env, trust):
        if driver == "ppo-post":
            raise ModelMismatch(f"{driver} does not fit")

    monkeypatch.setattr(comparing, "load_driver", refuse)
    for driving in ("race", "drive"):
        monkeypatch.setattr(comparing, driving, lambda *words, **named: pytest.fail("it drives"))
    with pytest.raises(ModelMismatch, match="ppo-post does not fit"):
        compare("inferno", "ddpg-aalborg", "ppo-post", track="aalborg", laps=1)


def test_an_evaluation_makes_the_same_page(tmp_path, capsys):
    page = tmp_path / "lap.html"
    words = f"evaluate scripted --env TorcsLite-v0 --track {TRACK} --laps 1 --report {page}"
    assert main(words.split()) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"report: {page}"
    text = page.read_text()
    assert "There is one lap only" in text
    assert "From the grid, not flying: the lap of scripted." in text


def test_a_track_may_be_somebodys_own_file(tmp_path, capsys):
    own = tmp_path / "mine.csv"
    shutil.copy(BUNDLED_FOLDER / "road" / "g-track-1.csv", own)
    drives, page = tmp_path / "drives.parquet", tmp_path / "lap.html"
    words = f"evaluate scripted --env TorcsLite-v0 --track {own} --laps 1 --telemetry {drives}"
    assert main([*words.split(), "--report", str(page)]) == 0
    assert page.read_text().startswith("<!DOCTYPE html>")
    assert run(capsys, drives, "--track", own, "--html", page)[0] == 0


def test_a_drive_on_an_own_track_names_its_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copy(BUNDLED_FOLDER / "road" / "g-track-1.csv", "aalborg.csv")
    words = (
        "evaluate scripted --env TorcsLite-v0 --track aalborg.csv --laps 1 --telemetry a.parquet"
    )
    assert main(words.split()) == 0
    assert set(read_drives("a.parquet")["track"]) == {str(tmp_path / "aalborg.csv")}
    monkeypatch.chdir("/")
    assert compare(tmp_path / "a.parquet").comparison.track.file == tmp_path / "aalborg.csv"
    status, _, err = run(
        capsys, tmp_path / "a.parquet", "--track", "aalborg", "--html", tmp_path / "a.html"
    )
    assert status == 2
    assert "but aalborg has 2588 m: another road of that name" in err
    (tmp_path / "aalborg.csv").unlink()
    status, _, err = run(capsys, tmp_path / "a.parquet", "--html", tmp_path / "a.html")
    assert status == 2
    assert f"there is no track file '{tmp_path / 'aalborg.csv'}'" in err


@pytest.mark.usefixtures("game")
@pytest.mark.parametrize(
    "driver", ["evaluate scripted --env Torcs-v0", "evaluate inferno", "race inferno --races 1"]
)
def test_others_drive_where_a_saved_drive_was(tmp_path, monkeypatch, driver):
    """And not on the track of the game that has the file's name."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(find_track("a-speedway", find_game()).path, "aalborg.xml")
    words = "--track aalborg.xml --laps 1 --telemetry a.parquet"
    assert main([*driver.split(), *words.split()]) == 0
    assert set(read_drives("a.parquet")["track"]) == {str(tmp_path / "aalborg.xml")}
    report = compare("a.parquet", "bt", laps=1)
    assert [len(one.drive.laps) for one in report.comparison.drivers] == [1, 1]
    assert report.comparison.track.length == load_track("a-speedway").length


def test_in_a_notebook_the_report_shows_itself(saved):
    shown = compare(saved)._repr_html_()
    assert shown.startswith('<iframe srcdoc="&lt;!DOCTYPE html&gt;')


def test_drives_of_different_tracks_are_refused(saved, oval, tmp_path, capsys):
    other = tmp_path / "other.parquet"
    drive(DriveLog(), oval, "cleo", track="aalborg").write(str(other))
    status, _, err = run(capsys, saved, other)
    assert status == 2
    assert "laps of different tracks cannot be compared: cleo on aalborg, not on" in err
    status, _, err = run(capsys, saved, "--track", "aalborg")
    assert status == 2
    assert "ana on g-track-1, ben on g-track-1, not on aalborg; name drives" in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none.parquet"], "there is no file 'none.parquet'"),
        (["broken.parquet"], "'broken.parquet' cannot be read as a drive"),
        (["infernal"], "there is no driver 'infernal'"),
        (["scripted", "--track", "forzza"], "no track 'forzza'"),
        (["scripted", "--html", "page.txt"], "'page.txt' should end in .html"),
        (
            ["scripted", "--track", "random"],
            "laps of one track are compared, and 'random' is another one each time",
        ),
    ],
)
def test_what_cannot_be_compared(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.parquet").write_bytes(b"PAR1")
    status, _, err = run(capsys, *words)
    assert status == 2
    assert message in err


def test_an_unfinished_lap_alone_is_an_error(oval, tmp_path, capsys):
    path = tmp_path / "short.parquet"
    drive(DriveLog(), oval, laps=0, end=120.0, track="aalborg").write(path)
    status, _, err = run(capsys, path, "--html", tmp_path / "page.html")
    assert status == 2
    assert "no driver completed a lap of aalborg (2588 m): ana drove 120 m" in err
    assert not (tmp_path / "page.html").exists()


def test_nobody_is_nobody_to_compare():
    with pytest.raises(ValueError, match="no driver is named; name some"):
        compare()


def test_a_race_of_several_makes_a_page_too(oval, monkeypatch):
    """Whoever has a log of drives calls this."""
    monkeypatch.setattr(comparing, "load_track", lambda name: oval)
    report = comparing.report_of(log_of(oval, ("ana", 25.0), ("ben", 20.0)).frame())
    assert [one.drive.driver for one in report.comparison.drivers] == ["ana", "ben"]


def test_a_report_of_an_own_track_needs_no_name(game, tmp_path):
    shutil.copy(find_track("g-track-1", game).path, tmp_path / "mine.xml")
    page = tmp_path / "lap.html"
    words = ["evaluate", "scripted", "--env", "Torcs-v0", "--track", str(tmp_path / "mine.xml")]
    assert main([*words, "--laps", "1", "--report", str(page)]) == 0
    assert page.is_file()


@pytest.mark.parametrize("driver", [3, None, ["inferno", "bt"]])
def test_drivers_are_names_and_paths_one_after_the_other(driver):
    with pytest.raises(InvalidOption, match=r"a driver is .*; expected names and paths, one after"):
        compare(driver, "inferno")
