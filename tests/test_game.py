"""Where the game is, what it holds, and what is said when a part of it is missing."""

from __future__ import annotations

from pathlib import Path

import fake_game
import pytest
from fake_game import write_game

from sb3_torcs.errors import (
    BackendUnavailable,
    GameIncomplete,
    GameNotFound,
    TrackNotFound,
    UnknownCar,
    UnknownRobot,
)
from sb3_torcs.torcs import installation as game_module
from sb3_torcs.torcs.installation import RobotEntry, find_game, torcs_folders
from sb3_torcs.torcs.track_names import find_track


@pytest.fixture
def nowhere(monkeypatch, tmp_path):
    """No game is named, none is in the system, and the user's folder is empty."""
    monkeypatch.delenv("SB3_TORCS_HOME", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr(game_module, "SYSTEM_ROOTS", (tmp_path / "usr", tmp_path / "usr/local"))


class TestSearch:
    @pytest.mark.parametrize("prefix", ["", "usr", "usr/local"])
    @pytest.mark.parametrize(
        "libraries", ["lib/torcs", "lib/x86_64-linux-gnu/torcs", "lib64/torcs"]
    )
    def test_a_root_is_searched_in_all_layouts(self, tmp_path, prefix, libraries):
        write_game(tmp_path / prefix, libraries)
        found = find_game(tmp_path)
        assert found.root == tmp_path / prefix
        assert found.data == tmp_path / prefix / "share/games/torcs"
        assert found.libraries == tmp_path / prefix / libraries
        assert (found.program, found.extra_libraries) == (None, None)
        assert found.library_path == (found.libraries / "lib",)

    def test_the_folder_of_data_names_the_game_too(self, tmp_path):
        write_game(tmp_path, "lib/x86_64-linux-gnu/torcs")
        found = find_game(tmp_path / "share/games/torcs")
        assert found.libraries == tmp_path / "lib/x86_64-linux-gnu/torcs"

    def test_one_folder_can_hold_everything(self, tmp_path):
        write_game(tmp_path, libraries=".", data=".")
        assert find_game(tmp_path).data == find_game(tmp_path).libraries == tmp_path

    def test_the_variable_is_obeyed_and_nothing_else_is_looked_at(self, tmp_path, monkeypatch):
        monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
        write_game(tmp_path / "sb3-torcs" / "torcs" / "usr")
        monkeypatch.setenv("SB3_TORCS_HOME", str(tmp_path / "elsewhere"))
        assert torcs_folders() == []
        with pytest.raises(GameNotFound, match=r"elsewhere, which SB3_TORCS_HOME names; expected"):
            find_game()
        write_game(tmp_path / "elsewhere")
        assert find_game().root == tmp_path / "elsewhere"
        assert torcs_folders() == [tmp_path / "elsewhere/share/games/torcs"]

    def test_the_system_goes_before_the_users_own(self, tmp_path, nowhere):
        write_game(tmp_path / "data/sb3-torcs/torcs/usr")
        own = tmp_path / "data/sb3-torcs/torcs/usr/share/games/torcs"
        assert find_game().data == own
        write_game(tmp_path / "usr/local")
        assert find_game().root == tmp_path / "usr/local"
        assert torcs_folders() == [tmp_path / "usr/local/share/games/torcs", own]

    def test_a_whole_game_goes_before_half_of_one(self, tmp_path, nowhere):
        """And tracks and physics come from the same one."""
        write_game(tmp_path / "usr")
        (tmp_path / "usr/lib/torcs/lib/libtgf.so").unlink()
        with pytest.raises(GameIncomplete, match=r"usr/lib/torcs/lib/libtgf\.so"):
            find_game()
        write_game(tmp_path / "data/sb3-torcs/torcs")
        assert find_game().root == tmp_path / "data/sb3-torcs/torcs"
        assert torcs_folders()[0] == find_game().data

    def test_libraries_unpacked_beside_the_game_are_extra(self, tmp_path):
        write_game(tmp_path, "lib/x86_64-linux-gnu/torcs")
        plib = tmp_path / "lib/x86_64-linux-gnu/libplibsg.so.1"
        plib.write_text("")
        (tmp_path / "lib/x86_64-linux-gnu/torcs/modules/simu/simuv2.so").write_bytes(
            b"\x7fELF\0libplibsg.so.1\0"
        )
        found = find_game(tmp_path)
        assert found.extra_libraries == plib.parent
        assert found.library_path == (found.libraries / "lib", plib.parent)

    def test_the_installed_game_is_whole(self, game):
        assert len(game.tracks()) >= 38
        assert len(game.cars()) >= 17
        assert {"inferno", "berniw", "bt", "olethros", "tita", "lliaw"} <= set(game.robots())
        assert game.find_robot("inferno", 3) == RobotEntry(3, "inferno 3", "car1-trb1")


class TestMissingParts:
    def test_nothing_at_all_says_what_to_type(self, tmp_path):
        with pytest.raises(GameNotFound, match=r"no TORCS in .*; type: `sb3-torcs install-torcs`"):
            find_game(tmp_path)
        assert issubclass(GameNotFound, BackendUnavailable)
        assert issubclass(GameIncomplete, BackendUnavailable)

    def test_no_game_anywhere_names_the_places(self, tmp_path, nowhere):
        with pytest.raises(GameNotFound) as caught:
            find_game()
        places = f"neither in {tmp_path}/usr nor in {tmp_path}/usr/local nor in {tmp_path}/data"
        assert f"TORCS is not installed, {places}" in str(caught.value)
        assert str(caught.value).endswith("; type: `sb3-torcs install-torcs`")

    @pytest.mark.parametrize(
        "missing",
        [
            "lib/torcs/lib/libtgf.so",
            "lib/torcs/modules/track/track.so",
            "lib/torcs/modules/simu/simuv2.so",
            "share/games/torcs/data/tracks/surfaces.xml",
        ],
    )
    def test_each_missing_file_is_named(self, tmp_path, missing):
        write_game(tmp_path)
        (tmp_path / missing).unlink()
        with pytest.raises(GameIncomplete, match=rf"missing {tmp_path / missing}; type"):
            find_game(tmp_path)

    def test_all_that_is_missing_is_named_at_once(self, tmp_path):
        fake_game.write(tmp_path / "share/games/torcs/tracks/readme", "")
        with pytest.raises(GameIncomplete) as caught:
            find_game(tmp_path)
        for part in ("surfaces.xml", "any track", "any car", "its libraries"):
            assert part in str(caught.value)

    def test_libraries_without_data_are_half_a_game(self, tmp_path):
        write_game(tmp_path)
        (tmp_path / "share").rename(tmp_path / "other")
        with pytest.raises(GameIncomplete, match=r"missing its data"):
            find_game(tmp_path)

    def test_a_plib_that_no_process_would_find_is_missing(self, tmp_path):
        write_game(tmp_path)
        module = tmp_path / "lib/torcs/modules/simu/simuv2.so"
        module.write_bytes(b"\0libplibnone.so.7\0libc.so.6\0")
        with pytest.raises(GameIncomplete, match=r"missing plib \(libplibnone\.so\.7\)"):
            find_game(tmp_path)

    def test_data_without_libraries_still_give_tracks(self, tmp_path, monkeypatch):
        write_game(tmp_path)
        (tmp_path / "lib").rename(tmp_path / "other")
        monkeypatch.setenv("SB3_TORCS_HOME", str(tmp_path))
        assert torcs_folders() == [tmp_path / "share/games/torcs"]
        with pytest.raises(GameIncomplete, match=r"SB3_TORCS_HOME name another folder, or unset"):
            find_game()


class TestContents:
    @pytest.fixture
    def fake(self, tmp_path):
        return find_game(write_game(tmp_path))

    def test_tracks_cars_and_robots_are_listed(self, fake):
        assert list(fake.tracks()) == ["dirt/mud-1", "road/loop"]
        assert list(fake.cars()) == ["big", "small"]
        # Neither people nor descriptions without a module are robots.
        drivers = [RobotEntry(3, "Three", "small"), RobotEntry(10, "Ten", "big")]
        assert fake.robots() == {"racer": drivers}

    @pytest.mark.parametrize("name", ["mud-1", "dirt/mud-1"])
    def test_a_track_has_a_short_and_a_full_name(self, fake, name):
        assert find_track(name, fake).name == "dirt/mud-1"

    def test_a_mistyped_name_is_recognised(self, fake):
        with pytest.raises(TrackNotFound, match=r"no track 'lop'; did you mean 'loop'\?"):
            find_track("lop", fake)
        with pytest.raises(UnknownCar, match=r"no car 'bigg'; did you mean 'big'\?"):
            fake.find_car("bigg")
        with pytest.raises(
            UnknownRobot, match=r"no robot 'racr'; did you mean 'racer'\? `sb3-torcs drivers`"
        ):
            fake.find_robot("racr", 3)
        with pytest.raises(UnknownRobot, match=r"no robot 'human'"):
            fake.find_robot("human", 3)
        with pytest.raises(UnknownRobot, match=r"robot 'racer' has no index 1; it has 3, 10"):
            fake.find_robot("racer", 1)

    @pytest.mark.parametrize("name", ["loop", "road/loop"])
    def test_a_track_without_its_file_is_half_an_installation(self, fake, name):
        fake.tracks()["road/loop"].unlink()
        with pytest.raises(GameIncomplete, match=r"loop' has no .*loop\.xml; type: `sb3-torcs"):
            find_track(name, fake)

    def test_a_broken_description_is_named(self, fake):
        fake_game.write(fake.data / "drivers/racer/racer.xml", "<params")
        with pytest.raises(GameIncomplete, match=r"racer\.xml, line 1: this is not well-formed"):
            fake.robots()

    def test_the_linkers_cache_is_read_and_may_be_absent(self, tmp_path, monkeypatch):
        cache = tmp_path / "cache"
        cache.write_bytes(b"libone.so.1\0/lib/libone.so.1\0")
        monkeypatch.setattr(game_module, "LINKER_CACHE", cache)
        assert game_module.linker_knows("libone.so.1")
        assert not game_module.linker_knows("libone.so")
        monkeypatch.setattr(game_module, "LINKER_CACHE", Path("/nonexistent"))
        assert not game_module.linker_knows("libone.so.1")
