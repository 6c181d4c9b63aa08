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

from sb3_torcs.car import DEFAULT_CAR
from sb3_torcs.files import writable_file

if TYPE_CHECKING:
    from sb3_torcs.agents.drivers import NamedDriver
    from sb3_torcs.envs.options import AidName
    from sb3_torcs.torcs.installation import Game

__all__ = [
    "CACHE_FIX",
    "DRIVER_HELP",
    "INTERRUPTED",
    "READER_LEFT",
    "TRUST_HELP",
    "add_environment",
    "drop_output",
    "environment_settings",
    "lacks_cache",
    "named_driver",
    "natural",
    "output_files",
    "parsed_robots",
    "positive",
    "print_json",
    "quiet_output",
    "seed",
    "setting",
    "status_of",
    "table",
    "warn_unless_known",
]

INTERRUPTED = 130
"""The exit status after Ctrl-C, as shells have it."""
READER_LEFT = 141
"""The exit status if the reader of standard output, e.g. `head`, has ended before."""

CACHE_FIX = "export NUMBA_CACHE_DIR=/tmp/numba"

DRIVER_HELP = (
    "an agent, a robot, a ghost, or 'scripted', as `sb3-torcs drivers` lists them; or a saved "
    ".zip or its run's folder"
)

TRUST_HELP = "run the code that is pickled in the model: only if you trust its author"


def output_files(args: argparse.Namespace, kinds: Mapping[str, tuple[str, ...]]) -> dict[str, Path]:
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


def named_driver(source: str, aids: Sequence[AidName] = ()) -> NamedDriver:
    """
    Find a driver; warn on standard error if an agent has no record of its training.

    :param source: as typed
    :param aids: driver aids that an agent gets besides those of its training
    :raises InvalidOption: if there is none
    """
    from sb3_torcs.agents.drivers import find_driver

    driver = find_driver(source, aids)
    warn_unless_known(driver)
    return driver


def warn_unless_known(driver: NamedDriver) -> None:
    """
    Warn on standard error if there is no record of how an agent was trained.

    :param driver: that was found
    """
    if driver.kind == "agent" and not driver.record.known:
        print(
            f"sb3-torcs: '{driver.source}' has no record of its training; track, car, action "
            "repeat and range finders are the defaults, unless you give them. RecordCallback, "
            "passed to each `learn`, writes the record",
            file=sys.stderr,
        )


def add_environment(parser: argparse.ArgumentParser, *, world: bool = True) -> None:
    """
    Add the options that choose an environment; :func:`environment_settings` reads them.

    :param parser: of the verb
    :param world: whether the verb drives in any world, not only in the game
    """
    add = parser.add_argument
    if world:
        add("--env", metavar="ID", help="default: that of an agent's training, or Torcs-v0")
    add("--track", metavar="T", help="default: that of an agent's training, or aalborg")
    add("--car", metavar="C", help=f"default: that of an agent's training, or {DEFAULT_CAR}")
    add("--env-kwargs", nargs="+", type=setting, default=[], metavar="NAME=VALUE",
        help="arguments of the environment, with values of YAML, e.g. "
        "conditions='{delay: 2}' aids=[unstick]")  # fmt: skip


def environment_settings(args: argparse.Namespace) -> dict[str, Any]:
    """
    Read the arguments of an environment that were typed: ``--track``, ``--car``, ``--env-kwargs``.

    :param args: from the command line
    :return: names and values
    :raises InvalidOption: if one is given twice
    """
    from sb3_torcs.errors import InvalidOption

    typed = [(name, getattr(args, name, None)) for name in ("track", "car")]
    pairs = [(name, value) for name, value in typed if value is not None]
    pairs += getattr(args, "env_kwargs", ())
    names = [name for name, _ in pairs]
    for name in names:
        if names.count(name) > 1:
            raise InvalidOption(f"{name} is given twice; give it one value")
    return dict(pairs)


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

    :param text: from the command line, e.g. ``"aids=[unstick]"``
    :return: the name and the value, of plain Python types
    """
    from yaml import YAMLError

    from sb3_torcs.files import read_yaml

    name, equals, value = text.partition("=")
    if not (name.isidentifier() and equals):
        raise argparse.ArgumentTypeError(
            f"{text!r}: expected NAME=VALUE, e.g. track=forza; drivers stand before this option"
        )
    try:
        return name, read_yaml(value)
    except YAMLError:
        raise argparse.ArgumentTypeError(
            f"{text!r}: {value!r} is no value of YAML; e.g. aids=[unstick] has one"
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
