"""Find the installed game, list its contents, and report missing parts.

All searches for files of TORCS are here. Nothing is loaded or run.
"""

from __future__ import annotations

import functools
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from sb3_torcs.car import DEFAULT_CAR
from sb3_torcs.errors import (
    GameIncomplete,
    GameNotFound,
    InvalidOption,
    TrackFileError,
    UnknownCar,
    UnknownRobot,
    near_miss,
)
from sb3_torcs.torcs.params import read_params

__all__ = [
    "HOME_VARIABLE",
    "INSTALL",
    "Game",
    "RobotEntry",
    "find_game",
    "linker_knows",
    "torcs_folders",
    "track_files",
    "user_folder",
]

HOME_VARIABLE = "SB3_TORCS_HOME"
INSTALL = "`sb3-torcs install-torcs`"

SYSTEM_ROOTS = (Path("/usr"), Path("/usr/local"))
PREFIXES = ("", "usr", "usr/local")  # inside a root, e.g. that of an unpacked package
DATA_FOLDERS = ("share/games/torcs", "share/torcs")
LIBRARY_FOLDERS = ("lib/*/torcs", "lib/torcs", "lib64/torcs")  # Debian, source or Arch, Fedora
SYSTEM_LIBRARIES = ("/lib", "/usr/lib", "/lib64", "/usr/lib64", "/usr/local/lib")
LINKER_CACHE = Path("/etc/ld.so.cache")

MODULES = (  # needed by a race without a window, in the folder of libraries
    "lib/libtxml.so",
    "lib/libtgf.so",
    "lib/librobottools.so",
    "modules/track/track.so",
    "modules/simu/simuv2.so",
)
PHYSICS = "modules/simu/simuv2.so"
SURFACES = "data/tracks/surfaces.xml"
NOT_ROBOTS = ("human",)


@dataclass(frozen=True, order=True)
class RobotEntry:
    """One of the drivers that a robot module brings."""

    index: int  # as the module counts; some begin at 0, some at 1
    name: str  # as the game shows it
    car: str


