"""Policies for stock algorithms: split heads for DDPG and TD3, bounded means for PPO and A2C."""

from sb3_torcs.policies.bounded import BoundedPolicy
from sb3_torcs.policies.export import export_actor
from sb3_torcs.policies.split_head import SplitHeadPolicy

__all__ = ["BoundedPolicy", "SplitHeadPolicy", "export_actor"]
