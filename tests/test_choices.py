"""What an environment takes by name stands in its types, and the check takes the same names."""

from __future__ import annotations

import inspect
import typing

import numpy as np
import pytest

from sb3_torcs.car import RANGE_FINDERS, RangeFinderName
from sb3_torcs.envs.options import CONDITIONS, ENDS, LITE, PICTURE, SCR, TORCS
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
    for cls, table in ((TorcsEnv, TORCS), (TorcsLiteEnv, LITE)):
        for argument, option in table.items():
            if argument != "picture" and names_in(option.hint):
                names = names_in(option.hint)
                yield pytest.param(cls, argument, names, id=f"{cls.__name__}-{argument}")


def test_what_is_chosen_by_name_has_a_type():
    chosen = {"action", "aids", "gearbox", "range_finders", "render_mode", "reward", "sensors",
              "start"}  # fmt: skip
    of_lite = {case.values[1] for case in choices() if case.values[0] is TorcsLiteEnv}
    of_the_game = {case.values[1] for case in choices() if case.values[0] is TorcsEnv}
    assert of_lite == chosen
    assert of_the_game == chosen | {"backend"}


@pytest.mark.parametrize(("cls", "argument", "names"), list(choices()))
def test_another_name_is_refused_and_those_of_the_type_are_told(cls, argument, names):
    wrong = ["nonsense"] if argument == "aids" else "nonsense"
    with pytest.raises(Sb3TorcsError) as told:
        cls(**{argument: wrong})
    after = str(told.value).partition("nonsense")[2]
    assert [name for name in names if name not in after] == []


@pytest.mark.parametrize("cls", [TorcsEnv, TorcsLiteEnv])
def test_the_table_is_the_signature(cls):
    """As editors, ``inspect`` and the documentation read it."""
    table = {TorcsEnv: TORCS, TorcsLiteEnv: LITE}[cls]
    parameters = inspect.signature(cls).parameters
    assert {name: each.default for name, each in parameters.items()} == {
        name: option.default for name, option in table.items()
    }
    assert all(option.text and f":param {name}: " in cls.__doc__ for name, option in table.items())


@pytest.mark.parametrize("group", [ENDS, CONDITIONS, PICTURE, SCR])
def test_the_keys_of_a_group_are_documented(group):
    assert all(option.text for option in group.values())


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
