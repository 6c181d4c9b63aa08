"""What displays leave behind."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

from processes import PATIENCE, runs


def traces(name):
    """The files of a display's server, those of a crashed one included."""
    number = name[1:]
    files = [Path(f"/tmp/.X{number}-lock"), Path(f"/tmp/.X11-unix/X{number}")]
    return [file for file in files if file.exists()]


def left_behind(display):
    """Its files, unless another server has its number by now, or is giving it back."""
    end = time.monotonic() + PATIENCE
    while traces(display.name):
        lock = Path(f"/tmp/.X{display.name[1:]}-lock")
        with contextlib.suppress(OSError, ValueError):
            owner = int(lock.read_text())
            if owner != display.pid and runs(owner):
                return []
        if time.monotonic() > end:
            return traces(display.name)
        time.sleep(0.05)
    return []
