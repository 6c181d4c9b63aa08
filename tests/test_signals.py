"""Signals that come while something must not stop half-way."""

from __future__ import annotations

import signal
import time

import pytest
from processes import raise_in_c

from sb3_torcs.signals import defer_signals, on_signal, redeliver_interrupts


def test_a_signal_waits_until_the_work_is_done():
    done = []

    @defer_signals()
    def work():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        done.append(True)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == [True]


def test_an_ignored_signal_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with defer_signals():
            signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_an_interrupt_that_python_ignores_comes_again():
    @redeliver_interrupts()
    def work():
        raise_in_c(signal.SIGINT)
        time.sleep(60.0)

    with pytest.raises(KeyboardInterrupt):
        work()


def test_an_error_that_follows_an_ignored_interrupt_is_the_interrupt():
    @redeliver_interrupts()
    def work():
        raise_in_c(signal.SIGINT)
        raise RuntimeError("no compiled object yet")

    with pytest.raises(KeyboardInterrupt):
        work()


def test_so_does_the_end_that_python_ignores():
    """A handler that raises SystemExit, as the command's."""

    def end(number, frame):
        del frame
        raise SystemExit(128 + number)

    @on_signal(end, signal.SIGTERM)
    @redeliver_interrupts()
    def work():
        raise_in_c(signal.SIGTERM)
        time.sleep(60.0)

    with pytest.raises(SystemExit, match="143"):
        work()


def test_other_errors_are_none():
    with pytest.raises(RuntimeError, match="else"), redeliver_interrupts():
        raise RuntimeError("something else")
