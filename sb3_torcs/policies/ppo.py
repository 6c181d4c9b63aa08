"""PPO's rollouts and updates without PyTorch's record of operations, equal but for rounding.

The policy and the value function share no layer, so two threads find their gradients at once.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from types import MethodType
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import RolloutBufferSamples
from stable_baselines3.common.utils import explained_variance
from torch import nn

from sb3_torcs.policies import kernels
from sb3_torcs.policies.bounded import BothWays, BoundedHead, BoundedPolicy, MeanOfBoth
from sb3_torcs.policies.inputs import SensorInputs
from sb3_torcs.policies.networks import ActorAverage
from sb3_torcs.policies.optimizers import adam_factors, adam_state, is_usual
from sb3_torcs.policies.ppo_passes import decide, find_policy_gradient, find_value_gradient
from sb3_torcs.policies.stock import has_hooks, has_module_hooks, has_own_methods
from sb3_torcs.policies.threads import Helper, two_threads
from sb3_torcs.policies.vectors import array

__all__ = ["LeanForward", "LeanPPO", "is_for"]

ENTROPY = 0.5 + 0.5 * math.log(math.tau)  # of a Gaussian whose standard deviation is 1
SPARE = 1e-6  # PyTorch adds it to the norm by which it divides
TINY = np.float32(1e-8)  # SB3 adds it to the standard deviation of advantages


class Figures(NamedTuple):
    """What a batch came to, for the log."""

    policy_loss: float
    clip_fraction: float
    approx_kl: float
    value_loss: float
    entropy_loss: float


class _Stack:
    """
    The layers of the policy or of the value function, as a part of a vector.

    :param hidden: layers, with ReLU in between
    :param last: layer
    :param start: where the part begins
    """

    def __init__(self, hidden: nn.Module, last: nn.Linear, start: int) -> None:
        layers = [each for each in hidden.children() if isinstance(each, nn.Linear)] + [last]
        self.sizes = (layers[0].in_features, *(each.out_features for each in layers))
        self.parameters = [own for each in layers for own in (each.weight, each.bias)]
        self.part = slice(start, start + sum(map(th.numel, self.parameters)))
        self._rooms: dict[int, np.ndarray] = {}

    def hidden(self) -> Iterator[tuple[slice, tuple[int, int]]]:
        """Find the matrices of the hidden layers in the whole vector, with their shapes."""
        start = self.part.start
        for inputs, units in itertools.pairwise(self.sizes[:-1]):
            yield slice(start, start + inputs * units), (units, inputs)
            start += (inputs + 1) * units

    def room(self, batch: int) -> np.ndarray:
        """
        Take the work space of a pass. It stays in the cache of the thread that uses it.

        :param batch: number of rows
        :return: always the same
        """
        if batch not in self._rooms:
            size = kernels.stack_work(self.sizes, batch)
            self._rooms[batch] = np.empty(size, np.float32)
        return self._rooms[batch]


class LeanPPO:
    """
    Decides and updates instead of a model's policy and of its ``train``.

    :param model: for which :func:`is_for` is true
    """

    def __init__(self, model: PPO) -> None:
        self.model, self.policy = model, model.policy
        policy, first = self.policy, self.policy.log_std.numel()
        hidden = policy.mlp_extractor
        head: Any = policy.action_net
        last, self.bounds = head, (np.empty(0, np.float32),) * 2
        if isinstance(head, BoundedHead):
            last, self.bounds = head.linear, (array(head.middle), array(head.reach))
        self.actor = _Stack(hidden.policy_net, last, first)
        self.critic = _Stack(hidden.value_net, policy.value_net, self.actor.part.stop)
        self.parameters = [policy.log_std, *self.actor.parameters, *self.critic.parameters]
        self.weights, self.gradient, self.mean, self.square = np.zeros(
            (4, self.critic.part.stop), np.float32
        )
        self.log_std = self.weights[:first]
        # The norm is summed input by input: another order would round it otherwise.
        self._summed = np.empty_like(self.gradient)
        self._hidden = [*self.actor.hidden(), *self.critic.hidden()]
        self.count = 0  # steps of Adam
        self.average: ActorAverage | None = getattr(policy, "average", None)
        self._modules = [part for part in policy.modules() if part is not policy]
        averages = 0 if self.average is None else self.actor.part.stop - first
        self.averaged = np.zeros(averages, np.float32)

    # ------------------------------------------------------------------------ rollouts

    def read_parameters(self) -> None:
        """Take over the parameters of the policy."""
        self._pointers = self._find_pointers()
        self._views = [array(own) for own in self.parameters]
        self._taken = [view.copy() for view in self._views]
        _read(self.weights, self.parameters)

    def _find_pointers(self) -> list[int]:
        return [own.data_ptr() for own in self.policy.parameters()]

    def can_decide(self) -> bool:
        """
        Return whether the policy has the parameters that were read; if their values have changed,
        read them again. PyTorch does not report changes within ``parameter.data``.
        """
        if self._find_pointers() != self._pointers or has_module_hooks(self._modules):
            return False
        if not all(map(np.array_equal, self._views, self._taken)):
            self.read_parameters()
        return True

    def forward(
        self, obs: th.Tensor, deterministic: bool = False
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        Decide as the policy does.

        :param obs: (batch, features)
        :param deterministic: as of the policy
        :return: actions, values of the observations, and logarithms of the actions' probabilities
        """
        seen, actor, critic = self._seen(obs), self.actor, self.critic
        batch = len(obs)
        noise = np.zeros((batch, len(self.log_std)), np.float32)
        if not deterministic:
            th.from_numpy(noise).normal_()
        actions, values, chances = np.empty_like(noise), *np.empty((2, batch), np.float32)
        decide(
            (self.weights[actor.part], self.log_std, self.weights[critic.part]), actor.sizes,
            critic.sizes, self.bounds, (*seen, noise),
            (actor.room(len(seen[0])), critic.room(len(seen[1]))), actions, values, chances,
        )  # fmt: skip
        return th.from_numpy(actions), th.from_numpy(values)[:, None], th.from_numpy(chances)

    def _seen(self, observations: th.Tensor) -> tuple[np.ndarray, np.ndarray]:
        """
        Return what the policy and what the value function sees of observations.

        :param observations: (batch, numbers)
        :return: (rows, features) of each; a symmetric policy has two rows per observation
        """
        given, policy = observations.float(), self.policy
        for_actor = policy.pi_features_extractor(given).flatten(end_dim=-2)
        for_critic = policy.vf_features_extractor(given).flatten(end_dim=-2)
        return array(for_actor), array(for_critic)

    # ------------------------------------------------------------------------- updates

    def train(self) -> None:
        """Update the networks as ``PPO.train`` does, in its order."""
        self.policy.set_training_mode(True)
        self.model._update_learning_rate(self.policy.optimizer)
        self._read_state()
        with two_threads() as other:
            try:
                figures = self._epochs(other)
            finally:
                self._write_state()
        self._record(figures)

    def _epochs(self, other: Helper) -> list[list[Figures]]:
        """Pass over the rollout so often, and return the figures of the batches."""
        model = self.model
        figures: list[list[Figures]] = []
        for _ in range(model.n_epochs):
            figures.append([])
            for batch in model.rollout_buffer.get(model.batch_size):
                figures[-1].append(self._find_gradient(batch, other))
                self._step()
            model._n_updates += 1
        return figures

    def _find_gradient(self, batch: RolloutBufferSamples, other: Helper) -> Figures:
        """Find the gradient of the loss, that of the value function on the second thread."""
        for_actor, for_critic = self._seen(batch.observations)
        actions, _, chances, advantages, returns = map(array, batch[1:6])
        if self.model.normalize_advantage and len(advantages) > 1:
            deviation = advantages.std(ddof=1)
            advantages = (advantages - advantages.mean()) / (deviation + TINY)
        actor, model, gradient = self.actor, self.model, self.gradient
        entropy = float(self.log_std.sum()) + ENTROPY * len(self.log_std)
        clip = model.clip_range(model._current_progress_remaining)  # type: ignore[operator]
        value_losses: list[float] = []
        other.begin(lambda: value_losses.append(self._find_value_gradient(for_critic, returns)))
        policy_loss, clipped, kl = find_policy_gradient(
            self.weights[actor.part], self.log_std, actor.sizes, self.bounds, np.float32(clip),
            (for_actor, actions), (chances, advantages), actor.room(len(for_actor)),
            gradient[actor.part], gradient[: len(self.log_std)],
        )  # fmt: skip
        gradient[: len(self.log_std)] -= np.float32(model.ent_coef)
        other.wait()
        (value_loss,) = value_losses
        return Figures(policy_loss, clipped, kl, value_loss, -entropy)

    def _find_value_gradient(self, observations: np.ndarray, returns: np.ndarray) -> float:
        critic = self.critic
        loss: float = find_value_gradient(
            self.weights[critic.part], critic.sizes, np.float32(self.model.vf_coef),
            observations, returns, critic.room(len(observations)), self.gradient[critic.part],
        )  # fmt: skip
        return loss

    def _step(self) -> None:
        """Make a step of Adam with the gradient, whose norm is limited."""
        np.copyto(self._summed, self.gradient)
        for part, shape in self._hidden:
            self._summed[part] = self.gradient[part].reshape(shape).T.ravel()
        norm = math.sqrt(float(self._summed @ self._summed))
        self.gradient *= np.float32(min(1.0, self.model.max_grad_norm / (norm + SPARE)))
        (group,) = self.policy.optimizer.param_groups
        self.count += 1
        factors = adam_factors(group, self.count, np.float32)
        kernels.adam(self.weights, self.gradient, self.mean, self.square, *factors)
        if self.average is not None:
            share = 1.0 - self.average.decay if self.average.has_begun else 1.0
            kernels.follow(self.averaged, self.weights[self.actor.part], np.float32(share))
            self.average.n_averaged += 1

    def _record(self, figures: list[list[Figures]]) -> None:
        """Log what ``PPO.train`` logs."""
        model, record = self.model, self.model.logger.record
        means = Figures(*np.mean([batch for epoch in figures for batch in epoch], axis=0).tolist())
        last, buffer = figures[-1][-1], model.rollout_buffer
        loss = last.policy_loss + model.ent_coef * last.entropy_loss
        record("train/entropy_loss", means.entropy_loss)
        record("train/policy_gradient_loss", means.policy_loss)
        record("train/value_loss", means.value_loss)
        record("train/approx_kl", np.mean([batch.approx_kl for batch in figures[-1]]))
        record("train/clip_fraction", means.clip_fraction)
        record("train/loss", loss + model.vf_coef * last.value_loss)
        explained = explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        record("train/explained_variance", explained)
        record("train/std", float(np.exp(self.log_std).mean()))
        record("train/n_updates", model._n_updates, exclude="tensorboard")
        record("train/clip_range", model.clip_range(model._current_progress_remaining))  # type: ignore[operator]

    # --------------------------------------------------------------------------- state

    def _averages(self) -> list[th.Tensor]:
        """Return the average of each parameter of the actor; there may be none."""
        return [] if self.average is None else list(self.average.module.parameters())

    def _states(self) -> list[dict[str, Any]]:
        """Look at what Adam keeps of each parameter; begin it if needed."""
        return [adam_state(self.policy.optimizer, own) for own in self.parameters]

    def _read_state(self) -> None:
        """Take over the parameters and what Adam keeps of them."""
        states = self._states()
        self.read_parameters()
        _read(self.mean, [state["exp_avg"] for state in states])
        _read(self.square, [state["exp_avg_sq"] for state in states])
        _read(self.averaged, self._averages())
        self.count = int(states[0]["step"].item())

    @th.no_grad()
    def _write_state(self) -> None:
        """Give them back to the model."""
        states = self._states()
        _write(self.weights, self.parameters)
        _write(self.mean, [state["exp_avg"] for state in states])
        _write(self.square, [state["exp_avg_sq"] for state in states])
        _write(self.averaged, self._averages())
        for state in states:
            state["step"].fill_(self.count)


