"""The command that builds the engine, for messages about a missing one."""

from __future__ import annotations

import json
import os
import shlex
import sys
from importlib import metadata
from urllib.parse import unquote, urlsplit

__all__ = ["build_command"]

ANYWHERE = "."
"""A checkout that one has gone to."""


def build_command() -> str:
    """
    Compose the command that builds the engine from the folder that the package was installed from.

    :return: a command line, and what it needs
    """
    source, editable = _source()
    words = [sys.executable, "-m", "pip", "install", "--force-reinstall", "--no-deps"]
    command = shlex.join([*words, *(["--editable"] if editable else []), source])
    where = " (in a checkout of sb3-torcs)" if source == ANYWHERE else ""
    return f"{command}{where} (it needs a C++17 compiler: sudo apt install g++ python3-dev)"


def _source() -> tuple[str, bool]:
    """Read from pip's record which folder the package was installed from, and whether editable."""
    try:
        record = json.loads(metadata.distribution("sb3-torcs").read_text("direct_url.json") or "{}")
    except (metadata.PackageNotFoundError, OSError, ValueError):
        record = {}
    url = record.get("url", "")
    path = unquote(urlsplit(url).path)
    if url.startswith("file:") and os.path.exists(path) and not path.endswith(".whl"):
        return path, bool(record.get("dir_info", {}).get("editable"))
    vcs = record.get("vcs_info")
    return (f"{vcs['vcs']}+{url}", False) if vcs else (ANYWHERE, False)
