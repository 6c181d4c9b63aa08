"""Signals that this process answers for a while."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

__all__ = ["answered"]


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
    before = {number: signal.signal(number, by) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
