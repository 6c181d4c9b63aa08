"""The installed game as a process of its own, in a private folder that is removed with it.

The user's own ``~/.torcs`` is not read or changed, and the installation is not changed. Robots that
learn begin anew each time.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sysconfig
import tempfile
import weakref
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from sb3_torcs.errors import BackendUnavailable, GameFailed, GameIncomplete, GameTimeout
from sb3_torcs.signals import defer_signals
from sb3_torcs.torcs.building import build_command
from sb3_torcs.torcs.installation import Game
from sb3_torcs.torcs.race_setup import RACE_FILE, SCR_SERVER, RaceSetup, write_race
from sb3_torcs.torcs.scenery import Scenery, find_scenery
from sb3_torcs.torcs.track_names import TrackFile, find_track

__all__ = ["PROCESS_NAME", "GameProcess", "TrackCheck", "compiled_library", "game_environment"]

PROCESS_NAME = "racing-game"  # in lists of processes
PREFIX = "sb3-torcs-game-"  # of private folders
LAST_LINES = 5  # [lines] of the game's output, for an error
OWN_TRACKS = "own"  # the category of a track that is not the game's
ENDING = 1.0  # [s] from the end of a process's connections to its own, at most
GRACE = 5.0  # [s] for a process to end after a signal
LOOK = 0.1  # [s] between two looks at what the game prints


TrackCheck = Callable[[Game, RaceSetup, Path], None]
"""Takes the installation, the race and the file of its track; raises what is wrong."""


class GameProcess:
    """
    A race that the installed game runs, from now until :meth:`stop`.

    Use it in a ``with`` statement. The process also ends with this one, and removes its folder
    if it has to do so itself (a driver of ours or the game's window is needed for that).

    :param game: the installation
    :param race: who races where
    :param check: refuses a track that the game cannot drive. It is an argument, because it is on a
        higher floor: ``sb3_torcs.tracks.trial.check_track``
    :param environment: variables for our own code inside the game
    :param descriptors: open files that the game inherits
    :param preload: a library of ours that the game's program loads first, instead of text mode
    :param files: texts for the private folder, by their place in it
    :raises TrackNotFound: if the game has no such track
    :raises TrackFileError: if the track's file is broken
    :raises SceneryMissing: if there is a window, and the game cannot draw the track
    :raises UnknownRobot: if the game has no such robot
    :raises UnknownCar: if the game does not have the car of a driver
    :raises GameIncomplete: if the game lacks its program, or a file that a race needs
    :raises BackendUnavailable: if a library of ours that the game needs was not built
    :raises GameFailed: if the program does not run
    """

    def __init__(
        self,
        game: Game,
        race: RaceSetup,
        *,
        check: TrackCheck,
        environment: Mapping[str, str] | None = None,
        descriptors: Sequence[int] = (),
        preload: Path | None = None,
        files: Mapping[str, str] | None = None,
    ) -> None:
        if game.program is None:
            raise GameIncomplete(
                f"{game.libraries} has no torcs-bin, which runs races; "
                "type: `sb3-torcs install-torcs`"
            )
        for name, index in race.drivers:
            if name == SCR_SERVER:
                game.find_car(race.client_car(index))
            else:
                game.find_robot(name, index)
        self._own_scenery: Path | None = None
        self.folder = Path(tempfile.mkdtemp(prefix=PREFIX))
        try:
            track = find_track(race.track, game)
            check(game, race, track.path)
            scenery = None if preload is None else find_scenery(game, track.path)
            if scenery is not None and track.source == "file":
                self._own_scenery = scenery.folder
            data, race = _data(game, self.folder, race, track, scenery)
            libraries = _libraries(game, self.folder, race)
            self.race_name = write_race(game, self.folder, race)
            for file, text in (files or {}).items():
                (self.folder / file).write_text(text, encoding="UTF-8")
            call = [str(game.program), "-l", str(self.folder), "-L", str(libraries)]
            call += ["-D", str(data)]
            variables = {
                **game_environment(game, self.folder),
                "SB3_TORCS_OWNER": str(os.getpid()),
                "SB3_TORCS_FOLDER": str(self.folder),
                **(environment or {}),
            }
            first = [] if preload is None else [preload]
            variables["LD_PRELOAD"] = ":".join(str(library) for library in [*first, *mathematics()])
            if preload is None:
                call += ["-r", str(self.folder / RACE_FILE)]
            else:
                variables["SB3_TORCS_RACE"] = str(self.folder / RACE_FILE)
            # Clients end games of their own by the name torcs.
            (self.folder / PROCESS_NAME).symlink_to(game.program)
            self._process = _start(call, self.folder, data, variables, descriptors)
        except BaseException:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise
        self._heard = 0  # [bytes] of what the game printed
        self._end = weakref.finalize(self, _end, self._process, self.folder, os.getpid())

    def __enter__(self) -> GameProcess:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def poll(self) -> int | None:
        """Return the exit status, negative for a signal; ``None`` while the game runs."""
        return self._process.poll()

    def is_ending(self) -> bool:
        """Whether the game has ended, or does so now: its ports close before it is gone."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(ENDING)
        return self.poll() is not None

    def wait(self, timeout: float | None = None) -> None:
        """
        Wait for the game to end by itself.

        :param timeout: after which it is stopped [s]; ``None`` waits for ever
        :raises GameTimeout: if it does not end in time
        :raises GameFailed: if it ends with an error
        """
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired as error:
            last = self.last_words()
            self.stop()
            raise GameTimeout(
                f"the game did not end the race within {timeout:g} s and was stopped; "
                f"it last said: {last}"
            ) from error
        if self._process.returncode != 0:
            raise GameFailed(self.epitaph())

    def follow(self, hear: Callable[[str], None]) -> None:
        """
        Wait for the game to end by itself, and pass on its output.

        :param hear: called with each line, without its end
        :raises GameFailed: if it ends with an error
        """
        while self._process.poll() is None:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(LOOK)
            self._pass_on(hear)
        self._pass_on(hear)
        self.wait()

    def end_race(self) -> None:
        """
        End the race as if all cars had finished, so that clients are told and results are written.

        This needs our driver module. A game without it, and a paused game, is killed.
        """
        self._process.terminate()
        try:
            self._process.wait(GRACE)
        except subprocess.TimeoutExpired:
            self._process.kill()

    def epitaph(self) -> str:
        """Make the error of a game that ended, with its last output."""
        status = self._process.poll()
        how = f"exit status {status}"
        if status is not None and status < 0:
            how = signal.Signals(-status).name
        hint = ""
        if status == -signal.SIGSEGV and self._own_scenery is not None:
            hint = f"; perhaps a file of the track's scenery in {self._own_scenery} is broken"
        return f"the game ended with {how}; it last said: {self.last_words()}{hint}"

    def _pass_on(self, hear: Callable[[str], None]) -> None:
        """
        Pass on the whole lines that the game has printed since the last time.

        :param hear: called with each
        """
        with (self.folder / "words").open("rb") as words:
            words.seek(self._heard)
            text = words.read()
        whole = text[: text.rfind(b"\n") + 1]
        self._heard += len(whole)
        for line in whole.decode(errors="replace").splitlines():
            hear(line)

    def last_words(self) -> str:
        """Return the last lines that the game printed, as one."""
        lines = self.words().splitlines()
        said = [" ".join(line.split()) for line in lines if line.strip()][-LAST_LINES:]
        return " / ".join(said) or "nothing"

    def words(self) -> str:
        """Return the end of what the game printed."""
        try:
            with (self.folder / "words").open("rb") as words:
                words.seek(max(0, os.fstat(words.fileno()).st_size - 4096))
                return words.read().decode(errors="replace")
        except FileNotFoundError:  # stopped before
            return ""

    def stop(self) -> None:
        """End the game, if it runs, and remove its folder. A second call does nothing."""
        self._end()


def compiled_library(name: str) -> Path:
    """
    Find a library of ours that the game loads.

    :param name: e.g. ``"_scr_server"``
    :return: its file
    :raises BackendUnavailable: if it was not built
    """
    file = Path(__file__).parents[1] / f"{name}{sysconfig.get_config_var('EXT_SUFFIX')}"
    if not file.is_file():
        raise BackendUnavailable(f"there is no {file}; build it: {build_command()}")
    return file


def mathematics() -> list[Path]:
    """
    Find the libraries that give the game mathematics with the same results on every machine.

    :raises BackendUnavailable: if ours was not built
    """
    return [compiled_library("_game_maths")]


def game_environment(game: Game, folder: Path) -> dict[str, str]:
    """
    Make the environment variables of the game: with its libraries, without the user's settings.

    :param game: the installation
    :param folder: that stands for the user's home
    :return: variables and their values
    """
    path = ":".join(str(part) for part in game.library_path)
    inherited = os.environ.get("LD_LIBRARY_PATH")
    return {
        "HOME": str(folder),
        "LC_ALL": "C",  # the game reads numbers by the locale
        "LD_LIBRARY_PATH": f"{path}:{inherited}" if inherited else path,
    }


def _data(
    game: Game, folder: Path, race: RaceSetup, track: TrackFile, scenery: Scenery | None
) -> tuple[Path, RaceSetup]:
    """
    Say where the game finds the track: in its own data, or in a folder that also has a user's.

    :param game: the installation
    :param folder: private to the game
    :param race: who races where
    :param track: of the race
    :param scenery: of the track, if it is drawn
    :return: the folder of data, and the race with its track as ``category/name``
    """
    file, is_own = track.path, track.source == "file"
    name = f"{OWN_TRACKS}/{track.name}" if is_own else track.name
    place = name if scenery is None else scenery.place
    if place == name and not is_own:
        return game.data, replace(race, track=place)
    data, category = folder / "data", Path(place).parent.name
    own = data / "tracks" / place
    own.mkdir(parents=True)
    _link_all(game.data, data, besides="tracks")
    _link_all(game.data / "tracks", data / "tracks", besides=category)
    if (game.data / "tracks" / category).is_dir():
        _link_all(game.data / "tracks" / category, own.parent, besides=file.stem)
    (own / f"{file.stem}.xml").symlink_to(file)  # in lower case
    _link_all(file.parent, own, besides=file.name)
    if scenery is not None and scenery.folder != file.parent:
        _link_all(scenery.folder, own, besides=f"{scenery.folder.name}.xml")
    return data, replace(race, track=place)


def _libraries(game: Game, folder: Path, race: RaceSetup) -> Path:
    """
    Say where the game finds its modules: where they are, or in a folder that also has ours.

    :param game: the installation
    :param folder: private to the game
    :param race: who races where
    :return: the folder of libraries
    """
    if not race.has_clients:
        return game.libraries
    module = compiled_library("_scr_server")
    libraries = folder / "libraries"
    (libraries / "drivers" / SCR_SERVER).mkdir(parents=True)
    _link_all(game.libraries, libraries, besides="drivers")
    _link_all(game.libraries / "drivers", libraries / "drivers", besides=SCR_SERVER)
    (libraries / "drivers" / SCR_SERVER / f"{SCR_SERVER}.so").symlink_to(module)
    return libraries


def _link_all(source: Path, target: Path, besides: str = "") -> None:
    """Link to everything in a folder."""
    for path in source.iterdir():
        if path.name != besides and not os.path.lexists(target / path.name):
            (target / path.name).symlink_to(path)


def _start(
    call: Sequence[str],
    folder: Path,
    data: Path,
    variables: Mapping[str, str],
    descriptors: Sequence[int],
) -> subprocess.Popen[bytes]:
    """
    Start the game's program.

    :param call: the program and its arguments
    :param folder: with a link to the program, and for the file of all that it prints
    :param data: the game opens its data relative to where it runs
    :param variables: its environment
    :param descriptors: that it inherits
    """
    with (folder / "words").open("wb") as output:
        try:
            # A group of its own: Ctrl-C is for this process, which then ends the game.
            return subprocess.Popen(
                call, executable=folder / PROCESS_NAME, cwd=data, env=dict(variables),
                stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                pass_fds=tuple(descriptors), start_new_session=True,
            )  # fmt: skip
        except OSError as error:
            raise GameFailed(f"{call[0]} does not run: {error.strerror}") from error


def _end(process: subprocess.Popen[bytes], folder: Path, owner: int) -> None:
    """End the game and remove its folder."""
    if os.getpid() != owner:
        return
    with defer_signals():
        process.kill()  # the game has nothing to save
        process.wait(GRACE)
        shutil.rmtree(folder, ignore_errors=True)
