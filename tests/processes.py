"""Programs that tests start, signals to them, and which processes still run."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from sb3_torcs.torcs.process import PROCESS_NAME

PATIENCE = 600.0  # [s] for what happens within seconds where nothing else runs


class Program:
    """
    A program that a test starts. What it prints goes to files, so that it never waits for a reader,
    and leaving the block ends it, so that it never outlives its test.
    """

    def __init__(self, *command, **options):
        self.output = tempfile.TemporaryFile()  # noqa: SIM115  closed in __exit__
        self.errors = tempfile.TemporaryFile()  # noqa: SIM115
        self.process = subprocess.Popen(
            command, **{"stdout": self.output, "stderr": self.errors, **options}
        )
        self.pid = self.process.pid

    @classmethod
    def of_ours(cls, *words, **options):
        """The command ``sb3-torcs``."""
        return cls(sys.executable, "-m", "sb3_torcs.cli", *words, **options)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        self.output.close()
        self.errors.close()

    def wait_for(self, condition):
        """Wait until something is true, which the program brings about."""
        end = time.monotonic() + PATIENCE
        while not (found := condition()):
            status = self.process.poll()
            assert status is None, f"it ended with {status} too early: {self.printed()}"
            assert time.monotonic() < end, f"it does not come to that: {self.printed()}"
            time.sleep(0.05)
        return found

    def end(self, number=None):
        """Wait for its end, which a signal may ask for, and return the exit status."""
        if number is not None:
            self.process.send_signal(number)
        return self.process.wait(PATIENCE)

    def printed(self):
        """What it has printed so far, and its errors."""
        files = (self.output.fileno(), self.errors.fileno())  # whose positions are the program's
        return tuple(os.pread(file, os.fstat(file).st_size, 0).decode() for file in files)


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


def processes_of(folder, program=b""):
    """The numbers of the processes whose command lines name a folder, and a program."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):  # it has ended
            line = path.read_bytes()
            if program in line and os.fsencode(folder) in line:
                found.append(int(path.parent.name))
    return found


def gone(*conditions):
    """Wait until nothing is there any more."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and any(condition() for condition in conditions):
        time.sleep(0.05)
    return not any(condition() for condition in conditions)
