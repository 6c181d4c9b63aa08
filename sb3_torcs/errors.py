"""The errors of this package: one class per mistake, one root.

Each message says what was received, what is allowed, and what to type next.
"""

from __future__ import annotations

import contextlib
import difflib
import importlib.util
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

__all__ = [
    "EXTRAS",
    "BackendUnavailable",
    "CarFileError",
    "CarLost",
    "DisplayUnavailable",
    "DriveFileError",
    "EngineBusy",
    "EngineForked",
    "EnvClosed",
    "GameFailed",
    "GameIncomplete",
    "GameNotFound",
    "GameTimeout",
    "InstallFailed",
    "InvalidAction",
    "InvalidOption",
    "LayoutMismatch",
    "MessageBroken",
    "ModelMismatch",
    "ModelNotTrusted",
    "NoiseNotBound",
    "OutputNotWritable",
    "PackageMissing",
    "PortTaken",
    "RayUnavailable",
    "RobotUnavailable",
    "Sb3TorcsError",
    "SceneryMissing",
    "ServerLost",
    "ServerNotFound",
    "StartBlocked",
    "StudyError",
    "TrackFileError",
    "TrackNotFound",
    "TrainingDiverged",
    "UnknownCar",
    "UnknownDriver",
    "UnknownRewardTerm",
    "UnknownRobot",
    "ZooConfigError",
    "check_extras",
    "ends_in_a_line",
    "install_line",
    "near_miss",
    "needs_extra",
    "unknown_argument",
]

Function = TypeVar("Function", bound=Callable[..., Any])


class Sb3TorcsError(Exception):
    """Root of all errors that this package raises on purpose."""


class TrackNotFound(Sb3TorcsError, LookupError):
    """No track has this name."""


class TrackFileError(Sb3TorcsError, ValueError):
    """A track file cannot be read; the message names the file and the line."""


class SceneryMissing(Sb3TorcsError, LookupError):
    """The game's window cannot draw a track; the message names the file that it would need."""


class InvalidOption(Sb3TorcsError, ValueError):
    """A keyword argument or reset option has a value outside what is allowed."""


class StartBlocked(InvalidOption):
    """A car would begin in a wall or in another car."""


class InvalidAction(Sb3TorcsError, ValueError):
    """An action has the wrong shape or is not a number."""


class UnknownDriver(InvalidOption, LookupError):
    """No driver has this name."""


class UnknownRewardTerm(Sb3TorcsError, LookupError):
    """A reward names a preset or a term that does not exist."""


class EnvClosed(Sb3TorcsError, RuntimeError):
    """The environment was used after ``close`` or before ``reset``."""


class BackendUnavailable(Sb3TorcsError, RuntimeError):
    """The simulator behind an environment is not installed."""


class GameNotFound(BackendUnavailable):
    """TORCS is not installed."""


class GameIncomplete(BackendUnavailable):
    """TORCS is installed in part: the message names what is missing or broken."""


class LayoutMismatch(BackendUnavailable):
    """The structures of the installed game are not those of the supported version."""


class RobotUnavailable(BackendUnavailable):
    """A robot's module does not load, or its set-up does not fit its car."""


class DisplayUnavailable(BackendUnavailable):
    """There is no display for the game's window."""


class DriveFileError(Sb3TorcsError, ValueError):
    """A file of drives cannot be read, or its drives cannot be compared."""


class EngineBusy(Sb3TorcsError, RuntimeError):
    """Two threads drive one engine."""


class EngineForked(Sb3TorcsError, RuntimeError):
    """An engine is used in a child process that was forked after it was made."""


class CarLost(Sb3TorcsError, RuntimeError):
    """The game's physics has divided by zero: a car has no position, and the race ends."""


class GameFailed(Sb3TorcsError, RuntimeError):
    """The game ended without results; the message holds the end of its output."""


class GameTimeout(Sb3TorcsError, TimeoutError):
    """The game did not end within its time limit."""


class InstallFailed(Sb3TorcsError, RuntimeError):
    """TORCS cannot be installed here; the message says why and what to do."""


class PortTaken(Sb3TorcsError, OSError):
    """A port for the game's clients is not free, or may not be used."""


class ServerNotFound(Sb3TorcsError, ConnectionError):
    """No SCR server answers at this address."""


class ServerLost(Sb3TorcsError, ConnectionError):
    """An SCR server that did answer has ended, or does not answer any more."""


class MessageBroken(Sb3TorcsError, ValueError):
    """A datagram does not follow the SCR protocol; the message shows the part that is wrong."""


class UnknownCar(Sb3TorcsError, LookupError):
    """The installed game has no car of this name."""


class CarFileError(Sb3TorcsError, ValueError):
    """A car's file cannot be read, or describes a car that cannot drive."""


