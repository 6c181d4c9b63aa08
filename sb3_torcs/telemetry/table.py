"""Drives as CSV files, one row per driver and moment, which any program reads."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sb3_torcs.car import CarState
from sb3_torcs.files import whole_file

__all__ = ["CONTROL_FIELDS", "STATE_FIELDS", "TELEMETRY_FIELDS", "write_telemetry"]

STATE_FIELDS = CarState._fields[: CarState._fields.index("wheel_speeds")]
CONTROL_FIELDS = ("steering", "throttle", "brake", "gear_asked")
TELEMETRY_FIELDS = ("robot", "index", *STATE_FIELDS, *CONTROL_FIELDS)
"""Columns of a telemetry file."""


def write_telemetry(path: Path, rows: Iterable[tuple[Any, ...]]) -> None:
    """
    Write a drive to a CSV file.

    :param path: of the CSV file, which appears when it is complete
    :param rows: values of :data:`TELEMETRY_FIELDS`; they are consumed one by one during the drive
    :raises OutputNotWritable: if the file cannot be written
    """
    with (
        whole_file(path) as aside,
        aside.open("w", newline="", encoding="utf-8", errors="surrogateescape") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(TELEMETRY_FIELDS)
        writer.writerows(rows)
