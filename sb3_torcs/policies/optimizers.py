"""Optimizers with a learning rate for each group, and for networks that learn nothing."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch as th

__all__ = ["IdleOptimizer", "adam_factors", "adam_state", "is_usual", "with_lr_scale"]


class _LrScale:
    """Mixin for an optimizer: each group's rate is multiplied by its ``lr_scale`` for a step."""

    param_groups: list[dict[str, Any]]

    def step(self, closure: Callable[[], float] | None = None) -> Any:
        step = super().step  # type: ignore[misc]
        if getattr(step, "hooked", False):
            # PyTorch wraps each class's own `step` to call the hooks: let them be called once.
            step = partial(step.__wrapped__, self)
        rates = [group["lr"] for group in self.param_groups]
        try:
            for group, rate in zip(self.param_groups, rates, strict=True):
                group["lr"] = rate * group.get("lr_scale", 1.0)
            return step(closure)
        finally:
            # SB3 writes the schedule's rate into the groups and logs it: restore that value.
            for group, rate in zip(self.param_groups, rates, strict=True):
                group["lr"] = rate


class _ScaledAdam(_LrScale, th.optim.Adam):
    """Adam whose groups may have an ``lr_scale``."""


class IdleOptimizer(th.optim.Optimizer):
    """
    What a policy that only drives has for an optimizer.

    The first of PyTorch's own in a process imports PyTorch's compiler, which takes seconds.

    :param params: as of every optimizer
    :param options: of any optimizer
    """

    def __init__(self, params: Any, **options: Any) -> None:
        super().__init__(params, options)

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """
        Take parameters, as PyTorch does after it has imported its compiler.

        :param param_group: with its options
        """
        self.param_groups.append(param_group)


def adam_state(optimizer: th.optim.Optimizer, param: th.Tensor) -> dict[str, th.Tensor]:
    """
    Look at what PyTorch's Adam keeps of a parameter; begin it if needed.

    :param optimizer: the parameter's
    :param param: any of its parameters
    """
    state: dict[str, th.Tensor] = optimizer.state[param]
    if not state:
        state["step"] = th.zeros((), dtype=th.float32)
        state["exp_avg"], state["exp_avg_sq"] = th.zeros_like(param), th.zeros_like(param)
    return state


def adam_factors(group: dict[str, Any], count: float, real: Any) -> tuple[Any, ...]:
    """
    Compute what the kernel of Adam takes after its averages.

    :param group: of the optimizer's parameters
    :param count: of updates, this one included
    :param real: type of the numbers
    :return: both betas, the rate, the factor on the root, epsilon, and the decay of weights
    """
    beta1, beta2 = group["betas"]
    rate = group["lr"] * group.get("lr_scale", 1.0)
    return (
        (real(beta1), real(beta2)), real(rate / (1 - beta1**count)),
        real((1 - beta2**count) ** -0.5), real(group["eps"]), real(group["weight_decay"]),
    )  # fmt: skip


def is_usual(optimizer: th.optim.Optimizer) -> bool:
    """
    Say whether an optimizer is Adam without the options that our kernel does not know.

    :param optimizer: of any kind
    """
    unusual = ("amsgrad", "maximize", "decoupled_weight_decay")
    kinds = th.optim.Adam, _ScaledAdam
    return type(optimizer) in kinds and all(
        not any(map(group.get, unusual)) and all(param.is_cpu for param in group["params"])
        for group in optimizer.param_groups
    )


def with_lr_scale(optimizer_class: type[th.optim.Optimizer]) -> type[th.optim.Optimizer]:
    """
    Make an optimizer that multiplies the learning rate by ``lr_scale`` of each parameter group.

    :param optimizer_class: any optimizer of PyTorch
    :return: a subclass; its groups need an ``lr_scale``, which their state keeps
    """
    if optimizer_class is th.optim.Adam:
        return _ScaledAdam
    return type(f"LrScaled{optimizer_class.__name__}", (_LrScale, optimizer_class), {})
