"""The threads of PyTorch."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch as th

__all__ = ["one_thread"]


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Let PyTorch compute on one thread: in small products, more threads wait for each other."""
    threads = th.get_num_threads()
    th.set_num_threads(1)
    try:
        yield
    finally:
        th.set_num_threads(threads)
