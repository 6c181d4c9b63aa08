"""Stable-Baselines3 for TORCS: racing environments, policies, noises and callbacks.

Importing the package registers ``Torcs-v0`` and ``TorcsLite-v0``; nothing heavy is loaded.
"""

from __future__ import annotations

from typing import Any

from gymnasium.envs.registration import register, registry

from sb3_torcs.torcs.opponents import register_opponents

__all__ = ["__version__", "compare", "parallel_env", "register_envs"]

__version__ = "0.1.0"

MAX_EPISODE_STEPS = 3000
"""Timesteps after which an episode is truncated: five minutes at the default action repeat."""


def register_envs() -> None:
    """Register both ids; calling it again changes nothing."""
    for name, entry_point, vector_entry_point in (
        ("TorcsLite-v0", "torcs_lite:TorcsLiteEnv", "torcs_vector:TorcsLiteVectorEnv"),
        ("Torcs-v0", "torcs:TorcsEnv", "torcs_vector:TorcsVectorEnv"),
    ):
        if name not in registry:
            # Gymnasium's passive checker would look at the first timesteps of each environment and
            # then stand in the way of all others; the tests run both libraries' full checks.
            register(
                name,
                entry_point=f"sb3_torcs.envs.{entry_point}",
                vector_entry_point=f"sb3_torcs.envs.{vector_entry_point}",
                max_episode_steps=MAX_EPISODE_STEPS,
                disable_env_checker=True,
            )


register_envs()
register_opponents("sb3_torcs.agents.pilots:AgentOpponents")


def __getattr__(name: str) -> Any:
    """Load ``compare`` and ``parallel_env`` when somebody asks for them."""
    if name == "compare":
        from sb3_torcs.evaluation.comparing import compare

        return compare
    if name == "parallel_env":
        from sb3_torcs.envs.parallel_env import parallel_env

        return parallel_env
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