@dataclass(frozen=True)
class Game:
    """
    An installation of TORCS.

    :param root: the folder that all of it is in, e.g. ``/usr`` or an unpacked package
    :param data: the folder with tracks/, cars/, categories/, data/ and drivers/
    :param libraries: the folder with lib/, modules/ and drivers/
    :param program: ``torcs-bin``, which takes all folders as arguments; only races by the game
        itself need it
    :param extra_libraries: the folder of plib and others, where they were unpacked with the game;
        ``None`` where the system has them
    """

    root: Path
    data: Path
    libraries: Path
    program: Path | None = None
    extra_libraries: Path | None = None

    @property
    def library_path(self) -> tuple[Path, ...]:
        """Folders in which a process finds the shared libraries of the game, in this order."""
        own = self.libraries / "lib"
        return (own,) if self.extra_libraries is None else (own, self.extra_libraries)

    def tracks(self) -> dict[str, Path]:
        """Map ``category/name`` to the track's file."""
        return track_files(self.data)

    def cars(self) -> dict[str, Path]:
        """Map the names of cars to their files."""
        files = sorted((self.data / "cars").glob("*/*.xml"))
        return {path.stem: path for path in files if path.stem == path.parent.name}

    def robots(self) -> dict[str, list[RobotEntry]]:
        """
        Map the names of robots, those with a module and a description, to their drivers.

        :raises GameIncomplete: if a description is broken
        """
        files = sorted((self.data / "drivers").glob("*/*.xml"))
        return {
            path.stem: _drivers(path)
            for path in files
            if path.stem == path.parent.name
            and path.stem not in NOT_ROBOTS
            and self.robot_module(path.stem).is_file()
        }

    def robot_module(self, name: str) -> Path:
        """
        Return the path of a robot's library.

        :param name: of the robot
        :return: the path; nothing is checked
        """
        return self.libraries / "drivers" / name / f"{name}.so"

    def find_car(self, name: str) -> Path:
        """
        Find the file of a car.

        :param name: e.g. ``"car1-trb1"``
        :return: the file
        :raises UnknownCar: if there is none of this name
        :raises InvalidOption: if that is no name
        """
        if not isinstance(name, str):
            raise InvalidOption(f"car is {name!r}; expected the name of one, e.g. '{DEFAULT_CAR}'")
        cars = self.cars()
        if name not in cars:
            hint = near_miss(name, cars) or f"; it has {', '.join(cars)}"
            raise UnknownCar(f"the game at {self.data} has no car '{name}'{hint}")
        return cars[name]

    def has_robot(self, text: str) -> bool:
        """
        Tell a robot from other drivers.

        :param text: ``"inferno:5"``, ``"inferno"``, or the name or path of an agent
        """
        return text.strip().partition(":")[0] in self.robots()

    def parse_robot(self, text: str) -> tuple[str, int]:
        """
        Read a robot's name, perhaps with the index of its driver.

        :param text: ``"inferno:5"``; or ``"inferno"`` for its first driver of ``car1-trb1``, or its
            first driver if none has that car
        :return: name and index
        :raises InvalidOption: if what follows the colon is no index
        :raises UnknownRobot: if there is none of this name, or none with this index
        """
        name, colon, index = text.strip().partition(":")
        if not name or (colon and not (index.isascii() and index.isdigit())):
            raise InvalidOption(f"robot {text!r}: expected NAME or NAME:INDEX, e.g. inferno:3")
        if colon:
            return name, self.find_robot(name, int(index)).index
        drivers = self.robots().get(name, ())
        if not drivers:
            return name, self.find_robot(name, 0).index  # whose error says which there are
        cars = self.cars()
        best = min(drivers, key=lambda d: (d.car != DEFAULT_CAR, d.car not in cars, d.index))
        return name, self.find_robot(name, best.index).index

    def robot_name(self, robot: tuple[str, int]) -> str:
        """
        Return the shortest name of a robot's driver, as one types it.

        :param robot: name and index
        """
        name, index = robot
        return name if self.parse_robot(name) == robot else f"{name}:{index}"

    def find_robot(self, name: str, index: int) -> RobotEntry:
        """
        Find one driver of a robot.

        :param name: of the robot, e.g. ``"inferno"``
        :param index: of the driver
        :return: the driver
        :raises UnknownRobot: if there is none of this name, or none with this index
        :raises UnknownCar: if the game does not have the robot's car
        """
        robots = self.robots()
        if name not in robots:
            hint = near_miss(name, robots, "`sb3-torcs drivers` lists them")
            raise UnknownRobot(f"the game at {self.data} has no robot '{name}'{hint}")
        for entry in robots[name]:
            if entry.index == index:
                if entry.car in self.cars():
                    return entry
                raise UnknownCar(
                    f"robot '{name}' with index {index} drives '{entry.car}', a car that the game "
                    f"at {self.data} does not have; `sb3-torcs drivers` lists those that can drive"
                )
        indices = ", ".join(str(entry.index) for entry in robots[name])
        raise UnknownRobot(f"robot '{name}' has no index {index}; it has {indices}")


class _Candidate(NamedTuple):
    """A folder in which something of TORCS was found."""

    root: Path
    data: Path | None
    libraries: Path | None


def user_folder() -> Path:
    """Return the folder into which the game is unpacked for one user."""
    from platformdirs import user_data_dir

    return Path(user_data_dir("sb3-torcs")) / "torcs"


