"""Handlers of signals for a limited time."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

__all__ = [
    "ENDING",
    "EXIT_STATUS",
    "count_interrupts",
    "defer_signals",
    "keep_handlers",
    "on_signal",
    "redeliver_interrupts",
]

SOON = 0.1  # [s] until a signal that was ignored comes again
# Windows has no SIGHUP.
ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that ask a process to end."""

EXIT_STATUS = 128  # of a process that a signal has ended, plus the number of the signal


@contextlib.contextmanager
def on_signal(by: Callable[[int, FrameType | None], None], *numbers: int) -> Iterator[None]:
    """
    Handle signals by a function. Python allows that in the main thread only; in others nothing
    changes.

    :param by: called with the number of the signal and the frame that it came in
    :param numbers: of the signals
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with keep_handlers(*numbers):
        for number in numbers:
            signal.signal(number, by)
        yield


@contextlib.contextmanager
def defer_signals() -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP wait until something has been done whole."""
    waiting: list[int] = []
    try:
        with on_signal(lambda number, _: waiting.append(number), signal.SIGINT, *ENDING):
            yield
    finally:
        for number in waiting[:1]:
            signal.raise_signal(number)


@contextlib.contextmanager
def count_interrupts(passed: int, message: str) -> Iterator[list[int]]:
    """
    Count Ctrl-C and SIGTERM. All but one raise ``KeyboardInterrupt``, as usual.

    :param passed: the number, from 1, of the one that only prints a message
    :param message: for standard error
    :return: the signals so far
    """
    seen: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        del frame
        seen.append(number)
        if len(seen) != passed:
            raise KeyboardInterrupt
        sys.stderr.write(message)

    with on_signal(note, signal.SIGINT, signal.SIGTERM):
        yield seen


@contextlib.contextmanager
def redeliver_interrupts() -> Iterator[None]:
    """
    Let signals come again where Python ignores what their handlers raise: in functions that C
    calls, as numba's compiler does.

    Numba raises a ``RuntimeError`` where it has lost one. That error becomes the one that was lost.

    :raises KeyboardInterrupt: in place of numba's error; or SystemExit, as the handler does
    """
    ignored: list[BaseException] = []
    timers: list[threading.Timer] = []
    numbers: list[int] = [signal.SIGINT, *ENDING]
    handlers = {number: signal.getsignal(number) for number in numbers}
    before = sys.unraisablehook

    def note(unraisable: Any) -> None:
        error = unraisable.exc_value
        if not isinstance(error, KeyboardInterrupt | SystemExit):
            before(unraisable)
            return
        ignored.append(error)
        status = getattr(error, "code", EXIT_STATUS + signal.SIGINT)  # KeyboardInterrupt has none
        number = status - EXIT_STATUS if isinstance(status, int) else None
        # Whoever has set another handler counts signals, and knows of this one.
        if number in handlers and signal.getsignal(number) is handlers[number]:
            timers.append(threading.Timer(SOON, _send_again, [number]))
            timers[-1].start()

    sys.unraisablehook = note
    try:
        yield
    except RuntimeError as error:
        if ignored and type(error) is RuntimeError:
            raise ignored[0] from error
        raise
    finally:
        for timer in timers:
            timer.cancel()
        sys.unraisablehook = before


def _send_again(number: int) -> None:
    """Send a signal to this process, which on Windows ``os.kill`` would end."""
    if sys.platform == "win32":
        signal.raise_signal(number)
    else:
        os.kill(os.getpid(), number)


@contextlib.contextmanager
def keep_handlers(*numbers: int) -> Iterator[None]:
    """
    Put back the handlers of signals that a library replaces and leaves replaced. Python allows that
    in the main thread only; elsewhere no library can replace them.

    :param numbers: of the signals
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None:  # else Python has not set it, and cannot restore it
                signal.signal(number, handler)
