"""The older path of the progress bar, for older hyperparameter files."""

from sb3_torcs.callbacks.progress import RacingProgressCallback

__all__ = ["RacingProgressCallback"]