def find_game(home: Path | None = None) -> Game:
    """
    Find a complete installation.

    If ``home`` or ``SB3_TORCS_HOME`` is given, only that folder is looked at. Otherwise the first
    complete one of ``/usr``, ``/usr/local`` and the user's own folder is taken.

    :param home: a root, such as an unpacked package or ``/usr``, or the folder of data itself
    :return: the installation
    :raises GameNotFound: if there is none
    :raises GameIncomplete: if it is incomplete; the message names all missing parts
    """
    lacking = []
    for candidate in _candidates(home):
        missing = _missing(candidate)
        if not missing:
            return _game(candidate)
        lacking.append((candidate, missing))
    if not lacking:
        raise GameNotFound(_not_found(home))
    candidate, missing = lacking[0]
    where = candidate.data or candidate.libraries
    raise GameIncomplete(
        f"TORCS at {where} is incomplete, missing {', '.join(missing)}; {_remedy(home)}"
    )


def torcs_folders() -> list[Path]:
    """
    Return the folders of TORCS data that exist, the preferred one first.

    Tracks can be read without the rest of the game. The folder of :func:`find_game` comes first.
    """
    found = [candidate for candidate in _candidates(None) if candidate.data is not None]
    found.sort(key=lambda candidate: bool(_missing(candidate)))
    return [candidate.data for candidate in found if candidate.data is not None]


def track_files(data: Path) -> dict[str, Path]:
    """
    Find the track files ``category/name/name.xml``.

    :param data: folder of the game's data
    :return: from ``category/name`` to the file
    """
    files = sorted((data / "tracks").glob("*/*/*.xml"))
    return {
        f"{path.parent.parent.name}/{path.stem}": path
        for path in files
        if path.stem == path.parent.name
    }


def _given(home: Path | None) -> str | None:
    """Say where alone to look."""
    return os.environ.get(HOME_VARIABLE) or None if home is None else os.fspath(home)


def _remedy(home: Path | None) -> str:
    """Say what to type."""
    if home is None and _given(home):
        return f"let {HOME_VARIABLE} name another folder, or unset it and type: {INSTALL}"
    return f"type: {INSTALL}"


def _not_found(home: Path | None) -> str:
    """
    Make the error of a missing game, with what to type.

    :param home: as given by the caller
    """
    given = _given(home)
    if given is None:
        where = "".join(f" in {root} nor" for root in SYSTEM_ROOTS)
        where = f"neither{where} in {user_folder()}"
        return f"TORCS is not installed, {where}; {_remedy(home)}"
    where = f"{given}, which {HOME_VARIABLE} names" if home is None else given
    expected = "share/games/torcs and lib/torcs"
    return f"there is no TORCS in {where}; expected {expected} in it; {_remedy(home)}"


def _candidates(home: Path | None) -> Iterator[_Candidate]:
    """
    Yield the folders with parts of TORCS, in the order of preference.

    :param home: where alone to look; ``None`` for everywhere
    """
    given = _given(home)
    if given is not None:
        root = Path(os.path.expanduser(given)).absolute()
        roots = [root / prefix for prefix in PREFIXES]
        if (root / "tracks").is_dir():
            yield _Candidate(root, root, _libraries_beside(root))
    else:
        roots = [*SYSTEM_ROOTS, *(user_folder() / prefix for prefix in PREFIXES)]
    for root in roots:
        data = next((root / d for d in DATA_FOLDERS if (root / d / "tracks").is_dir()), None)
        libraries = _libraries(root)
        if data is not None or libraries is not None:
            yield _Candidate(root, data, libraries)


def _libraries(root: Path) -> Path | None:
    """Find the folder of the game's libraries."""
    found = [path for pattern in LIBRARY_FOLDERS for path in sorted(root.glob(pattern))]
    own = getattr(sys.implementation, "_multiarch", "")
    found.sort(key=lambda path: path.parent.name != own)
    return next((path for path in found if (path / "lib").is_dir()), None)


def _libraries_beside(data: Path) -> Path | None:
    """
    Find the libraries that belong to a folder of data.

    :param data: the folder, e.g. ``/usr/share/games/torcs``
    :return: the folder of libraries, if there is one
    """
    if (data / "modules").is_dir():
        return data
    for folder in DATA_FOLDERS:
        if data.as_posix().endswith(f"/{folder}"):
            return _libraries(data.parents[folder.count("/")])
    return None


