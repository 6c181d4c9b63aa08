"""Find the shared libraries that the game's program lacks."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

from sb3_torcs.torcs.installation import Game
from sb3_torcs.torcs.process import game_environment

__all__ = ["missing_libraries"]


PATIENCE = 120.0  # [s] on a busy machine


def missing_libraries(game: Game) -> list[str]:
    """
    Ask the dynamic linker which libraries the game's program would not find.

    :param game: the installation; the program is not started
    :return: their names
    """
    if game.program is None:
        return []
    with tempfile.TemporaryDirectory(prefix="sb3-torcs-game-") as folder:
        environment = {**game_environment(game, Path(folder)), "LD_TRACE_LOADED_OBJECTS": "1"}
        # The arguments are for linkers that do not know this variable: the game ends at once.
        call = [str(game.program), "-l", folder, "-r", "none"]
        done = subprocess.run(
            call, cwd=folder, env=environment, timeout=PATIENCE, check=False,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    lines = done.stdout.decode(errors="replace").splitlines()
    return [line.split()[0] for line in lines if line.endswith("not found")]
