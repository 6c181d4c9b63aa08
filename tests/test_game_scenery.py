"""Tracks outside the game's folder: drawn, or refused by the name of the file that is missing."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from processes import children

from sb3_torcs.cli import main
from sb3_torcs.errors import GameFailed, SceneryMissing
from sb3_torcs.torcs.display import VirtualDisplay
from sb3_torcs.torcs.scenery import find_scenery

GAME = {"render_mode": "rgb_array", "picture": {"size": (160, 120)}}
CORNER = {"distance": 600.0, "speed": 20.0}


def picture(track):
    env = gym.make("sb3_torcs:Torcs-v0", track=str(track), **GAME)
    env.reset(options=CORNER)
    try:
        return env.render()
    finally:
        env.close()


@pytest.fixture
def aalborg(game):
    return game.tracks()["road/aalborg"]


def changed(aalborg, path, *changes, scenery=True):
    """A copy of a track with other words in its file."""
    text = aalborg.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path.parent.mkdir(exist_ok=True)
    path.write_text(text, encoding="utf-8")
    for file in aalborg.parent.iterdir() if scenery else ():
        if file != aalborg:
            (path.parent / file.name).symlink_to(file)
    return path


OTHER_SKY = ('"background.png"', '"aalborg.png"')


@pytest.mark.parametrize("name", ["aalborg.xml", "my.xml", "MY.XML"])
@pytest.mark.parametrize("scenery", [True, False])
@pytest.mark.parametrize("category", ["road", "dirt", "mine", ""])
def test_a_track_elsewhere_has_some_scenery(game, aalborg, tmp_path, name, scenery, category):
    header = ('name="category"    val="road"', f'name="category" val="{category}"')
    track = changed(aalborg, tmp_path / "x" / name, header, scenery=scenery)
    found = find_scenery(game, track)
    assert found.place == f"{category or 'road'}/{track.stem}"
    assert found.folder == (track.parent if scenery else aalborg.parent)


@pytest.mark.parametrize("scenery", [True, False])
def test_a_copy_looks_like_the_track(aalborg, tmp_path, scenery):
    track = changed(aalborg, tmp_path / "x" / "my.xml", scenery=scenery)
    np.testing.assert_array_equal(picture(track), picture("aalborg"))


@pytest.mark.parametrize("category", ["road", "mine"])
def test_a_namesake_of_the_games_own_has_the_scenery_beside_it(aalborg, tmp_path, category):
    header = ('name="category"    val="road"', f'name="category" val="{category}"')
    track = changed(aalborg, tmp_path / "x" / "aalborg.xml", header, OTHER_SKY)
    assert (picture(track) != picture("aalborg")).any()


@pytest.mark.parametrize("name", ["road/aalborg", "dirt/mixed-1", "oval/a-speedway"])
def test_the_games_own_tracks_are_where_they_are(game, name):
    file = game.tracks()[name]
    assert find_scenery(game, file) == (name, file.parent)


def test_every_track_of_the_game_can_be_drawn(game):
    for file in game.tracks().values():
        find_scenery(game, file)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('"aalborg.acc"', '"my.acc"'), "'my.acc' is not in .*/x, nor in any folder of .*/tracks"),
        (('"aalborg.acc"', '""'), "'track.ac' is not in"),
        (('val="120.0"', 'val="121.0"'), "in .*/aalborg is of another road"),
        (('val="spline"', 'val="linear"'), "in .*/aalborg is of another road"),
        (('"background.png"', '"sky.png"'), "picture 'sky.png' is in none of .*/x, .*/aalborg, "),
        (('val="road"', 'val="../road"'), r"look for the scenery in 'tracks/\.\./road/my'"),
        (('val="road"', f'val="{"x" * 300}"'), "no room for such a long name"),
        (
            (
                '<section name="Terrain Generation">',
                '<section name="Environment Mapping"><section name="1"><attstr name="env map image"'
                ' val="x/glass.png"/></section></section><section name="Terrain Generation">',
            ),
            "picture 'glass.png' is in none of",
        ),
    ],
)
def test_what_cannot_be_drawn_is_refused_by_name(aalborg, tmp_path, change, message):
    track = changed(aalborg, tmp_path / "x" / "my.xml", change, scenery=False)
    with pytest.raises(SceneryMissing, match=message):
        gym.make("sb3_torcs:Torcs-v0", track=str(track), **GAME)
    gym.make("sb3_torcs:Torcs-v0", track=str(track)).close()  # it can be driven


@pytest.mark.parametrize(
    "words",
    [
        ["watch", "inferno"],
        ["watch", "scripted"],
        ["watch", "inferno", "--video", "lap.mp4"],
        ["watch", "scripted", "--video", "lap.mp4"],
        ["serve", "--window", "--port", "27613"],
    ],
)
def test_nobody_opens_a_window_for_it(aalborg, tmp_path, monkeypatch, capsys, words):
    change = ('"aalborg.acc"', '"my.acc"')
    track = changed(aalborg, tmp_path / "x" / "my.xml", change, scenery=False)
    monkeypatch.chdir(tmp_path)
    with VirtualDisplay((320, 240)) as display:
        monkeypatch.setenv("DISPLAY", display.name)
        before = children()
        assert main([*words, "--track", str(track)]) == 2
        assert children() == before
    (line,) = capsys.readouterr().err.splitlines()
    assert "its 3D description 'my.acc' is not in" in line
    assert list(tmp_path.glob("*.mp4")) == []


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("aalborg.acc", b"no such format"),
        ("tr-asphalt-aa-bw1_n.rgb", b""),
        ("tr-asphalt-aa-bw1_n.rgb", bytes(range(256)) * 20),
    ],
)
def test_a_broken_file_ends_in_one_line_that_says_where(aalborg, tmp_path, name, content):
    track = changed(aalborg, tmp_path / "x" / "my.xml")
    (track.parent / name).unlink()
    (track.parent / name).write_bytes(content)
    before = children()
    with pytest.raises(GameFailed, match=f"SIGSEGV.*perhaps a file .* in {track.parent} is broken"):
        picture(track)
    assert children() == before
