"""The threads of PyTorch, and one more beside that of an update."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from functools import cache, partial
from queue import SimpleQueue

import torch as th

from sb3_torcs import cores

__all__ = ["Helper", "one_thread", "two_threads"]

Task = Callable[[], object]


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Let PyTorch compute on one thread: in small products, more threads wait for each other."""
    threads = th.get_num_threads()
    th.set_num_threads(1)
    try:
        yield
    finally:
        th.set_num_threads(threads)


class Helper:
    """
    Does tasks on a second thread, one after the other.

    Ctrl-C may come anywhere in the thread that it helps. ``concurrent.futures`` can lose a lock
    then, and wait for ever; a ``SimpleQueue`` cannot.

    :param tasks: that the second thread takes; with ``None`` there is none, and each task is done
        where it begins
    """

    def __init__(self, tasks: SimpleQueue[Task] | None) -> None:
        self._tasks = tasks
        self._ends: SimpleQueue[object] = SimpleQueue()
        self._begun = False

    def begin(self, task: Task) -> None:
        """
        Begin a task, after those before.

        :param task: to be done
        """
        if self._tasks is None:
            task()
            return
        self._begun = True
        self._tasks.put(partial(self._do, task))

    def _do(self, task: Task) -> None:
        try:
            task()
        except BaseException as error:  # who waits raises it
            self._ends.put(error)

    def wait(self) -> None:
        """
        Wait until all tasks are done.

        :raises BaseException: what the first of them has raised, if any has
        """
        if self._tasks is None or not self._begun:
            return
        last = object()  # one of its own: Ctrl-C may have ended another wait
        self._tasks.put(partial(self._ends.put, last))
        ends = list(iter(self._ends.get, last))
        self._begun = False
        for end in ends:
            if isinstance(end, BaseException):
                raise end


@contextlib.contextmanager
def two_threads() -> Iterator[Helper]:
    """
    Lend a second thread for the other half of an update, where there is a core for it.

    :return: what does tasks on it; at the end they are done
    """
    with one_thread():  # each half computes on one core
        helper = Helper(_second() if cores.number() > 1 else None)
        try:
            yield helper
        finally:  # after Ctrl-C, too: nobody writes to what follows reads
            helper.wait()


@cache
def _second() -> SimpleQueue[Task]:
    """Start the thread, once: an update is shorter than a thread's beginning and end."""
    tasks: SimpleQueue[Task] = SimpleQueue()
    threading.Thread(target=_work, args=(tasks,), name="update", daemon=True).start()
    return tasks


def _work(tasks: SimpleQueue[Task]) -> None:
    th.set_num_threads(1)
    while True:
        tasks.get()()


if hasattr(os, "register_at_fork"):  # a child has none of the threads
    os.register_at_fork(after_in_child=_second.cache_clear)
