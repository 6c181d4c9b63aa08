"""``Torcs-v0``: the racing environment on the real game. Its engine is not part of this version."""

from __future__ import annotations

from typing import Any, NoReturn

from sb3_torcs.errors import BackendUnavailable

__all__ = ["TorcsEnv"]


class TorcsEnv:
    """Says that the engine is missing; it never falls back to another world."""

    def __new__(cls, **kwargs: Any) -> NoReturn:  # noqa: ARG004
        """
        :param kwargs: those of the environment
        :raises BackendUnavailable: always, in this version
        """
        raise BackendUnavailable(
            "Torcs-v0 needs the native TORCS engine, which this version of sb3_torcs does not have "
            'yet; the same contract without TORCS is gym.make("sb3_torcs:TorcsLite-v0")'
        )
