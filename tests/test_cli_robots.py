"""``sb3-torcs robots``: lists, drives, tables, JSON, and what is refused."""

from __future__ import annotations

import json
import os
import signal
import sys
import types

import pytest
from fake_game import write_game
from processes import Program

from sb3_torcs.agents.robots import race
from sb3_torcs.cli import main
from sb3_torcs.errors import InvalidOption, OutputNotWritable
from sb3_torcs.torcs.race_results import Lap, RobotResult


def run(capsys, *words):
    status = main(["robots", *words])
    out, err = capsys.readouterr()
    return status, out, err


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """A game with one robot that cannot drive."""
    monkeypatch.setenv("SB3_TORCS_HOME", str(write_game(tmp_path / "game")))


@pytest.fixture
def engine(fake, monkeypatch):
    """An engine that returns what it is told to, and keeps what it was asked."""
    asked = {}

    def race(robots, track, laps, session="practice", telemetry=None):
        asked.update(robots=robots, track=track, laps=laps, session=session, telemetry=telemetry)
        return asked["results"], asked["unwritten"]

    module = types.ModuleType("sb3_torcs.agents.robots")
    module.race_to_its_end = race
    monkeypatch.setitem(sys.modules, "sb3_torcs.agents.robots", module)
    asked["unwritten"] = None
    asked["results"] = [
        RobotResult(
            "racer", 3, "small", [Lap(50.5, 0), Lap(49.25, 7)], 99.75, 1, 7, False, 2, 49.25
        )
    ]
    return asked


class TestByTheGame:
    def test_a_practice_as_json(self, game, capsys):
        status, out, _ = run(capsys, "inferno", "--track", "aalborg", "--game", "--json")
        times = (81.486, 76.32, 76.354)
        assert status == 0
        assert json.loads(out) == {
            "robot": "inferno", "index": 3, "track": "aalborg", "car": "car1-trb1",
            "laps": [{"time": time, "damage": 0} for time in times],
        }  # fmt: skip

    def test_a_polite_kill_ends_the_game_too(self, game, tmp_path):
        words = ["robots", "inferno", "--track", "aalborg", "--laps", "5000", "--game"]
        with Program.of_ours(*words, env={**os.environ, "TMPDIR": str(tmp_path)}) as program:
            program.wait_for(lambda: list(tmp_path.glob("*/words")))
            assert program.end(signal.SIGHUP) == 128 + signal.SIGHUP
        assert list(tmp_path.iterdir()) == []

    def test_a_practice_as_a_table(self, game, capsys):
        _, out, _ = run(capsys, "sparkle", "--index", "0", "--track", "g-track-1", "--laps", "1",
                        "--game")  # fmt: skip
        lines = out.splitlines()
        assert lines[0] == "sparkle:0, baja-bug, g-track-1"
        assert lines[1].split() == ["lap", "time", "s", "damage"]
        assert lines[3].split()[0] == "1"
        assert lines[4].startswith("best lap: ")

    def test_a_race_as_json_holds_everybody(self, game, capsys):
        words = ["sparkle", "--index", "0", "--with", "inferno:3,berniw", "--track", "g-track-1"]
        result = json.loads(run(capsys, *words, "--laps", "1", "--game", "--json")[1])
        assert (result["robot"], result["laps"]) == ("sparkle", [])
        assert [(entry["rank"], entry["robot"]) for entry in result["race"]][-1] == (3, "sparkle")
        assert {(e["robot"], e["index"]) for e in result["race"]} == {
            ("inferno", 3), ("berniw", 3), ("sparkle", 0)
        }  # fmt: skip
        keys = {"rank", "robot", "index", "car", "laps_completed", "total_time", "best_lap",
                "damage", "out", "laps"}  # fmt: skip
        assert all(set(entry) == keys for entry in result["race"])


