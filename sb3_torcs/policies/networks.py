"""The networks of the original post, as parts of SB3's TD3 policy.

An actor with one output function per actuator, and a critic that the action joins at the second
hidden layer. One update of a small network spends as much time around the matrix products as in
them, so the forward passes here call the functions of PyTorch directly, and in place where that
changes no bit of the result.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any, cast

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim, preprocess_obs
from stable_baselines3.td3.policies import Actor
from torch import nn
from torch.nn.functional import layer_norm as normalise
from torch.nn.functional import linear

from sb3_torcs.policies.mirror import mirror_actions, mirror_observations

__all__ = [
    "HEAD_GAINS",
    "ExactDriver",
    "LateActionCritic",
    "LateActionQ",
    "SplitHeadActor",
    "SplitHeads",
]

HEAD_GAINS = {"tanh": 1.0, "sigmoid": 0.5}
"""[-] SB3 wants actions in [-1, 1], where a sigmoid is 2 sigmoid(z) - 1 = tanh(z / 2), exactly."""


def _activation(activation_fn: type[nn.Module]) -> Callable[[th.Tensor], th.Tensor]:
    # A linear layer and a layer norm keep their input for the backward pass, never their output:
    # ReLU may overwrite it.
    return th.relu_ if activation_fn is nn.ReLU else activation_fn()


class Layer(nn.Linear):
    """
    A linear layer, normalised if asked for. The networks call its methods without hooks.

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
        # ``self.weight`` is a slow look-up, which small layers feel.
        own: dict[str, Any] = self._parameters
        x = linear(x, own["weight"], own["bias"])
        return x if self.norm is None else self.norm(x)

    def frozen(self, x: th.Tensor) -> th.Tensor:
        """
        Apply the layer with a gradient for its input, but none for its weights.

        :param x: (batch, in_features)
        :return: (batch, out_features), the same bits as ``forward``
        """
        own: dict[str, Any] = self._parameters
        x = linear(x, own["weight"].detach(), own["bias"].detach())
        if self.norm is None:
            return x
        weight, bias = self.norm.weight.detach(), self.norm.bias.detach()
        return normalise(x, self.norm.normalized_shape, weight, bias, self.norm.eps)


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
        self.activation = _activation(activation_fn)
        self.heads = Layer(net_arch[-1], len(heads))
        nn.init.normal_(self.heads.weight, std=init_std)
        with th.no_grad():
            self.heads.bias.copy_(th.tensor(head_bias))
        self.chain = (*self.hidden, self.heads)
        gain = th.tensor([HEAD_GAINS[head] for head in heads])
        self.register_buffer("gain", gain, persistent=False)

    def forward(self, features: th.Tensor) -> th.Tensor:
        """
        Decide.

        :param features: (batch, features_dim)
        :return: (batch, actuators) in [-1, 1]
        """
        *hidden, heads = self.chain
        x = features
        for layer in hidden:
            x = self.activation(layer.forward(x))
        return th.tanh(self.gain * heads.forward(x))


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


class ExactDriver(nn.Module):
    """
    A copy of an actor that drives in double precision.

    Processors round sums differently, and a car that is steered slightly differently is elsewhere
    after a lap. Rounded from double to single precision, the actions are the same everywhere.

    :param actor: of SB3's DDPG or TD3
    :param symmetric: drive the mean of what the actor does and the mirror image of what it does in
        the mirror
    """

    def __init__(self, actor: Actor, *, symmetric: bool = False) -> None:
        super().__init__()
        self.observation_space = actor.observation_space
        self.normalize_images = actor.normalize_images
        # Copies of the parts: the actor itself carries its optimizer and the hooks of a noise.
        self.features_extractor = copy.deepcopy(actor.features_extractor)
        self.mu = copy.deepcopy(actor.mu).double()
        self.symmetric = symmetric

    def forward(self, observation: th.Tensor) -> th.Tensor:
        """
        Decide.

        :param observation: (batch, observation)
        :return: (batch, actuators) in [-1, 1]
        """
        seen = cast(
            th.Tensor, preprocess_obs(observation, self.observation_space, self.normalize_images)
        )
        actions = self._drive(seen)
        if self.symmetric:
            image = mirror_actions(self._drive(mirror_observations(seen)))
            actions = 0.5 * (actions + image)
        return actions.float()

    def _drive(self, seen: th.Tensor) -> th.Tensor:
        actions: th.Tensor = self.mu(self.features_extractor(seen).double())
        return actions


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
        self.chain = (self.state1, self.state2, self.action2, self.joint3, self.value)
        self.activation = _activation(activation_fn)

    def forward(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Value the actions.

        :param features: (batch, features_dim)
        :param actions: (batch, action_dim) in [-1, 1]
        :return: (batch, 1)
        """
        state1, state2, action2, joint3, value = self.chain
        state = state2.forward(self.activation(state1.forward(features)))
        joint = joint3.forward(state.add_(action2.forward(actions)))
        return value.forward(self.activation(joint))

    def for_actor(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Value the actions with a gradient for them, but none for the weights.

        Stock DDPG computes the weights' gradient of the actor's loss and then deletes it.

        :param features: (batch, features_dim)
        :param actions: (batch, action_dim) in [-1, 1]
        :return: (batch, 1), the same bits as ``forward``
        """
        state1, state2, action2, joint3, value = self.chain
        with th.no_grad():
            state = state2.forward(self.activation(state1.forward(features)))
        joint = joint3.frozen(state + action2.frozen(actions))
        return value.frozen(self.activation(joint))


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
        for index in range(n_critics):
            network = LateActionQ(
                kwargs["features_dim"],
                get_action_dim(self.action_space),
                kwargs["net_arch"],
                kwargs["activation_fn"],
                layer_norm,
            )
            self.add_module(f"qf{index}", network)
            self.q_networks.append(network)

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
        return tuple(network(features, actions) for network in self.q_networks)

    def q1_forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Value the actions by the first value function, for the actor's loss.

        :param obs: (batch, observation)
        :param actions: (batch, action_dim) in [-1, 1]
        :return: (batch, 1), with a gradient for the actions only
        """
        with th.no_grad():
            features = self.extract_features(obs, self.features_extractor)
        network = self.q_networks[0]
        assert isinstance(network, LateActionQ)
        return network.for_actor(features, actions)
