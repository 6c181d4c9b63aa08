"""The parameters of a network as views of one vector, for lean updates.

A step of Adam, of a target network or of a running average is then one pass over a vector. The
matrices are turned, for faster products.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch as th
from torch import nn

__all__ = ["Slot", "Vector", "array", "slots_of"]

FEW_OUTPUTS = ("heads.weight", "value.weight")
"""Weights of layers whose outputs are computed one by one: they are not turned."""


class Slot(NamedTuple):
    """The place of a parameter in a vector."""

    shape: tuple[int, ...]  # of the parameter: a matrix is (outputs, inputs)
    turned: bool  # in the vector a matrix is (inputs, outputs)

    def of(self, part: th.Tensor) -> th.Tensor:
        """
        Return a view of the parameter.

        :param part: its part of the vector
        """
        return part.view(self.shape[::-1]).t() if self.turned else part.view(self.shape)


def slots_of(network: nn.Module) -> list[Slot]:
    """
    Return the places of a network's parameters in a vector.

    :param network: of linear layers and norms
    """
    return [
        Slot(tuple(own.shape), own.dim() == 2 and not name.endswith(FEW_OUTPUTS))
        for name, own in network.named_parameters()
    ]


def array(tensor: th.Tensor) -> np.ndarray:
    """
    Return the numbers of a tensor, contiguous; a view where they are already.

    :param tensor: on the CPU
    """
    return np.ascontiguousarray(tensor.detach().numpy())


class Vector:
    """
    Tensors that are views of one vector until they are released.

    Their numbers stay in their places for whoever holds the tensors: PyTorch's own functions read
    and write them as before.

    :param tensors: parameters, or what an optimizer keeps of each
    :param slots: of the tensors
    """

    def __init__(self, tensors: Iterable[th.Tensor], slots: Sequence[Slot]) -> None:
        self.tensors = list(tensors)
        self.flat = th.empty(sum(math.prod(slot.shape) for slot in slots))
        parts = self.flat.split([math.prod(slot.shape) for slot in slots])
        views = [slot.of(part) for slot, part in zip(slots, parts, strict=True)]
        self._places = [(view.data_ptr(), view.stride()) for view in views]
        for own, view in zip(self.tensors, views, strict=True):
            view.copy_(own.detach())
            own.data = view

    @property
    def numbers(self) -> np.ndarray:
        """The vector, (parameters,)."""
        return self.flat.numpy()

    def is_whole(self) -> bool:
        """Return whether all tensors are still views: others may replace their ``data``."""
        return self._places == [(own.data_ptr(), own.stride()) for own in self.tensors]

    def release(self) -> None:
        """Give each tensor numbers of its own, contiguous ones."""
        for own in self.tensors:
            own.data = own.detach().clone(memory_format=th.contiguous_format)