class TestByTheEngine:
    def test_it_is_asked_for_what_the_words_say(self, engine, capsys, tmp_path):
        file = tmp_path / "drive.csv"
        words = ["racer", "--track", "loop", "--laps", "2", "--telemetry", str(file)]
        status, out, _ = run(capsys, *words)
        assert (status, engine["robots"], engine["track"]) == (0, [("racer", 3)], "road/loop")
        assert (engine["laps"], engine["session"], engine["telemetry"]) == (2, "practice", file)
        assert out.splitlines() == [
            "racer:3, small, loop",
            "lap  time s  damage",
            "---  ------  ------",
            "  1  50.500       0",
            "  2  49.250       7",
            "best lap: 49.250 s",
            f"telemetry: {file}",
        ]

    def test_a_practice_as_json(self, engine, capsys):
        result = json.loads(run(capsys, "racer", "--track", "loop", "--json")[1])
        assert list(result) == ["robot", "index", "track", "car", "laps"]
        assert result["laps"] == [{"time": 50.5, "damage": 0}, {"time": 49.25, "damage": 7}]

    @pytest.mark.parametrize("words", [[], ["--json"]])
    def test_the_results_are_shown_though_the_telemetry_fails(
        self, engine, capsys, tmp_path, words
    ):
        engine["unwritten"] = OutputNotWritable("cannot write 'drive.csv': it is full")
        words = ["--track", "loop", "--telemetry", str(tmp_path / "drive.csv"), *words]
        status, out, err = run(capsys, "racer", *words)
        assert (status, err) == (2, "sb3-torcs: cannot write 'drive.csv': it is full\n")
        assert "49.25" in out
        assert "telemetry:" not in out

    def test_a_race_is_a_table_of_all(self, engine, capsys):
        engine["results"] = [
            RobotResult("racer", 10, "big", [], 90.0, 1, 0, False, 2, 44.0),
            RobotResult("racer", 3, "small", [], 0.0, 2, 10001, True),
        ]
        _, out, _ = run(capsys, "racer", "--with", "racer:10", "--track", "loop")
        assert engine["session"] == "race"
        assert engine["robots"] == [("racer", 3), ("racer", 10)]
        assert out.splitlines()[3].split() == [
            "1", "racer:10", "big", "2", "90.000", "44.000", "0", "no"
        ]  # fmt: skip
        assert out.splitlines()[4].split() == [
            "2", "racer:3", "small", "0", "0.000", "-", "10001", "yes"
        ]  # fmt: skip

    def test_without_a_whole_lap_there_is_no_table(self, engine, capsys):
        engine["results"] = [RobotResult("racer", 3, "small", [], 0.0, 1, 10001, True)]
        out = run(capsys, "racer", "--track", "loop")[1]
        assert out.splitlines()[1:] == ["no whole lap", "best lap: none without a fault; out"]

    def test_a_track_of_ones_own_is_handed_on(self, engine, capsys, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "some.xml").touch()
        run(capsys, "racer", "--track", "some.xml")
        assert engine["track"] == "some.xml"


class TestList:
    def test_as_a_table(self, fake, capsys):
        status, out, _ = run(capsys)
        assert status == 0
        assert [line.split() for line in out.splitlines()] == [
            ["robot", "index", "name", "car"],
            ["-----", "-----", "-----", "-----"],
            ["racer", "3", "Three", "small"],
            ["racer", "10", "Ten", "big"],
        ]

    def test_as_json(self, fake, capsys):
        result = json.loads(run(capsys, "--json")[1])
        assert result[0] == {"robot": "racer", "index": 3, "name": "Three", "car": "small"}

    def test_who_has_no_car_is_not_listed(self, fake, capsys, tmp_path):
        (tmp_path / "game/share/games/torcs/cars/big/big.xml").unlink()
        assert [entry["index"] for entry in json.loads(run(capsys, "--json")[1])] == [3]
        message = "robot 'racer' with index 10 drives 'big', a car that the game at"
        assert message in run(capsys, "racer", "--index", "10", "--track", "loop")[2]


class TestRefusals:
    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (["racerr"], "no robot 'racerr'; did you mean 'racer'? it has racer"),
            (["racer", "--index", "4"], "robot 'racer' has no index 4; it has 3, 10"),
            (["racer", "--track", "lop"], "no track 'lop'; did you mean 'loop'?"),
            (["racer", "--with", "rcaer:3"], "no robot 'rcaer'; did you mean 'racer'?"),
            (["racer", "--with", "racer:10,racer:10"], "robot 'racer:10' is named twice; name"),
            (["racer", "--game", "--telemetry", "x.csv"], "only; leave out --game"),
            (["racer:3", "--index", "3"], "'racer:3' has an index already; leave out --index 3"),
            ([], "--track is for a robot that drives; name one: robots inferno"),
        ],
    )
    def test_a_mistake_is_told_in_one_line(self, fake, capsys, words, message):
        status, out, err = run(capsys, "--track", "loop", *words)
        assert (status, out) == (2, "")
        assert message in err
        assert err.count("\n") == 1

    def test_a_missing_game_is_told(self, capsys, monkeypatch, tmp_path):
        monkeypatch.setenv("SB3_TORCS_HOME", str(tmp_path))
        status, out, err = run(capsys, "inferno")
        assert (status, out) == (2, "")
        assert "there is no TORCS in" in err

    @pytest.mark.parametrize("rivals", ["", "racer:b", ":3", "racer,,racer"])
    def test_rivals_have_a_form(self, fake, capsys, rivals):
        status, out, err = run(capsys, "racer", "--track", "loop", "--with", f"racer:3,{rivals}")
        assert (status, out) == (2, "")
        assert "expected NAME or NAME:INDEX, e.g. inferno:3" in err


def test_telemetry_in_another_format_is_refused(capsys, fake, tmp_path):
    status, out, err = run(capsys, "racer", "--telemetry", str(tmp_path / "drive.txt"))
    assert (status, out) == (2, "")
    assert "should end in .parquet or .csv" in err


@pytest.mark.parametrize("robots", [["inferno"], "inferno", [("inferno", 3, 1)], [3]])
def test_robots_are_pairs_of_a_name_and_an_index(robots):
    with pytest.raises(InvalidOption, match=r"robots hold .*; expected pairs of a name and an"):
        race(robots, "aalborg", 1)
