"""The threads of PyTorch, and one more beside that of an update."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import cache

import torch as th

from sb3_torcs import cores

__all__ = ["one_thread", "two_threads"]


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Let PyTorch compute on one thread: in small products, more threads wait for each other."""
    threads = th.get_num_threads()
    th.set_num_threads(1)
    try:
        yield
    finally:
        th.set_num_threads(threads)


@contextlib.contextmanager
def two_threads() -> Iterator[Executor | None]:
    """
    Lend a second thread for the other half of an update; each half computes on one core.

    :return: what runs functions on it, in their order; ``None`` on a single core
    """
    with one_thread():
        yield _second() if cores.number() > 1 else None


@cache
def _second() -> Executor:
    """Make the thread once: an update is shorter than a thread's beginning and end."""
    return ThreadPoolExecutor(1, "update", initializer=th.set_num_threads, initargs=(1,))


os.register_at_fork(after_in_child=_second.cache_clear)  # a child has none of the threads
