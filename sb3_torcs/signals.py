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

__all__ = ["answered", "counted_interrupts", "handlers_kept", "held_back", "ignored_interrupts"]

SOON = 0.1  # [s] until a signal that was ignored comes again


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
def ignored_interrupts() -> Iterator[None]:
    """
    Let Ctrl-C come again where Python ignores it: in functions that C calls, as numba does.

    What numba raises after it was ignored counts as the interrupt, too.

    :raises KeyboardInterrupt: in place of such an error
    """
    again: list[threading.Timer] = []
    before = sys.unraisablehook

    def note(unraisable: Any) -> None:
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            before(unraisable)
            return
        again.append(threading.Timer(SOON, os.kill, [os.getpid(), signal.SIGINT]))
        # Whoever has a handler of its own counts signals, and knows of this one.
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            again[-1].start()

    sys.unraisablehook = note
    try:
        yield
    except RuntimeError as error:
        if again and type(error) is RuntimeError:
            raise KeyboardInterrupt from error
        raise
    finally:
        for timer in again:
            timer.cancel()
        sys.unraisablehook = before


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