def _missing(candidate: _Candidate) -> list[str]:
    """
    List the missing parts that a race without a window needs.

    :param candidate: of the installation
    :return: the missing parts; files with their paths
    """
    missing = []
    if candidate.data is None:
        missing.append(f"its data ({candidate.root / DATA_FOLDERS[0]})")
    else:
        if not (candidate.data / SURFACES).is_file():
            missing.append(f"{candidate.data / SURFACES}")
        for kind, pattern in (("track", "tracks/*/*/*.xml"), ("car", "cars/*/*.xml")):
            if next(candidate.data.glob(pattern), None) is None:
                missing.append(f"any {kind} ({candidate.data / pattern})")
    if candidate.libraries is None:
        missing.append(f"its libraries ({candidate.root / 'lib' / 'torcs'})")
        return missing
    missing += [
        str(candidate.libraries / m) for m in MODULES if not (candidate.libraries / m).is_file()
    ]
    if (candidate.libraries / PHYSICS).is_file():
        missing += [f"plib ({name})" for name in _missing_plib(candidate.libraries)]
    return missing


def _missing_plib(libraries: Path) -> list[str]:
    """
    Look for the parts of plib that the physics links to; some builds have them inside.

    :param libraries: folder of the game's libraries
    :return: names of those that a process would not find
    """
    content = (libraries / PHYSICS).read_bytes()
    wanted = sorted({name.decode() for name in re.findall(rb"libplib\w+\.so[.\d]*", content)})
    given = os.environ.get("LD_LIBRARY_PATH", "").split(":")
    folders = [Path(folder) for folder in (*given, *SYSTEM_LIBRARIES) if folder]
    folders += [libraries / "lib", libraries.parent]
    return [name for name in wanted if not any((f / name).is_file() for f in folders)
            and not linker_knows(name)]  # fmt: skip


def linker_knows(name: str) -> bool:
    """
    Ask the dynamic linker's cache, without loading anything.

    :param name: of a shared library
    :return: whether it lists the library
    """
    try:
        return f"{name}\0".encode() in LINKER_CACHE.read_bytes()
    except OSError:
        return False


def _game(candidate: _Candidate) -> Game:
    """
    Describe a complete installation.

    :param candidate: of the installation
    """
    assert candidate.data is not None
    assert candidate.libraries is not None
    program = candidate.libraries / "torcs-bin"
    beside = candidate.libraries.parent
    unpacked = next(beside.glob("libplibsg.so*"), None) is not None
    system = candidate.root in SYSTEM_ROOTS
    return Game(
        root=candidate.root,
        data=candidate.data,
        libraries=candidate.libraries,
        program=program if program.is_file() else None,
        extra_libraries=beside if unpacked and not system else None,
    )


def _drivers(path: Path) -> list[RobotEntry]:
    """
    Read the description of a robot.

    :param path: of the file
    :return: its drivers, by index
    """
    try:
        return list(_drivers_of(path, path.stat().st_mtime_ns))
    except (TrackFileError, OSError) as error:
        raise GameIncomplete(
            f"a robot's description is broken: {error}; type: {INSTALL}"
        ) from error


@functools.lru_cache(maxsize=256)
def _drivers_of(path: Path, changed: int) -> tuple[RobotEntry, ...]:
    """Read a description once, until it changes: each race asks for those of its field."""
    del changed
    listed = read_params(path).child("Robots", "index").children
    drivers = (
        RobotEntry(int(index), section.texts.get("name", ""), section.texts.get("car name", ""))
        for index, section in listed.items()
        if index.isascii() and index.isdigit() and section.texts.get("type", "robot") == "robot"
    )
    return tuple(sorted(drivers))
