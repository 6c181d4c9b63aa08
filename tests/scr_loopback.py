"""The other end of the SCR protocol: a server without a game, and a network that errs."""

from __future__ import annotations

import socket
import threading

import numpy as np

from sb3_torcs.scr.protocol import (
    IDENTIFIED,
    RESTART,
    SHUTDOWN,
    ScrState,
    format_state,
    parse_action,
    parse_init,
)

COUNTDOWN = 3  # states before the race begins


class _Thread:
    """A thread with a socket, which ends with its ``with`` block."""

    def __init__(self, port=0):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", port))
        self.socket.settimeout(0.05)
        self.host, self.port = self.socket.getsockname()
        self.ending = False
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *error):
        self.stop()

    def stop(self):
        self.ending = True
        self._thread.join()

    def _run(self):
        while self._next():
            pass
        self.socket.close()

    def _next(self):
        """Take a datagram; what has come before the end is taken before it."""
        try:
            self.take(*self.socket.recvfrom(65535))
        except TimeoutError:
            return not self.ending
        except ConnectionError:
            return True  # the other end is gone
        return True


class Loopback(_Thread):
    """
    A server that waits for its client, as ours does. Its car's distance counts the answers.

    :param ticks: after which the race is over
    :param mute: states of these numbers are not sent before they are asked for again
    :param port: 0 is any that is free
    """

    def __init__(self, ticks=10**9, mute=(), port=0):
        super().__init__(port)
        self.ticks = ticks
        self.mute = set(mute)
        self.inits = []
        self.actions = []
        self.late = 0
        self.client = None
        self.address = {"host": self.host, "port": self.port}  # as of ``Torcs-v0``

    def take(self, message, sender):
        if message.startswith(b"SCR"):
            self.inits.append(parse_init(message))
            self.client, self.tick = sender, -COUNTDOWN
            self.say(IDENTIFIED + b"\0")
            self.send_state()
            return
        action = parse_action(message)
        if action.restart:
            self.say(RESTART + b"\0")
        elif action.lap_time is not None and action.lap_time != self.state().lap_time:
            self.late += 1
            self.send_state()
        else:
            self.actions.append(action)
            self.tick += 1
            if self.tick >= self.ticks:
                self.say(SHUTDOWN + b"\0")
            elif self.tick in self.mute:
                self.mute.discard(self.tick)
            else:
                self.send_state()

    def state(self):
        return ScrState(
            lap_time=float(f"{0.02 * self.tick:.6g}"), distance_from_start=float(max(self.tick, 0))
        )

    def send_state(self):
        self.say(format_state(self.state()))

    def say(self, message):
        self.socket.sendto(message, self.client)


class Errant(_Thread):
    """
    A network in front of a server that loses and doubles some datagrams, both ways.

    :param address: of the server
    :param share: that is lost, and that is doubled
    """

    def __init__(self, address, share=0.05):
        super().__init__()
        self.address = address
        self.share = share
        self.client = None
        self.lost = self.doubled = 0
        self._chance = np.random.default_rng(0)

    def take(self, message, sender):
        if sender != self.address:
            self.client = sender
        target = self.client if sender == self.address else self.address
        draw = self._chance.random()
        copies = 0 if draw < self.share else 2 if draw < 2.0 * self.share else 1
        self.lost += copies == 0
        self.doubled += copies == 2
        for _ in range(copies):
            self.socket.sendto(message, target)
