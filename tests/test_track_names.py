"""What the name of a track means: without a game, and in one."""

from __future__ import annotations

import copy
import pickle
import shutil
from pathlib import Path

import gymnasium as gym
import pytest
from fake_game import write_game

from sb3_torcs.agents.saved.writing import recipe
from sb3_torcs.errors import InvalidOption, TrackNotFound
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.track_names import (
    BUNDLED_FOLDER,
    TrackFile,
    find_track,
    known_tracks,
    stable_track,
)


@pytest.fixture
def fake(tmp_path):
    return find_game(write_game(tmp_path))


@pytest.mark.parametrize("name", ["aalborg", "road/aalborg"])
def test_without_a_game_a_name_is_a_bundled_track_first(name):
    path = BUNDLED_FOLDER / "road" / "aalborg.csv"
    assert find_track(name) == TrackFile(path, "bundled", "road/aalborg")


def test_in_a_game_a_name_is_a_track_of_it_alone(fake):
    path = fake.data / "tracks/road/loop/loop.xml"
    assert find_track("loop", fake) == TrackFile(path, "torcs", "road/loop")
    assert list(known_tracks(fake)) == ["dirt/mud-1", "road/loop"]
    with pytest.raises(TrackNotFound, match=f"^no track 'aalborg'; .*has those of {fake.data}"):
        find_track("aalborg", fake)


def test_a_path_is_a_file_in_both(fake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine.XML").touch()
    found = TrackFile(tmp_path / "mine.XML", "file", "mine")
    assert find_track("mine.XML") == find_track(Path("mine.XML"), fake) == found


def test_a_folder_is_answered_by_the_file_in_it(fake, tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "mine.xml").touch()
    for game in (None, fake):
        with pytest.raises(TrackNotFound, match=rf"is a folder: .*'{folder / 'mine.xml'}'$"):
            find_track(str(folder), game)


def test_our_own_files_are_not_for_the_game(fake, tmp_path):
    path = tmp_path / "mine.csv"
    path.touch()
    assert find_track(path).source == "file"
    with pytest.raises(TrackNotFound, match=r"mine\.csv' is a file for TorcsLite-v0; .*xml files$"):
        find_track(path, fake)


def test_a_file_that_was_found_is_not_looked_for_again(fake):
    found = find_track("loop", fake)
    found.path.unlink()
    assert find_track(found, fake) is found


@pytest.mark.parametrize("track", ["random", 7, None, ["aalborg"]])
def test_what_is_no_file_is_told(fake, track):
    with pytest.raises(InvalidOption, match="expected a name"):
        find_track(track)
    with pytest.raises(InvalidOption, match="Torcs-v0 takes the name of an installed track"):
        find_track(track, fake)


def test_a_file_without_a_track_s_ending_is_told_so(fake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ring").touch()
    for game in (fake, None):
        with pytest.raises(TrackNotFound, match=r"file 'ring', and a track's ends in \.xml or"):
            find_track("ring", game)


def test_a_path_means_the_same_in_another_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(BUNDLED_FOLDER / "road" / "aalborg.csv", "mine.csv")
    env = gym.make("TorcsLite-v0", track=["mine.csv", "aalborg"])
    env.reset(seed=0)
    monkeypatch.chdir("/")
    copy.deepcopy(env).reset(seed=0)
    pickle.loads(pickle.dumps(env)).reset(seed=0)
    assert stable_track(["~/a.xml", "aalborg"]) == [str(Path("~/a.xml").expanduser()), "aalborg"]


def test_a_path_means_the_same_for_the_game_s_own_process(game, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(find_track("g-track-1", game).path, "mine.xml")
    env = gym.make("Torcs-v0", track="mine.xml", backend="scr")
    monkeypatch.chdir("/")
    env.reset(seed=0)
    env.close()


def test_a_record_names_the_whole_path_of_a_track(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    asked = {"env_kwargs": {"track": "mine.xml"}}
    assert recipe("ppo", "Torcs-v0", asked)["env_kwargs"] == {"track": str(tmp_path / "mine.xml")}
