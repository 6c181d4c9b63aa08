"""Where tracks come from: a name or a path becomes a :class:`~sb3_torcs.tracks.track.Track`."""

from __future__ import annotations

import functools
import os
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from sb3_torcs.errors import InvalidOption, TrackFileError, TrackNotFound, near_miss
from sb3_torcs.torcs.installation import torcs_folders, track_files
from sb3_torcs.torcs.params import digests
from sb3_torcs.tracks.track import Track, TrackSummary, closed

__all__ = ["available_tracks", "load_track"]


BUNDLED_FOLDER = Path(__file__).parents[1] / "data" / "tracks"


TRACK_SUFFIX = ".csv"


CATEGORIES = ("road", "oval", "dirt")


def load_track(
    track: str | os.PathLike[str] | Track, rng: np.random.Generator | None = None
) -> Track:
    """
    Find a track by name or path. What was read once is kept.

    :param track: ``"aalborg"``, ``"road/aalborg"``, a path to a ``.xml`` (TORCS) or ``.csv``
        file, ``"random"``, or a track, which comes back as it is
    :param rng: what a random track is drawn from; only ``"random"`` needs it
    :return: the track
    """
    if isinstance(track, Track):
        return track
    if not isinstance(track, (str, os.PathLike)):
        raise InvalidOption(
            f"track is {track!r}; expected a name (`sb3-torcs tracks` lists them), a path, "
            "'random', or a Track"
        )
    name = os.fspath(track)
    if name == "random":
        if rng is None:
            raise InvalidOption(
                "track 'random' needs a generator; pass rng=numpy.random.default_rng(seed)"
            )
        from sb3_torcs.tracks.generator import random_track

        return random_track(rng)
    if Path(name).suffix.lower() in (TRACK_SUFFIX, ".xml"):
        path = Path(os.path.expanduser(name))
        if not path.is_file():
            raise TrackNotFound(
                f"there is no track file '{path}'; give the path of a TORCS .xml or a "
                f"{TRACK_SUFFIX} file, or a name: `sb3-torcs tracks` lists them"
            )
        return _read(path, "file")
    for candidate, (path, source) in _known_files().items():
        if name in (candidate, candidate.rpartition("/")[2]):
            return _read(path, source)
    known = [key for full in _known_files() for key in (full.rpartition("/")[2], full)]
    hint = near_miss(name, known, "`sb3-torcs tracks` lists them")
    raise TrackNotFound(f"no track '{name}'{hint}")


def available_tracks() -> list[TrackSummary]:
    """List the bundled tracks and those of the installed TORCS, by category and name."""
    return sorted(
        (_read(path, source).summary() for path, source in _known_files().values()),
        key=lambda entry: (
            (CATEGORIES.index(entry.category), entry.name)
            if entry.category in CATEGORIES
            else (len(CATEGORIES), entry.name)
        ),
    )


def _known_files() -> dict[str, tuple[Path, str]]:
    """Map ``category/name`` to file and source: bundled tracks first, then the installed ones."""
    files: dict[str, tuple[Path, str]] = {}
    for path in sorted(BUNDLED_FOLDER.glob(f"*/*{TRACK_SUFFIX}")):
        files[f"{path.parent.name}/{path.stem}"] = (path, "bundled")
    for folder in torcs_folders()[:1]:
        for name, path in track_files(folder).items():
            files.setdefault(name, (path, "torcs"))
    return files


def _read(path: Path, source: str) -> Track:
    """Read a track file of either kind, once per content: times may stay as they are."""
    return _read_once(path.resolve(), source, digests(path, torcs_folders()))


@functools.lru_cache(maxsize=128)
def _read_once(
    path: Path, source: Literal["bundled", "torcs", "file"], content: tuple[str, ...]
) -> Track:
    """
    Read a track file of either kind.

    :param path: of the file
    :param source: where it came from
    :param content: from :func:`~sb3_torcs.torcs.params.digests`; only a key of the cache
    :return: the track
    """
    del content
    # The readers build tracks, so they import this module; it can import them only when asked.
    if path.suffix.lower() == ".xml":
        from sb3_torcs.tracks.torcs_xml import read_track_xml as read
    else:
        from sb3_torcs.tracks.compact import read_track_file as read
    track = replace(read(path), source=source)
    try:
        return replace(track, segments=closed(track.segments))
    except ValueError as error:
        raise TrackFileError(f"{path}: {error}") from error
