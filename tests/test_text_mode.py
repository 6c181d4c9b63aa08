"""Races by the installed game's own text mode, and what happens when it misbehaves."""

from __future__ import annotations

import dataclasses
import os
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import text_mode
from fake_game import write, write_game, write_program
from text_mode import run

from sb3_torcs.errors import (
    GameFailed,
    GameIncomplete,
    GameTimeout,
    InvalidOption,
    TrackFileError,
    TrackNotFound,
    UnknownCar,
    UnknownRobot,
)
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.libraries import missing_libraries
from sb3_torcs.torcs.process import game_environment
from sb3_torcs.torcs.race_results import Lap
from sb3_torcs.torcs.race_setup import RaceSetup
from sb3_torcs.torcs.results import read_results

pytestmark = pytest.mark.usefixtures("nothing_is_left")


@pytest.fixture
def tracks_that_nobody_reads(monkeypatch):
    """Those of the game that is made here are empty; whether they can be driven is not asked."""
    monkeypatch.setattr(text_mode, "check_track", lambda game, race, file: None)


class TestTheGame:
    def test_a_practice_gives_every_lap(self, game):
        (result,) = run(game, "aalborg", [("inferno", 3)])
        assert result.laps == [Lap(81.486, 0), Lap(76.32, 0), Lap(76.354, 0)]
        assert (result.robot, result.index, result.car) == ("inferno", 3, "car1-trb1")
        assert (result.rank, result.damage, result.out) == (1, 0, False)
        assert result.total_time == pytest.approx(234.16, abs=1e-9)
        assert (result.laps_completed, result.best_lap) == (3, 76.32)

    def test_a_practice_without_fuel_use_gives_known_times(self, game, tmp_path):
        """With another description of the race, in which no fuel is used."""
        data = tmp_path / "data"
        data.mkdir()
        for path in game.data.iterdir():
            if path.name != "config":
                (data / path.name).symlink_to(path)
        for name in ("raceengine.xml", "raceman/practice.xml"):
            write(data / "config" / name, (game.data / "config" / name).read_text("latin-1"))
        practice = data / "config/raceman/practice.xml"
        text = practice.read_text("utf-8").replace('max="5.0" val="1.0"', 'max="5.0" val="0.0"')
        practice.write_text(re.sub(r'(name="rows" +val=)"1"', r'\1"2"', text), "utf-8")
        (result,) = run(dataclasses.replace(game, data=data), "road/aalborg", [("inferno", 3)])
        assert (result.laps[0].time, min(lap.time for lap in result.laps)) == (81.566, 76.424)

    def test_a_race_gives_order_times_and_damage(self, game):
        robots = [("inferno", 3), ("sparkle", 0), ("berniw", 3)]
        results = run(game, "a-speedway", robots, laps=2, session="race")
        assert [result.rank for result in results] == [1, 2, 3]
        assert {(result.robot, result.index) for result in results} == set(robots)
        assert [result.robot for result in results][-1] == "sparkle"
        times = [result.total_time for result in results if result.laps_completed == 2]
        assert times == sorted(times)
        assert times[0] > 0.0
        assert all(result.laps == [] and not result.out for result in results)

    def test_twice_is_the_same(self, game):
        """Robots that learn begin anew each time."""
        assert run(game, "aalborg", [("bt", 2)], laps=2) == run(
            game, "aalborg", [("bt", 2)], laps=2
        )

    def test_nothing_of_the_users_is_touched_or_needed(self, game, tmp_path, monkeypatch):
        home = tmp_path / "home"
        write(home / ".torcs" / "config" / "raceengine.xml", "broken")
        monkeypatch.setenv("HOME", str(home))
        monkeypatch.delenv("DISPLAY", raising=False)
        before = Path.cwd()
        assert run(game, "g-track-1", [("inferno", 3)], laps=1)[0].laps_completed == 1
        assert Path.cwd() == before
        assert [path.name for path in (home / ".torcs").rglob("*")] == ["config", "raceengine.xml"]

    def test_its_program_finds_all_libraries(self, game):
        assert missing_libraries(game) == []

    def test_a_robot_whose_library_does_not_load_is_an_error(self, game, tmp_path):
        libraries = tmp_path / "libraries"
        for name in ("lib", "modules"):
            libraries.mkdir(exist_ok=True)
            (libraries / name).symlink_to(game.libraries / name)
        write(libraries / "drivers" / "inferno" / "inferno.so", "no library")
        with pytest.raises(GameFailed, match=r"it last said: .*inferno\.so: file too short"):
            run(dataclasses.replace(game, libraries=libraries), "aalborg", [("inferno", 3)])


