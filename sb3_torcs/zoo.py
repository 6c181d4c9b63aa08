"""The name by which records of older trainings call a wrapper of theirs."""

from sb3_torcs.training.zoo import UninterruptedWorker

__all__ = ["UninterruptedWorker"]
