"""Find a track by name or path, and read it as a :class:`~sb3_torcs.tracks.track.Track`."""

from __future__ import annotations

import functools
import os
import warnings
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from sb3_torcs.errors import InvalidOption, TrackFileError
from sb3_torcs.torcs.installation import torcs_folders, track_files
from sb3_torcs.torcs.params import digests
from sb3_torcs.torcs.track_names import RANDOM_TRACK, TrackFile, find_track, known_tracks
from sb3_torcs.tracks.compact import read_track_file
from sb3_torcs.tracks.generator import random_track
from sb3_torcs.tracks.torcs_xml import read_track_xml
from sb3_torcs.tracks.track import Track, TrackSummary, closed

__all__ = ["CATEGORIES", "available_tracks", "load_track", "stable_name", "summaries", "tracks_of"]


CATEGORIES = ("road", "oval", "dirt")


def load_track(
    track: str | os.PathLike[str] | TrackFile | Track, rng: np.random.Generator | None = None
) -> Track:
    """
    Find a track by name or path. Files that were read are cached.

    :param track: ``"aalborg"``, ``"road/aalborg"``, a path to a ``.xml`` (TORCS) or ``.csv``
        file, its file as :func:`~sb3_torcs.torcs.track_names.find_track` finds it, ``"random"``, or
        a track, which comes back as it is
    :param rng: what a random track is drawn from; only ``"random"`` needs it
    :return: the track
    :raises TrackNotFound: if there is none
    :raises InvalidOption: if ``"random"`` has no generator
    """
    if isinstance(track, Track):
        return track
    if isinstance(track, str) and track == RANDOM_TRACK:
        if not isinstance(rng, np.random.Generator):
            raise InvalidOption(
                f"track '{RANDOM_TRACK}' needs a generator, and rng is {rng!r}; pass "
                "rng=numpy.random.default_rng(seed)"
            )
        return random_track(rng)
    return _read(find_track(track), tuple(torcs_folders()))


def available_tracks() -> list[TrackSummary]:
    """
    List the bundled tracks and those of the installed TORCS, by category and name.

    A broken file is left out with a warning: the others can be driven.
    """
    good = []
    for file in known_tracks().values():
        try:
            good += summaries([file])
        except TrackFileError as error:
            warnings.warn(f"a track is left out: {error}", stacklevel=2)
    return _sorted(good)


def summaries(files: Iterable[TrackFile]) -> list[TrackSummary]:
    """
    Read track files only as far as a list of tracks needs.

    :param files: of the tracks
    :return: by category and name
    :raises TrackFileError: if one cannot be read
    """
    folders = tuple(torcs_folders())
    return _sorted(_read(file, folders, located=False).summary() for file in files)


def _sorted(summaries: Iterable[TrackSummary]) -> list[TrackSummary]:
    return sorted(
        summaries,
        key=lambda entry: (
            (CATEGORIES.index(entry.category), entry.name)
            if entry.category in CATEGORIES
            else (len(CATEGORIES), entry.name)
        ),
    )


def tracks_of(name: str) -> list[str]:
    """
    Replace the name of a category by its tracks.

    :param name: of a category, e.g. ``"oval"``, or of a track
    :return: ``category/name`` of each of its tracks; any other name stands for itself
    """
    if name not in CATEGORIES:
        return [name]
    return [f"{s.category}/{s.name}" for s in available_tracks() if s.category == name]


def stable_name(track: Track) -> str:
    """
    Name a track so that :func:`load_track` finds it again, in any folder.

    :param track: of a world
    :return: its name; of somebody's own file the path, since other roads may have its name
    """
    named = [file.path for file in known_tracks().values()]
    for folder in torcs_folders()[:1]:  # whose tracks may have bundled ones before them
        named += track_files(folder).values()
    known = track.file is None or track.file in {path.resolve() for path in named}
    return track.name if known else str(track.file)


def _read(file: TrackFile, folders: tuple[Path, ...], *, located: bool = True) -> Track:
    """
    Read a track file of either kind, once per content.

    :param file: of the track
    :param folders: of TORCS's data, in which to look for the surfaces of all tracks
    :param located: whether the place of the road matters, too
    """
    content = digests(file.path, folders)
    return _read_once(file.path.resolve(), file.source, folders, content, located)


@functools.lru_cache(maxsize=128)
def _read_once(
    path: Path,
    source: Literal["bundled", "torcs", "file"],
    folders: tuple[Path, ...],
    content: tuple[str, ...],
    located: bool,
) -> Track:
    """
    Read a track file of either kind.

    :param path: of the file
    :param source: where it came from
    :param folders: of TORCS's data
    :param content: from :func:`~sb3_torcs.torcs.params.digests`; only a key of the cache
    :param located: whether the place of the road matters, too
    :return: the track
    """
    del content
    is_xml = path.suffix.lower() == ".xml"
    track = read_track_xml(path, folders, located=located) if is_xml else read_track_file(path)
    track = replace(track, source=source, file=path)
    try:
        return replace(track, segments=closed(track.segments))
    except ValueError as error:
        raise TrackFileError(f"{path}: {error}") from error
