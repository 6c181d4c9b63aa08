"""The policy with split heads for stock DDPG and TD3, and its parts."""

from sb3_torcs.policies.bounded import BoundedPolicy
from sb3_torcs.policies.export import export_actor
from sb3_torcs.policies.split_head import SplitHeadPolicy

__all__ = ["BoundedPolicy", "SplitHeadPolicy", "export_actor"]
