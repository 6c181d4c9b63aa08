"""Broken tracks of the real game: each is refused by name, and nothing crashes, hangs or stays."""

from __future__ import annotations

import os
import re
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from processes import Program, gone, runs

from sb3_torcs.backends.lite.backend import LiteBackend
from sb3_torcs.backends.native import NativeBackend
from sb3_torcs.backends.scr import ScrBackend
from sb3_torcs.errors import BackendUnavailable, TrackFileError
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.process import GameProcess
from sb3_torcs.torcs.race_setup import RaceSetup
from sb3_torcs.tracks import trial as track_trial
from sb3_torcs.tracks.catalogue import load_track
from sb3_torcs.tracks.trial import check_road, check_track, engine_arguments, try_race

pytestmark = pytest.mark.usefixtures("game")

FIRST_SEGMENT = r'(?s)(Track Segments">.*?<section name=")[^"]*'
ID_OF_NOTHING = r'\g<0><section name="nowhere"><attnum name="id" val="-7"/></section>'


@pytest.fixture
def broken(tmp_path):
    """Write a copy of one of the game's tracks in which patterns are replaced, each once."""

    def write(track, *changes):
        text = find_game().tracks()[track].read_bytes().decode("latin-1")
        for pattern, new in changes:
            text, found = re.subn(pattern, new, text, count=1)
            assert found == 1
        path = tmp_path / "broken.xml"
        path.write_bytes(text.encode("latin-1"))
        return path

    return write


def hanging(broken):
    """A track at which the game's loader looks for a segment that never comes."""
    return broken(
        "road/g-track-1",
        ('<section name="Track Segments">', ID_OF_NOTHING),
        (r'(name="fov end" +val=")[^"]*', r"\g<1>nowhere"),
    )


def crashing(broken):
    """A wall that is lower than the one beside it."""
    return broken(
        "road/wheel-1",
        (
            r'(?s)(wall-1-w1"/>\s*<attstr name="style" val="wall"/>.{0,60}height" val=")1.0',
            r"\g<1>0",
        ),
    )


