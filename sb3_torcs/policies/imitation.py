"""Imitation: a policy learns to act as others do, from what they would do where it goes itself.

That is DAgger (Ross, Gordon and Bagnell, "A Reduction of Imitation Learning and Structured
Prediction to No-Regret Online Learning", arXiv:1011.0686), and with several teachers policy
distillation (Rusu et al., "Policy Distillation", arXiv:1511.06295).
"""

from __future__ import annotations

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import update_learning_rate

from sb3_torcs.errors import InvalidOption

__all__ = ["Imitation", "mean_actions"]

STEERING, PEDALS = 0.05, 0.2  # errors that weigh the same


def mean_actions(policy: ActorCriticPolicy, seen: th.Tensor) -> th.Tensor:
    """
    Tell what a policy would do.

    :param policy: of PPO or A2C
    :param seen: (batch, features) observations. A policy that has fewer features takes the first
        ones, so its sensors have to be the first of these
    :return: (batch, actuators) actions without noise
    :raises InvalidOption: if the policy has more features
    """
    shape = policy.observation_space.shape
    assert shape is not None
    (features,) = shape
    if features > seen.shape[1]:
        raise InvalidOption(
            f"a teacher of {features} features cannot tell what to do with {seen.shape[1]}; it has "
            "to see the same, or less"
        )
    with th.no_grad():
        return policy.get_distribution(seen[:, :features]).mode()


class Imitation:
    """
    Teaches a policy. Its value function and its noise stay as they are.

    :param policy: of PPO or A2C, which learns
    :param learning_rate: of Adam
    :raises InvalidOption: if an average of the policy's weights drives, which would not learn
    """

    def __init__(self, policy: ActorCriticPolicy, learning_rate: float = 1e-3) -> None:
        if getattr(policy, "average", None) is not None:
            raise InvalidOption(
                "the student drives an average of its weights, which does not follow imitation; "
                "make its policy without ema_decay"
            )
        self._policy = policy
        parts = (policy.mlp_extractor.policy_net, policy.action_net)
        parameters = [own for part in parts for own in part.parameters()]
        self._adam = th.optim.Adam(parameters, lr=learning_rate)

    def set_learning_rate(self, rate: float) -> None:
        """
        Change the learning rate.

        :param rate: of Adam
        """
        update_learning_rate(self._adam, rate)

    def learn(self, seen: th.Tensor, wanted: th.Tensor) -> float:
        """
        Make a step towards what is wanted.

        :param seen: (batch, features) observations
        :param wanted: (batch, actuators) actions, steering first
        :return: mean squared error, where 1 is one of 0.05 of the steering, or of 0.2 of a pedal
        """
        errors = th.full((wanted.shape[1],), PEDALS)
        errors[0] = STEERING
        loss = (((self._policy.get_distribution(seen).mode() - wanted) / errors) ** 2).mean()
        loss.backward()
        self._adam.step()
        self._adam.zero_grad()
        return loss.item()
