"""A policy for the stock DDPG and TD3 with one output function per actuator.

The networks are those of the original post: an actor of 300 and 600 ReLU units whose heads start
near zero, and a critic that the action joins at the second hidden layer. A hyperparameter file can
name ``sb3_torcs.policies.split_head.SplitHeadPolicy`` without an import.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, cast

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.td3.policies import Actor, TD3Policy
from torch import nn

from sb3_torcs.car import check_count, checked_flag, is_number
from sb3_torcs.errors import InvalidOption
from sb3_torcs.policies.exact import ExactDriver, ExactPolicy, check_sizes, checked_decay
from sb3_torcs.policies.export import export_actor
from sb3_torcs.policies.mirror import check_symmetric
from sb3_torcs.policies.networks import (
    HEAD_GAINS,
    ActorAverage,
    LateActionCritic,
    SplitHeadActor,
)
from sb3_torcs.policies.optimizers import IdleOptimizer, with_lr_scale

__all__ = ["SplitHeadPolicy", "export_actor"]

NET_ARCH = (300, 600)
"""Hidden units of both networks in the original post."""

OWN_KERNEL = frozenset({"fused", "foreach", "capturable", "differentiable"})
"""Options of Adam with which somebody chooses its kernel; then it stays as chosen."""


class SplitHeadPolicy(ExactPolicy, TD3Policy):
    """
    The networks of the original post for the stock ``DDPG`` and ``TD3``.

    Two defaults differ from SB3's ``TD3Policy``: ``net_arch`` is ``[300, 600]`` (the critic takes
    two numbers), and an Adam gets ``fused=True`` unless ``optimizer_kwargs`` choose its kernel,
    e.g. by ``{"fused": False}``.

    :param observation_space: as in ``TD3Policy``
    :param action_space: as in ``TD3Policy``
    :param lr_schedule: as in ``TD3Policy``
    :param heads: output function of each action, ``"tanh"`` or ``"sigmoid"``; by default the one
        for its range: a tanh where the range begins below 0, as for steering and a signed pedal,
        and a sigmoid where it begins at 0, as for throttle and brake
    :param head_bias: initial value before each output function, by default 0. A sigmoid of 0 is
        half throttle and half brake; ``(0, 0, -2)`` starts with 12 % brake
    :param init_std: standard deviation of the heads' initial weights
    :param layer_norm: normalise the hidden layers of both networks
    :param critic_lr_scale: learning rate of the critic divided by that of the actor
    :param ema_decay: if given, a running average of the actor's weights drives in its place
        whenever ``predict`` is ``deterministic``, as in evaluations; each update keeps this share
        of the average, e.g. 0.9995. Training is the same to the bit without it
    :param symmetric: whenever ``predict`` is ``deterministic``, drive the mean of the actor's
        action and the mirror image of its action in the mirrored drive, so that left and right
        bends are driven alike. It needs observations whose middle is 0 (no ``VecNormalize``), and
        range finders with the same angles on both sides. Training is the same to the bit without it
    :param kwargs: the other arguments of ``TD3Policy``
    :raises InvalidOption: if an argument has no such value, or the algorithm is neither DDPG nor
        TD3
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        *,
        heads: Sequence[str] | None = None,
        head_bias: Sequence[float] | None = None,
        init_std: float = 1e-4,
        layer_norm: bool = False,
        critic_lr_scale: float = 1.0,
        ema_decay: float | None = None,
        symmetric: bool = False,
        **kwargs: Any,
    ) -> None:
        if "use_sde" in kwargs:  # all algorithms but DDPG and TD3 pass it
            raise InvalidOption(
                "SplitHeadPolicy is a policy of DDPG and TD3; give PPO and A2C BoundedPolicy, and "
                'SAC, TQC and CrossQ their own "MlpPolicy"'
            )
        net_arch = kwargs.pop("net_arch", None)
        net_arch = list(NET_ARCH) if net_arch is None else net_arch
        heads = heads_for(action_space) if heads is None else _as_list(heads)
        _check_heads(heads, action_space)
        bias = _bias(head_bias, len(heads))
        _check_net_arch(net_arch)
        layer_norm = checked_flag("layer_norm", layer_norm)
        symmetric = checked_flag("symmetric", symmetric)
        check_count("n_critics", kwargs.get("n_critics", 2))
        check_symmetric(symmetric, observation_space, action_space)
        self.own_kwargs: dict[str, Any] = {
            "heads": tuple(heads),
            "head_bias": bias,
            "init_std": _positive("init_std", init_std),
            "layer_norm": layer_norm,
            "critic_lr_scale": _positive("critic_lr_scale", critic_lr_scale),
            "ema_decay": checked_decay(ema_decay),
            "symmetric": symmetric,
        }
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=net_arch,
            **_fast_optimizer(kwargs),
        )

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        scale = self.own_kwargs["critic_lr_scale"]
        self.actor.optimizer = self._optimizer(self.actor, 1.0, lr_schedule)
        self.critic.optimizer = self._optimizer(self.critic, scale, lr_schedule)
        decay = self.own_kwargs["ema_decay"]
        self.average = None if decay is None else ActorAverage(self.actor, decay)
        self._follow_actor()

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Become a copy. Copies of optimizers leave their hooks behind."""
        super().__setstate__(state)
        self._follow_actor()

    def _follow_actor(self) -> None:
        """Let the average follow the actor."""
        if self.average is not None:
            self.average.follow(self.actor, self.actor.optimizer)

    def _optimizer(
        self, network: nn.Module, scale: float, lr_schedule: Schedule
    ) -> th.optim.Optimizer:
        group: dict[str, Any] = {"params": list(network.parameters())}
        optimizer_class = self.optimizer_class
        if scale != 1.0:
            group["lr_scale"] = scale
            if not issubclass(optimizer_class, IdleOptimizer):
                optimizer_class = with_lr_scale(optimizer_class)
        rate = lr_schedule(1)
        return optimizer_class([group], lr=rate, **self.optimizer_kwargs)  # type: ignore[call-arg]

    @property
    def driver(self) -> Actor:
        """The actor that drives when ``predict`` is deterministic."""
        if self.average is None or not self.average.has_begun:
            return self.actor
        return cast(Actor, self.average.module)

    def exact_driver(self) -> ExactDriver:
        """Return a copy of the actor that drives when ``predict`` is deterministic."""
        heads, symmetric = copy.deepcopy(self.driver.mu), self.own_kwargs["symmetric"]
        return ExactDriver(self, self.driver.features_extractor, heads, symmetric=symmetric)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """
        Make an actor. Called by ``TD3Policy`` for the actor and for its target.

        :param features_extractor: the one to share, or ``None`` for one of its own
        :return: the actor, on the policy's device
        """
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        own = {
            key: self.own_kwargs[key] for key in ("heads", "head_bias", "init_std", "layer_norm")
        }
        return SplitHeadActor(**own, **kwargs).to(self.device)

    def make_critic(
        self, features_extractor: BaseFeaturesExtractor | None = None
    ) -> ContinuousCritic:
        """
        Make a critic. Called by ``TD3Policy`` for the critic and for its target.

        :param features_extractor: the one to share, or ``None`` for one of its own
        :return: the critic, on the policy's device
        """
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        own = {"layer_norm": self.own_kwargs["layer_norm"]}
        return LateActionCritic(**own, **kwargs).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), **self.own_kwargs}


def heads_for(action_space: spaces.Box) -> tuple[str, ...]:
    """
    Choose output functions by the ranges of the actions.

    :param action_space: of the environment
    :return: ``"tanh"`` or ``"sigmoid"`` for each action
    """
    return tuple("sigmoid" if low == 0.0 else "tanh" for low in action_space.low.flatten())


def _check_heads(heads: Any, action_space: spaces.Box) -> None:
    n_actions = get_action_dim(action_space)
    allowed = " or ".join(repr(name) for name in HEAD_GAINS)
    if not isinstance(heads, list | tuple) or any(str(head) not in HEAD_GAINS for head in heads):
        raise InvalidOption(
            f"heads={heads!r}: each head is {allowed}; "
            f"pass policy_kwargs=dict(heads={heads_for(action_space)!r})"
        )
    if len(heads) != n_actions:
        raise InvalidOption(
            f"heads={tuple(heads)!r} has {len(heads)} entries, but the action space has "
            f"{n_actions} actions; pass policy_kwargs=dict(heads=...) with {n_actions} "
            f"entries, each {allowed}"
        )


def _as_list(given: Any) -> Any:
    """Make a list of an array, a tensor or a range."""
    if isinstance(given, range):
        return list(given)
    return given.tolist() if hasattr(given, "tolist") else given


def _bias(given: Any, number: int) -> tuple[float, ...]:
    """Check the initial values before the output functions; ``None`` is 0 for each."""
    if given is None:
        return (0.0,) * number
    values = _as_list(given)
    if not isinstance(values, list | tuple) or not all(map(is_number, values)):
        raise InvalidOption(
            f"head_bias={given!r}: pass one finite number per action, e.g. {(0.0,) * number}"
        )
    if len(values) != number:
        raise InvalidOption(
            f"head_bias={tuple(values)!r} has {len(values)} entries, but the action space has "
            f"{number} actions; pass one number per action, e.g. {(0.0,) * number}"
        )
    return tuple(map(float, values))


def _check_net_arch(net_arch: Any) -> None:
    check_sizes(net_arch)
    critic = net_arch.get("qf") if isinstance(net_arch, dict) else net_arch
    actor = net_arch.get("pi") if isinstance(net_arch, dict) else net_arch
    others = isinstance(net_arch, dict) and net_arch.keys() - {"pi", "qf"}
    if others or not actor or not critic or len(critic) != 2:
        raise InvalidOption(
            f"net_arch={net_arch!r}: the critic has two layer sizes (the action joins at the "
            "second) and the actor at least one; pass net_arch=[300, 600], or "
            "net_arch=dict(pi=[300, 600], qf=[300, 600])"
        )


def _positive(name: str, value: float) -> float:
    if not is_number(value) or value <= 0.0:
        raise InvalidOption(f"{name}={value!r}: pass a number above 0, e.g. {name}=1.0")
    return float(value)


def _fast_optimizer(kwargs: dict[str, Any]) -> dict[str, Any]:
    optimizer_class = kwargs.get("optimizer_class", th.optim.Adam)
    options = dict(kwargs.get("optimizer_kwargs") or {})
    if issubclass(optimizer_class, th.optim.Adam) and not OWN_KERNEL & options.keys():
        options["fused"] = True
    return {**kwargs, "optimizer_class": optimizer_class, "optimizer_kwargs": options}


# Saved models and YAML files name the class by its package, whichever file it stands in.
SplitHeadPolicy.__module__ = "sb3_torcs.policies"