@pytest.mark.parametrize(
    ("track", "pattern", "new", "message"),
    [
        ("oval/d-speedway", 'name="side" val="left"', 'name="side" val="right"',
         r"line \d+: the pits lie on the right, where segment 'pit entry' has no ground"),
        ("oval/c-speedway", '<attstr name="side" val="left"/>', "",
         r"line \d+: the pits lie on the right.*'side' of the pits, which is 'right' if"),
        ("oval/a-speedway", r'(?s)(rside width" +val=")3.0(.*"pit side" +val=")left',
         r"\g<1>0\g<2>right", r"line \d+: the pits lie on the right"),
        ("road/aalborg", r'(name="end width"[^>]*val=")[^"]*"', r'\g<1>-1001"',
         r"line \d+: 'end width' is -1001 m; -1000 to 1000 is allowed"),
        ("road/ole-road-1", FIRST_SEGMENT, r"\g<1>a/b",
         r"line \d+: <section> is named 'a/b'.*no '/'"),
        ("road/g-track-1", r'name="lg"', r'name="profil steps" val="0"/><attnum name="lg"',
         r"line \d+: .* cut into 0 steps.* 'profil steps' is 0, at least 1 is allowed"),
        ("road/g-track-1", r'(name="profil steps length"[^>]*val=")[^"]*', r"\g<1>-4",
         r"line \d+: .*'profil steps length' is -4, at least 0"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("world", [NativeBackend, LiteBackend])
def test_what_the_game_cannot_lay_is_refused(broken, world, track, pattern, new, message):
    with pytest.raises(TrackFileError, match=message):
        world(broken(track, (pattern, new)))


def test_a_crash_of_the_game_s_code_is_an_error(broken):
    path = crashing(broken)
    with pytest.raises(TrackFileError, match=rf"{path}: the game's own code crashes .*SIGSEGV"):
        NativeBackend(path)


def test_a_loader_that_never_ends_is_an_error(broken, monkeypatch):
    monkeypatch.setattr(track_trial, "COMPUTING", 1)
    path = hanging(broken)
    with pytest.raises(TrackFileError, match=rf"{path}: the game's loader does not come to an end"):
        NativeBackend(path)


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_a_signal_ends_the_wait_and_leaves_no_process(broken, end):
    code = "import sys; from sb3_torcs.backends.native import NativeBackend as N; N(sys.argv[1])"
    with Program(sys.executable, "-c", code, str(hanging(broken))) as waiting:
        children = Path(f"/proc/{waiting.pid}/task/{waiting.pid}/children")
        (trial,) = waiting.wait_for(lambda: children.read_text().split())
        assert waiting.end(end) in (-end, 1)
    assert gone(lambda: runs(int(trial)))


@pytest.mark.parametrize("spoil", [crashing, hanging])
def test_the_game_s_own_process_is_not_started_with_it(broken, monkeypatch, spoil):
    monkeypatch.setattr(track_trial, "COMPUTING", 1)
    path = spoil(broken)
    with pytest.raises(TrackFileError, match=str(path)):
        GameProcess(find_game(), RaceSetup(path, [("inferno", 3)], laps=1), check=check_track)
    with pytest.raises(TrackFileError, match=str(path)):
        ScrBackend(path).reset(np.random.default_rng(0), None)


def test_known_tracks_need_no_trial(monkeypatch):
    """All that TORCS 1.3.7 brings, by content: what somebody put beside them is tried."""
    monkeypatch.setattr(track_trial, "load_road", lambda *words: pytest.fail("was tried"))
    game = find_game()
    for path in game.tracks().values():
        arguments = {"cars": ["car1-trb1"], "session": "practice", "laps": 0}
        try_race(path, engine_arguments(game, path, [("", 0)], **arguments))


def test_a_content_is_tried_once_for_each_race(broken, monkeypatch):
    tried = []
    load = track_trial.load_road

    def noted(*words):
        tried.append(words)
        return load(*words)

    monkeypatch.setattr(track_trial, "load_road", noted)
    path = broken("road/g-track-1", (r"\Z", " "))
    for opponents in ((), (), ("bt",)):
        NativeBackend(path, opponents=opponents).close()
    assert len(tried) == 2
    path.write_bytes(path.read_bytes() + b" ")
    NativeBackend(path).close()
    assert len(tried) == 3


def test_what_is_no_fault_of_the_file_is_not_blamed_on_it(monkeypatch):
    monkeypatch.setattr(sys, "path", [])
    path = find_game().tracks()["road/g-track-1"]
    with pytest.raises(BackendUnavailable, match=r"cannot be tried .*No module named '"):
        track_trial.load_road(path, {"entries": [], "cars": []})


class TestRoad:
    """What the game has laid is held to what was read."""

    @pytest.fixture
    def laid(self):
        backend = NativeBackend("g-track-1")
        yield find_game().tracks()["road/g-track-1"], backend.engine.road()
        backend.close()

    @pytest.mark.parametrize("name", ["dirt-4", "alpine-1", "a-speedway", "spring"])
    def test_it_is_the_same(self, name):
        backend = NativeBackend(name)
        read = np.array([step[:8] for step in backend.track.steps])
        # Both add up single precision: in bends of changing radius, hundreds of steps.
        assert backend.engine.road()[:, :8] == pytest.approx(read, rel=1e-5, abs=1e-5)
        backend.close()

    def test_a_road_without_one_of_its_segments(self, laid):
        path, road = laid
        with pytest.raises(TrackFileError, match=r"lays 300 segments .* says 301 of 205\d\.\d m"):
            check_road(path, road[1:])

    @pytest.mark.parametrize("column", range(13))
    def test_a_segment_that_is_another(self, laid, column):
        path, road = laid
        other = road.copy()
        other[100, column] += 0.1
        with pytest.raises(TrackFileError, match=f"100, .*{track_trial.COLUMNS[column]} is"):
            check_road(path, other)


def test_a_lap_that_the_game_adds_up_otherwise_is_refused(broken):
    """In steps of 3 mm, single precision loses 0.4 m of 2,587 m."""
    changed = (r'(name="profil steps length" val="3" unit=")m', r"\g<1>mm")
    path = broken("road/aalborg", changed)
    with pytest.raises(TrackFileError, match=r"the place of the end is .* in the game"):
        NativeBackend(path)


def test_a_file_that_is_rewritten_is_read_anew_whatever_its_times_say(broken):
    path = broken("road/g-track-1", (r"\Z", " "))
    times = path.stat()
    first = load_track(path)
    path.write_bytes(
        re.sub(rb'(?s)(Main Track.{0,80}"width"[^>]*val=")15', rb"\g<1>14", path.read_bytes())
    )
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert path.stat().st_size == times.st_size
    assert (first.width, load_track(path).width) == (15.0, 14.0)
