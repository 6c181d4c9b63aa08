"""Vector environments that are joined do what each of them does by itself, to the bit."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor

from sb3_torcs.errors import EnvClosed, InvalidAction, InvalidOption
from sb3_torcs.vec_env import JoinedVecEnv, TorcsVecEnv

FAST = {"track": "aalborg", "max_episode_steps": 20}
CAREFUL = {"track": "g-track-1", "max_episode_steps": 30, "reward": {"progress": 0.5}}


@pytest.fixture
def make():
    """Make two and three cars, and close them afterwards."""
    made = []

    def make(*parts):
        made.append([TorcsVecEnv(n, env_id="TorcsLite-v0", **options) for n, options in parts])
        return made[-1]

    yield make
    for parts in made:
        for part in parts:
            part.close()


@pytest.fixture
def joined(make):
    return JoinedVecEnv(make((2, FAST), (3, CAREFUL)))


def test_it_drives_as_its_parts_do(joined, make):
    parts = make((2, FAST), (3, CAREFUL))
    random = np.random.default_rng(0)
    joined.seed(7)
    parts[0].seed(7)
    parts[1].seed(9)
    seen = joined.reset()
    assert (seen == np.concatenate([part.reset() for part in parts])).all()
    ends = 0
    for _ in range(70):
        actions = random.uniform(joined.action_space.low, joined.action_space.high, (5, 3))
        actions = actions.astype(np.float32)
        ours = joined.step(actions)
        theirs = [parts[0].step(actions[:2]), parts[1].step(actions[2:])]
        for mine, other in zip(ours[:3], zip(*theirs, strict=True), strict=False):
            assert (mine == np.concatenate(other)).all()
        for mine, other in zip(ours[3], theirs[0][3] + theirs[1][3], strict=True):
            assert mine["distance"] == other["distance"]
            assert mine.get("episode", {}).get("l") == other.get("episode", {}).get("l")
        ends += int(ours[2].sum())
    assert ends >= 5
    assert len(joined.reset_infos) == 5


def test_environments_are_named_across_its_parts(joined):
    joined.reset()
    names = [track.name for track in joined.get_attr("track")]
    assert names == ["aalborg", "aalborg", "g-track-1", "g-track-1", "g-track-1"]
    assert [track.name for track in joined.get_attr("track", [3, -5])] == ["g-track-1", "aalborg"]
    joined.set_attr("note", "here", indices=[1, 2])
    assert joined.get_attr("note", [2, 1]) == ["here", "here"]
    assert joined.env_method("has_wrapper_attr", "note", indices=[0, 1]) == [False, True]
    assert joined.env_is_wrapped(Monitor) == [True] * 5
    assert joined.env_is_wrapped(gym.wrappers.RecordVideo, indices=4) == [False]


def test_options_go_to_the_environment_that_they_are_for(joined):
    joined.set_options([{}, {}, {"distance": 500.0}, {}, {}])
    joined.reset()
    starts = [car.distance_from_start for car in joined.get_attr("car")]
    assert starts[2] == pytest.approx(500.0, abs=1.0)
    joined.reset()
    assert joined.get_attr("car", 2)[0].distance_from_start == starts[3]


def test_stock_ppo_learns_from_it(joined):
    model = PPO("MlpPolicy", joined, n_steps=16, batch_size=40, n_epochs=1, seed=0)
    assert model.learn(160).num_timesteps == 160


def test_closing_it_closes_its_parts(joined):
    joined.close()
    for part in joined.parts:
        with pytest.raises(EnvClosed):
            part.step(np.zeros((part.num_envs, 3), np.float32))


def test_a_part_that_fails_leaves_the_others_in_step(joined, monkeypatch):
    def fail():
        raise RuntimeError("lost")

    actions = np.zeros((5, 3), np.float32)
    joined.seed(0)
    first = joined.reset()
    monkeypatch.setattr(joined.parts[0], "step_wait", fail)
    waited = []
    monkeypatch.setattr(joined.parts[1], "step_wait", lambda: waited.append(True))
    with pytest.raises(RuntimeError, match="lost"):
        joined.step(actions)
    assert waited
    monkeypatch.undo()
    joined.seed(0)
    assert (joined.reset() == first).all()
    monkeypatch.setattr(joined.parts[0], "close", fail)
    with pytest.raises(RuntimeError, match="lost"):
        joined.close()
    with pytest.raises(EnvClosed):
        joined.parts[1].step(actions[2:])


def test_parts_have_equal_spaces(make):
    with pytest.raises(InvalidOption, match=r"parts\[1\] has the action_space .*same sensors"):
        JoinedVecEnv(make((1, FAST), (1, {**FAST, "action": "pedal"})))
    with pytest.raises(InvalidOption, match="parts is empty"):
        JoinedVecEnv([])
    for parts in (make((1, FAST))[0], None):
        with pytest.raises(InvalidOption, match=r"parts is .*; expected a list of vector env"):
            JoinedVecEnv(parts)


def test_parts_are_different_vector_environments(make):
    (part,) = make((1, FAST))
    for parts, place in (([1], 0), ([part, part], 1)):
        with pytest.raises(InvalidOption, match=rf"parts\[{place}\] is .*; expected a vector"):
            JoinedVecEnv(parts)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((6, 3), np.float32), r"shape \(6, 3\); expected \(5, 3\)"),
        (None, r"shape \(\); expected \(5, 3\)"),
        (np.full((5, 3), [[0.0], [0.0], [0.0], [np.nan], [0.0]]), "environment 3 has nan"),
    ],
)
def test_a_wrong_action_drives_nobody(joined, actions, message):
    joined.reset()
    with pytest.raises(InvalidAction, match=message):
        joined.step(actions)
    assert {car.time for car in joined.get_attr("car")} == {0.0}
