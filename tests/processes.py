"""Which processes still run, and signals to them."""

from __future__ import annotations

import ctypes
import os
import re
import signal
import subprocess
import time
from pathlib import Path

from sb3_torcs.torcs.process import PROCESS_NAME


def raise_in_c(number):
    """Raise a signal in a function that C calls: Python ignores what its handler raises."""
    ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(number))()


def children() -> set[int]:
    """Games and displays that this process has started, by whatever test, and that still run."""
    call = ["ps", "--ppid", str(os.getpid()), "-o", "pid=,comm="]
    listed = subprocess.run(call, capture_output=True, text=True, check=False).stdout
    return {
        int(pid) for pid in re.findall(rf"^ *(\d+) (?:{PROCESS_NAME}|Xvfb)\b", listed, re.MULTILINE)
    }


def runs(pid):
    """Whether a process runs: one that waits to be reaped by somebody else does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def gone_within(seconds, *conditions):
    """Wait until nothing is there any more."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and any(condition() for condition in conditions):
        time.sleep(0.05)
    return not any(condition() for condition in conditions)
