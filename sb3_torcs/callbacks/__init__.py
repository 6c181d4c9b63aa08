"""Callbacks for Stable-Baselines3. Their arguments are plain values.

So a hyperparameter file can name them, e.g. ``sb3_torcs.callbacks.NoiseCallback: {kind: ou}``.
"""

from sb3_torcs.agents.saved.writing import RecordCallback
from sb3_torcs.callbacks.exploration import (
    NoiseCallback,
    NoiseDecayCallback,
    StochasticBrakeCallback,
)
from sb3_torcs.callbacks.learning import LeanUpdatesCallback
from sb3_torcs.callbacks.metrics import MONITOR_KWARGS, DrivingMetricsCallback
from sb3_torcs.callbacks.switches import RandomStartCallback, RewardCallback

__all__ = [
    "MONITOR_KWARGS",
    "DrivingMetricsCallback",
    "LeanUpdatesCallback",
    "NoiseCallback",
    "NoiseDecayCallback",
    "RandomStartCallback",
    "RecordCallback",
    "RewardCallback",
    "StochasticBrakeCallback",
]
