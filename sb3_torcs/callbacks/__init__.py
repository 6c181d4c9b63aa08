"""Callbacks for Stable-Baselines3. Their arguments are plain values.

So a hyperparameter file can name them, e.g. ``sb3_torcs.callbacks.NoiseCallback: {kind: ou}``.
"""

from sb3_torcs.agents.saved.writing import RecordCallback
from sb3_torcs.callbacks.exploration import (
    NoiseCallback,
    NoiseDecayCallback,
    StochasticBrakeCallback,
)
from sb3_torcs.callbacks.learning import (
    AdaptiveLearningRateCallback,
    GradientStepsCallback,
    LeanUpdatesCallback,
    MirrorCallback,
    ValuesOnlyCallback,
)
from sb3_torcs.callbacks.lines import LinePicturesCallback
from sb3_torcs.callbacks.metrics import MONITOR_KWARGS, DrivingMetricsCallback
from sb3_torcs.callbacks.progress import RacingProgressCallback
from sb3_torcs.callbacks.reuse import ReuseRolloutsCallback
from sb3_torcs.callbacks.switches import ConditionsCallback, RandomStartCallback, RewardCallback

__all__ = [
    "MONITOR_KWARGS",
    "AdaptiveLearningRateCallback",
    "ConditionsCallback",
    "DrivingMetricsCallback",
    "GradientStepsCallback",
    "LeanUpdatesCallback",
    "LinePicturesCallback",
    "MirrorCallback",
    "NoiseCallback",
    "NoiseDecayCallback",
    "RacingProgressCallback",
    "RandomStartCallback",
    "RecordCallback",
    "ReuseRolloutsCallback",
    "RewardCallback",
    "StochasticBrakeCallback",
    "ValuesOnlyCallback",
]
