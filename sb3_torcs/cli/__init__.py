"""The command ``sb3-torcs``: one module per verb, each with ``add_parser`` and ``run``."""

from __future__ import annotations

import argparse
import contextlib
import errno
import os
import signal
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import FrameType

from sb3_torcs import __version__
from sb3_torcs.cli import (
    bench,
    compare,
    compete,
    doctor,
    drivers,
    evaluate,
    install_torcs,
    optimize_lap,
    race,
    serve,
    study,
    tracks,
    train,
    watch,
)
from sb3_torcs.cli.common import CACHE_FIX, INTERRUPTED, READER_LEFT, drop_output, lacks_cache
from sb3_torcs.cli.parser import Parser, grouped
from sb3_torcs.cli.plain import any_terminal, open_streams
from sb3_torcs.errors import Sb3TorcsError
from sb3_torcs.signals import ENDING, EXIT_STATUS, on_signal, redeliver_interrupts

__all__ = ["main"]

USAGE_ERROR = 2
PROCESS_NAME = "sb3-racing"
GROUPS = {
    "begin": (doctor, install_torcs, tracks, drivers),
    "learn": (train, study),
    "look": (evaluate, compare, watch),
    "race": (race, serve, compete),
    "measure": (optimize_lap, bench),
}
"""The verbs, as the help shows them."""
VERBS = tuple(verb for verbs in GROUPS.values() for verb in verbs)


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run one verb.

    :param argv: the words after the command's name; ``None`` takes those of the process
    :return: the exit status: 0, 2 if the command cannot be run as typed, 130 after Ctrl-C
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if argv is None:
        _name_process()
    open_streams()
    with any_terminal():
        args = _parsed(words)
        return 0 if args is None else _run(args)


def _name_process() -> None:
    """Choose another name in lists of processes: SCR clients end what is called torcs."""
    with contextlib.suppress(OSError):  # only Linux has it
        Path("/proc/self/comm").write_text(PROCESS_NAME, encoding="utf-8")


def _parsed(words: list[str]) -> argparse.Namespace | None:
    """Read the command line. Without a verb, print the help and return ``None``."""
    parser, verbs = _parser()
    if words:
        parser.check_verb(words[0], verbs)
    args = parser.parse_args(words)
    if args.verb is None:
        parser.print_help()
        return None
    return args


def _run(args: argparse.Namespace) -> int:
    """Run a verb; print an error as one line."""
    try:
        os.getcwd()
    except FileNotFoundError:
        print("sb3-torcs: the working folder was deleted; go to another one", file=sys.stderr)
        return USAGE_ERROR
    try:
        # Under nohup, SIGHUP is ignored and stays so.
        ends = [n for n in ENDING if signal.getsignal(n) == signal.SIG_DFL]
        with on_signal(_end, *ends), redeliver_interrupts():
            status: int = args.run(args)
        sys.stdout.flush()
    except Sb3TorcsError as error:
        print(f"sb3-torcs: {error}", file=sys.stderr)
        return USAGE_ERROR
    except BrokenPipeError:  # the reader, e.g. `head`, has ended
        drop_output()
        return READER_LEFT
    except RuntimeError as error:
        if not lacks_cache(error):
            raise
        print(f"sb3-torcs: numba {error}; type: {CACHE_FIX}", file=sys.stderr)
        return USAGE_ERROR
    except OSError as error:
        where = error.filename or "the output"
        too_long = error.errno == errno.ENAMETOOLONG
        remedy = "type a shorter name" if too_long else "make room, or choose another folder"
        said = f"{error.strerror or error}: {where}; {remedy}"
        print(f"sb3-torcs: {said}", file=sys.stderr)
        drop_output()
        return USAGE_ERROR
    except KeyboardInterrupt:
        print("sb3-torcs: interrupted", file=sys.stderr)
        return INTERRUPTED
    return status


def _end(number: int, frame: FrameType | None) -> None:
    """Let SIGTERM and SIGHUP end the process as an exception does, so that it cleans up."""
    del frame
    raise SystemExit(EXIT_STATUS + number)


def _parser() -> tuple[Parser, Iterable[str]]:
    """Build the parser; return it and the verbs that it knows."""
    parser = Parser(
        prog="sb3-torcs",
        usage="%(prog)s [-h] [--version] VERB ...",
        description="Train, watch and measure cars that learn to race.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    subparsers = parser.add_subparsers(
        dest="verb", metavar="VERB", prog="sb3-torcs", help=argparse.SUPPRESS
    )
    groups: dict[str, list[str]] = {}
    for group, verbs in GROUPS.items():
        known = set(subparsers.choices)
        for verb in verbs:
            verb.add_parser(subparsers)
        groups[group] = [name for name in subparsers.choices if name not in known]
    helps = {action.dest: action.help or "" for action in subparsers._get_subactions()}
    parser.epilog = grouped(
        {group: {name: helps[name] for name in names} for group, names in groups.items()}
    )
    return parser, subparsers.choices
