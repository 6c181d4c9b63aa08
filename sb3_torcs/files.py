"""Checks of files and folders for results, before any work begins."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_torcs.errors import OutputNotWritable

__all__ = ["writable_file", "writable_folder"]

if TYPE_CHECKING:
    pass


def writable_folder(folder: str | Path) -> Path:
    """
    Make a folder, and make sure that files can be written in it.

    :param folder: that results should go to
    :return: the folder
    :raises OutputNotWritable: if it cannot be made or written
    """
    path = Path(os.path.expanduser(folder))
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise OutputNotWritable(
            f"cannot write to the folder '{path}': {error.strerror or error}; give another one"
        ) from error
    return path


def writable_file(file: str | Path, suffixes: tuple[str, ...]) -> Path:
    """
    Make sure that a file can be written.

    :param file: that a result should go to
    :param suffixes: allowed endings, e.g. ``(".png",)``
    :return: its path
    :raises OutputNotWritable: if its folder cannot be written, or its kind is another
    """
    path = Path(os.path.expanduser(file))
    if path.suffix.lower() not in suffixes:
        raise OutputNotWritable(f"'{path}' should end in {' or '.join(suffixes)}")
    if path.is_dir():
        raise OutputNotWritable(f"'{path}' is a folder; give a file in it")
    writable_folder(path.parent)
    return path
