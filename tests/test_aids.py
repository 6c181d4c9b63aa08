"""What all driver aids have in common."""

from __future__ import annotations

import gymnasium as gym
import pytest

from sb3_torcs.envs.aids import Aids, parse_aids
from sb3_torcs.envs.options import AIDS
from sb3_torcs.errors import InvalidOption


def test_an_environment_has_the_aids_that_it_is_given():
    env = gym.make("TorcsLite-v0", aids=["catch_slides", "unstick"]).unwrapped
    assert env.aids == Aids(True, False, False, True)
    assert env.aids.names == ("unstick", "catch_slides")


@pytest.mark.parametrize("aids", ["unstick", True, None, 1])
def test_only_a_list_is_an_answer(aids):
    with pytest.raises(InvalidOption, match=f"aids is {aids!r}; expected a list with any of uns"):
        gym.make("TorcsLite-v0", aids=aids)


def test_an_unknown_aid_is_answered_by_the_nearest():
    with pytest.raises(InvalidOption, match="aids has 'unstik'; did you mean 'unstick'"):
        gym.make("TorcsLite-v0", aids=["unstik"])


@pytest.mark.parametrize(
    ("names", "aids"), [("all", AIDS), ("unstick, keep_clear", ("unstick", "keep_clear"))]
)
def test_a_command_names_them_with_commas(names, aids):
    assert parse_aids(names) == aids
