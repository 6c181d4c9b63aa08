"""The older path of a wrapper, for records of older trainings."""

from sb3_torcs.training.zoo import UninterruptedWorker

__all__ = ["UninterruptedWorker"]
