"""Who stands on a rung has beaten all below, and the shipped laps are the engine's."""

import runpy
import sys
from pathlib import Path

import pytest

from sb3_torcs.agents.scripted import SCRIPTED
from sb3_torcs.evaluation.ladder import REFERENCE_FILE, ROBOTS, reference_laps, rung
from sb3_torcs.evaluation.protocol import Episode, merit
from sb3_torcs.tracks.catalogue import available_tracks

TOOLS = Path(__file__).parent.parent / "tools"


def race(*laps, end="laps", distance=7000.0):
    return Episode(len(laps), list(laps), distance, end, 0.0, 0.0)


@pytest.mark.parametrize(
    ("lap", "expected"),
    [
        (120.0, "finishes"),
        (110.336, "finishes"),  # as fast is not faster
        (110.335, "beats scripted"),
        (78.075, "beats bt"),
        (76.319, "beats the best robot"),
    ],
)
def test_the_best_flying_lap_says_how_high_a_race_stands(lap, expected):
    """The scripted driver's, bt's and inferno's laps of aalborg are 110.336, 78.076 and 76.320."""
    drive = race(70.0, lap, lap + 1.0)
    assert rung(drive, "Torcs-v0", "car1-trb1", "aalborg") == expected


def test_who_does_not_finish_stands_nowhere_and_who_drives_elsewhere_no_higher_than_finishing():
    assert rung(race(70.0, 60.0, end="off_track"), "Torcs-v0", "car1-trb1", "aalborg") == ""
    fast = race(70.0, 60.0, 60.0)
    assert rung(fast, "TorcsLite-v0", "car1-trb1", "aalborg") == "finishes"
    assert rung(fast, "Torcs-v0", "car1-ow1", "aalborg") == "finishes"
    assert rung(fast, "Torcs-v0", "car1-trb1", "somewhere") == "finishes"


def test_who_has_no_lap_is_beaten_by_whoever_finishes():
    assert SCRIPTED not in reference_laps("dirt-2")
    assert rung(race(999.0, 998.0, 998.0), "Torcs-v0", "car1-trb1", "dirt-2") == "beats scripted"


def test_better_is_three_laps_then_the_time_then_the_way():
    slow, fast = race(99.0, 98.0, 98.0), race(97.0, 98.0, 98.0)
    near, far = race(end="stuck", distance=900.0), race(90.0, end="off_track", distance=5000.0)
    assert merit([fast]) > merit([slow]) > merit([far]) > merit([near])
    assert merit([slow, near]) > merit([far, far])


def test_all_tracks_of_the_game_are_on_the_ladder(game):
    rows = [line.split(",") for line in REFERENCE_FILE.read_text().splitlines()[2:]]
    assert {row[0] for row in rows} == {name.rpartition("/")[2] for name in game.tracks()}
    assert {(row[0], row[1]) for row in rows} == {
        (track.name, driver) for track in available_tracks() for driver in (SCRIPTED, *ROBOTS)
    }


@pytest.mark.usefixtures("game")
def test_the_shipped_laps_are_what_the_engine_drives(monkeypatch, tmp_path, capsys):
    out = tmp_path / "laps.csv"
    words = ["reference_laps.py", "--tracks", "dirt/dirt-1", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", words)
    runpy.run_path(str(TOOLS / words[0]), run_name="__main__")
    shipped = REFERENCE_FILE.read_text().splitlines()
    measured = out.read_text().splitlines()
    assert measured[:2] == shipped[:2]
    assert measured[2:] == [line for line in shipped if line.startswith("dirt-1,")]
    assert "dirt/dirt-1: inferno" in capsys.readouterr().out
