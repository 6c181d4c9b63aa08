"""Drives as Parquet files: one row per driver and moment, every column with its unit.

``pandas.read_parquet`` reads them as they are; the units stand in the ``attrs`` of its table and in
the metadata of each column.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sb3_torcs.car import CarState, Controls
from sb3_torcs.errors import DriveFileError, InvalidOption, needs_extra
from sb3_torcs.files import atomic_file, checked_ending, readable
from sb3_torcs.sensors import SENSORS
from sb3_torcs.tracks.track import Track

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

__all__ = [
    "COLUMNS",
    "LABELS",
    "STATE_FIELDS",
    "WHEELS",
    "DriveLabel",
    "DriveLog",
    "car_of",
    "controls_of",
    "read_drives",
]

STATE_FIELDS = CarState._fields[: CarState._fields.index("wheel_speeds")]
CONTROL_FIELDS = ("steering", "throttle", "brake", "gear_asked")

FORMAT = "sb3-torcs drives, version 1"
AT_ONCE = 5000  # rows that are turned into columns together

NO_OPPONENTS = np.full(36, 200.0)  # [m] as of CarState
WHEELS = ("front_right", "front_left", "rear_right", "rear_left")
WHOLE = {"gear", "laps", "race_position", "gear_asked"}  # columns of whole numbers
LEFT_BY_PHYSICS = {"engine_speed", "fuel"}  # as wheels: may stay no number in a car that it lost
OTHER_UNITS = {  # of what the sensor table does not hold
    "time": "s", "x": "m", "y": "m", "yaw": "rad", "yaw_rate": "rad/s", "height": "m",
    "distance_from_axis": "m", "track_width": "m", "distance_from_start": "m",
    "distance_raced": "m", "fuel": "l", "damage": "points", "lap_time": "s", "last_lap_time": "s",
    "best_lap_time": "s",
}  # fmt: skip


class DriveLabel(NamedTuple):
    """Whose drive it is; the first columns of the table."""

    driver: str  # as it is named on the command line
    track: str  # a name, or the absolute path of somebody's own file
    car: str
    world: str  # the environment's id
    episode: int = 1  # the driver's races are counted


LABELS = DriveLabel._fields


def _units() -> dict[str, str]:
    """Name every column of numbers, with its unit."""
    units = {sensor.name: sensor.unit for sensor in SENSORS} | OTHER_UNITS
    columns = {name: units.get(name, "-") for name in STATE_FIELDS}
    columns |= {f"wheel_speed_{wheel}": units["wheel_speeds"] for wheel in WHEELS}
    beams = next(sensor.size for sensor in SENSORS if sensor.name == "range_finders")
    columns |= {f"range_finder_{n}": units["range_finders"] for n in range(beams)}
    return columns | dict.fromkeys(CONTROL_FIELDS, "-")


COLUMNS = _units()
"""The columns of numbers and their units: of the car after the tick, and of its controls."""


class DriveLog:
    """Gathers the rows of drives. Any world, and any mixture of drivers, may fill it."""

    def __init__(self) -> None:
        self._labels: list[DriveLabel] = []
        self._numbers: list[np.ndarray[Any, Any]] = []
        self._open: list[tuple[Any, ...]] = []
        self.tracks: dict[DriveLabel, Track] = {}
        """Where was driven, if the world has told: a track that was drawn has no lasting name."""

    def add(self, label: DriveLabel, car: CarState, controls: Controls) -> None:
        """
        Append a row.

        :param label: whose it is
        :param car: at the end of the control tick or timestep
        :param controls: that it was driven with
        :raises InvalidOption: if the label is none
        """
        if not isinstance(label, DriveLabel):
            raise InvalidOption(
                f"label is {label!r}; give a DriveLabel, as sb3_torcs.telemetry has it"
            )
        gear = np.nan if controls.gear is None else controls.gear
        asked = (controls.steering, controls.throttle, controls.brake, gear)
        state = car[: len(STATE_FIELDS)]
        self._labels.append(label)
        self._open.append((*state, *car.wheel_speeds, *car.range_finders, *asked))
        if len(self._open) == AT_ONCE:
            self._close()

    def extend(self, other: DriveLog) -> None:
        """
        Append the rows of another log.

        :param other: which is not filled any more
        """
        for log in (self, other):
            log._close()
        self._labels += other._labels
        self._numbers += other._numbers
        self.tracks |= other.tracks

    def _close(self) -> None:
        """Pack the newest rows into an array."""
        if self._open:
            self._numbers.append(np.array(self._open))
            self._open = []

    def episodes(self) -> dict[DriveLabel, np.ndarray[Any, Any]]:
        """Return the rows of each drive: (n, columns), as of :data:`COLUMNS`."""
        self._close()
        numbers = self._joined()
        places: dict[DriveLabel, list[int]] = {}
        for place, label in enumerate(self._labels):
            places.setdefault(label, []).append(place)
        return {label: numbers[rows] for label, rows in places.items()}

    def _joined(self) -> np.ndarray[Any, Any]:
        return np.concatenate(self._numbers or [np.empty((0, len(COLUMNS)))])

    def table(self) -> pa.Table:
        """Return all rows as a table of Apache Arrow."""
        with needs_extra("a table of drives"):
            import pyarrow as pa

        self._close()
        numbers = self._joined()
        columns: dict[str, pa.Array] = {
            name: pa.array(
                [readable(getattr(label, name)) for label in self._labels]
            ).dictionary_encode()
            for name in LABELS[:-1]
        }
        columns["episode"] = pa.array([label.episode for label in self._labels], pa.int32())
        for name, values in zip(COLUMNS, numbers.T, strict=True):
            kind = pa.int32() if name in WHOLE else pa.float64()
            columns[name] = pa.array(values, mask=np.isnan(values)).cast(kind)
        fields = [
            pa.field(name, column.type, metadata={"unit": COLUMNS.get(name, "")})
            for name, column in columns.items()
        ]
        # pandas reads a table's `attrs` from this.
        attrs = json.dumps({"format": FORMAT, "units": COLUMNS})
        schema = pa.schema(fields, metadata={"PANDAS_ATTRS": attrs})
        return pa.Table.from_arrays(list(columns.values()), schema=schema)

    def frame(self) -> pd.DataFrame:
        """Return all rows as a table of pandas, as :func:`read_drives` does of a file."""
        return self.table().to_pandas()

    def write(self, path: str | Path) -> None:
        """
        Write all rows to a Parquet file.

        :param path: of the file, which ends in ``.parquet`` and appears when it is complete
        :raises OutputNotWritable: if the file has another ending or cannot be written
        """
        with needs_extra("a file of drives"):
            from pyarrow import parquet

        file = checked_ending(path, (".parquet",))
        table = self.table()
        floats = [field.name for field in table.schema if str(field.type) == "double"]
        others = [field.name for field in table.schema if field.name not in floats]
        with atomic_file(file) as aside:
            # Bytes of one weight stand together, which compresses better.
            parquet.write_table(
                table, aside, compression="zstd", use_dictionary=others,
                use_byte_stream_split=floats, write_page_checksum=True,
            )  # fmt: skip


def car_of(row: np.ndarray[Any, Any]) -> CarState:
    """
    Make the car of a row, without opponents.

    :param row: of :meth:`DriveLog.episodes`
    """
    state, wheels = len(STATE_FIELDS), len(WHEELS)
    values = dict(zip(STATE_FIELDS, row[:state].tolist(), strict=True))
    whole = {name: int(values[name]) for name in STATE_FIELDS if name in WHOLE}
    beams = row[state + wheels : -len(CONTROL_FIELDS)]
    sensed = {"wheel_speeds": row[state : state + wheels], "range_finders": beams}
    return CarState(**{**sensed, "opponents": NO_OPPONENTS, **values, **whole})


def controls_of(row: np.ndarray[Any, Any]) -> Controls:
    """
    Make the controls of a row.

    :param row: of :meth:`DriveLog.episodes`
    """
    steering, throttle, brake, gear = row[-len(CONTROL_FIELDS) :].tolist()
    return Controls(steering, throttle, brake, None if np.isnan(gear) else int(gear))


def read_drives(path: str | Path) -> pd.DataFrame:
    """
    Read the drives of a file, and make sure that they are drives.

    :param path: of a Parquet file that ``--telemetry`` or :class:`DriveLog` has written
    :return: one row per driver and moment; the columns are :data:`LABELS` and :data:`COLUMNS`
    :raises DriveFileError: if the file is missing, damaged, or holds something else
    """
    import pandas as pd

    with needs_extra("a file of drives"):
        import pyarrow as pa

    again = "write it anew: sb3-torcs evaluate MODEL --telemetry FILE.parquet"
    if not os.path.isfile(path):  # to read a pipe would wait for who writes it
        raise DriveFileError(f"there is no file '{path}'; {again}")
    try:
        frame = pd.read_parquet(path, page_checksum_verification=True)
    except (OSError, ValueError, pa.ArrowException) as error:
        told = str(error).splitlines()[0]
        raise DriveFileError(f"'{path}' cannot be read as a drive ({told}); {again}") from error
    missing = [name for name in (*LABELS, *COLUMNS) if name not in frame]
    if missing:
        raise DriveFileError(
            f"'{path}' is no drive of ours: it has no column {', '.join(missing[:3])}; {again}"
        )
    if frame.empty:
        raise DriveFileError(f"'{path}' holds no rows; {again}")
    damage = _damage(frame)
    if damage is not None:
        raise DriveFileError(f"'{path}' is damaged: {damage}; {again}")
    return frame


def _damage(frame: pd.DataFrame) -> str | None:
    """Say what keeps rows from being drives, if anything does."""
    if frame[list(LABELS)].isna().any(axis=None):
        return "it does not say of each row who drove where"
    labels = [label for name in LABELS[:-1] for label in frame[name].unique()]
    if not all(isinstance(label, str) and label.isprintable() for label in labels):
        return "a driver, track, car or world is no text that a terminal can show"
    numbers = frame[list(COLUMNS)].select_dtypes("number")
    for name in COLUMNS:
        if name not in numbers:
            return f"its column {name} holds no numbers"
    if not np.isfinite(frame[["time", "distance_from_start", "lap_time"]].to_numpy()).all():
        return "a time or a distance is no number"
    finite = np.isfinite(numbers[list(STATE_FIELDS)].to_numpy(float, na_value=np.nan)).all(axis=0)
    for name, whole in zip(STATE_FIELDS, finite, strict=True):
        if not whole and name not in LEFT_BY_PHYSICS:
            return f"its column {name} has rows without a number"
    drives = frame.groupby(list(LABELS), sort=False, observed=True)
    if (drives["time"].diff() < 0.0).any():
        return "its rows are out of order"
    return None
