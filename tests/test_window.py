"""The game's window: straight into the race, and out again."""

from __future__ import annotations

import dataclasses
import os
import re
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from processes import PATIENCE, gone, runs
from viewers import ESCAPE, LAP, SIZE, Viewer, shown

from sb3_torcs.errors import GameFailed, GameIncomplete, InvalidOption
from sb3_torcs.torcs import window as game_window
from sb3_torcs.torcs.display import VirtualDisplay
from sb3_torcs.torcs.process import GameProcess
from sb3_torcs.torcs.window import VIEWS, Window, window_arguments, window_files
from sb3_torcs.tracks.trial import check_track

pytestmark = pytest.mark.usefixtures("nothing_is_left")


@contextmanager
def race_of_another_process():
    """Somebody who shows a race: his process, the numbers of game and display, the folder."""
    code = (
        "import sys; sys.path.insert(0, 'tests')\n"
        "from viewers import shown, Viewer\n"
        "from sb3_torcs.torcs.display import VirtualDisplay\n"
        "from sb3_torcs.torcs.installation import find_game\n"
        f"display = VirtualDisplay({SIZE})\n"
        "process = shown(find_game(), display)\n"
        "Viewer(display.name).wait_for_a_race()\n"
        "print(process.pid, display.pid, process.folder, flush=True)\n"
        "input()\n"
    )
    call = [sys.executable, "-c", code]
    root = Path(__file__).parent.parent
    with subprocess.Popen(call, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=root) as owner:
        game, display, folder = owner.stdout.readline().decode().split()
        yield owner, int(game), int(display), Path(folder)


class TestSettings:
    def values(self, game, window, file, section):
        root = ElementTree.fromstring(window_files(game, window)[file])
        for name in section.split("/"):
            root = root.find(f"section[@name='{name}']")
        return {value.get("name"): value.get("val") for value in root if value.tag != "section"}

    def test_the_window_has_its_size_and_is_no_whole_screen(self, game):
        values = self.values(game, Window((640, 360)), "config/screen.xml", "Screen Properties")
        assert (values["x"], values["y"]) == ("640", "360")
        assert (values["window width"], values["window height"]) == ("640", "360")
        assert values["fullscreen"] == "no"

    @pytest.mark.parametrize("view", VIEWS)
    def test_a_view_is_one_of_the_games_cameras(self, game, view):
        window = Window(view=view, driver="scr_server 0")
        values = self.values(game, window, "config/graph.xml", "Display Mode/0")
        assert (int(values["camera head list"]), int(values["camera"])) == VIEWS[view]
        assert values["current driver"] == "scr_server 0"
        assert values["driver board"] == "2"  # the one with the driver's messages

    def test_a_video_is_silent(self, game, monkeypatch):
        monkeypatch.setenv("PULSE_SERVER", "somewhere")
        for window, state in ((Window(), "openal"), (Window(frames=5), "disabled")):
            values = self.values(game, window, "config/sound.xml", "Sound Settings")
            assert values["state"] == state

    def test_without_a_device_there_is_no_sound(self, game, monkeypatch):
        monkeypatch.setattr(game_window, "_has_sound", lambda: False)
        values = self.values(game, Window(), "config/sound.xml", "Sound Settings")
        assert values["state"] == "disabled"

    def test_the_game_finds_the_users_display(self, game, monkeypatch, tmp_path):
        monkeypatch.delenv("XAUTHORITY", raising=False)
        monkeypatch.setenv("HOME", str(tmp_path))
        (tmp_path / ".Xauthority").touch()
        environment = window_arguments(game, Window(display=":7"))["environment"]
        assert environment["DISPLAY"] == ":7"
        assert environment["XAUTHORITY"] == str(tmp_path / ".Xauthority")
        assert "SB3_TORCS_FRAMES" not in environment

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"view": "behnd"}, r"no view 'behnd'; did you mean 'behind'\?"),
            *[({"size": size}, "expected 64 to 4096 pixels")
              for size in ((0, 480), (640, -1), (100_000, 480))],
        ],
    )  # fmt: skip
    def test_a_window_that_cannot_be_had_is_an_error(self, options, message):
        with pytest.raises(InvalidOption, match=message):
            Window(**options)

    def test_a_game_without_its_settings_is_an_error(self, game, tmp_path):
        (tmp_path / "config").mkdir()
        (tmp_path / "config" / "screen.xml").write_text("<params")
        with pytest.raises(GameIncomplete, match=r"screen\.xml cannot be read.*install-torcs"):
            window_files(dataclasses.replace(game, data=tmp_path), Window())

    def test_the_documentation_names_the_views(self):
        page = Path(__file__).parent.parent / "docs" / "window.md"
        (named,) = re.findall(r"views by name: (.*?)\.\n", page.read_text(), re.DOTALL)
        assert re.findall(r"`(\w+)`", named) == list(VIEWS)


class TestTheWindow:
    @pytest.mark.parametrize("escapes", [True, False])
    def test_it_opens_in_the_race_and_escape_or_its_cross_ends_it(self, game, escapes):
        with (
            VirtualDisplay(SIZE) as display,
            shown(game, display) as process,
            Viewer(display.name) as viewer,
        ):
            first = viewer.wait_for_a_race()
            assert gone(lambda: np.abs(viewer.look() - first).mean() <= 10), "nothing moves"
            viewer.press(ESCAPE) if escapes else viewer.close_window()
            process.wait(PATIENCE)
            assert list((process.folder / "results" / "race").glob("*.xml"))

    def test_without_a_display_it_says_so(self, game):
        window = Window(SIZE, display=":2999")
        with GameProcess(game, LAP, check=check_track, **window_arguments(game, window)) as process:
            with pytest.raises(GameFailed, match="failed to open display ':2999'"):
                process.wait(PATIENCE)

    def test_it_removes_no_folder_but_its_own(self, game, tmp_path):
        precious = tmp_path / "precious"
        precious.mkdir()
        with VirtualDisplay(SIZE) as display:
            arguments = window_arguments(game, Window(SIZE, display=display.name))
            # No process has this number: as if the owner were gone.
            gone = {"SB3_TORCS_OWNER": "999999999", "SB3_TORCS_FOLDER": str(precious)}
            arguments["environment"] |= gone
            with GameProcess(game, LAP, check=check_track, **arguments) as process:
                with pytest.raises(GameFailed, match="exit status 1"):
                    process.wait(PATIENCE)
                assert process.folder.exists()
        assert precious.exists()

    def test_it_goes_with_the_process_that_started_it(self):
        with race_of_another_process() as (owner, game, display, folder):
            owner.kill()
        assert gone(lambda: runs(game), folder.exists, lambda: runs(display))

    def test_it_goes_with_a_session_that_ends(self):
        """The display first, and the process that started the game just after it."""
        with race_of_another_process() as (owner, game, display, folder):
            os.kill(display, signal.SIGTERM)
            owner.kill()
        assert gone(lambda: runs(game), folder.exists)
