"""Telemetry: drives as tables, and the lap report, which says where one lap is faster than another.

``drives`` writes and reads them as Parquet, ``table`` writes CSV. ``laps`` and ``corners`` cut them
up, ``comparison`` lays laps on each other, and ``page`` shows that as one HTML ``document``.
"""

from sb3_torcs.telemetry.drives import DriveLabel, DriveLog, read_drives
from sb3_torcs.telemetry.table import (
    CONTROL_FIELDS,
    STATE_FIELDS,
    TELEMETRY_FIELDS,
    write_telemetry,
)

__all__ = [
    "CONTROL_FIELDS",
    "STATE_FIELDS",
    "TELEMETRY_FIELDS",
    "DriveLabel",
    "DriveLog",
    "read_drives",
    "write_telemetry",
]
