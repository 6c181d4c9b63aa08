"""The connection of one driver to an SCR server, over UDP.

Datagrams may be lost, doubled or late. A state that arrives twice is taken once; of several states
in the queue, the newest is taken; if nothing arrives for a while, the last message is sent again,
which our own server recognises (see :attr:`sb3_torcs.scr.protocol.ScrAction.lap_time`).
"""

from __future__ import annotations

import math
import os
import socket
import struct
import warnings
import weakref
from array import array
from collections.abc import Callable
from contextlib import suppress
from time import perf_counter

from sb3_torcs.car import FloatArray, Start
from sb3_torcs.errors import MessageBroken, ServerLost, ServerNotFound
from sb3_torcs.scr.protocol import (
    IDENTIFIED,
    RESTART,
    SHUTDOWN,
    ScrAction,
    format_action,
    format_init,
    parse_state,
)

__all__ = ["ScrClient"]

LONGEST = 65535  # [bytes] of a datagram; some servers send pictures
LOOKS = 50  # polls for an answer before this process sleeps: some 100 microseconds
# A wait begins by polling. Polls that find an answer add 1 to a score of at most FULL_LUCK, others
# take 2 off; when it is used up, the next -NO_LUCK waits sleep at once.
FULL_LUCK = 8
NO_LUCK = -200
FIRST_PAUSE = 1.0  # [s] before the first message is sent again; servers load for a while
PAUSE = 1.0  # [s] before an action is sent again
LONGEST_PAUSE = 5.0  # [s] until a closed port is noticed
MOST_BROKEN = 10  # states in a row
PATIENCE = 10.0  # [s] without a datagram after which a server counts as lost


