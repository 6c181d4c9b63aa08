"""What all driver aids have in common."""

from __future__ import annotations

import gymnasium as gym
import pytest

from sb3_torcs.envs.aids import AIDS
from sb3_torcs.errors import InvalidOption


@pytest.mark.parametrize("answer", [1, "yes", None])
@pytest.mark.parametrize("aid", AIDS)
def test_only_yes_or_no_is_an_answer(aid, answer):
    with pytest.raises(InvalidOption, match=f"{aid} is {answer!r}; expected True or False"):
        gym.make("TorcsLite-v0", **{aid: answer})
