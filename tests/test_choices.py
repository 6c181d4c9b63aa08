"""What an environment takes by name stands in its types, and the check takes the same names."""

from __future__ import annotations

import typing

import numpy as np
import pytest

from sb3_torcs.car import RANGE_FINDERS, RangeFinderName
from sb3_torcs.envs.torcs import TorcsEnv
from sb3_torcs.envs.torcs_lite import TorcsLiteEnv
from sb3_torcs.errors import Sb3TorcsError
from sb3_torcs.rewards import PRESETS, RewardName
from sb3_torcs.torcs.window import VIEWS, ViewName


def names_in(hint):
    """The strings that a type allows by name, in the order of the type."""
    if typing.get_origin(hint) is typing.Literal:
        return typing.get_args(hint)
    return tuple(name for part in typing.get_args(hint) for name in names_in(part))


def choices():
    for cls in (TorcsEnv, TorcsLiteEnv):
        for argument, hint in typing.get_type_hints(cls.__init__).items():
            if names_in(hint):
                yield pytest.param(cls, argument, names_in(hint), id=f"{cls.__name__}-{argument}")


def test_what_is_chosen_by_name_has_a_type():
    chosen = {
        "action",
        "gearbox",
        "picture",
        "range_finders",
        "render_mode",
        "reward",
        "sensors",
        "start",
    }
    of_lite = {case.values[1] for case in choices() if case.values[0] is TorcsLiteEnv}
    of_the_game = {case.values[1] for case in choices() if case.values[0] is TorcsEnv}
    assert of_lite == chosen
    assert of_the_game == chosen | {"backend", "view"}


@pytest.mark.parametrize(("cls", "argument", "names"), list(choices()))
def test_another_name_is_refused_and_those_of_the_type_are_told(cls, argument, names):
    more = {"picture": "game"} if argument == "view" else {}
    with pytest.raises(Sb3TorcsError) as told:
        cls(**{argument: "nonsense"}, **more)
    after = str(told.value).partition("nonsense")[2]
    assert [name for name in names if name not in after] == []


@pytest.mark.parametrize(
    ("alias", "table"),
    [(RewardName, PRESETS), (RangeFinderName, RANGE_FINDERS), (ViewName, VIEWS)],
    ids=["rewards", "range finders", "views"],
)
def test_a_table_has_the_names_of_its_type(alias, table):
    assert typing.get_args(alias) == tuple(table)


NO_CHOICES = [np.array(["grid", "pedal"]), np.array([1.0, 2.0]), b"base", {"grid": 1}, 3]


@pytest.mark.parametrize("cls", [TorcsEnv, TorcsLiteEnv])
@pytest.mark.parametrize("wrong", NO_CHOICES, ids=["names", "numbers", "bytes", "dict", "number"])
@pytest.mark.parametrize(
    "argument",
    ["action", "car", "gearbox", "opponents", "picture", "backend", "sensors", "start", "track"],
)
def test_what_is_no_name_is_refused_by_its_option(game, cls, wrong, argument):
    """Also an array, which compares one by one."""
    with pytest.raises(Sb3TorcsError, match=argument):
        cls(**{argument: wrong})
