"""The older place of :class:`sb3_torcs.callbacks.RecordCallback` and of ``write_driver``."""

from sb3_torcs.agents.saved.writing import RecordCallback, write_driver

__all__ = ["RecordCallback", "write_driver"]
