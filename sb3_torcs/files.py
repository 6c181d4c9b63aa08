"""Files of results, which are checked before any work begins; and YAML that people write."""

from __future__ import annotations

import ast
import contextlib
import itertools
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from sb3_torcs.errors import EXTRAS, OutputNotWritable, Sb3TorcsError, check_extras, install_line

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

__all__ = [
    "IN_A_FOLDER",
    "PICTURES",
    "as_list",
    "atomic_file",
    "checked_ending",
    "import_advice",
    "lock",
    "path_and_arguments",
    "plain_python",
    "read_yaml",
    "readable",
    "writable_file",
    "writable_folder",
]

PICTURES = (".png", ".svg", ".pdf")
"""Endings of pictures that matplotlib draws."""

WRITTEN_BY = {
    ".html": ("plotly", "pyarrow"), ".mp4": ("imageio_ffmpeg",), ".parquet": ("pyarrow",),
}  # fmt: skip
"""Packages of extras that it takes to write a file, by its ending."""

IN_A_FOLDER = "choose a file in an existing folder that you may write to"
"""Advice where a file cannot be written."""

MAX_LENGTH = 2**16  # [characters] PyYAML takes about a second for as many
MAX_BRACKETS = 100  # open at once: PyYAML's time grows with their square
MAX_NODES = 100_000  # after aliases are expanded

TOO_MUCH = (RecursionError, MemoryError, SyntaxError, TypeError)
"""What Python's parser raises for a text that is no expression, or nests too deep."""


def readable(name: str) -> str:
    r"""
    Make text of a file's name, for tables and pictures: a byte that is none is written as ``\xff``.

    :param name: as Python reads it from the system
    """
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def import_advice(module: str) -> str:
    """
    Tell what to do about a module that does not import.

    :param module: its dotted path
    """
    top = module.partition(".")[0]
    if top in EXTRAS:
        return f"type: {install_line(top)}"
    if Path(f"{top}.py").is_file() or Path(top).is_dir():
        return f"'{top}' lies in this folder; type PYTHONPATH=. before the command"
    return "install the package that it is in"


def as_list(value: Any) -> list[Any]:
    """
    Read a list in any of the RL Zoo's forms: callbacks, for one, or wrappers.

    :param value: a list, a single item, or ``None``
    :return: a new list
    """
    return list(value) if isinstance(value, list) else [] if value is None else [value]


def path_and_arguments(item: Any) -> tuple[str, dict[str, Any]]:
    """
    Read a class and its arguments, in either of the RL Zoo's forms.

    :param item: a dotted path, or ``{path: {argument: value}}``
    :return: the path and the arguments
    :raises ValueError: if it is neither
    """
    single = isinstance(item, dict) and len(item) == 1
    path, arguments = next(iter(item.items())) if single else (item, {})
    if not isinstance(path, str) or not isinstance(arguments, dict):
        raise ValueError(f"{item!r:.80} is no dotted path, alone or with arguments")
    return path, dict(arguments)


def writable_folder(folder: str | Path) -> Path:
    """
    Make a folder, and make sure that files can be written in it.

    :param folder: that results should go to
    :return: the folder
    :raises OutputNotWritable: if it cannot be made or written
    """
    path = Path(os.path.expanduser(folder))
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise OutputNotWritable(
            f"cannot write to the folder '{path}': {error.strerror or error}; give another one"
        ) from error
    return path


def checked_ending(file: str | Path, suffixes: tuple[str, ...]) -> Path:
    """
    Make sure that a file gets the ending of what it will hold.

    :param file: that a result should go to
    :param suffixes: allowed endings, e.g. ``(".png",)``
    :return: its path
    :raises OutputNotWritable: if it has another one
    """
    path = Path(os.path.expanduser(file))
    if path.suffix.lower() not in suffixes:
        raise OutputNotWritable(f"'{file}' should end in {' or '.join(suffixes)}")
    return path


def writable_file(file: str | Path, suffixes: tuple[str, ...]) -> Path:
    """
    Make sure that a file can be written.

    :param file: that a result should go to
    :param suffixes: allowed endings, e.g. ``(".png",)``
    :return: its path
    :raises OutputNotWritable: if its folder cannot be written, or its kind is another
    :raises PackageMissing: if a package that files of this kind take is not installed
    """
    path = checked_ending(file, suffixes)
    ending = path.suffix.lower()
    check_extras(f"a {ending} file", *WRITTEN_BY.get(ending, ()))
    if path.is_dir():
        raise OutputNotWritable(f"'{path}' is a folder; give a file in it")
    writable_folder(path.parent)
    return path


