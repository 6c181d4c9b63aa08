"""Handlers of signals for a limited time."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

__all__ = ["answered", "counted_interrupts", "handlers_kept", "held_back"]


@contextlib.contextmanager
def answered(by: Callable[[int, FrameType | None], None], *numbers: int) -> Iterator[None]:
    """
    Handle signals by a function. Python allows that in the main thread only; in others nothing
    changes.

    :param by: called with the number of the signal and the frame that it came in
    :param numbers: of the signals
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with handlers_kept(*numbers):
        for number in numbers:
            signal.signal(number, by)
        yield


@contextlib.contextmanager
def held_back() -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP wait until something has been done whole."""
    waiting: list[int] = []
    signals = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
    try:
        with answered(lambda number, _: waiting.append(number), *signals):
            yield
    finally:
        for number in waiting[:1]:
            signal.raise_signal(number)


@contextlib.contextmanager
def counted_interrupts(passed: int, message: str) -> Iterator[list[int]]:
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

    with answered(note, signal.SIGINT, signal.SIGTERM):
        yield seen


@contextlib.contextmanager
def handlers_kept(*numbers: int) -> Iterator[None]:
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