class UnknownRobot(Sb3TorcsError, LookupError):
    """The installed game has no robot of this name, or none with this index."""


class ModelMismatch(Sb3TorcsError, ValueError):
    """A saved model does not fit the environment it is asked to drive."""


class ModelNotTrusted(Sb3TorcsError, ValueError):
    """Loading a model would run code that is pickled in it, which was not allowed."""


class NoiseNotBound(Sb3TorcsError, RuntimeError):
    """A noise that depends on the policy's action was not told which policy it perturbs."""


class OutputNotWritable(Sb3TorcsError, OSError):
    """A folder or file that results should go to cannot be written."""


class StudyError(Sb3TorcsError, ValueError):
    """A study's file or folder has a mistake."""


class RayUnavailable(Sb3TorcsError, RuntimeError):
    """A study needs Ray, which is not installed or does not answer."""


class TrainingDiverged(Sb3TorcsError, ArithmeticError):
    """A model that learns computes no numbers any more."""


class PackageMissing(Sb3TorcsError, ImportError):
    """Something needs a package that is not installed; the message says what to type."""


class ZooConfigError(Sb3TorcsError, ValueError):
    """A hyperparameter file has a mistake, such as a key that nothing reads."""


ELSEWHERE = {
    "agents": "races of several agents are sb3_torcs.vec_env.TorcsVecEnv and "
    "sb3_torcs.parallel_env",
    "frame_skip": "it is called 'action_repeat' here",
    "num_envs": "gym.make_vec makes several environments",
    "threads": "gym.make_vec('Torcs-v0') and sb3_torcs.vec_env.TorcsVecEnv drive on threads",
}
"""Arguments that people try where they are not, and what has them."""


EXTRAS = {
    "imageio_ffmpeg": "video",
    "onnx": "export",
    "onnxscript": "export",
    "openskill": "races",
    "pettingzoo": "races",
    "plotly": "reports",
    "pyarrow": "reports",
    "ray": "study",
    "rl_zoo3": "zoo",
    "sb3_contrib": "zoo",
    "sbx": "sbx",
}
"""Packages that the core does without, and the extra that brings each."""


def install_line(package: str) -> str:
    """
    Say what to type for a package of an extra.

    :param package: name of its module, one of :data:`EXTRAS`
    """
    return f'pip install "sb3-torcs[{EXTRAS[package]}]"'


@contextlib.contextmanager
def needs_extra(what: str) -> Iterator[None]:
    """
    Let imports of packages of an extra say what to type where they are missing.

    :param what: needs the packages that the block imports
    :raises PackageMissing: in place of Python's own error
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        raise PackageMissing(
            f"{what} needs {package}, which is not installed; type: {install_line(package)}"
        ) from error


def check_extras(what: str, *packages: str) -> None:
    """
    Make sure that packages are there before work begins whose result needs them.

    :param what: needs them
    :param packages: names of their modules, all in :data:`EXTRAS`
    :raises PackageMissing: if one is not installed
    """
    with needs_extra(what):
        for package in packages:
            if importlib.util.find_spec(package) is None:
                raise ModuleNotFoundError(name=package)


@contextlib.contextmanager
def ends_in_a_line() -> Iterator[None]:
    """
    Let a script end with the message of an error of this package, not with a traceback.

    :raises SystemExit: with the message
    """
    try:
        yield
    except Sb3TorcsError as error:
        raise SystemExit(f"error: {error}") from None


def near_miss(name: object, known: Iterable[str], advice: str = "") -> str:
    """
    Complete a message about an unknown name with the name that was probably meant, and advice.

    Capital and small letters count as the same. The name itself, as of a link to nothing, is left
    out.

    :param name: what was typed
    :param known: the names that exist
    :param advice: what else to say
    :return: e.g. ``"; did you mean 'x'? it has x, y"``, or ``"; it has x, y"`` if none is close
    """
    typed = str(name)
    lowered = {str(one).lower(): str(one) for one in known if str(one) != typed}
    close = difflib.get_close_matches(typed.lower(), lowered, n=1, cutoff=0.6)
    suggestion = [f"did you mean '{lowered[close[0]]}'?"] if close else []
    ending = " ".join([*suggestion, advice] if advice else suggestion)
    return f"; {ending}" if ending else ""


def unknown_argument(owner: str, name: str, known: Iterable[str]) -> TypeError:
    """
    Make the error for an argument that a function does not have: Python's own, and advice.

    :param owner: name of the function
    :param name: of the argument
    :param known: the names that it has
    """
    error = f"{owner}() got an unexpected keyword argument {name!r}"
    advice = f"; {ELSEWHERE[name]}" if name in ELSEWHERE else near_miss(name, known)
    return TypeError(error + advice)
