"""What the game drives, we drive: track files as people write them, and robots' laps there."""

from __future__ import annotations

import re

import pytest
from game_copy import copy_game, replace
from text_mode import run as run_game

from sb3_torcs.agents.robots import race
from sb3_torcs.backends.lite.backend import LiteBackend
from sb3_torcs.backends.native import NativeBackend
from sb3_torcs.errors import TrackFileError
from sb3_torcs.torcs.installation import find_game

WEATHER = '<section name="Weather"><attnum name="station" val="{}"/></section>'
PLACES = r'(<attstr name="(?:entry|start|end|exit)" +val=")[^"]*"'
NO_PITS = (PLACES, r'\g<1>"')
CHANGES = {
    "pits without a place": [NO_PITS, (r'(name="length"[^>]*val=")[^"]*"', r'\g<1>0"')],
    "pits at no segment": [(PLACES, r'\g<1>here"')],
    "text for a number": [("</params>", WEATHER.format("LOWS") + "</params>")],
    "unknown unit": [("</params>", WEATHER.format('3" unit="bar') + "</params>")],
    "negative width": [NO_PITS, (r'(name="end width"[^>]*val=")[^"]*"', r'\g<1>-0.5"')],
    "very negative width": [NO_PITS, (r'(name="end width"[^>]*val=")[^"]*"', r'\g<1>-20"')],
}


def laps_of(result):
    return [(round(1000.0 * lap.time), lap.damage) for lap in result.laps]


def rewritten(text, changes):
    for pattern, new in changes:
        text, found = re.subn(pattern, new, text)
        assert found, f"{pattern} is not there"
    return text


@pytest.fixture(scope="module")
def written(game, tmp_path_factory):
    """A game that has a changed aalborg for each kind of file, and their paths."""
    root = copy_game(game, tmp_path_factory.mktemp("game"))
    text = game.tracks()["road/aalborg"].read_text(encoding="utf-8", errors="replace")
    tracks = root / "share/games/torcs/tracks/road"
    paths = {}
    for kind, changes in CHANGES.items():
        name = kind.replace(" ", "-")
        paths[kind] = replace(tracks / name / f"{name}.xml", rewritten(text, changes))
    return root / "share/games/torcs", paths


@pytest.mark.parametrize("kind", CHANGES)
def test_a_robot_s_laps_are_those_of_the_game(written, monkeypatch, kind):
    home, paths = written
    robot = ("inferno", 1)
    (ours,) = race([robot], paths[kind], 2)
    monkeypatch.setenv("SB3_TORCS_HOME", str(home))
    (theirs,) = run_game(find_game(), f"road/{paths[kind].stem}", [robot], 2)
    assert len(ours.laps) == 2
    assert laps_of(ours) == laps_of(theirs)


@pytest.mark.parametrize("kind", CHANGES)
def test_both_worlds_read_it(written, kind):
    for world in (NativeBackend, LiteBackend):
        world(written[1][kind])


@pytest.mark.parametrize("name", ["lg", "radius", "friction"])
def test_a_number_that_is_read_has_to_be_one(written, tmp_path, name):
    text = written[1]["text for a number"].read_text(encoding="utf-8")
    path = tmp_path / "words.xml"
    path.write_text(rewritten(text, [(rf'(name="{name}"[^>]*val=")[^"]*"', r'\g<1>LOWS"')]))
    with pytest.raises(TrackFileError, match=rf"{path}, line \d+: 'LOWS' is not a finite number"):
        LiteBackend(path)


def test_a_folder_of_one_s_own_may_be_called_as_those_of_the_game(game, tmp_path):
    """The game's loader opens the shared surfaces relative to the track's file."""
    path = tmp_path / "data/tracks/mine/aalborg/aalborg.xml"
    path.parent.mkdir(parents=True)
    text = game.tracks()["road/aalborg"].read_text(encoding="utf-8", errors="replace")
    path.write_text(text + "<!-- mine -->", encoding="utf-8")
    NativeBackend(path)
