"""Optimizers for small networks, with less Python code per step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch as th

__all__ = ["LeanAdam", "with_lr_scale"]


class LeanAdam(th.optim.Adam):
    """
    ``Adam(fused=True)``: the same kernel and the same bits, with less Python around it.

    :param params: as in ``Adam``
    :param kwargs: as in ``Adam``
    """

    def __init__(self, params: Any, **kwargs: Any) -> None:
        super().__init__(params, **{**kwargs, "fused": True})

    def zero_grad(self, set_to_none: bool = True) -> None:
        """
        Forget the gradients.

        :param set_to_none: as in ``Adam``
        """
        if not set_to_none:
            super().zero_grad(set_to_none=False)
            return
        for group in self.param_groups:
            for param in group["params"]:
                param.grad = None

    @th.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:
        """
        Make one update.

        :param closure: as in ``Adam``
        :return: as in ``Adam``
        """
        if closure is not None or not all(map(self._is_lean, self.param_groups)):
            return super().step(closure)
        for group in self.param_groups:
            self._step_group(group)
        return None

    def _is_lean(self, group: dict[str, Any]) -> bool:
        # The first step, which makes the state, and whatever is unusual go the usual way.
        unusual = group["amsgrad"] or group.get("decoupled_weight_decay")
        return (
            not unusual
            and bool(group["fused"])
            and isinstance(group["lr"], float)
            and all(p in self.state for p in group["params"] if p.grad is not None)
            and not hasattr(self, "grad_scale")
        )

    def _step_group(self, group: dict[str, Any]) -> None:
        params = [param for param in group["params"] if param.grad is not None]
        if not params:
            return
        states = [self.state[param] for param in params]
        steps = [state["step"] for state in states]
        th._foreach_add_(steps, 1)
        th._fused_adam_(
            params,
            [param.grad for param in params],
            [state["exp_avg"] for state in states],
            [state["exp_avg_sq"] for state in states],
            [],
            steps,
            lr=group["lr"],
            beta1=group["betas"][0],
            beta2=group["betas"][1],
            weight_decay=group["weight_decay"],
            eps=group["eps"],
            amsgrad=False,
            maximize=group["maximize"],
        )


class _LrScale:
    """Mixin for an optimizer: each group's rate is multiplied by its ``lr_scale`` for a step."""

    param_groups: list[dict[str, Any]]

    def step(self, closure: Callable[[], float] | None = None) -> Any:
        rates = [group["lr"] for group in self.param_groups]
        try:
            for group, rate in zip(self.param_groups, rates, strict=True):
                group["lr"] = rate * group["lr_scale"]
            return super().step(closure)  # type: ignore[misc]
        finally:
            # SB3 writes the schedule's rate into the groups and logs it: it must find its own.
            for group, rate in zip(self.param_groups, rates, strict=True):
                group["lr"] = rate


def with_lr_scale(optimizer_class: type[th.optim.Optimizer]) -> type[th.optim.Optimizer]:
    """
    Make an optimizer that multiplies the learning rate by ``lr_scale`` of each parameter group.

    :param optimizer_class: any optimizer of PyTorch
    :return: a subclass; its groups need an ``lr_scale``, which their state keeps
    """
    return type(f"LrScaled{optimizer_class.__name__}", (_LrScale, optimizer_class), {})
