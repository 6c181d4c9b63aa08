"""What users may have added to a model or a network, which lean updates would overlook."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

import torch as th
from torch import nn

__all__ = ["has_hooks", "has_module_hooks", "has_own_methods"]

MODULE_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
PARAMETER_HOOKS = ("_backward_hooks", "_post_accumulate_grad_hooks")
OPTIMIZER_HOOKS = ("_optimizer_step_pre_hooks", "_optimizer_step_post_hooks")


def has_own_methods(owner: Any) -> bool:
    """
    Check whether a method of one object was replaced, e.g. by ``torch.compile``.

    :param owner: a model or a policy
    :return: whether the object has an attribute in place of a method of its class
    """
    own_class: type = type(owner)
    return not _methods(own_class).isdisjoint(vars(owner))


@cache
def _methods(owner: type) -> frozenset[str]:
    return frozenset(name for name in dir(owner) if callable(getattr(owner, name)))


def has_module_hooks(modules: Iterable[nn.Module]) -> bool:
    """
    Check whether PyTorch would call somebody's function where data pass through modules.

    :param modules: of a network
    """
    return any(getattr(part, name) for part in modules for name in MODULE_HOOKS)


def has_hooks(
    modules: Iterable[nn.Module], optimizer: th.optim.Optimizer, own_hooks: int = 0
) -> bool:
    """
    Check whether PyTorch would call somebody's function during an update.

    :param modules: that an update passes through
    :param optimizer: of their parameters
    :param own_hooks: number of the optimizer's hooks that the policy itself has registered
    :return: whether there are other hooks, on a module, a parameter or the optimizer
    """
    parts = list(modules)
    parameters = [own for part in parts for own in part._parameters.values() if own is not None]
    return (
        has_module_hooks(parts)
        or any(getattr(own, name) for own in parameters for name in PARAMETER_HOOKS)
        or sum(len(getattr(optimizer, name)) for name in OPTIMIZER_HOOKS) != own_hooks
    )
