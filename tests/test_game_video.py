"""Videos of the game: every frame once, at its time."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import imageio_ffmpeg
import numpy as np
import pytest
from displays import left_behind, traces
from processes import gone, runs
from recordings import FPS, LAP, SIZE, recorded, saved

from sb3_torcs.errors import (
    DisplayUnavailable,
    GameFailed,
    GameTimeout,
    InvalidOption,
    OutputNotWritable,
)
from sb3_torcs.races.text_mode import run
from sb3_torcs.rendering import game_video as video_module
from sb3_torcs.rendering.game_video import HEADER, GameVideo, read_frame, side_by_side
from sb3_torcs.torcs.process import GameProcess
from sb3_torcs.torcs.race_setup import RaceSetup
from sb3_torcs.tracks.trial import check_track

pytestmark = pytest.mark.usefixtures("nothing_is_left")


@pytest.fixture(scope="module")
def lap(game):
    """A whole lap."""
    with recorded(game) as video:
        return list(video.frames())


class TestFrames:
    def test_every_frame_is_there_at_its_time(self, lap):
        assert [frame.number for frame in lap] == list(range(len(lap)))
        expected = -1.0 + np.arange(len(lap)) / FPS
        # The game's own clock is a sum of thousands of steps.
        np.testing.assert_allclose([frame.time for frame in lap], expected, rtol=0, atol=1e-9)

    def test_each_frame_tells_how_much_of_the_race_is_driven(self, lap):
        shares = [frame.share for frame in lap]
        assert shares == sorted(shares)
        assert shares[0] == 0.0
        assert shares[len(lap) // 2] == pytest.approx(0.5, abs=0.2)
        assert shares[-1] == pytest.approx(1.0, abs=0.05)

    def test_the_last_crossing_of_the_line_is_in_the_video(self, game, lap):
        (result,) = run(game, "a-speedway", LAP.drivers, laps=1)
        after_the_race = lap[-1].time - result.laps[0].time
        assert 1.0 - 1e-9 <= after_the_race < 1.0 + 2 / FPS

    def test_no_frame_is_black_and_none_is_drawn_twice(self, lap):
        pictures = np.array([frame.picture for frame in lap])
        assert pictures.shape == (len(lap), SIZE[1], SIZE[0], 3)
        assert pictures.mean(axis=(1, 2, 3)).min() > 50
        driving = pictures[(FPS + 1) * 2 :].astype(int)
        assert np.abs(np.diff(driving, axis=0)).mean(axis=(1, 2, 3)).min() > 1

    @pytest.mark.parametrize("view", ["helicopter", "tv"])
    def test_no_view_begins_in_the_dark(self, game, view):
        with recorded(game, view=view) as video:
            frame = next(video.frames())
        assert (frame.number, frame.time) == (0, pytest.approx(-1.0))
        middle = frame.picture[40:80, 60:120]
        assert middle.mean() > 30

    def test_the_sky_is_above_the_road(self, lap):
        picture = lap[0].picture
        assert picture[:40, 60:120].mean() > picture[-40:, 60:120].mean() + 30

    def test_the_same_race_gives_the_same_video(self, game, lap):
        with recorded(game) as video:
            again = list(video.frames())
        assert [frame.time for frame in again] == [frame.time for frame in lap]
        for one, other in zip(lap, again, strict=True):
            np.testing.assert_array_equal(one.picture, other.picture)

    def test_frames_that_fall_between_two_steps_are_of_the_nearest(self, game):
        with recorded(game, fps=29.97) as video:
            times = [frame.time for frame in islice(video.frames(), 90)]
        expected = -1.0 + np.arange(90) / 29.97
        np.testing.assert_allclose(times, expected, rtol=0, atol=0.001 + 1e-9)

    def test_who_is_looked_at_can_be_chosen(self, game):
        race = RaceSetup("a-speedway", [("inferno", 3), ("bt", 2)], laps=1, session="race")
        pictures = []
        for driver in (None, "bt 3"):
            with recorded(game, race, driver=driver) as video:
                pictures.append(next(video.frames()).picture)
        assert (pictures[0] != pictures[1]).any()


class TestFiles:
    def test_a_video_plays_in_a_browser(self, game, tmp_path, lap):
        with recorded(game) as video:
            path = saved(video, tmp_path / "lap.mp4")
        call = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "null", "-"]
        words = subprocess.run(call, capture_output=True, check=True).stderr.decode()
        assert "Video: h264" in words
        assert "yuv420p" in words
        assert f"{SIZE[0]}x{SIZE[1]}" in words
        assert f"frame={len(lap):5d}" in words
        content = path.read_bytes()
        assert content.index(b"moov") < content.index(b"mdat")  # plays before it is loaded

    def test_a_full_disk_leaves_no_half_video(self, game, tmp_path):
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        target = tmp_path / "videos"
        with recorded(game) as video:
            resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
            try:
                with pytest.raises(OutputNotWritable, match="is there room on the disk"):
                    saved(video, target / "lap.mp4")
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert list(target.iterdir()) == []

    def test_videos_go_side_by_side(self):
        def plain(level, width, count):
            return (np.full((4, width, 3), level + n, np.uint8) for n in range(count))

        joint = list(side_by_side(plain(0, 2, 3), plain(100, 6, 2)))
        assert [picture.shape for picture in joint] == [(4, 8, 3)] * 3
        assert [(p[0, 0, 0], p[0, 7, 0]) for p in joint] == [(0, 100), (1, 101), (2, 101)]


class TestFaults:
    def test_odd_sizes_are_refused(self, game):
        with pytest.raises(InvalidOption, match="161x120; a video needs even numbers"):
            recorded(game, size=(161, 120))

    def test_without_a_virtual_display_nothing_is_left(self, game, monkeypatch, tmp_path):
        monkeypatch.setenv("PATH", str(tmp_path))
        with pytest.raises(DisplayUnavailable, match="apt install xvfb"):
            recorded(game)

    def test_a_game_that_is_killed_is_an_error(self, game):
        with recorded(game) as video:
            frames = video.frames()
            next(frames)
            os.kill(video.game.pid, signal.SIGKILL)
            with pytest.raises(GameFailed, match="SIGKILL"):
                list(frames)

    def test_a_display_that_is_killed_is_an_error(self, game):
        # So many pictures that the pipe does not hold the rest of the video.
        with recorded(game, fps=100) as video:
            frames = video.frames()
            next(frames)
            display = SimpleNamespace(name=video.display.name, pid=video.display.pid)
            os.kill(display.pid, signal.SIGKILL)
            with pytest.raises(GameFailed, match="the game ended"):
                list(frames)
        assert not left_behind(display)

    def test_a_game_that_draws_nothing_is_an_error(self, game):
        """As when it cannot load a driver: it ends as if all were well."""

        def start(window):
            return GameProcess(game, LAP, check=check_track, descriptors=[window.frames])

        with GameVideo(start, size=SIZE) as video, pytest.raises(GameFailed, match="exit status 0"):
            list(video.frames())

    def test_a_game_that_hangs_is_an_error(self, monkeypatch):
        monkeypatch.setattr(video_module, "PATIENCE", 0.1)
        game = SimpleNamespace(last_words=lambda: "Ready.")
        receiver, sender = os.pipe()
        with pytest.raises(GameTimeout, match=r"no picture for 0\.1 s; it last said: Ready\."):
            read_frame(receiver, game)
        os.close(sender)
        assert read_frame(receiver, game) is None
        os.close(receiver)

    @pytest.mark.parametrize(
        "sent",
        [
            HEADER.pack(b"SB3F", 2, 2, 0, 0.0, 0.0) + b"short",
            HEADER.pack(b"what", 2, 2, 0, 0.0, 0.0) + bytes(12),
            b"SB3F",
        ],
    )
    def test_half_a_frame_is_an_error(self, sent):
        game = SimpleNamespace(epitaph=lambda: "the game ended")
        receiver, sender = os.pipe()
        os.write(sender, sent)
        os.close(sender)
        with pytest.raises(GameFailed, match="the game ended"):
            read_frame(receiver, game)
        os.close(receiver)

    def test_nothing_outlives_a_process_that_is_killed_in_mid_video(self):
        code = (
            "import sys; sys.path.insert(0, 'tests')\n"
            "from recordings import recorded\n"
            "from sb3_torcs.torcs.installation import find_game\n"
            "video = recorded(find_game(), fps=100)\n"
            "frame = next(video.frames())\n"
            "display = video.display\n"
            "print(video.game.pid, video.game.folder, display.pid, display.name, flush=True)\n"
            "input()\n"
        )
        call = [sys.executable, "-c", code]
        root = Path(__file__).parent.parent
        with subprocess.Popen(
            call, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=root
        ) as owner:
            pid, folder, server, name = owner.stdout.readline().decode().split()
            owner.kill()
        left = [lambda: runs(pid), Path(folder).exists, lambda: runs(server), lambda: traces(name)]
        assert gone(*left)
