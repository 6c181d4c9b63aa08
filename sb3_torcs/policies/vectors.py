"""The parameters of a network as views of one vector, for lean updates.

A step of Adam, of a target network or of a running average is then one pass over a vector.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch as th

__all__ = ["Vector", "array"]


def array(tensor: th.Tensor) -> np.ndarray:
    """
    Return the numbers of a tensor, contiguous; a view where they are already.

    :param tensor: on the CPU
    """
    return np.ascontiguousarray(tensor.detach().numpy())


class Vector:
    """
    Tensors that are views of one vector until they are released.

    PyTorch's own functions, and whoever else holds the tensors, read and write them as before.

    :param tensors: parameters, or what an optimizer keeps of each; in single precision
    """

    def __init__(self, tensors: Iterable[th.Tensor]) -> None:
        self.tensors = list(tensors)
        self.flat = th.cat([own.detach().reshape(-1) for own in self.tensors])
        parts = self.flat.split([own.numel() for own in self.tensors])
        for own, part in zip(self.tensors, parts, strict=True):
            own.data = part.view(own.shape)
        self._places = [own.data_ptr() for own in self.tensors]

    @property
    def numbers(self) -> np.ndarray:
        """The vector, (parameters,)."""
        return self.flat.numpy()

    def is_whole(self) -> bool:
        """Return whether all tensors are still views: others may replace their ``data``."""
        return self._places == [own.data_ptr() for own in self.tensors]

    def release(self) -> None:
        """Give each tensor numbers of its own."""
        for own in self.tensors:
            own.data = own.detach().clone()
