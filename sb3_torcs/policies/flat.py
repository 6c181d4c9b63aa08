"""Parameters of a network in one vector, without a change of saved files.

A step of an optimizer, of a target network or of a running average is then one operation, instead
of one per matrix and bias.
"""

from __future__ import annotations

import copy
import math
from typing import Any, NamedTuple

import torch as th
from torch import nn

__all__ = ["FlatParameters", "Slot", "keep_plain_state"]

FEW_OUTPUTS = ("heads.weight", "value.weight")
"""Weights that no matrix product meets: each output's stand together, as in the plain network."""


class Slot(NamedTuple):
    """A parameter of the plain network."""

    shape: tuple[int, ...]  # in the plain network, whose matrices are (outputs, inputs)
    turned: bool  # in the vector a matrix is (inputs, outputs), for faster products

    def of(self, part: th.Tensor) -> th.Tensor:
        """
        Look at the parameter.

        :param part: its part of the vector
        :return: a view as the plain network has it
        """
        return part.view(self.shape[::-1]).t() if self.turned else part.view(self.shape)


class FlatParameters(nn.Module):
    """A network with all of its parameters in ``flat``; its state is that of the plain network."""

    flat: nn.Parameter
    slots: dict[str, Slot]
    size: int  # number of parameters of the plain network

    def adopt(self, parameters: dict[str, th.Tensor]) -> None:
        """
        Take over the parameters of the plain network.

        :param parameters: by their names
        """
        self.slots = {
            name: Slot(tuple(parameter.shape), _is_product(name, parameter))
            for name, parameter in parameters.items()
        }
        self.size = sum(map(th.numel, parameters.values()))
        self.flat = nn.Parameter(th.empty(self.size))
        for name, view in self.views(self.flat.detach()):
            view.copy_(parameters[name].detach())

    def views(self, vector: th.Tensor) -> list[tuple[str, th.Tensor]]:
        """
        Look at the parameters one by one.

        :param vector: of all parameters, or of something that each of them has
        :return: names and views as the plain network has them
        """
        parts = vector.split([math.prod(slot.shape) for slot in self.slots.values()])
        named = zip(self.slots.items(), parts, strict=True)
        return [(name, slot.of(part)) for (name, slot), part in named]

    def _save_to_state_dict(
        self, destination: dict[str, Any], prefix: str, keep_vars: bool
    ) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        vector = destination.pop(f"{prefix}flat")
        destination.update((prefix + name, view) for name, view in self.views(vector))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        rest, vector = dict(state_dict), self.flat.detach().clone()
        _, _, missing, _, errors = args
        for name, view in self.views(vector):
            value = rest.pop(prefix + name, None)
            if value is None:
                missing.append(prefix + name)
            elif value.shape != view.shape:
                errors.append(
                    f"size mismatch for {prefix}{name}: {tuple(value.shape)} in the file, "
                    f"{tuple(view.shape)} in the network"
                )
            else:
                view.copy_(value)
        super()._load_from_state_dict({**rest, f"{prefix}flat": vector}, prefix, *args)


def keep_plain_state(optimizer: th.optim.Optimizer, network: FlatParameters) -> None:
    """
    Let an optimizer write and read its state as the optimizer of the plain network does.

    :param optimizer: its last parameter is the network's vector, after others if there are any
    :param network: to which the vector belongs
    """
    optimizer.register_state_dict_post_hook(lambda _, state: _split(state, network))
    optimizer.register_load_state_dict_pre_hook(lambda _, state: _joined(state, network))


def _split(state: dict[str, Any], network: FlatParameters) -> dict[str, Any]:
    """Turn the state of the vector into those of its parameters."""
    (group,) = state["param_groups"]
    *others, last = group["params"]
    entries = {key: entry for key, entry in state["state"].items() if key != last}
    if last in state["state"]:
        for number in range(len(network.slots)):
            entries[last + number] = {
                name: network.views(value)[number][1] if _is_vector(value) else copy.deepcopy(value)
                for name, value in state["state"][last].items()
            }
    numbers = [*others, *range(last, last + len(network.slots))]
    return {**state, "state": entries, "param_groups": [{**group, "params": numbers}]}


def _joined(state: dict[str, Any], network: FlatParameters) -> dict[str, Any]:
    """Turn the states of the parameters into that of the vector."""
    (group,) = state["param_groups"]
    first = len(group["params"]) - len(network.slots)
    entries = {key: entry for key, entry in state["state"].items() if key < first}
    if first in state["state"]:
        entries[first] = dict(state["state"][first])
        for name, value in entries[first].items():
            if _is_vector(value):
                vector = entries[first][name] = th.empty_like(network.flat.detach())
                for number, (_, view) in enumerate(network.views(vector), first):
                    view.copy_(state["state"][number][name])
    numbers = group["params"][: first + 1]
    return {**state, "state": entries, "param_groups": [{**group, "params": numbers}]}


def _is_product(name: str, parameter: th.Tensor) -> bool:
    """Whether the parameter is a factor of a matrix product."""
    return parameter.dim() == 2 and not name.endswith(FEW_OUTPUTS)


def _is_vector(value: Any) -> bool:
    """Whether it has a number for each parameter; a count of steps has none."""
    return isinstance(value, th.Tensor) and value.dim() > 0
