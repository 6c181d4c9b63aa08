"""Faster updates of DDPG and TD3 without PyTorch's record of operations, equal but for rounding."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_torcs.policies import kernels
from sb3_torcs.policies.fused import FusedActor, FusedValues, array, give
from sb3_torcs.policies.optimizers import LeanAdam, is_usual
from sb3_torcs.policies.split_head import SplitHeadPolicy

__all__ = ["LeanUpdates", "is_for"]


class _Network:
    """
    A network whose passes are by hand.

    :param owner: of its parameters
    :param networks: number of those that pass together
    """

    def __init__(self, owner: Any, networks: int) -> None:
        self.flat: th.Tensor = owner.flat
        self.vector = array(owner.flat)
        self.vectors = self.vector.reshape(networks, -1)
        self.passes: Any = owner.fused


class LeanUpdates:
    """
    Updates a model in the place of its ``train``.

    :param model: for which :func:`is_for` is true
    """

    def __init__(self, model: TD3) -> None:
        self.model, policy = model, cast(SplitHeadPolicy, model.policy)
        self.actor, self.actor_target = (
            _Network(actor.mu, 1) for actor in (policy.actor, policy.actor_target)
        )
        self.critic, self.critic_target = (
            _Network(critic, policy.critic.n_critics)
            for critic in (policy.critic, policy.critic_target)
        )
        self.actor_gradient = np.empty_like(self.actor.vector)
        self.critic_gradient = np.empty_like(self.critic.vectors)
        self.average = policy.average
        self.average_weights = (
            None if self.average is None else array(cast(th.Tensor, policy.driver.mu.flat))
        )

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """
        Update the networks as ``TD3.train`` does, in its order.

        :param gradient_steps: number of updates
        :param batch_size: transitions per update
        """
        model = self.model
        model.policy.set_training_mode(True)
        model._update_learning_rate([model.actor.optimizer, model.critic.optimizer])
        actor_losses, critic_losses = [], []
        assert model.replay_buffer is not None
        for _ in range(gradient_steps):
            model._n_updates += 1
            batch = model.replay_buffer.sample(batch_size, env=model._vec_normalize_env)
            critic_losses.append(self._update_critic(batch))
            if model._n_updates % model.policy_delay == 0:
                actor_losses.append(self._update_actor(array(batch.observations)))
                self._follow()
        model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")
        if actor_losses:
            model.logger.record("train/actor_loss", np.mean(actor_losses))
        model.logger.record("train/critic_loss", np.mean(critic_losses))

    def _update_critic(self, batch: ReplayBufferSamples) -> float:
        """Learn from the targets' values; return the loss."""
        observations, actions, following, dones, rewards = map(array, batch[:5])
        given = batch.discounts
        discounts = np.full_like(rewards, self.model.gamma) if given is None else array(given)
        passes: FusedValues = self.critic.passes
        target = self.critic_target.vectors
        next_values, work = passes.forward(target, following, self._next_actions(following))
        give(work)
        values, work = passes.forward(self.critic.vectors, observations, actions)
        slope, gradient = np.empty_like(values), self.critic_gradient
        loss: float = kernels.difference(values, next_values, rewards, dones, discounts, slope)
        passes.backward(self.critic.vectors, observations, actions, work, slope, gradient)
        optimizer = cast(LeanAdam, self.model.critic.optimizer)
        optimizer.step_of(self.critic.flat, gradient.reshape(-1))
        return loss

    def _next_actions(self, following: np.ndarray) -> np.ndarray:
        """Let the target decide, with a clipped noise."""
        passes: FusedActor = self.actor_target.passes
        actions, work = passes.forward(self.actor_target.vector, following)
        give(work)
        # Drawn even if it is clipped to 0, so that later random numbers are the same.
        noise = th.empty(actions.shape).normal_(0, self.model.target_policy_noise).numpy()
        clip = self.model.target_noise_clip
        return np.clip(actions + np.clip(noise, -clip, clip), -1, 1) if clip else actions

    def _update_actor(self, observations: np.ndarray) -> float:
        """Learn from the first critic's values; return the loss."""
        passes: FusedActor = self.actor.passes
        critic: FusedValues = self.critic.passes
        weights, first = self.actor.vector, self.critic.vectors[:1]
        actions, work = passes.forward(weights, observations)
        values, seen = critic.forward(first, observations, actions)
        share = np.full_like(values[0], -1.0 / len(observations))
        slope = critic.backward_to_actions(first, seen, share)
        passes.backward(weights, observations, work, actions, slope, self.actor_gradient)
        cast(LeanAdam, self.model.actor.optimizer).step_of(self.actor.flat, self.actor_gradient)
        return -float(values.mean())

    def _follow(self) -> None:
        """Let the targets, and the average that drives, follow by a share."""
        if self.average is not None:
            # The average begins with the actor of the first update.
            kept = self.average.decay if self.average.n_averaged > 0 else 0.0
            kernels.follow(self.average_weights, self.actor.vector, np.float32(1.0 - kept))
            self.average.n_averaged += 1
        share = np.float32(self.model.tau)
        kernels.follow(self.critic_target.vector, self.critic.vector, share)
        kernels.follow(self.actor_target.vector, self.actor.vector, share)


def is_for(model: TD3) -> bool:
    """
    Say whether lean updates are equal to those of a model.

    :param model: DDPG or TD3 with a :class:`~sb3_torcs.policies.SplitHeadPolicy`
    :return: false on a GPU, or if a part is not the default
    """
    policy = cast(SplitHeadPolicy, model.policy)
    optimizers = policy.actor.optimizer, policy.critic.optimizer
    return (
        type(model).train is TD3.train
        and policy.fuses
        and type(policy.actor.features_extractor) is FlattenExtractor
        and all(isinstance(own, LeanAdam) and is_usual(own) for own in optimizers)
    )
