"""The rows of a study's results, grouped by trial."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

__all__ = ["Results"]


class Results(NamedTuple):
    """The rows of one variant with one seed."""

    variant: str
    seed: int
    train: list[dict[str, Any]]
    final: list[dict[str, Any]]

    @property
    def evaluations(self) -> list[list[dict[str, Any]]]:
        """Rows of the training, one list of tracks per evaluation."""
        return [list(rows) for _, rows in itertools.groupby(self.train, lambda r: r["decisions"])]

    def at_home(self) -> dict[str, Any] | None:
        """Return the final drive on the track that chose the model."""
        home = self.train[0]["track"]
        return next((row for row in self.final if row["track"] == home), None)