class LeanForward:
    """
    Replaces a policy's ``forward`` during a rollout; copies of the policy have their own.

    An error or Ctrl-C may leave it behind. So it lets the policy itself decide after another
    update, where PyTorch records operations, and after somebody has moved the parameters.

    :param lean: that decides
    """

    def __init__(self, lean: LeanPPO) -> None:
        self._lean = lean
        self._updates = lean.model._n_updates

    def __call__(
        self, obs: th.Tensor, deterministic: bool = False
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Decide; see :meth:`LeanPPO.forward`."""
        lean = self._lean
        is_old = lean.model._n_updates != self._updates
        if is_old or th.is_grad_enabled() or not lean.can_decide():
            return type(lean.policy).forward(lean.policy, obs, deterministic)
        return lean.forward(obs, deterministic)

    def __reduce__(self) -> tuple[Any, ...]:
        policy = self._lean.policy
        return MethodType, (type(policy).forward, policy)


def _read(vector: np.ndarray, tensors: Sequence[th.Tensor]) -> None:
    """Copy the numbers of tensors into a vector."""
    if tensors:
        th.cat([own.detach().reshape(-1) for own in tensors], out=th.from_numpy(vector))


def _write(vector: np.ndarray, tensors: Sequence[th.Tensor]) -> None:
    """Copy the parts of a vector back into tensors."""
    parts = th.from_numpy(vector).split([own.numel() for own in tensors])
    for own, part in zip(tensors, parts, strict=True):
        own.copy_(part.view(own.shape))


def is_for(model: PPO) -> bool:
    """
    Say whether lean rollouts and updates are equal to those of a model, but for rounding.

    :param model: PPO
    :return: false on a GPU, or if a part is not one that the passes know
    """
    policy = model.policy
    return (
        type(model).train is PPO.train
        and not has_own_methods(model)
        and type(policy) in (ActorCriticPolicy, BoundedPolicy)
        and not has_own_methods(policy)
        and isinstance(model.observation_space, spaces.Box)
        and isinstance(model.action_space, spaces.Box)
        and len(model.observation_space.shape) == len(model.action_space.shape) == 1
        and type(policy.action_dist) is DiagGaussianDistribution
        and _plain(policy.pi_features_extractor) in (FlattenExtractor, SensorInputs)
        and _plain(policy.vf_features_extractor) in (FlattenExtractor, SensorInputs)
        and _is_known(policy.mlp_extractor.policy_net)
        and _is_known(policy.mlp_extractor.value_net)
        and model.clip_range_vf is None
        and model.target_kl is None
        and _learns_all(policy)
    )


def _learns_all(policy: Any) -> bool:
    """Whether an optimizer of the usual kind, and nothing else, changes all parameters."""
    optimizer = policy.optimizer
    learns = {
        name: own for name, own in policy.named_parameters() if not name.startswith("average.")
    }
    own_hooks = int(getattr(policy, "average", None) is not None)
    return (
        is_usual(optimizer)
        and len(optimizer.param_groups) == 1
        and {*map(id, optimizer.param_groups[0]["params"])} == {*map(id, learns.values())}
        and all(map(_can_be_read, learns.values()))
        and not has_hooks(
            (part for part in policy.modules() if part is not policy), optimizer, own_hooks
        )
    )


def _can_be_read(parameter: nn.Parameter) -> bool:
    """Whether a parameter can be compared with its copy without another one."""
    return parameter.dtype == th.float32 and parameter.is_contiguous() and parameter.requires_grad


def _plain(extractor: nn.Module) -> type[nn.Module]:
    """Find what extracts features, maybe both ways."""
    return type(extractor.extractor if isinstance(extractor, BothWays) else extractor)


def _is_known(hidden: nn.Module) -> bool:
    """Whether hidden layers are linear ones, each followed by ReLU."""
    layers = [each for each in hidden.children() if not isinstance(each, MeanOfBoth)]
    kinds = list(map(type, layers))
    return (
        bool(kinds)
        and kinds == [nn.Linear, nn.ReLU] * (len(kinds) // 2)
        and all(each.bias is not None for each in layers[::2])
    )
