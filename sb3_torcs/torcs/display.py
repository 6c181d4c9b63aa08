"""Displays for the game's window: the user's, or a virtual one."""

from __future__ import annotations

import os
import re
import select
import shutil
import socket
import subprocess
import tempfile
import weakref
from contextlib import suppress
from pathlib import Path
from typing import IO

from sb3_torcs.errors import DisplayUnavailable

__all__ = ["INSTALL", "PROGRAM", "VirtualDisplay", "find_display"]

PROGRAM = "Xvfb"
INSTALL = "`sb3-torcs install-torcs --video`, or: `sudo apt install xvfb`"
PATIENCE = 120.0  # [s] for a server to start on a busy machine
GRACE = 5.0  # [s] for a server to end
ANSWER_TIME = 30.0  # [s] for a server to greet
FIRST_TCP_PORT = 6000
SOCKETS = Path("/tmp/.X11-unix")
GREETING = b"l\0\x0b\0\0\0" + bytes(6)  # little endian, protocol 11.0, no password


def find_display(otherwise: str) -> str:
    """
    Find the user's display.

    :param otherwise: what to do where there is none
    :return: its name, from ``$DISPLAY``
    :raises DisplayUnavailable: if there is none, or no server answers there
    """
    name = os.environ.get("DISPLAY", "")
    if not name:
        raise DisplayUnavailable(f"there is no display ($DISPLAY is not set); {otherwise}")
    try:
        _connect(name).close()
    except (OSError, ValueError) as error:
        raise DisplayUnavailable(
            f"no X server answers at $DISPLAY={name} ({error}); {otherwise}"
        ) from error
    return name


class VirtualDisplay:
    """
    A virtual display, for a window that is not shown.

    It ends when it is closed, and also when this process is killed, since it has no client then.

    :param size: width and height [pixels]
    :raises DisplayUnavailable: if there is no program for that, or it does not run
    """

    def __init__(self, size: tuple[int, int]) -> None:
        program = shutil.which(PROGRAM)
        if program is None:
            raise DisplayUnavailable(
                f"there is no {PROGRAM}, the program for a virtual display; type: {INSTALL}"
            )
        with tempfile.TemporaryFile() as words:
            process, number = _start(program, size, words)
            try:
                self.name = f":{_read_number(number, words)}"
                # As long as a client is connected, the server stays; this one is the first.
                client = _connect(self.name)
            except BaseException as error:
                _end(process, None, "", os.getpid())
                if isinstance(error, OSError):
                    raise DisplayUnavailable(f"{program} does not answer: {error}") from error
                raise
        self.pid = process.pid
        self._end = weakref.finalize(self, _end, process, client, self.name, os.getpid())

    def __enter__(self) -> VirtualDisplay:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the display. A second call does nothing."""
        self._end()


def _start(
    program: str, size: tuple[int, int], words: IO[bytes]
) -> tuple[subprocess.Popen[bytes], int]:
    """
    Start the server, which looks for a free display by itself.

    :param program: its path
    :param size: width and height [pixels]
    :param words: the file for what it prints
    :return: its process, and the open file from which the display's number can be read
    """
    number, written = os.pipe()
    call = [program, "-displayfd", str(written), "-screen", "0", f"{size[0]}x{size[1]}x24"]
    call += ["-nolisten", "tcp", "-terminate"]  # with its last client
    try:
        # A session of its own: Ctrl-C is for this process, which then ends the server.
        process = subprocess.Popen(
            call, stdin=subprocess.DEVNULL, stdout=words, stderr=words,
            pass_fds=(written,), start_new_session=True,
        )  # fmt: skip
    except OSError as error:
        os.close(number)
        raise DisplayUnavailable(f"{program} does not run: {error.strerror}") from error
    finally:
        os.close(written)
    return process, number


def _read_number(number: int, words: IO[bytes]) -> int:
    """
    Wait for the server to be ready.

    :param number: the open file that the number comes from; closed here
    :param words: what it printed
    :return: the number of its display
    """
    with os.fdopen(number, "rb") as file:
        ready, _, _ = select.select([file], [], [], PATIENCE)
        text = file.readline().strip() if ready else b""
    if text.isdigit():
        return int(text)
    words.seek(0)
    lines = [line.strip() for line in words.read().decode(errors="replace").splitlines()]
    said = " / ".join(line for line in lines if line) or "nothing"
    raise DisplayUnavailable(f"{PROGRAM} does not start; it said: {said}")


def _connect(name: str) -> socket.socket:
    """
    Connect to a display, as its clients do.

    :param name: e.g. ``":0"`` or ``"localhost:10.0"``
    :return: the connection
    :raises ValueError: if this is not a display's name
    :raises OSError: if no server answers
    """
    parts = re.fullmatch(r"(.*):(\d+)(\.\d+)?", name)
    if parts is None:
        raise ValueError("expected a name such as :0")
    host, number = parts[1], int(parts[2])
    if host not in ("", "unix") and not host.startswith("/"):
        return socket.create_connection((host, FIRST_TCP_PORT + number), ANSWER_TIME)
    client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        client.settimeout(ANSWER_TIME)
        path = str(SOCKETS / f"X{number}")
        try:
            client.connect(f"\0{path}")
        except OSError:  # not every server listens there
            client.connect(path)
        client.sendall(GREETING)
        # Any answer shows that a server is there; the game knows its password, if it needs one.
        if not client.recv(1):
            raise ConnectionError("it closed the connection")
    except BaseException:
        client.close()
        raise
    return client


def _end(
    process: subprocess.Popen[bytes], client: socket.socket | None, name: str, owner: int
) -> None:
    """
    End a server, and remove its files.

    :param process: of the server
    :param client: our connection to it
    :param name: of the display, empty if it has none yet
    :param owner: the process that started it; a fork of that leaves the server alone
    """
    if os.getpid() != owner:
        return
    if client is not None:
        client.close()
    process.terminate()
    try:
        process.wait(GRACE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait(GRACE)
    if client is None:
        return
    # A server that was killed leaves this; another may have taken it over since.
    left = SOCKETS / f"X{name[1:]}"
    with suppress(OSError):
        if not _is_open(left):
            left.unlink()


def _is_open(path: Path) -> bool:
    """
    Say whether a process has opened a socket.

    To connect would tell the same, but a server that nobody uses yet would end with us.

    :param path: of the socket
    """
    opened = Path("/proc/net/unix").read_bytes().splitlines()
    return any(line.endswith((b" %b" % bytes(path), b" @%b" % bytes(path))) for line in opened)
