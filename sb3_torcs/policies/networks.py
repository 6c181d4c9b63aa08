"""The networks of the original post, as parts of SB3's TD3 policy.

The actor has one output function per actuator. The critic gets the action at the second hidden
layer. While :class:`~sb3_torcs.callbacks.LeanUpdatesCallback` is active,
:mod:`sb3_torcs.policies.updates` computes the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.td3.policies import Actor
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

__all__ = [
    "HEAD_GAINS",
    "ActorAverage",
    "LateActionCritic",
    "LateActionQ",
    "SplitHeadActor",
    "SplitHeads",
]

HEAD_GAINS = {"tanh": 1.0, "sigmoid": 0.5}
"""[-] SB3 wants actions in [-1, 1], where a sigmoid is 2 sigmoid(z) - 1 = tanh(z / 2), exactly."""


class Layer(nn.Linear):
    """
    A linear layer, normalised if asked for.

    :param in_features: size of the input
    :param out_features: size of the output
    :param layer_norm: normalise the output
    """

    def __init__(self, in_features: int, out_features: int, layer_norm: bool = False) -> None:
        super().__init__(in_features, out_features)
        self.norm = nn.LayerNorm(out_features) if layer_norm else None

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        Apply the layer.

        :param x: (batch, in_features)
        :return: (batch, out_features)
        """
        x = super().forward(x)
        return x if self.norm is None else self.norm(x)


class SplitHeads(nn.Module):
    """
    Hidden layers, and one head per actuator, with actions in SB3's scaled space [-1, 1].

    :param features_dim: size of the input
    :param net_arch: units of each hidden layer
    :param heads: ``"tanh"`` or ``"sigmoid"`` per actuator
    :param head_bias: initial value before the output function, per actuator
    :param init_std: standard deviation of the heads' initial weights
    :param activation_fn: activation of the hidden layers
    :param layer_norm: normalise each hidden layer before its activation
    """

    gain: th.Tensor

    def __init__(
        self,
        features_dim: int,
        net_arch: Sequence[int],
        *,
        heads: Sequence[str],
        head_bias: Sequence[float],
        init_std: float,
        activation_fn: type[nn.Module],
        layer_norm: bool,
    ) -> None:
        super().__init__()
        inputs = [features_dim, *net_arch[:-1]]
        self.hidden = nn.ModuleList(
            Layer(n_in, n_out, layer_norm) for n_in, n_out in zip(inputs, net_arch, strict=True)
        )
        self.activation = activation_fn()
        self.heads = Layer(net_arch[-1], len(heads))
        nn.init.normal_(self.heads.weight, std=init_std)
        with th.no_grad():
            self.heads.bias.copy_(th.tensor(head_bias))
        gain = th.tensor([HEAD_GAINS[head] for head in heads])
        self.register_buffer("gain", gain, persistent=False)
        self.lean: Callable[[th.Tensor], th.Tensor | None] | None = None
        """Decides faster where no gradient is needed; returns ``None`` where it cannot."""

    def forward(self, features: th.Tensor) -> th.Tensor:
        """
        Decide.

        :param features: (batch, features_dim)
        :return: (batch, actuators) in [-1, 1]
        """
        if self.lean is not None and not th.is_grad_enabled():
            actions = self.lean(features)
            if actions is not None:
                return actions
        x = features
        for layer in self.hidden:
            x = self.activation(layer(x))
        return th.tanh(self.gain * self.heads(x))


class SplitHeadActor(Actor):
    """
    SB3's TD3 actor with :class:`SplitHeads` for its network.

    :param heads: as in :class:`SplitHeads`
    :param head_bias: as in :class:`SplitHeads`
    :param init_std: as in :class:`SplitHeads`
    :param layer_norm: as in :class:`SplitHeads`
    :param kwargs: what SB3's ``Actor`` takes
    """

    def __init__(
        self,
        *,
        heads: Sequence[str],
        head_bias: Sequence[float],
        init_std: float,
        layer_norm: bool,
        **kwargs: Any,
    ) -> None:
        # The parent builds a network of its own first; a narrow one costs nothing.
        super().__init__(**{**kwargs, "net_arch": [1]})
        self.net_arch = kwargs["net_arch"]
        self.head_kwargs: dict[str, Any] = {
            "heads": tuple(heads),
            "head_bias": tuple(head_bias),
            "init_std": init_std,
            "layer_norm": layer_norm,
        }
        self.mu = SplitHeads(  # type: ignore[assignment]  # the parent's is an nn.Sequential
            self.features_dim, self.net_arch, activation_fn=self.activation_fn, **self.head_kwargs
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), **self.head_kwargs}


