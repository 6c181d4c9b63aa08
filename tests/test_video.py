"""The video writer: a whole file or none."""

from __future__ import annotations

import io
import re
import subprocess

import imageio_ffmpeg
import numpy as np
import pytest

from sb3_torcs.errors import InvalidOption, OutputNotWritable
from sb3_torcs.rendering.encoder import write_video


def frames(count=5, size=(32, 48)):
    for index in range(count):
        yield np.full((*size, 3), 40 * index, np.uint8)


def ffmpeg(*arguments):
    command = [imageio_ffmpeg.get_ffmpeg_exe(), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL, check=False)


def test_a_video_holds_every_frame(tmp_path):
    path = write_video(tmp_path / "new" / "lap.mp4", frames(), fps=10, total=5)
    raw = ffmpeg("-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-").stdout
    levels = np.frombuffer(raw, np.uint8).reshape(-1, 32 * 48 * 3).mean(axis=1)
    # The encoder loses colour: three grey levels of 255 is what its quality may cost.
    np.testing.assert_allclose(levels, [0, 40, 80, 120, 160], atol=3)


def test_a_video_is_encoded_for_every_player(tmp_path):
    path = write_video(tmp_path / "lap.mp4", frames(), fps=10)
    described = ffmpeg("-i", path).stderr.decode()
    assert "Video: h264" in described
    assert "yuv420p" in described
    assert "48x32" in described
    assert "10 fps" in described


class Terminal(io.StringIO):
    """A standard error that somebody looks at."""

    def isatty(self):
        return True


@pytest.mark.parametrize(
    "known", [{"total": 4}, {"share": iter([0.25, 0.5, 0.75, 1.0]).__next__}, {"share": lambda: 0}]
)
def test_a_terminal_shows_per_cent_and_the_time_left(tmp_path, monkeypatch, known):
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    write_video(tmp_path / "lap.mp4", frames(4), fps=10, **known)
    shown = re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", terminal.getvalue())  # without colours
    assert re.search(r"lap\.mp4 .* 100% \d:\d\d:\d\d left: 0:00:00", shown)


def test_a_log_file_shows_nothing(tmp_path, capsys):
    write_video(tmp_path / "lap.mp4", frames(), fps=10, total=5)
    assert capsys.readouterr() == ("", "")


def test_a_video_that_fails_half_way_leaves_nothing_behind(tmp_path):
    def failing():
        yield from frames()
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write_video(tmp_path / "lap.mp4", failing(), fps=10)
    assert list(tmp_path.iterdir()) == []


def test_a_failure_keeps_the_previous_video(tmp_path):
    (tmp_path / "lap.mp4").write_bytes(b"previous")
    with pytest.raises(InvalidOption, match="must be alike"):
        write_video(tmp_path / "lap.mp4", [*frames(1), *frames(1, (64, 64))], fps=10)
    assert (tmp_path / "lap.mp4").read_bytes() == b"previous"
    assert len(list(tmp_path.iterdir())) == 1


def test_a_folder_that_cannot_be_made_is_an_error_that_says_so(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputNotWritable, match=r"cannot write '.*lap\.mp4': .*; choose a file"):
        write_video(tmp_path / "file" / "lap.mp4", frames(), fps=10)


def test_a_folder_in_the_videos_place_is_an_error(tmp_path):
    (tmp_path / "lap.mp4").mkdir()
    with pytest.raises(OutputNotWritable, match="is a folder"):
        write_video(tmp_path / "lap.mp4", frames(), fps=10)


def test_no_frames_is_an_error_that_names_the_render_mode(tmp_path):
    with pytest.raises(InvalidOption, match="rgb_array"):
        write_video(tmp_path / "lap.mp4", [], fps=10)
    assert list(tmp_path.iterdir()) == []


def test_another_ending_than_mp4_is_an_error(tmp_path):
    with pytest.raises(InvalidOption, match=r"expected a name that ends in '\.mp4'"):
        write_video(tmp_path / "lap.avi", frames(), fps=10)
