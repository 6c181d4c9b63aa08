"""Encode frames as a video file that every player opens."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from sb3_torcs.errors import InvalidOption, OutputNotWritable, needs_extra
from sb3_torcs.files import atomic_file

with needs_extra("a video"):
    import imageio_ffmpeg

__all__ = ["ENCODING", "PHOTOGRAPHIC", "write_video"]

Frame = npt.NDArray[np.uint8]

ENCODING: Mapping[str, Any] = {
    "codec": "libx264",
    "quality": 7,  # of 10: figures stay sharp
    "pix_fmt_out": "yuv420p",  # what browsers and phones can show
    "macro_block_size": 2,  # yuv420p halves the colours' resolution: sizes must be even
    "output_params": ["-movflags", "+faststart"],  # plays before it is loaded
}
PHOTOGRAPHIC: Mapping[str, Any] = {
    **ENCODING,
    "quality": None,  # by ffmpeg's own rule: asphalt and leaves need not be exact
    "output_params": [*ENCODING["output_params"], "-crf", "23", "-preset", "veryfast"],
}
"""For pictures that look like photographs: a quarter of the size, in a third of the time."""

ADVICE = "choose a file in a folder that you may write to"

INDEX = b"moov"  # the name of its box in an mp4 file
BEGINNING = 64  # [bytes] that hold the names of the first boxes


def write_video(
    path: str | os.PathLike[str],
    frames: Iterable[Frame],
    fps: float,
    total: int | None = None,
    encoding: Mapping[str, Any] = ENCODING,
    share: Callable[[], float] | None = None,
) -> Path:
    """
    Write frames to an mp4 file (H.264, yuv420p).

    On a terminal, standard error shows the progress and the time left.

    The file appears complete or not at all: it is written under another name and renamed at the
    end.

    :param path: of the file, ending in ``.mp4``; its folder is made if it is missing
    :param frames: (height, width, 3) each, all of one size
    :param fps: frames per second
    :param total: number of frames, for the progress bar, if known
    :param encoding: that of this module: for figures, or :data:`PHOTOGRAPHIC`
    :param share: returns the share of the video that is done, 0 to 1, if ``total`` is not known
    :return: the path
    :raises InvalidOption: if the name does not end in ``.mp4``, or there are no frames
    :raises OutputNotWritable: if the file cannot be written; no part of it is left behind
    """
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise InvalidOption(f"the video's name is '{path}'; expected a name that ends in '.mp4'")
    with (
        atomic_file(path, ADVICE, parents=True) as part,
        _progress(path.name, total, share) as advance,
    ):
        _encode(path, part, frames, fps, advance, encoding)
    return path


@contextmanager
def _progress(
    name: str, total: int | None, share: Callable[[], float] | None
) -> Iterator[Callable[[], None]]:
    """
    Show the progress of a video and the time left, on a terminal.

    :param name: of the video
    :param total: number of frames, if known
    :param share: as of :func:`write_video`
    :return: to be called after each frame
    """
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(),
               TimeElapsedColumn(), TextColumn("left:"), TimeRemainingColumn())  # fmt: skip
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(name, total=total if share is None else 1.0)

        def advance() -> None:
            if share is None:
                progress.advance(task)
            else:
                progress.update(task, completed=share())

        yield advance
        end = progress.tasks[0].total
        progress.update(task, completed=end)  # a drive may end before its race


def _encode(
    path: Path,
    part: Path,
    frames: Iterable[Frame],
    fps: float,
    advance: Callable[[], None],
    encoding: Mapping[str, Any],
) -> None:
    """
    Send the frames through ffmpeg.

    :param path: of the video, for messages
    :param part: file to write
    :param frames: (height, width, 3) each
    :param fps: frames per second
    :param advance: called after each frame
    :param encoding: options of ffmpeg
    """
    remaining = iter(frames)
    first = next(remaining, None)
    if first is None:
        raise InvalidOption(
            f"there are no frames for '{path}'; pass at least one array from env.render(), "
            'of an environment made with render_mode="rgb_array"'
        )
    size = (first.shape[1], first.shape[0])
    # If a frame raises, imageio's own writer leaves ffmpeg running; this one closes it.
    with closing(imageio_ffmpeg.write_frames(part, size, fps=fps, **encoding)) as ffmpeg:
        ffmpeg.send(None)
        for frame in chain([first], remaining):
            if frame.shape != first.shape or frame.dtype != np.uint8:
                raise InvalidOption(
                    f"a frame is {frame.dtype} {frame.shape}; the first is uint8 {first.shape}, "
                    "and all must be alike"
                )
            try:
                ffmpeg.send(np.ascontiguousarray(frame))
            except OSError as error:
                raise _out_of_room(path) from error
            advance()
    if not _is_whole(part):
        raise _out_of_room(path)


def _is_whole(part: Path) -> bool:
    """
    Check that the file begins with its index, which ffmpeg writes last and without an error.

    :param part: the file
    """
    with part.open("rb") as file:
        return INDEX in file.read(BEGINNING)


def _out_of_room(path: Path) -> OutputNotWritable:
    """Make the error of an ffmpeg that ended early; its own message went to standard error."""
    return OutputNotWritable(f"ffmpeg stopped writing '{path}'; is there room on the disk?")
