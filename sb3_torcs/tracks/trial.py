"""Check that the game can load a track, and that its road is the one that was read from the file.

The game's loader trusts its files: one wrong value can crash it or keep it busy for ever, and with
it the process that it is in. So a file that is not one of TORCS 1.3.7's own is first loaded in a
process of its own, which may crash.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from functools import lru_cache
from importlib.util import find_spec
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from sb3_torcs import errors
from sb3_torcs.car import DEFAULT_CAR, FloatArray
from sb3_torcs.errors import BackendUnavailable, TrackFileError
from sb3_torcs.torcs.installation import Game, torcs_folders
from sb3_torcs.torcs.params import digests
from sb3_torcs.torcs.race_setup import SCR_SERVER, SESSIONS, RaceSetup, Session
from sb3_torcs.torcs.trial_child import ANSWER, REFUSED
from sb3_torcs.tracks.catalogue import load_track
from sb3_torcs.tracks.track import Track

__all__ = ["check_road", "check_track", "engine_arguments", "load_road", "try_race"]

KNOWN_TRACKS = Path(__file__).parents[1] / "data" / "known_tracks.sha256"
CHILD = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from sb3_torcs.torcs.trial_child import main; main()"
)
COMPUTING = 3  # [s] of computing that a load may take; it takes 0.2
COMPUTING_PER_ROBOT = 1  # [s] besides; planning takes 0.3 on the longest track
PATIENCE = 300.0  # [s] until a process that computes nothing is given up
RANGE_FINDERS = 19  # whose angles the engine wants
PLACES = 40  # along the road, at which a car that is alone is put down
UNSETTLED = "does not come to rest"  # the engine's error for a car without a position
ADVICE = "the game understands the file otherwise than it is written"
HINT = "look at what was changed last: heights of walls, lengths, names of other segments"

COLUMNS = (  # of the engine's road
    "length", "curvature", "width at the start", "width at the end",
    "ground to the left at the start", "ground to the left at the end",
    "ground to the right at the start", "ground to the right at the end",
    "friction", "rolling resistance", "friction of the left wall", "friction of the right wall",
    "place of the end",
)  # fmt: skip
HEIGHTS = 4  # columns after these, which are not read from files
ROUNDING = 1e-4  # [-] the game computes in single precision; its own tracks differ by 1e-5

_tried: set[Any] = set()


def engine_arguments(
    game: Game,
    path: Path,
    entries: Sequence[tuple[str, int]],
    *,
    cars: Sequence[str],
    session: Session,
    laps: int,
) -> dict[str, Any]:
    """
    Describe a race for the engine, but for the sensors.

    :param game: the installation
    :param path: of the track's file
    :param entries: the starting list; agents are ``("", 0)``, ``("", 1)`` and so on
    :param cars: the agents'
    :param session: whose rules and grid count
    :param laps: of the race; 0 drives on
    :return: arguments by name
    """
    return {
        "data": str(game.data),
        "libraries": str(game.libraries),
        "plib": str(game.extra_libraries or ""),
        "track": str(path),
        "session": SESSIONS[session],
        "entries": list(entries),
        "cars": list(cars),
        "laps": laps,
    }


def try_race(path: Path, race: dict[str, Any]) -> None:
    """
    Load a race in a process of its own, unless its track is known; once for each content.

    :param path: of the track's file
    :param race: from :func:`engine_arguments`
    :raises TrackFileError: if the game's loader crashes, hangs, or lays another road
    :raises Sb3TorcsError: what the engine raises
    """
    content = digests(path, torcs_folders())
    key = (content, json.dumps(race))
    if _known_digests().issuperset(content) or key in _tried or not _engine_is_built():
        return
    check_road(path, load_road(path, race))
    _tried.add(key)


def check_road(path: Path, road: FloatArray) -> None:
    """
    Compare the road that the game has made with the one that was read.

    :param path: of the track's file
    :param road: (n_segments, 17) from the engine
    :raises TrackFileError: if they differ, naming where
    """
    read = _as_read(load_track(path))
    if len(read) != len(road):
        raise TrackFileError(
            f"{path}: the game lays {len(road)} segments of {road[:, 0].sum():.1f} m in all, and "
            f"its file says {len(read)} of {read[:, 0].sum():.1f} m; {ADVICE}"
        )
    road = road[:, : len(COLUMNS)]
    differ = np.abs(road - read) > ROUNDING * np.maximum(1.0, np.abs(read))
    if differ.any():
        row, column = np.argwhere(differ)[0]
        raise TrackFileError(
            f"{path}: of segment {row}, {read[:row, 0].sum():.1f} m from the start line, the "
            f"{COLUMNS[column]} is {road[row, column]:g} in the game, and {read[row, column]:g} "
            f"by its file; {ADVICE}"
        )


@lru_cache(maxsize=16)
def _as_read(track: Track) -> FloatArray:
    """
    Put the steps of a track into the engine's form.

    :param track: from a file of the game
    :return: (n_segments, 13)
    """
    ends = accumulate(s.length for s in track.steps)
    return np.array(
        [
            (*s[:8], *s.road[1:3], s.left_wall.friction, s.right_wall.friction, end)
            for s, end in zip(track.steps, ends, strict=True)
        ]
    )


def load_road(path: Path, race: dict[str, Any]) -> FloatArray:
    """
    Load a race in a process of its own.

    :param path: of the track's file
    :param race: from :func:`engine_arguments`
    :return: (n_segments, 17) its road, as of the engine
    :raises TrackFileError: if the game's loader crashes or hangs
    """
    race = {**race, "angles": [[0.0] * RANGE_FINDERS] * len(race["cars"])}
    robots = len(race["entries"]) - len(race["cars"])
    task = {
        "owner": os.getpid(),
        "seconds": COMPUTING + COMPUTING_PER_ROBOT * robots,
        "places": 0 if robots else PLACES,
        "race": race,
    }
    call = [sys.executable, "-c", CHILD, json.dumps(sys.path), json.dumps(task)]
    # A group of its own: Ctrl-C is for this process, which then ends the other one.
    process = subprocess.Popen(
        call, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        start_new_session=True, env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    try:
        output, words = process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired as error:
        raise TrackFileError(f"{path}: the game's loader is stuck on it") from error
    finally:
        process.kill()
        process.wait()
    return _verdict(path, process.returncode, output.rpartition(ANSWER)[2], words)


def _verdict(path: Path, status: int, output: bytes, words: bytes) -> FloatArray:
    """
    Turn the end of the process into a result or an error.

    :param path: of the track's file
    :param status: with which it ended
    :param output: what it printed
    :param words: what it complained of
    :return: the road
    """
    if status == REFUSED:
        name, message = json.loads(output)
        if UNSETTLED in message:
            raise TrackFileError(f"{path}: {message}, or the road on the grid is none; {HINT}")
        raise getattr(errors, name)(message)
    if status == -signal.SIGXCPU:
        raise TrackFileError(f"{path}: the game's loader does not come to an end with it; {HINT}")
    if status < 0:
        how = signal.Signals(-status).name
        raise TrackFileError(f"{path}: the game's own code crashes with it ({how}); {HINT}")
    if status:
        last = words.decode(errors="replace").strip().splitlines()[-1:]
        raise BackendUnavailable(f"{path} cannot be tried in another process: {''.join(last)}")
    return np.frombuffer(output).reshape(-1, len(COLUMNS) + HEIGHTS)


@lru_cache
def _known_digests() -> frozenset[str]:
    """Read the digests of TORCS 1.3.7's own tracks, which all load."""
    lines = KNOWN_TRACKS.read_text(encoding="utf-8").splitlines()
    return frozenset(line.split()[0] for line in lines)


def _engine_is_built() -> bool:
    """Check for the engine. Without it only the game's own process loads tracks, and may crash."""
    return find_spec("sb3_torcs._engine") is not None


def check_track(game: Game, race: RaceSetup, file: Path) -> None:
    """
    Refuse a track at which the game would crash or hang.

    :param game: the installation
    :param race: who races where
    :param file: of the track
    :raises TrackFileError: naming file and line, or what the game did with the file
    """
    load_track(file)
    robots = [driver for driver in race.drivers if driver[0] != SCR_SERVER]
    clients = [index for name, index in race.drivers if name == SCR_SERVER]
    agent = [("", 0)] if clients else []  # one stands for all, as they have no part in the track
    cars = [race.client_car(index) for index in clients[:1]] or [DEFAULT_CAR]
    try_race(
        file,
        engine_arguments(
            game, file, agent + robots, cars=cars, session=race.session, laps=race.laps
        ),
    )