@pytest.mark.usefixtures("tracks_that_nobody_reads")
class TestRefusals:
    """All of it is refused before the game is started: here it would not even run."""

    @pytest.fixture
    def fake(self, tmp_path):
        root = write_game(tmp_path / "game")
        write(root / "lib/torcs/torcs-bin", "no program")
        return find_game(root)

    def test_a_track_that_does_not_exist(self, fake):
        with pytest.raises(TrackNotFound, match="did you mean 'loop'"):
            run(fake, "looop", [("racer", 3)])

    def test_a_robot_that_does_not_exist(self, fake):
        with pytest.raises(UnknownRobot, match="did you mean 'racer'"):
            run(fake, "loop", [("racerr", 3)])
        with pytest.raises(UnknownRobot, match="has no index 4"):
            run(fake, "loop", [("racer", 4)])

    def test_a_robot_whose_car_is_missing(self, fake):
        fake.cars()["small"].unlink()
        with pytest.raises(UnknownCar, match="index 3 drives 'small', a car that the game"):
            run(fake, "loop", [("racer", 3)])

    @pytest.mark.parametrize(
        ("robots", "changes", "message"),
        [
            ([("racer", 3), ("racer", 10)], {}, r"a practice is for one robot, but 2 are named"),
            ([], {"session": "race"}, "no robot is named; name at least one"),
            ([("racer", 3)] * 2, {"session": "race"}, r"robot 'racer:3' is named twice"),
            (
                [("racer", n) for n in range(21)],
                {"session": "race"},
                r"21 cars are named; a grid of the game has room for 20",
            ),
            (
                [("racer", 3)],
                {"laps": 0},
                r"laps is 0; expected .* from 1 to 1073741824",
            ),
            (
                [("racer", 3)],
                {"session": "duel"},
                r"session is 'duel'; expected 'practice' or 'race'",
            ),
        ],
    )
    def test_what_no_session_can_be(self, fake, robots, changes, message):
        with pytest.raises(InvalidOption, match=message):
            run(fake, "loop", robots, **changes)

    def test_a_game_without_its_program(self, fake):
        with pytest.raises(GameIncomplete, match=r"has no torcs-bin, .*type: `sb3-torcs install"):
            run(dataclasses.replace(fake, program=None), "loop", [("racer", 3)])
        assert missing_libraries(dataclasses.replace(fake, program=None)) == []

    @pytest.mark.parametrize("name", ["raceengine.xml", "raceman/practice.xml"])
    def test_a_game_without_its_settings(self, fake, name):
        (fake.data / "config" / name).unlink()
        with pytest.raises(GameIncomplete, match=rf"there is no .*{name}"):
            run(fake, "loop", [("racer", 3)])

    @pytest.mark.parametrize("text", ["<params", "<params/>"])
    def test_broken_settings(self, fake, text):
        write(fake.data / "config/raceman/practice.xml", text)
        with pytest.raises(GameIncomplete, match=r"practice\.xml is broken \("):
            run(fake, "loop", [("racer", 3)])

    def test_a_program_that_is_none(self, fake):
        fake.program.chmod(0o755)
        with pytest.raises(GameFailed, match=r"torcs-bin does not run: Exec format error"):
            run(fake, "loop", [("racer", 3)])


@pytest.mark.usefixtures("tracks_that_nobody_reads")
class TestMisbehaviour:
    """Programs in the place of the game."""

    @pytest.fixture
    def play(self, tmp_path):
        def play(code, **changes):
            root = write_game(tmp_path / "game")
            write_program(root / "lib/torcs/torcs-bin", code)
            return run(find_game(root), "mud-1", [("racer", 3)], **changes)

        return play

    def test_a_game_that_hangs_is_stopped(self, play):
        code = "import time\nprint('waiting', flush=True)\ntime.sleep(60)"
        with pytest.raises(GameTimeout, match=r"within 5 s and was stopped; .* said: waiting"):
            play(code, timeout=5.0)

    def test_a_game_that_crashes_gives_its_last_lines(self, play):
        code = "import os\nfor n in range(20): print('line', n, flush=True)\nos.abort()"
        with pytest.raises(GameFailed, match=r"ended with SIGABRT; .*: line 15 / .* / line 19$"):
            play(code)

    def test_a_game_that_fails_gives_its_status(self, play):
        with pytest.raises(GameFailed, match=r"exit status 3; it last said: nothing"):
            play("raise SystemExit(3)")

    def test_a_game_without_results_is_an_error(self, play):
        with pytest.raises(GameFailed, match="ended without results; it last said: bye"):
            play("print('bye')")

    def test_the_game_reads_what_was_asked_for(self, play):
        code = (
            "import os, sys\nargs = dict(zip(sys.argv[1::2], sys.argv[2::2]))\n"
            "print(open(args['-r']).read().replace('\\n', ' '))\n"
            "settings = args['-l'] + '/config/raceengine.xml'\n"
            "print(os.getcwd() == args['-D'], os.path.isfile(settings))\n"
            "print(sorted(os.environ.items()), args['-L'])\nraise SystemExit(1)"
        )
        with pytest.raises(GameFailed) as caught:
            play(code, laps=7)
        said = str(caught.value)
        assert '<section name="1"><attstr name="name" val="mud-1" />' in said
        assert '<attstr name="category" val="dirt" />' in said
        assert '<attnum name="laps" val="7" />' in said
        assert '<attnum name="idx" val="3" /><attstr name="module" val="racer" />' in said
        assert "human" not in said
        assert " True True " in said

    def test_a_robot_that_is_out_has_fewer_laps(self, play):
        code = RESULTS.format(
            rows='<section name="1"><attnum name="time" val="50.5"/>'
            '<attnum name="dammages" val="9000"/></section>'
        )
        (result,) = play(code)
        assert result.laps == [Lap(50.5, 9000)]
        assert (result.out, result.damage, result.best_lap) == (True, 9000, None)

    def test_a_robot_that_never_came_round_has_none(self, play):
        (result,) = play(RESULTS.format(rows=""))
        assert (result.laps, result.out, result.damage, result.total_time) == ([], True, 0, 0.0)


