"""Values that change over a training. Saved models name this module."""

from __future__ import annotations

__all__ = ["FallingSchedule"]


class FallingSchedule:
    """
    Falls linearly to 0 over a training: an entry's ``lin_0.001``.

    :param first: value at the beginning
    """

    def __init__(self, first: float) -> None:
        self.first = first

    def __call__(self, progress_remaining: float) -> float:
        """
        Return the present value.

        :param progress_remaining: 1 at the beginning of a training, 0 at its end
        """
        return progress_remaining * self.first

    def __repr__(self) -> str:
        return f"FallingSchedule({self.first})"