class ScrClient:
    """
    A client that drives one car.

    A server on this machine that ends is noticed at once, by its port being closed; any other one
    after ``patience`` or ``silence``.

    :param host: name or address of the server
    :param port: of the driver; the first one's is 3001
    :param angles: (19,) of the range finders [rad], left negative
    :param patience: without an answer to the first word, or to a wish for a restart, after which
        the server is given up [s]
    :param silence: without a state after which a server elsewhere is given up later [s]: the race
        waits for other clients, or somebody has paused it; one on this machine is then waited for
        as long as its port is open. ``None`` is as ``patience`` for both
    :param pause: before an action is said again [s], then twice that, and so on: servers but ours
        take each for the answer to another state, so it should be rare
    :param name: of the driver, which our own server shows
    :param latencies: to which the time from each state to its answer is added [s], for a server
        that does not wait
    :param watch: called while nothing comes; raises if the server has ended
    :param skips_broken: leave broken states out, with one warning, until ``MOST_BROKEN`` have come
        in a row: networks garble datagrams
    :raises ServerNotFound: if the host has no address
    """

    def __init__(
        self,
        host: str,
        port: int,
        angles: FloatArray,
        *,
        patience: float = PATIENCE,
        silence: float | None = None,
        pause: float = PAUSE,
        name: str = "",
        latencies: array[float] | None = None,
        watch: Callable[[], None] = lambda: None,
        skips_broken: bool = False,
    ) -> None:
        self.address = f"{host}:{port}"
        self.over = True
        """Whether the server has ended the race, or there was none yet."""
        self.restarted = False
        """Whether that was to begin it anew: then whoever identifies again drives in it."""
        self.lost = 0
        """States that another one followed before our answer: the server did not wait for it."""
        self._skips_broken = skips_broken
        self._broken = 0  # states in a row
        self._has_warned = False
        self._latencies = latencies
        self._arrived = 0.0
        self._angles = angles
        self._name = name
        self._patience = patience
        self._pause = pause
        self._watch = watch
        self._said = b""  # the last message, to be sent again
        self._taken = b""  # the last state
        self._buffer = memoryview(bytearray(LONGEST))
        self._timeout = 0.0
        self._luck = FULL_LUCK
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._end = weakref.finalize(self, self._socket.close)
        try:
            # A connected socket receives from this server only, and reports a closed port.
            self._socket.connect((host, port))
        except (OSError, OverflowError, TypeError, UnicodeError) as error:  # no name of a host
            self.close()
            raise ServerNotFound(
                f"{self.address} cannot be reached ({error}); check host and port"
            ) from error
        here = self._socket.getpeername()[0].startswith("127.")
        self._silence = patience if silence is None else math.inf if here else silence

    def identify(self, start: Start | None = None) -> None:
        """
        Identify the driver, and wait for the server's answer.

        :param start: where to begin, if not on the grid; only our own server does that
        :raises ServerNotFound: if nothing answers in time
        """
        self._taken = b""
        self._drain()
        words = format_init(self._angles, start, exact=True, name=self._name)
        if not self._ask(words, IDENTIFIED, FIRST_PAUSE):
            raise ServerNotFound(
                f"no SCR server answers at {self.address}, tried for {self._patience:g} s; start "
                "one with `sb3-torcs serve --track aalborg`, or check host and port"
            )
        self.over = self.restarted = False

    def send(self, message: bytes) -> None:
        """
        Send an action. It is sent again if no state follows.

        :param message: a datagram
        :raises ServerLost: if the server has ended
        """
        if self._latencies is not None and message is not self._said:
            self._latencies.append(perf_counter() - self._arrived)
            self.lost += self._is_late()
        self._said = message
        try:
            self._socket.send(message)
        except OSError as error:
            raise self._unreachable(error) from error

    def receive(self) -> bytes | None:
        """
        Wait for the next state.

        :return: a datagram; ``None`` when the server has ended the race, or restarts it
        :raises ServerLost: if the server has ended, or does not answer any more
        """
        if self.over:
            return None
        waited, pause = 0.0, self._pause
        while True:
            try:
                message = self._wait(pause)
            except OSError as error:
                raise self._unreachable(error) from error
            if message is None:
                self._watch()
                waited += pause
                if waited >= self._silence:
                    raise self._lost(f"nothing came for {waited:.0f} s")
                self.send(self._said)
                pause = min(2.0 * pause, LONGEST_PAUSE, self._silence - waited)
                continue
            state = self._newest(message)
            if state or self.over:
                self._taken = state or b""
                self._arrived = perf_counter()
                return state

    def restart(self, start: Start | None = None) -> None:
        """
        Restart the race.

        :param start: as of :meth:`identify`
        :raises ServerLost: if the server does not restart in time
        :raises ServerNotFound: if it ends at the restart
        """
        if not self._ask(format_action(ScrAction(restart=True)), RESTART, self._pause):
            raise self._lost("it does not restart the race")
        self.identify(start)

    def close(self) -> None:
        """Close the connection. A second call does nothing."""
        self.over = True
        self._end()

    def _ask(self, question: bytes, answer: bytes, pause: float) -> bool:
        """
        Send a message until it is answered; other datagrams are ignored.

        :param question: a datagram
        :param answer: the beginning of the answer
        :param pause: before the message is sent again [s]
        :return: whether the answer came in time
        """
        self._said = question
        now = again = perf_counter()
        until = now + self._patience
        while now < until:
            message = None
            with suppress(OSError):  # the error is of an earlier datagram: the server may be back
                # By the clock, because states arrive in real time in any case.
                if now >= again:
                    again = now + pause
                    self._socket.send(question)
                message = self._wait(pause)
            if message is None:
                self._watch()
            elif message.startswith(answer):
                return True
            now = perf_counter()
        return False

    def _wait(self, pause: float) -> bytes | None:
        """
        Wait for a datagram.

        :param pause: [s]
        :return: ``None`` if there was none
        """
        if pause != self._timeout:
            microseconds = max(int(pause * 1e6), 1)
            times = struct.pack("ll", *divmod(microseconds, 1_000_000))
            # Python's own time-out takes one more system call for each datagram.
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, times)
            self._timeout = pause
        message = self._look()
        if message is not None:
            return message
        with suppress(BlockingIOError):
            return self._take()
        return None

    def _look(self) -> bytes | None:
        """
        Poll for a datagram for a short time, since waking up takes longer than a tick of the game.

        Polling stops where it seldom succeeds, as with more processes than processors.
        """
        if self._luck < 0:
            self._luck += 1
            return None
        for _ in range(LOOKS):
            with suppress(BlockingIOError):
                message = self._take(socket.MSG_DONTWAIT)
                self._luck = min(self._luck + 1, FULL_LUCK)
                return message
            os.sched_yield()
        self._luck = self._luck - 2 if self._luck >= 2 else NO_LUCK
        return None

    def _take(self, flags: int = 0) -> bytes:
        """Take a datagram."""
        size = self._socket.recv_into(self._buffer, 0, flags)
        return self._buffer[:size].tobytes()

    def _drain(self) -> list[bytes]:
        """Take all datagrams in the queue."""
        messages = []
        try:
            while True:
                messages.append(self._take(socket.MSG_DONTWAIT))
        except OSError:  # the queue is empty, or the next call raises the same error
            return messages

    def _is_late(self) -> bool:
        """Check whether a newer state is in the queue than the one that is answered now."""
        with suppress(OSError):
            following = self._take(socket.MSG_DONTWAIT | socket.MSG_PEEK)
            return following != self._taken and not following.startswith(b"***")
        return False

    def _newest(self, message: bytes) -> bytes | None:
        """
        Take the newest state of those in the queue.

        :param message: that came first
        :return: ``None`` if there is none
        """
        state = None
        for text in (message, *self._drain()):
            if not text.startswith(b"***"):
                if text not in (state, self._taken) and self._is_whole(text):
                    self.lost += state is not None
                    state = text
            elif text.startswith((SHUTDOWN, RESTART)):
                self.over = True
                self.restarted = text.startswith(RESTART)
        return state

    def _is_whole(self, text: bytes) -> bool:
        """
        Check a state, where broken ones are left out.

        :raises MessageBroken: if too many are broken: the server speaks another language
        """
        if not self._skips_broken:
            return True
        try:
            parse_state(text)
        except MessageBroken as error:
            self._broken += 1
            if self._broken >= MOST_BROKEN:
                raise
            if not self._has_warned:
                self._has_warned = True
                warnings.warn(f"{self.address} sent {error}; it is left out", stacklevel=2)
            return False
        self._broken = 0
        return True

    def _unreachable(self, error: OSError) -> ServerLost:
        """Build the error."""
        closed = isinstance(error, ConnectionError)
        return self._lost("its port is closed" if closed else error.strerror or str(error))

    def _lost(self, why: str) -> ServerLost:
        """
        Build the error.

        :param why: the server is given up
        """
        self.over = True
        self._watch()
        return ServerLost(
            f"the SCR server at {self.address} is lost: {why}; see what it said, and begin anew "
            "when it runs again"
        )
