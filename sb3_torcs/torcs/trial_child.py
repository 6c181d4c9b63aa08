"""The process in which :mod:`sb3_torcs.tracks.trial` loads a track; it may crash or hang.

It imports little, so that it starts in a quarter of a second.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import sys
from typing import Any

from sb3_torcs.errors import Sb3TorcsError

__all__ = ["ANSWER", "REFUSED", "encoded", "main"]

SPEED = 20.0  # [m/s] of the car at each start
TICKS = 10  # [s] of driving after each start
REFUSED = 3  # exit status: the engine has raised an error, which is printed
ANSWER = b"\nsb3-torcs:"  # comes before the answer, since some Pythons print when they start
PR_SET_PDEATHSIG = 1  # of Linux's prctl


def main() -> None:
    """Load the race that the last argument describes, and print its road's numbers."""
    task = json.loads(sys.argv[-1])
    _limit(task["owner"], task["seconds"])
    from sb3_torcs import _engine

    try:
        engine = _engine.Engine(**encoded(task["race"]))
        engine.start()
        _look_around(engine, task["places"])
        _answer(0, engine.road().tobytes())
    except Sb3TorcsError as error:
        _answer(REFUSED, json.dumps([type(error).__name__, str(error)]).encode())


def encoded(race: dict[str, Any]) -> dict[str, Any]:
    """
    Put the engine's arguments into its form: paths as bytes, since not every one is a text.

    :param race: from :func:`sb3_torcs.tracks.trial.engine_arguments`
    :return: the same with other paths
    """
    paths = {name: os.fsencode(race[name]) for name in ("data", "libraries", "plib", "track")}
    return {**race, **paths}


def _answer(status: int, answer: bytes) -> None:
    """Print the answer and end at once, before more of the game's code runs."""
    sys.stdout.flush()
    sys.stdout.buffer.write(ANSWER + answer)
    sys.stdout.buffer.flush()
    os._exit(status)


def _look_around(engine: Any, places: int) -> None:
    """Start at several points of the road and drive: single heights or widths may be absurd."""
    length = engine.track_summary()["length"]
    for place in range(places):
        with contextlib.suppress(Sb3TorcsError):  # who starts there is told so
            engine.start_at(length * place / places, 0.0, 0.0, SPEED)
            engine.advance(TICKS)


def _limit(owner: int, seconds: int) -> None:
    """
    End with the owner, after some seconds of computing, and without a core file.

    :param owner: the process that waits for this one
    :param seconds: of processor time, so that a busy machine does not change the result
    """
    import resource  # of Linux, like the game: other systems import this module, too

    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != owner:
        os._exit(1)  # it had ended before
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _, most = resource.getrlimit(resource.RLIMIT_CPU)
    limit = seconds if most == resource.RLIM_INFINITY else min(seconds, most)
    resource.setrlimit(resource.RLIMIT_CPU, (limit, most))
