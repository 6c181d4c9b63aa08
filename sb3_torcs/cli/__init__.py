"""The command ``sb3-torcs``: one module per verb, each with ``add_parser`` and ``run``."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from types import FrameType

from sb3_torcs.cli import (
    bench,
    compete,
    doctor,
    evaluate,
    install_torcs,
    report,
    robots,
    serve,
    study,
    tracks,
    train,
    watch,
)
from sb3_torcs.errors import Sb3TorcsError

__all__ = ["main"]

USAGE_ERROR = 2
INTERRUPTED = 130
READER_LEFT = 141
VERBS = (
    doctor, install_torcs, tracks, train, evaluate, watch, study, report, robots, serve, compete,
    bench,
)  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run one verb.

    :param argv: the words after the command's name; ``None`` takes those of the process
    :return: the exit status: 0, 2 for a mistake in what was asked, 130 after Ctrl-C
    """
    words = list(sys.argv[1:] if argv is None else argv)
    split = words.index("--") if "--" in words else len(words)
    parser = _parser()
    args = parser.parse_args(words[:split])
    args.zoo_args = words[split + 1 :]
    if args.zoo_args and args.verb != "train":
        parser.error(f"{args.verb} passes nothing on; leave out '--' and what follows it")
    try:
        with _ended_politely():
            status: int = args.run(args)
        sys.stdout.flush()
    except Sb3TorcsError as error:
        print(f"sb3-torcs: {error}", file=sys.stderr)
        return USAGE_ERROR
    except BrokenPipeError:  # the reader, e.g. `head`, has seen enough
        _drop_output()
        return READER_LEFT
    except OSError as error:
        where = error.filename or "the output"
        said = f"{error.strerror or error}: {where}; make room, or choose another place"
        print(f"sb3-torcs: {said}", file=sys.stderr)
        _drop_output()
        return USAGE_ERROR
    except KeyboardInterrupt:
        print("sb3-torcs: interrupted", file=sys.stderr)
        return INTERRUPTED
    return status


@contextlib.contextmanager
def _ended_politely() -> Iterator[None]:
    """Clean up before SIGTERM, or the terminal's going away, ends the process."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        del frame
        raise SystemExit(128 + number)

    default = [n for n in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(n) == signal.SIG_DFL]
    for number in default:  # nohup ignores the latter
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in default:
            signal.signal(number, signal.SIG_DFL)


def _drop_output() -> None:
    """Let Python, when it ends, write what it still holds to nowhere."""
    with contextlib.suppress(OSError):  # it is no file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-torcs", description="Train, watch and measure cars that learn to race."
    )
    subparsers = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    for verb in VERBS:
        verb.add_parser(subparsers)
    return parser