class ActorAverage(AveragedModel):
    """
    A running average of an actor's weights. It begins with those of the first update; before that
    the actor itself drives.

    :param actor: to average
    :param decay: share of the average that each update keeps
    """

    def __init__(self, actor: nn.Module, decay: float) -> None:
        super().__init__(actor, multi_avg_fn=partial(_follow, decay))
        self.decay = decay
        self.requires_grad_(False)

    def follow(self, actor: nn.Module, optimizer: th.optim.Optimizer) -> None:
        """
        Follow an actor from now on. Copies of an optimizer leave its hooks behind.

        :param actor: of the same shape
        :param optimizer: whose steps are the updates
        """
        optimizer.register_step_post_hook(lambda *_: self.update_parameters(actor))

    @property
    def has_begun(self) -> bool:
        """Whether there was an update. Loaded weights may come without an average of theirs."""
        return int(self.n_averaged) > 0


def _follow(decay: float, averages: Any, current: Any, count: Any) -> None:
    """Follow as PyTorch's function does, which cannot be pickled."""
    get_ema_multi_avg_fn(decay)(averages, current, count)


class LateActionQ(nn.Module):
    """
    One value function: the state's second layer and the action are added, then a third layer.

    :param features_dim: size of the state's features
    :param action_dim: number of actuators
    :param net_arch: units of the first, and of the second and third layer
    :param activation_fn: activation of the first and third layer
    :param layer_norm: normalise those two before their activation
    """

    def __init__(
        self,
        features_dim: int,
        action_dim: int,
        net_arch: Sequence[int],
        activation_fn: type[nn.Module],
        layer_norm: bool,
    ) -> None:
        super().__init__()
        first, second = net_arch
        self.state1 = Layer(features_dim, first, layer_norm)
        self.state2 = Layer(first, second)
        self.action2 = Layer(action_dim, second)
        self.joint3 = Layer(second, second, layer_norm)
        self.value = Layer(second, 1)
        self.activation = activation_fn()

    def forward(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Value the actions.

        :param features: (batch, features_dim)
        :param actions: (batch, action_dim) in [-1, 1]
        :return: (batch, 1)
        """
        state = self.state2(self.activation(self.state1(features)))
        joint = self.joint3(state + self.action2(actions))
        value: th.Tensor = self.value(self.activation(joint))
        return value


class LateActionCritic(ContinuousCritic):
    """
    SB3's critic with :class:`LateActionQ` for its value functions.

    :param n_critics: number of value functions
    :param layer_norm: as in :class:`LateActionQ`
    :param kwargs: what SB3's ``ContinuousCritic`` takes
    """

    def __init__(self, *, n_critics: int, layer_norm: bool, **kwargs: Any) -> None:
        super().__init__(n_critics=0, **kwargs)
        self.n_critics = n_critics
        action_dim = get_action_dim(self.action_space)
        self.networks = [
            LateActionQ(
                kwargs["features_dim"], action_dim, kwargs["net_arch"], kwargs["activation_fn"],
                layer_norm,
            )
            for _ in range(n_critics)
        ]  # fmt: skip
        for number, network in enumerate(self.networks):
            self.add_module(f"qf{number}", network)

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """
        Value the actions by each value function.

        :param obs: (batch, observation)
        :param actions: (batch, action_dim) in [-1, 1]
        :return: one (batch, 1) per value function
        """
        # As in SB3: shared features learn from the actor's loss only.
        with th.set_grad_enabled(th.is_grad_enabled() and not self.share_features_extractor):
            features = self.extract_features(obs, self.features_extractor)
        return tuple(network(features, actions) for network in self.networks)

    def q1_forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Value the actions by the first value function, for the actor's loss.

        :param obs: (batch, observation)
        :param actions: (batch, action_dim) in [-1, 1]
        :return: (batch, 1)
        """
        with th.no_grad():
            features = self.extract_features(obs, self.features_extractor)
        value: th.Tensor = self.networks[0](features, actions)
        return value
