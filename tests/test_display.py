"""Displays: the user's, and the virtual one, which leaves nothing behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest
from displays import traces
from processes import PATIENCE, gone, runs

from sb3_torcs.errors import BackendUnavailable, DisplayUnavailable
from sb3_torcs.torcs.display import VirtualDisplay, find_display

SIZE = (160, 120)


def program(folder, script):
    """Put an Xvfb of our own in front of the real one."""
    file = folder / "Xvfb"
    file.write_text(f"#!/bin/sh\n{script}\n")
    file.chmod(0o755)
    return str(folder) + os.pathsep + os.environ["PATH"]


class TestTheUsersDisplay:
    def test_it_is_found_by_its_name(self, monkeypatch):
        with VirtualDisplay(SIZE) as display:
            monkeypatch.setenv("DISPLAY", f"{display.name}.0")
            assert find_display("do without one") == f"{display.name}.0"

    @pytest.mark.parametrize(
        ("name", "message"),
        [
            ("", "DISPLAY is not set.*do without one"),
            *[(name, rf"no X server answers at .*{name}.*do without one")
              for name in (":2999", "unix:2999", "localhost:2999")],
            ("the big one", "expected a name such as :0"),
        ],
    )  # fmt: skip
    def test_none_is_an_error_that_says_what_else_to_do(self, monkeypatch, name, message):
        monkeypatch.setenv("DISPLAY", name) if name else monkeypatch.delenv(
            "DISPLAY", raising=False
        )
        with pytest.raises(DisplayUnavailable, match=message):
            find_display("do without one")


class TestTheVirtualDisplay:
    def test_closing_it_leaves_nothing(self):
        with VirtualDisplay(SIZE) as display:
            assert runs(display.pid)
            assert traces(display.name)
        assert not runs(display.pid)
        assert not traces(display.name)
        display.close()  # does no harm

    def test_there_can_be_several(self):
        with VirtualDisplay(SIZE) as one, VirtualDisplay(SIZE) as other:
            assert one.name != other.name

    def test_one_that_is_killed_leaves_nothing_either(self):
        with VirtualDisplay(SIZE) as display:
            os.kill(display.pid, signal.SIGKILL)
        assert not traces(display.name)

    def test_closing_it_leaves_another_process_that_has_taken_its_name(self):
        """A server ends with its last client, be it one that only looks whether it is there."""
        with VirtualDisplay(SIZE) as display:
            os.kill(display.pid, signal.SIGKILL)
            assert gone(lambda: runs(display.pid))
            number, written = os.pipe()
            call = ["Xvfb", display.name, "-terminate", "-displayfd", str(written)]
            heir = subprocess.Popen(call, stderr=subprocess.DEVNULL, pass_fds=(written,))
            os.close(written)
            with os.fdopen(number) as ready:
                ready.readline()
        try:
            with pytest.raises(subprocess.TimeoutExpired):
                heir.wait(1.0)
            assert traces(display.name)
        finally:
            heir.terminate()
            heir.wait(PATIENCE)

    def test_it_goes_with_the_process_that_has_it(self):
        code = (
            "from sb3_torcs.torcs.display import VirtualDisplay\n"
            f"display = VirtualDisplay({SIZE})\n"
            "print(display.name, display.pid, flush=True)\n"
            "input()\n"
        )
        call = [sys.executable, "-c", code]
        with subprocess.Popen(call, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as owner:
            name, pid = owner.stdout.readline().decode().split()
            owner.kill()
        assert gone(lambda: runs(pid), lambda: traces(name))

    def test_without_the_program_the_error_says_what_to_type(self, monkeypatch, tmp_path):
        monkeypatch.setenv("PATH", str(tmp_path))
        with pytest.raises(DisplayUnavailable, match="sudo apt install xvfb") as caught:
            VirtualDisplay(SIZE)
        assert isinstance(caught.value, BackendUnavailable)

    @pytest.mark.parametrize(
        ("script", "message"),
        [
            ("echo 'no memory' >&2; exit 1", "does not start; it said: no memory"),
            ('echo 2999 >/dev/fd/"$2"; exec sleep 60', "does not answer"),
        ],
    )
    def test_a_program_that_fails_is_an_error(self, monkeypatch, tmp_path, script, message):
        monkeypatch.setenv("PATH", program(tmp_path, script))
        with pytest.raises(DisplayUnavailable, match=message):
            VirtualDisplay(SIZE)
