"""A policy learns to act as a teacher does."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_torcs.errors import InvalidOption
from sb3_torcs.policies import BoundedPolicy
from sb3_torcs.policies.imitation import Imitation, mean_actions

ACTIONS = spaces.Box(-1.0, 1.0, (2,), np.float32)


def policy(features, seed):
    th.manual_seed(seed)
    seen = spaces.Box(-1.0, 1.0, (features,), np.float32)
    return BoundedPolicy(seen, ACTIONS, lambda _: 1e-3, net_arch=[16, 16])


def test_a_student_comes_close_to_its_teacher():
    teacher, student = policy(4, 0), policy(4, 1)
    imitation = Imitation(student, 3e-3)
    seen = th.rand(512, 4) * 2.0 - 1.0
    wanted = mean_actions(teacher, seen)
    losses = [imitation.learn(seen, wanted) for _ in range(300)]
    assert losses[-1] < 0.02 * losses[0]


def test_only_what_acts_is_taught():
    student = policy(4, 1)
    before = {name: own.clone() for name, own in student.state_dict().items()}
    Imitation(student).learn(th.rand(8, 4), th.zeros(8, 2))
    changed = {name for name, own in student.state_dict().items() if not own.equal(before[name])}
    assert {name.split(".")[0] for name in changed} == {"mlp_extractor", "action_net"}
    assert not any("value" in name for name in changed)
    assert all(own.grad is None for own in student.parameters())


def test_an_average_does_not_imitate():
    student = BoundedPolicy(
        spaces.Box(-1.0, 1.0, (4,), np.float32), ACTIONS, lambda _: 1e-3, ema_decay=0.9
    )
    with pytest.raises(InvalidOption, match="make its policy without ema_decay"):
        Imitation(student)


def test_the_steering_counts_more_than_the_pedal():
    """A unit is an error of 0.05 of the steering, and of 0.2 of the pedal."""
    student = policy(4, 1)
    seen = th.rand(8, 4)
    own = mean_actions(student, seen)
    for error in ([0.05, 0.0], [0.0, 0.2]):
        assert Imitation(student).learn(seen, own + th.tensor(error)) == pytest.approx(0.5)
        student = policy(4, 1)


def test_a_teacher_who_sees_less_looks_at_the_first_features():
    teacher, seen = policy(3, 0), th.rand(8, 5)
    assert mean_actions(teacher, seen).equal(mean_actions(teacher, seen[:, :3]))


def test_a_teacher_who_sees_more_is_refused():
    with pytest.raises(InvalidOption, match="a teacher of 5 features"):
        mean_actions(policy(5, 0), th.rand(8, 4))
