"""The name by which older hyperparameter files call the progress bar."""

from sb3_torcs.callbacks.progress import RacingProgressCallback

__all__ = ["RacingProgressCallback"]
