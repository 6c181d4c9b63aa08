"""What of the game still runs."""

from __future__ import annotations

import os
import re
import subprocess


def children() -> set[int]:
    """Games and displays that this process has started, by whatever test, and that still run."""
    call = ["ps", "--ppid", str(os.getpid()), "-o", "pid=,comm="]
    listed = subprocess.run(call, capture_output=True, text=True, check=False).stdout
    return {int(pid) for pid in re.findall(r"^ *(\d+) (?:torcs-bin|Xvfb)\b", listed, re.MULTILINE)}
