"""Many races as one environment of Stable-Baselines3."""

from sb3_torcs.vec_env.info import LazyInfo, glance
from sb3_torcs.vec_env.joined import JoinedVecEnv
from sb3_torcs.vec_env.mirror import MirrorVecEnv
from sb3_torcs.vec_env.torcs import TorcsVecEnv

__all__ = ["JoinedVecEnv", "LazyInfo", "MirrorVecEnv", "TorcsVecEnv", "glance"]
