"""An SCR client as others write them: plain text over UDP, nothing of this package."""

from __future__ import annotations

import re
import socket
import time

INIT = b"SCR(init -90 -75 -60 -45 -30 -20 -15 -10 -5 0 5 10 15 20 30 45 60 75 90)"
GIVE_UP = 600.0  # [s] without any server, on a busy machine


class ThirdParty:
    """A careful driver that comes round on easy tracks."""

    def __init__(self, port: int) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(GIVE_UP)
        self.socket.bind(("127.0.0.1", 0))
        self.address = "127.0.0.1:{1}".format(*self.socket.getsockname())
        self.server = ("127.0.0.1", port)
        self.answers = 0

    def last(self) -> bytes:
        """The last message, of those that wait."""
        self.socket.settimeout(GIVE_UP)
        message = b""
        while not message.startswith(b"***"):
            message = self.socket.recv(2000)
        return message

    def __enter__(self) -> ThirdParty:
        return self

    def __exit__(self, *error: object) -> None:
        self.socket.close()

    def identify(self) -> None:
        """Say who this is until the server answers."""
        end = time.monotonic() + GIVE_UP
        self.socket.settimeout(0.5)
        while not self._identified():
            assert time.monotonic() < end, "there is no server"
            time.sleep(0.05)
        self.socket.settimeout(GIVE_UP)

    def _identified(self) -> bool:
        try:
            self.socket.sendto(INIT, self.server)
            return self.socket.recv(2000).startswith(b"***identified***")
        except (ConnectionError, TimeoutError):
            return False

    def drive(self, answers: int | None = None, think: float = 0.0) -> bytes:
        """Drive for some states, or to the end; return the last message."""
        message = b""
        while answers is None or answers > 0:
            message = self.socket.recv(2000)
            if message.startswith(b"***"):
                break
            time.sleep(think)
            self.socket.sendto(self.action(message), self.server)
            self.answers += 1
            answers = None if answers is None else answers - 1
        return message

    def action(self, message: bytes) -> bytes:
        """Follow the road at a speed that every corner allows."""
        pairs = (pair.split(b" ", 1) for pair in re.findall(rb"\(([^)]*)\)", message))
        state = {name: value.split() for name, value in pairs}
        angle, place, speed, rpm = (
            float(state[name][0]) for name in (b"angle", b"trackPos", b"speedX", b"rpm")
        )
        steer = max(-1.0, min(1.0, 3.0 * angle - 0.15 * place))
        accel = 1.0 if speed < 60.0 else 0.3 if speed < 65.0 else 0.0
        gear = max(1, int(state[b"gear"][0]) + (rpm > 8500.0))
        return b"(accel %.3f)(brake 0)(gear %d)(steer %.4f)(clutch 0)(meta 0)\0" % (
            accel, gear, steer,
        )  # fmt: skip
