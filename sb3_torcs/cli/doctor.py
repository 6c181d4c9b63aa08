"""``sb3-torcs doctor``: what is there, what is missing, and what to type."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from sb3_torcs.car import DEFAULT_CAR
from sb3_torcs.cli.common import CACHE_FIX, lacks_cache, print_json, quiet_output
from sb3_torcs.cli.requirements import Check, check_core, check_extras
from sb3_torcs.errors import BackendUnavailable, Sb3TorcsError, install_line
from sb3_torcs.torcs.building import build_command
from sb3_torcs.torcs.installation import find_game, linker_knows

__all__ = ["Check", "add_parser", "checks", "run"]

OLDEST_PYTHON = (3, 11)
EXTENSION = "sb3_torcs._engine"
COMPILERS = ("c++", "g++", "clang++")
GAME_LIBRARIES = ("_scr_server", "_game_window")
PROGRAM_USERS = "`watch`, `serve`, backend 'scr' and picture 'game'"
LIBRARY_USERS = "`watch`, `serve`, backend 'scr' and render_mode 'game'"
REINSTALL = "sudo apt-get install --reinstall torcs torcs-data"


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
    Run all checks.

    :return: one result per check
    """
    results = [_python(), *check_core(), *check_extras()]
    plain = _compile_cache, _mathematics, _bundled_tracks, _video_encoder
    results += [_guarded(check) for check in plain]
    results.append(_guarded(_torcslite, "TorcsLite-v0"))
    results += [_guarded(check) for check in (_compiler, _extension)]
    game = _guarded(_game)
    results.append(game)
    for look in (_tracks, _cars, _layout):
        missing = Check(look.__name__.strip("_"), False, "there is no game to look at", game.fix)
        results.append(_guarded(look) if game.ok else missing)
    results.append(_guarded(_torcs, "Torcs-v0"))
    extras = (_game_program, _game_libraries, _window, _video)
    return results + [_guarded(check) for check in extras]


def _guarded(check: Callable[[], Check], name: str | None = None) -> Check:
    """Run a check; if it raises, the error is its result."""
    name = name or check.__name__.strip("_").replace("_", " ")
    try:
        return check()
    except BackendUnavailable as error:
        return Check(name, False, *_found_and_fix(error))
    except Exception as error:
        fix = CACHE_FIX if lacks_cache(error) else "pip install --force-reinstall sb3-torcs"
        return Check(name, False, f"{type(error).__name__}: {error}", fix)


def _found_and_fix(error: Sb3TorcsError) -> tuple[str, str | None]:
    """Split a message into what was found and what to do, if it says that."""
    found, cut, remedy = str(error).rpartition("; ")
    if not cut:
        return remedy, None
    typed = remedy.removeprefix("type: ")
    return found, typed if typed == remedy else typed.strip("`")


def _python() -> Check:
    found = ".".join(str(part) for part in sys.version_info[:3])
    ok = sys.version_info >= OLDEST_PYTHON
    return Check("python", ok, found, None if ok else "install Python 3.11 or newer")


def _compile_cache() -> Check:
    """Ask numba where it keeps what it compiles. Without that, each start takes seconds longer."""
    try:
        from sb3_torcs.actions import automatic_gear
    except RuntimeError as error:  # no folder can be written
        return Check("compile cache", False, str(error), CACHE_FIX)
    return Check("compile cache", True, automatic_gear.stats.cache_path, None)


def _mathematics() -> Check:
    """Compute known values by the functions on which the laps of all machines depend."""
    from sb3_torcs.maths import wrong_functions

    wrong = wrong_functions()
    with contextlib.suppress(ImportError):  # another check misses the engine
        wrong += importlib.import_module(EXTENSION).wrong_functions()
    if not wrong:
        return Check("mathematics", True, "the same as on other machines", None)
    found = f"other values of {', '.join(wrong)}: laps differ from those of other machines"
    return Check("mathematics", False, found, build_command())


def _bundled_tracks() -> Check:
    from sb3_torcs.torcs.track_names import known_tracks
    from sb3_torcs.tracks.catalogue import summaries

    files = [file for file in known_tracks().values() if file.source == "bundled"]
    names = [track.name for track in summaries(files)]
    fix = None if names else "pip install --force-reinstall sb3-torcs"
    return Check("bundled tracks", bool(names), ", ".join(names) or "none", fix)


def _video_encoder() -> Check:
    try:
        import imageio_ffmpeg

        return Check("video encoder", True, imageio_ffmpeg.get_ffmpeg_exe(), None)
    except ImportError as error:
        found = f"{error}; type: {install_line('imageio_ffmpeg')}"
        return _optional("video encoder", found, "videos")
    except RuntimeError as error:
        return Check("video encoder", False, str(error), install_line("imageio_ffmpeg"))


