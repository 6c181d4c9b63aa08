"""What the name of a track means, for all worlds and for the game: the one place that decides."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

from sb3_torcs.errors import GameIncomplete, InvalidOption, TrackNotFound, near_miss
from sb3_torcs.torcs.installation import INSTALL, Game, torcs_folders, track_files

__all__ = [
    "BUNDLED_FOLDER",
    "RANDOM_TRACK",
    "TrackFile",
    "find_track",
    "kind_without_game",
    "known_tracks",
    "stable_kwargs",
    "stable_track",
]

BUNDLED_FOLDER = Path(__file__).parents[1] / "data" / "tracks"
COMPACT, XML = ".csv", ".xml"  # suffixes of our own files, and of the game's
RANDOM_TRACK = "random"
"""The name of a track that is drawn anew: there is no file of it."""
LISTED = "`sb3-torcs tracks` lists them"


class TrackFile(NamedTuple):
    """Where a track is said."""

    path: Path  # absolute
    source: Literal["bundled", "torcs", "file"]
    name: str  # ``category/name``; of a file that somebody else wrote, its name without suffix


def find_track(track: str | os.PathLike[str] | TrackFile, game: Game | None = None) -> TrackFile:
    """
    Find the file of a track.

    :param track: ``"aalborg"``, ``"road/aalborg"``, or the path of a file: TORCS's ``.xml``, and
        without a game also our ``.csv``; or what was found before, which comes back as it is
    :param game: the installation that drives; ``None`` for TorcsLite-v0, which has the bundled
        tracks first, and then those of any installation
    :return: the file
    :raises TrackNotFound: if there is none
    :raises GameIncomplete: if the game has a folder for it, and no file
    :raises InvalidOption: if that is no name and no path
    """
    if isinstance(track, TrackFile):
        return track
    if not isinstance(track, (str, os.PathLike)) or track == RANDOM_TRACK:
        raise InvalidOption(f"track is {track!r}; {_expected(game)}")
    name = os.fspath(track)
    suffix = _suffix(name)
    if suffix == XML or (suffix == COMPACT and game is None):
        return _own_file(Path(stable_track(name)))
    if suffix == COMPACT:
        raise TrackNotFound(
            f"'{name}' is a file for TorcsLite-v0; Torcs-v0 has the game's own tracks ({LISTED}) "
            f"and TORCS's {XML} files"
        )
    known = known_tracks(game)
    for full, file in known.items():
        if name in (full, full.rpartition("/")[2]):
            return file
    if game is not None:
        _refuse_half_a_track(name, game)
    of_that_kind = [full for full in known if full.startswith(f"{name}/")]
    if of_that_kind:
        raise TrackNotFound(
            f"'{name}' is a kind of tracks; name one of the {len(of_that_kind)}, "
            f"e.g. '{of_that_kind[0]}'"
        )
    names = [word for full in known for word in (full.rpartition("/")[2], full)]
    raise TrackNotFound(f"no track '{name}'{near_miss(name, names, LISTED)}{_hint(name, game)}")


def _hint(name: str, game: Game | None) -> str:
    """Say more of a name that no track has."""
    if os.path.isdir(name):
        inside = sorted(Path(name).glob(f"*{XML}"))
        example = f", e.g. '{inside[0]}'" if inside else ""
        return f"; '{name}' is a folder: name the {XML} file of the track{example}"
    if os.path.isfile(name):
        return f"; there is a file '{name}', and a track's ends in {XML} or {COMPACT}"
    if game is not None:
        return f"; Torcs-v0 has those of {game.data}, and TORCS's {XML} files"
    if not torcs_folders():
        return f"; those of the game are missing, since TORCS was not found; type: {INSTALL}"
    return ""


def kind_without_game(track: Any) -> str | None:
    """
    Tell of which kind a track is that TorcsLite-v0 alone has.

    :param track: as of an environment
    :return: ``"random"`` or ``".csv"``; ``None`` for a track that Torcs-v0 may have, too
    """
    if track == RANDOM_TRACK:
        return RANDOM_TRACK
    return COMPACT if _suffix(track) == COMPACT else None


def stable_track(track: Any) -> Any:
    """
    Say a track so that it means the same in another working folder.

    :param track: as of an environment: a name, a path, a ``Track``, or a list of them
    :return: the same, with absolute paths
    """
    if isinstance(track, (list, tuple)) and not isinstance(track, TrackFile):
        return [stable_track(item) for item in track]
    is_path = _suffix(track) in (XML, COMPACT)
    return str(Path(os.path.expanduser(track)).absolute()) if is_path else track


def stable_kwargs(env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """
    Say the track in arguments of an environment as :func:`stable_track` does.

    :param env_kwargs: as of ``gym.make``
    :return: a copy
    """
    track = {"track": stable_track(env_kwargs["track"])} if "track" in env_kwargs else {}
    return {**env_kwargs, **track}


def known_tracks(game: Game | None = None) -> dict[str, TrackFile]:
    """
    List the tracks that have names, in the order in which they are found.

    :param game: the installation that drives; ``None`` as for :func:`find_track`
    :return: files by ``category/name``
    """
    files: dict[str, TrackFile] = {}
    if game is None:
        for path in sorted(BUNDLED_FOLDER.glob(f"*/*{COMPACT}")):
            name = f"{path.parent.name}/{path.stem}"
            files[name] = TrackFile(path, "bundled", name)
    for folder in torcs_folders()[:1] if game is None else [game.data]:
        for name, path in track_files(folder).items():
            files.setdefault(name, TrackFile(path.absolute(), "torcs", name))
    return files


def _suffix(track: Any) -> str:
    """Return the ending of a name or path, in small letters; empty for what is neither."""
    return Path(track).suffix.lower() if isinstance(track, (str, os.PathLike)) else ""


def _expected(game: Game | None) -> str:
    if game is None:
        return f"expected a name ({LISTED}), a path, '{RANDOM_TRACK}', or a Track"
    return (
        f"Torcs-v0 takes the name of an installed track ({LISTED}) or the path of a TORCS {XML}; "
        "random tracks are for TorcsLite-v0"
    )


def _own_file(path: Path) -> TrackFile:
    if not path.is_file():
        raise TrackNotFound(
            f"there is no track file '{path}'; give the path of a TORCS {XML} or, for "
            f"TorcsLite-v0, a {COMPACT} file, or a name: {LISTED}"
        )
    return TrackFile(path, "file", path.stem)


def _refuse_half_a_track(name: str, game: Game) -> None:
    short = name.rpartition("/")[2]
    for folder in (game.data / "tracks").glob("*/*"):
        if folder.name == short and name in (short, f"{folder.parent.name}/{short}"):
            raise GameIncomplete(f"track '{name}' has no {folder / short}{XML}; type: {INSTALL}")
