"""The algorithm of a saved model, and the class that loads it."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from sb3_torcs.errors import (
    InvalidOption,
    ModelMismatch,
    PackageMissing,
    install_line,
    near_miss,
    needs_extra,
)

__all__ = [
    "ALGORITHMS",
    "SBX",
    "algorithm_class",
    "check_same",
    "find_base_algorithm",
    "zoo_name",
]

SBX = "sbx_"
"""Begins the names of SBX's algorithms, which are SB3's in JAX: ``"sbx_tqc"``."""

ALGORITHMS = {
    **{name.lower(): f"stable_baselines3.{name}" for name in (
        "A2C", "DDPG", "DQN", "PPO", "SAC", "TD3",
    )},
    **{name.lower(): f"sb3_contrib.{name}" for name in ("ARS", "CrossQ", "QRDQN", "TQC", "TRPO")},
    "ppo_lstm": "sb3_contrib.RecurrentPPO",
}  # fmt: skip
"""The RL Zoo's names, and the classes. Its own table would bring all that the zoo imports."""

LIBRARIES = ("stable_baselines3", "sb3_contrib", "sbx")

SAVED_AS = {"ddpg": "td3"}  # models of the two cannot be told apart


def algorithm_class(name: str) -> Any:
    """
    Find an algorithm.

    :param name: the zoo's name of it, or SBX's in small letters after ``sbx_``
    :return: its class
    :raises InvalidOption: if there is no such algorithm
    :raises PackageMissing: if it is one of SBX, and that is not installed
    """
    if name.startswith(SBX):
        owner, known = "SBX", _sbx_algorithms(name)
        if name in known:
            return known[name]
    else:
        owner, known = "the RL Zoo", ALGORITHMS
        if name in known:
            library, _, class_name = known[name].rpartition(".")
            with needs_extra(f"'{name}'"):
                return getattr(importlib.import_module(library), class_name)
    advice = f"it has: {', '.join(sorted(known))}"
    raise InvalidOption(f"{owner} has no algorithm '{name}'{near_miss(name, known, advice)}")


def find_base_algorithm(own: type) -> type:
    """
    Find the algorithm of which another is a subclass, without importing the zoo, which patches.

    :param own: class of an algorithm
    :return: the first of its parents in SB3, sb3-contrib or SBX; itself if there is none
    """
    for parent in own.__mro__:
        package, _, rest = parent.__module__.partition(".")
        if package in LIBRARIES and not rest.startswith("common"):
            return parent
    return own


def zoo_name(algorithm: type) -> str:
    """
    Name an algorithm as the zoo does.

    :param algorithm: its class; that of SBX is named without ``sbx_``
    """
    name = algorithm.__name__
    return "ppo_lstm" if name == "RecurrentPPO" else name.lower()


def _sbx_algorithms(name: str) -> dict[str, Any]:
    """Import the algorithms of SBX, which is an optional package."""
    try:
        sbx = importlib.import_module("sbx")
    except ImportError as error:
        raise PackageMissing(
            f"'{name}' is an algorithm of SBX, which does not import ({error}); type: "
            f"{install_line('sbx')}"
        ) from error
    return {SBX + word.lower(): own for word, own in vars(sbx).items() if word[0].isupper()}


def check_same(model: Path, saved: str | None, algo: str, *, to_learn: bool = False) -> None:
    """
    Make sure that a model is one of this algorithm.

    :param model: the file, for the message
    :param saved: the algorithm that it is of, if that is known
    :param algo: that it should be of
    :param to_learn: whether it is to learn on: then TD3 is not DDPG, whose models drive alike
    :raises ModelMismatch: if it is not
    """
    names = {algo} if saved is None else {saved, algo}
    if len(names if to_learn else {SAVED_AS.get(name, name) for name in names}) > 1:
        raise ModelMismatch(f"'{model}' is a model of {saved}, not of {algo}; give --algo {saved}")