@contextlib.contextmanager
def atomic_file(
    path: Path, advice: str = "choose another file", *, parents: bool = False
) -> Iterator[Path]:
    """
    Write a file completely or not at all, also if the power fails.

    :param path: of the file, which appears when the block ends
    :param advice: what to do where it cannot be written
    :param parents: whether to make the folder that it is in
    :return: a path beside it with the same ending, which the block writes
    :raises OutputNotWritable: if the file cannot be written; the previous one is kept
    """
    if path.is_dir():
        raise OutputNotWritable(f"cannot write '{path}': it is a folder; {advice}")
    path = Path(os.path.realpath(path))  # a symbolic link stays, and its target is written
    aside = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        try:
            if parents:
                path.parent.mkdir(parents=True, exist_ok=True)
            aside.touch()  # a path that cannot be written raises here, before the work
            yield aside
            with aside.open("r+b") as written:  # Windows flushes only what may be written
                os.fsync(written.fileno())
            aside.replace(path)
        finally:
            with contextlib.suppress(OSError):  # no folder, no file
                aside.unlink()
    except Sb3TorcsError:  # some are an OSError, too
        raise
    except OSError as error:
        raise OutputNotWritable(
            f"cannot write '{path}': {error.strerror or error}; {advice}"
        ) from error


def lock(file: int, *, wait: bool) -> None:
    """
    Lock a file or a folder until it is closed. On Windows nothing is locked, as on file systems
    that know no locks.

    :param file: descriptor of the open file
    :param wait: until another process has released it
    :raises OSError: if the file system knows no locks
    :raises BlockingIOError: if another process holds it, and this one does not wait
    """
    if fcntl is not None:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


def read_yaml(text: str, loader_class: type[yaml.SafeLoader] = yaml.SafeLoader) -> Any:
    """
    Read a YAML document as plain data, with limits on size, depth and aliases, so that reading
    never hangs.

    :param text: of the file
    :param loader_class: that builds the values
    :return: of plain Python types
    :raises yaml.YAMLError: if it is not YAML, or beyond the limits
    """
    if len(text) > MAX_LENGTH:
        raise yaml.YAMLError(f"{len(text)} characters; at most {MAX_LENGTH} are read")
    steps = ((char in "[{") - (char in "]}") for char in text)
    if max(itertools.accumulate(steps), default=0) > MAX_BRACKETS:
        raise yaml.YAMLError("it nests too deep")
    loader = loader_class(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        if _written_out(node, {}) > MAX_NODES:
            raise yaml.YAMLError(f"its aliases stand for more than {MAX_NODES} values")
        return loader.construct_document(node)
    except RecursionError as error:
        raise yaml.YAMLError("it nests too deep, or an alias is within what it stands for") from (
            error
        )
    except ValueError as error:  # of an invalid date or number
        raise yaml.YAMLError(str(error)) from error
    except (LookupError, AttributeError) as error:
        raise yaml.YAMLError(f"a value does not fit its tag, such as !!int ({error})") from error
    finally:
        loader.dispose()


def _written_out(node: yaml.Node, known: dict[int, int]) -> int:
    """Count the nodes after aliases are expanded, visiting each once."""
    if id(node) not in known:
        parts = node.value if isinstance(node, yaml.CollectionNode) else []
        children = [child for part in parts for child in (part if type(part) is tuple else (part,))]
        known[id(node)] = 1 + sum(_written_out(child, known) for child in children)
    return known[id(node)]


def plain_python(text: str, changes: ast.NodeTransformer | None = None) -> Any:
    """
    Read an expression like ``dict(net_arch=[64, 64])``, as the zoo's own files have them.

    :param text: of literals, in ``{}``, ``[]`` and calls of ``dict``
    :param changes: to the expression, before it is read
    :return: their value; tuples become lists
    :raises ValueError: if it is anything else
    """
    try:
        expression = ast.parse(text.strip(), mode="eval")
        return _value((changes.visit(expression) if changes else expression).body)
    except TOO_MUCH as error:
        raise ValueError(f"{text!r:.80} is not plain data") from error


def _value(node: ast.expr) -> Any:
    if isinstance(node, ast.List | ast.Tuple):
        return [_value(item) for item in node.elts]
    if isinstance(node, ast.Dict) and None not in node.keys:
        keys = [ast.literal_eval(key) for key in node.keys if key is not None]
        return dict(zip(keys, map(_value, node.values), strict=True))
    if isinstance(node, ast.Call) and not node.args and ast.unparse(node.func) == "dict":
        named = {keyword.arg: keyword.value for keyword in node.keywords}
        if None not in named:  # of ``**``
            return {str(name): _value(value) for name, value in named.items()}
    return ast.literal_eval(node)
