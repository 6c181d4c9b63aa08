"""Many races as one environment of Stable-Baselines3."""

from sb3_torcs.vec_env.joined import JoinedVecEnv
from sb3_torcs.vec_env.mirror import MirrorVecEnv
from sb3_torcs.vec_env.torcs import RaceInfo, TorcsVecEnv, glance

__all__ = ["JoinedVecEnv", "MirrorVecEnv", "RaceInfo", "TorcsVecEnv", "glance"]
