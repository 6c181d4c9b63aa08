"""A copy of the installed game, made of links, in which a test can break one thing."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

LINKED_DEEP = ("cars", "tracks", "categories", "drivers")  # folders whose files tests replace

TRY = """
import json, sys
from sb3_torcs.backends.native import make_engine
from sb3_torcs.torcs.starting_list import AGENT
from sb3_torcs.errors import Sb3TorcsError
from sb3_torcs.torcs.installation import find_game

def attempt(track="aalborg", entries=(AGENT,), **options):
    try:
        engine = make_engine(find_game(), track, list(entries), **options)
        engine.start()
        engine.advance(50)
        engine.close()
    except Sb3TorcsError as error:
        return [type(error).__name__, str(error)]
    return ["nothing", ""]

print(json.dumps([attempt(**words) for words in json.loads(sys.argv[1])]))
"""


def copy_game(game, root: Path) -> Path:
    """Lay out links to all files of a game; folders that tests write to are real."""
    data, libraries = root / "share/games/torcs", root / "lib/torcs"
    data.mkdir(parents=True)
    for path in game.data.iterdir():
        if path.name in LINKED_DEEP:
            _link_tree(path, data / path.name)
        else:
            (data / path.name).symlink_to(path)
    _link_tree(game.libraries, libraries)
    for path in (game.extra_libraries or root / "nothing").glob("libplib*"):
        (root / "lib" / path.name).symlink_to(path)
    return root


def _link_tree(source: Path, target: Path) -> None:
    for folder, _, files in os.walk(source, followlinks=True):
        made = target / Path(folder).relative_to(source)
        made.mkdir(parents=True, exist_ok=True)
        for name in files:
            (made / name).symlink_to(Path(folder) / name)


def replace(path: Path, content: str | bytes | None) -> Path:
    """Put a file of the test's own in place of a link; ``None`` leaves nothing there."""
    path.unlink(missing_ok=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, str):
        path.write_text(content, encoding="utf-8")
    elif content is not None:
        path.write_bytes(content)
    return path


def python(code: str, *words: str, cwd: Path | None = None, **environment: str) -> str:
    """Run code in a process of its own, so that its crash is a failed test with all it said."""
    done = subprocess.run(
        [sys.executable, "-X", "faulthandler", "-c", code, *words],
        capture_output=True, text=True, check=False, cwd=cwd,
        env={**os.environ, **environment},
    )  # fmt: skip
    assert done.returncode == 0, f"exit status {done.returncode}\n{done.stdout}\n{done.stderr}"
    assert done.stderr == ""
    return done.stdout


def attempts(home: Path | None, *options: dict) -> list[tuple[str, str]]:
    """Load races, one after the other, in a process of their own: what each one raised."""
    environment = {} if home is None else {"SB3_TORCS_HOME": str(home)}
    found = json.loads(python(TRY, json.dumps(options), **environment))
    return [(name, message) for name, message in found]


def compiled(source: str, path: Path) -> Path:
    """Build a shared library in place of one of the game's."""
    compiler = shutil.which("c++") or shutil.which("g++")
    assert compiler, "no C++ compiler, with which the extension was built: install g++"
    path.unlink(missing_ok=True)
    call = [compiler, "-shared", "-fPIC", "-O0", "-x", "c++", "-", "-o", str(path)]
    subprocess.run(call, input=source, text=True, check=True, capture_output=True)
    return path
