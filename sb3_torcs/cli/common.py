"""Helpers of several verbs: numbers from the command line, JSON, tables."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_torcs.files import writable_file

if TYPE_CHECKING:
    from sb3_torcs.agents.models import TrainingRecord
    from sb3_torcs.torcs.installation import Game

__all__ = [
    "AGENT_HELP",
    "CACHE_FIX",
    "INTERRUPTED",
    "MODEL_HELP",
    "READER_LEFT",
    "TRUST_HELP",
    "asked_files",
    "drop_output",
    "lacks_cache",
    "natural",
    "parsed_robots",
    "positive",
    "print_json",
    "quiet_output",
    "seed",
    "setting",
    "status_of",
    "table",
    "told_record",
    "warn_unless_known",
]

INTERRUPTED = 130
"""The exit status after Ctrl-C, as shells have it."""
READER_LEFT = 141
"""The exit status if the reader of standard output, e.g. `head`, has ended before."""

CACHE_FIX = "export NUMBA_CACHE_DIR=/tmp/numba"

AGENT_HELP = "a saved .zip, a run's folder, a shipped agent, or 'scripted'"
MODEL_HELP = AGENT_HELP.replace(", or ", ", a ghost, or ")

TRUST_HELP = "run the code that is pickled in the model: only if you trust its author"


def asked_files(args: argparse.Namespace, kinds: Mapping[str, tuple[str, ...]]) -> dict[str, Path]:
    """
    Check the files that are asked for, before anything is driven.

    :param args: from the command line
    :param kinds: the allowed endings of each option
    :return: their paths, by option
    """
    return {
        what: writable_file(getattr(args, what), suffixes)
        for what, suffixes in kinds.items()
        if getattr(args, what) is not None
    }


def drop_output() -> None:
    """Discard what is still to be written to standard output."""
    with contextlib.suppress(OSError):  # standard output is not a file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def status_of(ended: BaseException) -> int:
    """
    Tell the exit status of work that a signal has ended: 128 and its number.

    :param ended: what the signal has raised: ``KeyboardInterrupt``, or ``SystemExit`` of the status
    """
    code = getattr(ended, "code", None)
    return code if isinstance(code, int) else INTERRUPTED


def lacks_cache(error: Exception) -> bool:
    """
    Tell whether numba has found no folder that it may write what it compiles to.

    :param error: that an import has raised
    """
    return isinstance(error, RuntimeError) and "cannot cache function" in str(error)


def told_record(driver: str, game: Game | None = None) -> TrainingRecord:
    """
    Read how a driver was trained; warn on standard error if no record is found.

    :param driver: as typed
    :param game: the installation, where one of its robots can be named instead
    :return: the record, which may be empty
    """
    from sb3_torcs.agents.models import agent_record, driver_record

    record = driver_record(driver) if game is None else agent_record(driver, game)
    warn_unless_known(driver, record)
    return record


def warn_unless_known(driver: str, record: TrainingRecord) -> None:
    """
    Warn on standard error if there is no record of how a driver was trained.

    :param driver: as typed
    :param record: of its training, which may be empty
    """
    from sb3_torcs.agents.scripted import SCRIPTED

    if not record.known and driver != SCRIPTED:
        print(
            f"sb3-torcs: '{driver}' has no record of its training; track, car, action repeat and "
            "range finders are the defaults, unless you give them. RecordCallback, passed to each "
            "`learn`, writes the record",
            file=sys.stderr,
        )


def _whole_number(least: int, bits: int | None = None) -> Callable[[str], int]:
    """
    Make a type of argparse that reads a whole number.

    :param least: that it may be
    :param bits: that it may have; ``None`` is any number
    """

    def read(text: str) -> int:
        number = int(text) if text.strip().isdecimal() else -1
        if number < least:
            raise argparse.ArgumentTypeError(f"{text!r}: expected a whole number >= {least}")
        if bits is not None and number >= 1 << bits:
            raise argparse.ArgumentTypeError(f"{text!r}: expected a whole number below 2**{bits}")
        return number

    return read


positive, natural = _whole_number(1), _whole_number(0)
seed = _whole_number(0, bits=32)  # as NumPy takes


def parsed_robots(names: str | None, game: Game) -> list[tuple[str, int]]:
    """
    Read the robots of an option.

    :param names: with commas between them; ``None`` if the option was not given
    :param game: the installation
    :return: names and indices, as of ``Game.parse_robot``
    """
    return [] if names is None else [game.parse_robot(name) for name in names.split(",")]


def setting(text: str) -> tuple[str, Any]:
    """
    Read a name and a value of YAML, for argparse.

    :param text: from the command line, e.g. ``"delay=[0, 5]"``
    :return: the name and the value, of plain Python types
    """
    from yaml import YAMLError

    from sb3_torcs.files import read_yaml

    name, equals, value = text.partition("=")
    if not (name.isidentifier() and equals):
        raise argparse.ArgumentTypeError(
            f"{text!r}: expected NAME=VALUE, e.g. delay=2; name anything else before this option"
        )
    try:
        return name, read_yaml(value)
    except YAMLError:
        raise argparse.ArgumentTypeError(
            f"{text!r}: {value!r} is no value of YAML; e.g. delay=[0, 5] has one"
        ) from None


@contextlib.contextmanager
def quiet_output(active: bool) -> Iterator[None]:
    """
    Send what libraries print to standard error, so that standard output holds results only.

    :param active: whether to do so
    """
    if not active:
        yield
        return
    with contextlib.redirect_stdout(sys.stderr):
        yield


def print_json(value: Any) -> None:
    """
    Print one JSON value; infinities and NaN become ``null``.

    :param value: of plain Python types
    """
    print(json.dumps(_finite(value), indent=2, allow_nan=False))


def _finite(value: Any) -> Any:
    """Replace infinities and NaN, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def table(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """
    Lay out a table: words to the left, numbers to the right.

    It is plain text of any width, which ``cut`` and ``awk`` read. rich's table would need as much
    code to be kept from folding cells, drawing lines and reading ``[...]`` as markup.

    :param headers: of the columns
    :param rows: cells, as many per row as there are headers
    :return: lines without trailing spaces
    """
    columns = list(zip(headers, *rows, strict=True))
    widths = [max(len(cell) for cell in column) for column in columns]
    numeric = [all(_is_number(cell) for cell in column[1:]) for column in columns]
    lines = []
    for row in (headers, ["-" * width for width in widths], *rows):
        cells = zip(row, widths, numeric, strict=True)
        padded = [cell.rjust(width) if right else cell.ljust(width) for cell, width, right in cells]
        lines.append("  ".join(padded).rstrip())
    return "\n".join(lines)


def _is_number(cell: str) -> bool:
    return cell[:1].isdigit() or cell[:1] == "-"
