"""``sb3-torcs doctor``: what is there, what is missing, and what to type."""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import os
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sb3_torcs.cli.common import print_json, quiet_output
from sb3_torcs.errors import Sb3TorcsError

__all__ = ["Check", "add_parser", "checks", "run"]

OLDEST_PYTHON = (3, 10)
PACKAGES = {
    "gymnasium": "gymnasium",
    "highway-env": "highway_env",
    "imageio": "imageio",
    "matplotlib": "matplotlib",
    "numba": "numba",
    "numpy": "numpy",
    "rl_zoo3": "rl_zoo3",
    "stable-baselines3": "stable_baselines3",
    "tensorboard": "tensorboard",
    "torch": "torch",
}
"""Distributions, and what is imported of them."""


@dataclass(frozen=True)
class Check:
    """One thing that was looked at."""

    name: str
    ok: bool
    found: str
    fix: str | None  # what to do; ``None`` when nothing is wrong


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "doctor",
        help="check what is installed and say what is missing",
        description="Check what TorcsLite-v0 and Torcs-v0 need. The exit status is 0 only when "
        "both have all they need.",
    )
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object and nothing else"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status: 1 when something is missing
    """
    with quiet_output(args.json):
        results = checks()
    ok = all(check.ok for check in results)
    if args.json:
        print_json({"ok": ok, "checks": [asdict(check) for check in results]})
        return 0 if ok else 1
    width = max(len(check.name) for check in results)
    for check in results:
        print(f"{'ok     ' if check.ok else 'MISSING'}  {check.name.ljust(width)}  {check.found}")
        if check.fix:
            print(f"{' ' * (width + 9)}  -> {check.fix}")
    return 0 if ok else 1


def checks() -> list[Check]:
    """
    Look at everything.

    :return: one result per thing
    """
    results = [_python(), *(_package(name, module) for name, module in PACKAGES.items())]
    others = (_compile_cache, _tracks, _video, _lite, _torcs_data, _torcs)
    return results + [_guarded(check) for check in others]


def _guarded(check: Callable[[], Check]) -> Check:
    """Look at something that may be too broken to look at: that, too, is a finding."""
    name = check.__name__.strip("_").replace("_", " ")
    try:
        return check()
    except Exception as error:
        fix = "pip install --force-reinstall sb3-torcs"
        return Check(name, False, f"{type(error).__name__}: {error}", fix)


def _python() -> Check:
    found = ".".join(str(part) for part in sys.version_info[:3])
    ok = sys.version_info >= OLDEST_PYTHON
    return Check("python", ok, found, None if ok else "install Python 3.10 or newer")


def _package(name: str, module: str) -> Check:
    try:
        version = importlib.metadata.version(name)
        importlib.import_module(module)
    except Exception as error:
        return Check(name, False, f"{type(error).__name__}: {error}", f"pip install '{name}'")
    return Check(name, True, version, None)


def _compile_cache() -> Check:
    """Where numba keeps compiled code; without it each start compiles anew, for seconds."""
    from numba.core import config

    import sb3_torcs.backends

    given = config.CACHE_DIR
    folder = Path(given) if given else Path(sb3_torcs.backends.__file__).parent / "__pycache__"
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if os.access(existing, os.W_OK):
        return Check("compile cache", True, str(folder), None)
    fix = "export NUMBA_CACHE_DIR=~/.cache/numba"
    return Check("compile cache", False, f"{folder} is not writable", fix)


def _tracks() -> Check:
    from sb3_torcs.tracks import available_tracks

    names = [track.name for track in available_tracks() if track.source == "bundled"]
    fix = None if names else "pip install --force-reinstall sb3-torcs"
    return Check("bundled tracks", bool(names), ", ".join(names) or "none", fix)


def _video() -> Check:
    try:
        import imageio_ffmpeg  # type: ignore[import-untyped]

        return Check("video encoder", True, imageio_ffmpeg.get_ffmpeg_exe(), None)
    except (ImportError, RuntimeError) as error:
        return Check("video encoder", False, str(error), "pip install 'imageio[ffmpeg]'")


def _lite() -> Check:
    """Drive one decision."""
    import gymnasium as gym

    env = gym.make("TorcsLite-v0")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
    return Check("TorcsLite-v0", True, "drives", None)


def _torcs_data() -> Check:
    from sb3_torcs.tracks import torcs_folders

    folders = torcs_folders()
    if folders:
        return Check("TORCS data", True, str(folders[0]), None)
    found = "not installed; only Torcs-v0 needs it, TorcsLite-v0 does not"
    return Check("TORCS data", False, found, "sudo apt install torcs-data")


def _torcs() -> Check:
    import gymnasium as gym

    try:
        env = gym.make("Torcs-v0")
        env.reset(seed=0)
        env.close()
    except Sb3TorcsError as error:
        found, _, fix = str(error).partition("; ")
        return Check("Torcs-v0", False, found, fix or "use TorcsLite-v0")
    return Check("Torcs-v0", True, "drives", None)
