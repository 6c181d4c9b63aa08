"""The scenery of a track: files besides the track's own, which the game's window draws.

The game looks for them in the folder that the header of the track's file names, wherever the file
itself is, and crashes if the 3D description is not there.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from sb3_torcs.errors import SceneryMissing
from sb3_torcs.torcs.installation import Game, torcs_folders
from sb3_torcs.torcs.params import Section, read_params

__all__ = ["Scenery", "find_scenery"]

USUAL_CATEGORY = "road"  # the game's default for a track without a category
USUAL_DESCRIPTION = "track.ac"
USUAL_BACKGROUND, USUAL_REFLECTION = "background.png", "env.png"
WITH_BACKGROUND = (0, 2, 4)  # types of background
PICTURES = ("data/img", "data/textures", ".")  # where the game has those that tracks share
LONGEST_PATH = 255  # [characters] that the game has room for
REMEDY = "put it beside the track, or drive without the game's picture and window"
TEXTURE_FOLDERS = "tracks/{};data/textures;data/img;."


class Scenery(NamedTuple):
    """The scenery of a track."""

    place: str  # ``category/name`` of the folder in which the game looks for it
    folder: Path  # where it is


def find_scenery(game: Game, file: Path) -> Scenery:
    """
    Find the scenery of a track: beside its file, or else beside that of the same road in the game.

    :param game: the installation
    :param file: of the track, absolute
    :return: the scenery
    :raises SceneryMissing: if the game cannot draw the track
    :raises TrackFileError: if the track's file is broken
    """
    root = read_params(file, torcs_folders())
    place = _place(file, root)
    folder = _folder(game, file, root)
    folders = [file.parent, folder, *(game.data / name for name in PICTURES)]
    for picture in _pictures(root.child("Graphic")):
        if not any((where / picture).is_file() for where in folders):
            raise SceneryMissing(
                f"the game cannot draw {file}: its picture '{picture}' is in none of "
                f"{', '.join(dict.fromkeys(map(str, folders)))}; {REMEDY}"
            )
    return Scenery(place, folder)


def _place(file: Path, root: Section) -> str:
    """
    Say where the game looks for the scenery of a track.

    :param file: of the track
    :param root: what is in it
    :return: ``category/name`` of a folder
    """
    category = root.child("Header").texts.get("category") or USUAL_CATEGORY
    place = f"{category}/{file.stem}"
    if "/" in category or category.startswith(".") or ";" in place:
        raise SceneryMissing(
            f"the game cannot draw {file}: it would look for the scenery in 'tracks/{place}'; name "
            "another category in the file's header, e.g. 'road', or rename the file without ';'"
        )
    if len(TEXTURE_FOLDERS.format(place)) > LONGEST_PATH:
        raise SceneryMissing(
            f"the game cannot draw {file}: it has no room for such a long name; shorten it"
        )
    return place


def _folder(game: Game, file: Path, root: Section) -> Path:
    """
    Find the 3D description of a track.

    :param game: the installation
    :param file: of the track
    :param root: what is in it
    :return: the folder that has it
    """
    description = root.child("Graphic").texts.get("3d description") or USUAL_DESCRIPTION
    if (file.parent / description).is_file():
        return file.parent
    known = [path for path in game.tracks().values() if (path.parent / description).is_file()]
    for other in known:
        if _equal(
            root.child("Main Track"), read_params(other, torcs_folders()).child("Main Track")
        ):
            return other.parent
    also = f"nor in any folder of {game.data / 'tracks'}"
    if known:
        also = f"and the one in {known[0].parent} is of another road"
    raise SceneryMissing(
        f"the game cannot draw {file}: its 3D description '{description}' is not in "
        f"{file.parent}, {also}; {REMEDY}"
    )


def _pictures(graphic: Section) -> list[str]:
    """
    List the pictures without which the game crashes.

    :param graphic: the section of the track's file on its appearance
    """
    names = []
    if graphic.number("background type", 0) in WITH_BACKGROUND:
        names.append(graphic.texts.get("background image") or USUAL_BACKGROUND)
    reflections = graphic.child("Environment Mapping")
    for number in range(1, 1 + max(1, len(reflections.children))):
        image = reflections.child(str(number)).texts.get("env map image")
        names.append(image or USUAL_REFLECTION)
    return [name.rpartition("/")[2] for name in names]  # as the game takes them


def _equal(one: Section, other: Section) -> bool:
    """
    Check whether two files describe the same road, apart from its surfaces.

    :param one: a section of the one file
    :param other: the same section of the other file
    """

    def words(section: Section) -> dict[str, str]:
        return {n: text for n, text in section.texts.items() if not n.endswith("surface")}

    return (
        one.numbers == other.numbers
        and words(one) == words(other)
        and list(one.children) == list(other.children)
        and all(map(_equal, one.children.values(), other.children.values()))
    )
