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

from sb3_torcs.agents import remote as driving
from sb3_torcs.cli import _parser, main
from sb3_torcs.evaluation import watching
from sb3_torcs.evaluation.comparing import saved_drives
from sb3_torcs.scr.server import start_server
from sb3_torcs.torcs.display import VirtualDisplay

pytestmark = pytest.mark.usefixtures("game", "nothing_is_left")

TINY = ["--track", "a-speedway", "--size", "160x120"]
SMALL = [*TINY, "--fps", "5"]  # videos


@pytest.fixture
def nothing_is_left(nothing_is_left):
    """Whatever happens, no folder and no process of the game stays."""
    before = children()
    yield
    assert children() - before == set()


class Turning:
    """Leaves the road at once."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.array([1.0, 1.0, 0.0], np.float32), None


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


def test_a_video_of_a_robot_is_the_race_that_the_game_runs_without_one(tmp_path, capsys):
    assert main(["robots", "inferno", "--track", "a-speedway", "--laps", "1", "--game"]) == 0
    alone = capsys.readouterr().out
    video = tmp_path / "lap.mp4"
    assert main(["watch", "inferno", *SMALL, "--video", str(video)]) == 0
    recorded = capsys.readouterr().out
    assert recorded == f"{alone}video: {video}\n"
    (lap,) = re.findall(r"best lap: ([\d.]+) s", alone)
    kind, frames = stream(video)
    assert kind == ("h264", "yuv420p", "160x120")
    # A second before the start, the lap, a second after it.
    assert abs(frames - 5 * (float(lap) + 2.0)) <= 2


def test_two_drivers_side_by_side(tmp_path, capsys):
    video, drives = tmp_path / "both.mp4", tmp_path / "drives.parquet"
    words = ["watch", "scripted", *SMALL, "--beside", "inferno", "--video", str(video)]
    assert main([*words, "--telemetry", str(drives)]) == 0
    out = capsys.readouterr().out
    assert "scripted, car1-trb1, a-speedway" in out
    assert "inferno:3, car1-trb1, a-speedway" in out
    laps = [float(lap) for lap in re.findall(r"best lap: ([\d.]+) s", out)]
    saved = [round(drive.laps[0].time, 3) for drive in saved_drives(drives)]
    assert saved == pytest.approx(laps, abs=0.001)  # [s] SCR packets carry six digits
    slower = max(laps)
    kind, frames = stream(video)
    assert kind[2] == "160x120"
    assert abs(frames - 5 * (slower + 2.0)) <= 2


def test_two_side_by_side_are_on_one_track(monkeypatch):
    recorded = []
    monkeypatch.setattr(watching, "record_shows", lambda shows, *_, **__: recorded.extend(shows))
    words = ["--beside", "ddpg-aalborg", "--video", "both.mp4"]
    assert main(["watch", "ppo-league", *words]) == 0
    assert main(["watch", "inferno", *words, "--track", "forza"]) == 0
    assert main(["watch", "bt", "--beside", "ppo-league", "--video", "both.mp4"]) == 0
    tracks = [show.track for show in recorded]
    assert tracks == ["corkscrew"] * 2 + ["forza"] * 2 + ["corkscrew"] * 2
    assert [show.race.car for show in recorded[:2]] == ["car1-ow1", "car1-trb1"]


def test_a_video_ends_soon_after_the_agents_drive(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(driving, "load_driver", lambda *_: Turning())
    video = tmp_path / "off.mp4"
    assert main(["watch", "scripted", *SMALL, "--video", str(video)]) == 0
    assert re.search(r"scripted: (off_track|backwards) after -?\d+ m", capsys.readouterr().out)
    assert 10 < stream(video)[1] < 60


def test_an_agent_that_breaks_down_ends_everything(tmp_path, monkeypatch):
    monkeypatch.setattr(driving, "load_driver", lambda *_: Failing())
    with pytest.raises(ZeroDivisionError, match="as told"):
        main(["watch", "scripted", *SMALL, "--video", str(tmp_path / "broken.mp4")])
    assert not (tmp_path / "broken.mp4").exists()


def test_a_window_shows_the_race_and_closes(monkeypatch, capsys):
    monkeypatch.setattr(driving, "load_driver", lambda *_: Turning())
    with VirtualDisplay((320, 240)) as display:
        monkeypatch.setenv("DISPLAY", display.name)
        assert main(["watch", "scripted", "--robots", "bt", "--size", "160x120"]) == 0
    assert re.search(r"scripted: (off_track|backwards) after", capsys.readouterr().out)


@pytest.mark.parametrize("video", [[], ["--video", "killed.mp4"]])
def test_a_game_that_is_killed_says_how_it_ended(video, tmp_path, monkeypatch, capsys):
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

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(watching, "start_server", start)
    monkeypatch.setattr(driving, "load_driver", lambda *_: Killing())
    with VirtualDisplay((320, 240)) as display:
        monkeypatch.setenv("DISPLAY", display.name)
        assert main(["watch", "scripted", *TINY, *video]) == 2
    assert "the game ended with SIGKILL" in capsys.readouterr().err
    assert list(Path().glob("*.mp4")) == []


def test_without_a_display_it_offers_a_video(monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    assert main(["watch", "inferno"]) == 2
    said = capsys.readouterr().err
    assert "there is no display" in said
    assert "--video" in said


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["infernal"], "there is no model 'infernal'"),
        (["infernal"], "and there is no robot 'infernal'; did you mean 'inferno'?"),
        (["inferno", "--beside", "bt"], "--beside is for videos; add --video FILE.mp4"),
        (["inferno", "--fps", "10"], "--fps is for videos; add --video FILE.mp4"),
        (["inferno", "--beside", "bt:4", "--car", "buggy", "--video", "lap.mp4"], "--car is for"),
        (
            ["inferno", "--beside", "bt", "--size", "642x360", "--video", "lap.mp4"],
            "size is 642x360; the width of a video with 2 side by side has to be a multiple of 4",
        ),
        (["inferno", "--video", "lap.avi"], "'lap.avi' should end in .mp4"),
        (["inferno", "--video", "lap.mp4", "--view", "behnd"], "did you mean 'behind'?"),
        (["inferno", "--video", "lap.mp4", "--fps", "0"], "fps is 0; expected 1 to 500"),
        (["inferno", "--video", "lap.mp4", "--size", "161x120"], "a video needs even numbers"),
        (["inferno", "--video", "lap.mp4", "--track", "forzza"], "did you mean 'forza'?"),
        (["inferno", "--video", "lap.mp4", "--robots", "inferno"], "'inferno:3' is named twice"),
        (["inferno", "--video", "lap.mp4", "--robots", ""], "robot '': expected NAME"),
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


def test_the_older_name_of_the_video_still_works():
    """It is hidden, for scripts of before."""
    parser, _ = _parser()
    assert parser.parse_args(["watch", "inferno", "--film", "lap.mp4"]).video == "lap.mp4"
