"""Rules over the files of the project: each file is read and parsed once, all faults are shown."""

from __future__ import annotations

import ast
import functools
import subprocess
from pathlib import Path

ROOT = Path(__file__).parent.parent


@functools.cache
def source(path):
    return path.read_text(encoding="utf-8")


@functools.cache
def tree(path):
    return ast.parse(source(path))


@functools.cache
def nodes(path):
    return list(ast.walk(tree(path)))


@functools.cache
def tracked():
    """The names of the files that belong to the project."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True)
    return listed.stdout.decode().splitlines()


def assert_none(faults):
    """Fail with all faults of a rule, one a line, as ``file:line: what is wrong``."""
    faults = list(faults)
    assert not faults, "\n" + "\n".join(faults)
