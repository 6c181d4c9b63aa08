"""``sb3-torcs watch``: agents and robots in the game's window, and videos of them."""

from __future__ import annotations

import os
import re
import signal
import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from processes import children

from sb3_torcs.agents import pilots
from sb3_torcs.agents import remote as driving
from sb3_torcs.cli import main
from sb3_torcs.evaluation import watching
from sb3_torcs.races import video as races_video
from sb3_torcs.races.video import FPS, LAST_PICTURE
from sb3_torcs.scr.server import start_server
from sb3_torcs.torcs.display import VirtualDisplay

pytestmark = pytest.mark.usefixtures("game", "nothing_is_left")

TINY = ["--track", "a-speedway", "--size", "160x120"]


@pytest.fixture
def nothing_is_left(nothing_is_left):
    """Whatever happens, no folder and no process of the game stays."""
    before = children()
    yield
    assert children() - before == set()


class Turning:
    """Leaves the road at once."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        action = np.array([1.0, 1.0, 0.0], np.float32)
        return np.broadcast_to(action, (*np.shape(observation)[:-1], 3)), None


class Failing(Turning):
    """Breaks down after some timesteps."""

    timesteps = 0

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.timesteps += 1
        if self.timesteps > 30:
            raise ZeroDivisionError("as told")
        return super().predict(observation)


def stream(path):
    """What ffmpeg says of a video: codec, pixels, size; and the number of frames."""
    call = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path)]
    said = subprocess.run(call, capture_output=True, text=True, check=False).stderr
    frames, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    return re.search(r"Video: (h264).*?(yuv420p).*? (\d+x\d+)", said).groups(), frames


def test_a_video_of_a_robot_shows_its_race(tmp_path, capsys):
    video = tmp_path / "lap.mp4"
    assert main(["watch", "inferno", *TINY, "--video", str(video)]) == 0
    out = capsys.readouterr().out
    (lap,) = re.findall(r"inferno +1 +1 +([\d.]+)", out)
    assert f"video: {video}" in out
    kind, frames = stream(video)
    assert kind == ("h264", "yuv420p", "160x120")
    assert abs(frames - FPS * float(lap) - LAST_PICTURE) <= 25  # to the next second of the race


def test_two_drivers_side_by_side_are_on_one_track(tmp_path, monkeypatch, capsys):
    """The first known of a training, if none is given; each in its own car."""
    saved = []
    monkeypatch.setattr(races_video, "save_beside", lambda footages, *_: saved.extend(footages))
    words = ["--size", "320x120", "--laps", "1", "--video", str(tmp_path / "both.mp4")]
    assert main(["watch", "bt", "--beside", "ppo-league", *words]) == 0
    assert [footage.setup.track for footage in saved] == ["corkscrew"] * 2
    assert [footage.size for footage in saved] == [(160, 120)] * 2
    assert [[*footage.setup.car] for footage in saved] == [[], ["car1-ow1"]]


def test_a_video_of_two_has_both_races_in_full(tmp_path):
    video = tmp_path / "both.mp4"
    words = ["watch", "bt", "--beside", "inferno", "--track", "a-speedway", "--size", "160x120"]
    assert main([*words, "--video", str(video)]) == 0
    kind, frames = stream(video)
    assert kind[2] == "160x120"
    assert frames > 20 * FPS


def test_a_video_ends_soon_after_the_agents_drive(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pilots, "load_driver", lambda *_, **__: Turning())
    video = tmp_path / "off.mp4"
    assert main(["watch", "scripted", *TINY, "--video", str(video)]) == 0
    assert "out" in capsys.readouterr().out
    assert 10 < stream(video)[1] - LAST_PICTURE < 15 * FPS


def test_an_agent_that_breaks_down_ends_everything(tmp_path, monkeypatch):
    monkeypatch.setattr(pilots, "load_driver", lambda *_, **__: Failing())
    with pytest.raises(ZeroDivisionError, match="as told"):
        main(["watch", "scripted", *TINY, "--video", str(tmp_path / "broken.mp4")])
    assert not (tmp_path / "broken.mp4").exists()


def test_a_window_shows_the_race_and_closes(monkeypatch, capsys):
    monkeypatch.setattr(driving, "load_driver", lambda *_: Turning())
    with VirtualDisplay((320, 240)) as display:
        monkeypatch.setenv("DISPLAY", display.name)
        assert main(["watch", "scripted", "--robots", "bt", "--size", "160x120"]) == 0
    assert re.search(r"scripted: (off_track|backwards) after", capsys.readouterr().out)


def test_a_game_that_is_killed_says_how_it_ended(monkeypatch, capsys):
    started = []

    def start(*args, **options):
        started.append(start_server(*args, **options))
        return started[-1]

    class Killing(Turning):
        timesteps = 0

        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            self.timesteps += 1
            if self.timesteps == 20:
                os.kill(started[0].pid, signal.SIGKILL)
            return super().predict(observation)

    monkeypatch.setattr(watching, "start_server", start)
    monkeypatch.setattr(driving, "load_driver", lambda *_: Killing())
    with VirtualDisplay((320, 240)) as display:
        monkeypatch.setenv("DISPLAY", display.name)
        assert main(["watch", "scripted", *TINY]) == 2
    assert "the game ended with SIGKILL" in capsys.readouterr().err


def test_without_a_display_it_offers_a_video(monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    assert main(["watch", "inferno"]) == 2
    said = capsys.readouterr().err
    assert "there is no display" in said
    assert "--video" in said


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["infernal"], "there is no driver 'infernal'; did you mean 'inferno'?"),
        (["inferno", "--beside", "bt"], "--beside is for videos; add --video FILE.mp4"),
        (["inferno", "--beside", "bt:4", "--car", "buggy", "--video", "lap.mp4"], "--car is for"),
        (
            ["inferno", "--beside", "bt", "--size", "642x360", "--video", "lap.mp4"],
            "a multiple of 4",
        ),
        (["inferno", "--video", "lap.avi"], "'lap.avi' should end in .mp4"),
        (["inferno", "--video", "lap.mp4", "--size", "161x120"], "a multiple of 2"),
        (["inferno", "--video", "lap.mp4", "--track", "forzza"], "did you mean 'forza'?"),
        (["inferno", "--video", "lap.mp4", "--robots", "inferno"], "is named twice"),
        (["ghost-aalborg", "--laps", "9"], "laps, so it cannot drive 9; ask for no more"),
    ],
)
def test_what_cannot_be_watched(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["watch", *words]) == 2
    assert message in capsys.readouterr().err
    assert list(Path().glob("*.mp4")) == []


def test_a_size_that_is_none(capsys):
    with pytest.raises(SystemExit):
        main(["watch", "inferno", "--size", "big"])
    assert "'big': expected WIDTHxHEIGHT" in capsys.readouterr().err
