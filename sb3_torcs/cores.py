"""The cores of the processor that this process uses."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator

__all__ = ["at_most", "number"]

_limits = [math.inf]


def number() -> int:
    """Return how many cores this process may use at once."""
    # Windows and macOS do not restrict a process to some cores.
    affinity = getattr(os, "sched_getaffinity", None)
    own = (os.cpu_count() or 1) if affinity is None else len(affinity(0))
    return int(min(own, *_limits))


@contextlib.contextmanager
def at_most(cores: int) -> Iterator[None]:
    """
    Leave the other cores to the processes beside this one, in all threads of this process.

    :param cores: number of them, at least 1
    """
    _limits.append(cores)
    try:
        yield
    finally:
        _limits.remove(cores)