def _torcslite() -> Check:
    """Drive one timestep."""
    import gymnasium as gym

    env = gym.make("TorcsLite-v0")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
    return Check("TorcsLite-v0", True, "drives", None)


def _compiler() -> Check:
    """Look for a C++ compiler, which is needed until the extension is built."""
    named = os.environ.get("CXX")
    compilers = (named,) if named else COMPILERS
    path = next((found for name in compilers if (found := shutil.which(name))), None)
    if path is not None:
        return Check("compiler", True, path, None)
    found = f"none of {', '.join(compilers)}"
    if _extension().ok:
        return Check("compiler", True, f"{found}; the extension is built already", None)
    return Check("compiler", False, found, "sudo apt install g++")


def _extension() -> Check:
    try:
        module = importlib.import_module(EXTENSION)
    except ModuleNotFoundError:
        return Check("extension", False, f"{EXTENSION} is not built", build_command())
    except ImportError as error:
        return Check("extension", False, f"{EXTENSION} does not load: {error}", build_command())
    return Check("extension", True, str(module.__file__), None)


def _game() -> Check:
    game = find_game()
    return Check("game", True, f"{game.data}, {game.libraries}", None)


def _tracks() -> Check:
    """Read all tracks of the game."""
    from sb3_torcs.torcs.track_names import known_tracks
    from sb3_torcs.tracks.catalogue import summaries

    tracks = known_tracks(find_game())
    for file in tracks.values():
        try:
            summaries([file])
        except Sb3TorcsError as error:
            fix = f"repair or remove '{file.path}'; for a track of the game: {REINSTALL}"
            return Check("tracks", False, str(error), fix)
    categories = [name.partition("/")[0] for name in tracks]
    counts = [f"{categories.count(kind)} {kind}" for kind in sorted(set(categories))]
    return Check("tracks", True, f"{len(tracks)}: {', '.join(counts)}", None)


def _cars() -> Check:
    cars = find_game().cars()
    if DEFAULT_CAR in cars:
        return Check("cars", True, f"{len(cars)}, {DEFAULT_CAR} among them", None)
    return Check("cars", False, f"{len(cars)}, no {DEFAULT_CAR}", REINSTALL)


def _layout() -> Check:
    """Compare the game's structures with those that the extension knows."""
    game = find_game()
    extension = _extension()
    if not extension.ok:
        return Check("layout", False, "not compared: the extension is missing", extension.fix)
    from sb3_torcs.backends.native import check_layout

    return Check("layout", True, check_layout(game), None)


def _torcs() -> Check:
    import gymnasium as gym

    try:
        env = gym.make("Torcs-v0")
        env.reset(seed=0)
        env.close()
    except Sb3TorcsError as error:
        found, fix = _found_and_fix(error)
        return Check("Torcs-v0", False, found, fix or "use TorcsLite-v0")
    return Check("Torcs-v0", True, "drives", None)


def _game_program() -> Check:
    """Check that the game's program would start. `Torcs-v0` does not need it."""
    from sb3_torcs.torcs.libraries import missing_libraries

    try:
        game = find_game()
    except BackendUnavailable:
        return _optional("game program", "no game", PROGRAM_USERS)
    if game.program is None:
        return _optional("game program", f"no torcs-bin in {game.libraries}", PROGRAM_USERS)
    missing = missing_libraries(game)
    if missing:
        found = f"{game.program} would not find {', '.join(missing)}"
        return _optional("game program", found, PROGRAM_USERS)
    return Check("game program", True, str(game.program), None)


def _game_libraries() -> Check:
    """Look for our libraries that the game's program loads."""
    from sb3_torcs.torcs.process import compiled_library

    try:
        files = [compiled_library(name) for name in GAME_LIBRARIES]
    except BackendUnavailable as error:
        return _optional("game libraries", str(error), LIBRARY_USERS)
    return Check("game libraries", True, ", ".join(file.name for file in files), None)


def _window() -> Check:
    """Look for OpenGL and a display."""
    library = "libGL.so.1" if linker_knows("libGL.so.1") else "no libGL.so.1 (libgl1)"
    display = os.environ.get("DISPLAY")
    where = f"display {display}" if display else "no display"
    return _optional("window", f"{library}, {where}", "`watch` and `serve --window`")


def _video() -> Check:
    """Look for Xvfb."""
    from sb3_torcs.torcs.display import INSTALL, PROGRAM

    program = shutil.which(PROGRAM)
    if program is not None:
        return Check("video", True, program, None)
    found = f"no {PROGRAM}; type: {INSTALL}"
    return _optional("video", found, "`watch --video` and render_mode 'game'")


def _optional(name: str, found: str, users: str) -> Check:
    """Report something that no environment needs to drive."""
    return Check(name, True, f"{found}; only for {users}", None)
