"""Telemetry: drives as tables, and the lap report, which shows where a lap is faster.

``drives`` notes them, and writes and reads them as Parquet. ``laps`` and ``corners`` cut them up,
``comparison`` lays laps on each other, and ``page`` shows that as one HTML ``document``.
"""

from sb3_torcs.telemetry.drives import COLUMNS, STATE_FIELDS, DriveLabel, DriveLog, read_drives

__all__ = ["COLUMNS", "STATE_FIELDS", "DriveLabel", "DriveLog", "read_drives"]
