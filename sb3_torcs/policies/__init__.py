"""Policies for stock algorithms: split heads for DDPG and TD3, bounded means for PPO and A2C.

Importing this package makes ``DDPG("SplitHeadPolicy", ...)`` and ``PPO("BoundedPolicy", ...)``
work.
"""

from stable_baselines3 import A2C, DDPG, PPO, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_torcs.policies.bounded import BoundedPolicy
from sb3_torcs.policies.export import export_actor
from sb3_torcs.policies.split_head import SplitHeadPolicy

__all__ = ["BoundedPolicy", "SplitHeadPolicy", "export_actor"]


def _register(policy: type[BasePolicy], *algorithms: type[BaseAlgorithm]) -> None:
    """Let algorithms know a policy by its name."""
    for algorithm in algorithms:
        # SB3's classes share one dictionary: each gets a copy of its own.
        aliases: dict[str, type[BasePolicy]] = {**algorithm.policy_aliases}
        algorithm.policy_aliases = {**aliases, policy.__name__: policy}


_register(SplitHeadPolicy, DDPG, TD3)
_register(BoundedPolicy, PPO, A2C)