RESULTS = """
import pathlib, sys
folder = pathlib.Path(sys.argv[sys.argv.index("-l") + 1]) / "results" / "race"
folder.mkdir(parents=True)
(folder / "results-1.xml").write_text('''<params><section name="Header"/><section name="A/B">
<section name="Results"><section name="Practice">{rows}</section></section></section></params>''')
"""


def row(rank, module, laps, time, penalty=0.0):
    values = {"idx": 3, "laps": laps, "time": time, "penaltytime": penalty, "dammages": 1}
    numbers = "".join(f'<attnum name="{key}" val="{value}"/>' for key, value in values.items())
    return f'<section name="{rank}"><attstr name="module" val="{module}"/>{numbers}</section>'


def test_who_is_lapped_is_not_out_and_who_stopped_is(tmp_path, tracks_that_nobody_reads):
    """The game writes neither down: the times tell."""
    root = write_game(tmp_path / "game")
    for name in ("second", "third"):
        write(root / f"lib/torcs/drivers/{name}/{name}.so", "")
        text = (root / "share/games/torcs/drivers/racer/racer.xml").read_text()
        write(root / f"share/games/torcs/drivers/{name}/{name}.xml", text)
    rows = row(2, "second", 2, 310.0) + row(1, "racer", 3, 305.0, 5.0) + row(3, "third", 2, 290.0)
    ranks = f'<section name="Rank">{rows}</section>'
    code = RESULTS.format(rows=ranks).replace("Practice", "Quick Race")
    write_program(root / "lib/torcs/torcs-bin", code)
    robots = [("racer", 3), ("second", 3), ("third", 3)]
    results = run(find_game(root), "loop", robots, session="race")
    order = [(result.rank, result.robot, result.out) for result in results]
    assert order == [(1, "racer", False), (2, "second", False), (3, "third", True)]
    with pytest.raises(GameFailed, match="3 of 2 robots raced"):
        run(find_game(root), "loop", robots[:2], session="race")


def test_the_environment_of_the_game_holds_nothing_of_the_users(game, tmp_path, monkeypatch):
    monkeypatch.setenv("LD_LIBRARY_PATH", "/opt/lib")
    environment = game_environment(game, tmp_path)
    folders = [*map(str, game.library_path), "/opt/lib"]
    assert environment == {
        "HOME": str(tmp_path), "LC_ALL": "C", "LD_LIBRARY_PATH": os.pathsep.join(folders)
    }  # fmt: skip


def test_libraries_that_are_not_there_are_named(game):
    """Without the game's own folders its program finds none of its libraries."""
    libraries = Path("/nonexistent")
    missing = missing_libraries(
        dataclasses.replace(game, libraries=libraries, extra_libraries=None)
    )
    assert "libtgf.so" in missing


class TestOwnTracks:
    @pytest.mark.parametrize("name", ["mine.xml", "Mine.XML", "two words.xml"])
    def test_a_file_of_any_name(self, game, name, tmp_path):
        (tmp_path / name).write_bytes(game.tracks()["oval/a-speedway"].read_bytes())
        path = tmp_path / name
        assert run(game, path, [("bt", 4)], 1) == run(game, "a-speedway", [("bt", 4)], 1)

    @pytest.mark.parametrize("content", [None, "hello"])
    def test_a_file_that_is_none(self, game, content, tmp_path):
        path = tmp_path / "mine.xml"
        if content:
            path.write_text(content)
        with pytest.raises((TrackNotFound, TrackFileError), match=r"mine\.xml"):
            run(game, path, [("bt", 4)])


def test_results_that_are_cut_off_are_told(tmp_path):
    results = tmp_path / "results" / "race"
    results.mkdir(parents=True)
    (results / "results.xml").write_text("<params><sec")
    process = SimpleNamespace(folder=tmp_path, race_name="Practice", last_words=lambda: "")
    with pytest.raises(GameFailed, match=r"cut off .* is there room in"):
        read_results(process, RaceSetup("aalborg", [("bt", 4)], 1), ["car1-trb1"])
