"""The record of a model's training: in its own file, or beside it as the RL Zoo writes it.

The record is one more attribute of the model, which SB3 saves as JSON with the others: stock SB3
loads such a file as before, and a file that is copied or renamed keeps its record.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from sb3_torcs.agents.saved.file import raise_mismatch
from sb3_torcs.agents.saved.policy import Spaces, restore_space
from sb3_torcs.car import DEFAULT_CAR
from sb3_torcs.errors import ModelMismatch
from sb3_torcs.files import read_yaml

__all__ = [
    "BEST_MODEL",
    "DRIVEN_WITH",
    "RECORD",
    "STATISTICS",
    "VERSION",
    "Statistics",
    "TrainingRecord",
    "record_beside",
    "record_within",
]

DRIVEN_WITH = ("action_repeat", "range_finders", "sensors", "action", "gearbox", "aids")
"""Options of its environment without which an agent does not drive as in its training."""

RECORD = "sb3_torcs"
"""What the attribute is called."""

VERSION = 1

BEST_MODEL, STATISTICS, CHECKPOINT = "best_model.zip", "vecnormalize.pkl", "rl_model_"
"""Files of a run, as the zoo calls them; a checkpoint's name only begins so."""


@dataclass(frozen=True)
class Statistics:
    """
    The statistics of ``VecNormalize`` about the observations.

    :param mean: of each number
    :param var: of each number
    :param epsilon: added to the variance
    :param clip_obs: largest normalized number
    """

    mean: tuple[float, ...]
    var: tuple[float, ...]
    epsilon: float
    clip_obs: float

    @functools.cached_property
    def _arrays(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array(self.mean), np.sqrt(np.array(self.var) + self.epsilon)

    def normalize_obs(self, observation: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """
        Normalize as ``VecNormalize`` does, to the bit.

        :param observation: (…, n) as the environment gives it
        :return: the same shape
        """
        mean, deviation = self._arrays
        scaled = np.clip((observation - mean) / deviation, -self.clip_obs, self.clip_obs)
        return scaled.astype(np.float32)


@dataclass(frozen=True)
class TrainingRecord:
    """The record of a model's training. Unknown parts are empty."""

    algo: str | None = None
    env_id: str | None = None
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)  # the entry, as it was read
    spaces: Spaces | None = None  # of observations and actions
    policy: Mapping[str, Any] | None = None  # as of ``saved.policy.plain_policy``
    statistics: Statistics | None = None  # of VecNormalize
    statistics_file: Path | None = None  # the same, pickled by the zoo
    subclass: str | None = None  # of the algorithm, by whose own code it has learned
    driver_only: bool = False  # whether the parts that only learning needs were left out

    @property
    def known(self) -> bool:
        """Whether any part is known."""
        return self != TrainingRecord()

    @property
    def one_car(self) -> str:
        """The car to drive: that of the training, or the usual one if it had none or several."""
        car = self.env_kwargs.get("car")
        return car if isinstance(car, str) else DEFAULT_CAR

    def select(self, names: Iterable[str]) -> dict[str, Any]:
        """
        Select keyword arguments of the training's environment.

        :param names: of keyword arguments
        :return: those that the training's environment was given
        """
        return {name: self.env_kwargs[name] for name in names if name in self.env_kwargs}


def record_within(model: Path, data: Mapping[str, Any]) -> TrainingRecord | None:
    """
    Read the record that a model's file holds.

    :param model: the file, for messages
    :param data: of :func:`~sb3_torcs.agents.saved.file.saved_data`
    :return: the record; ``None`` if there is none, or if it is of an earlier training
    :raises ModelMismatch: if it cannot be read
    """
    said = data.get(RECORD)
    if said is None:
        return None
    with raise_mismatch(f"the record in '{model}' cannot be read", "give"):
        if said["version"] > VERSION:
            raise ValueError(f"it has version {said['version']}; upgrade sb3_torcs")
        # SB3 keeps the attribute when a training resumes without writing a new record.
        if said["start_time"] != data.get("start_time"):
            return None
        seen = tuple(restore_space(said[name]) for name in ("observation_space", "action_space"))
        return TrainingRecord(
            algo=_take(said, "algo", str),
            env_id=_take(said, "env_id", str),
            env_kwargs=_take(said, "env_kwargs", dict) or {},
            hyperparameters=_take(said, "hyperparameters", dict) or {},
            spaces=None if seen[0] is None or seen[1] is None else (seen[0], seen[1]),
            policy=_take(said, "policy", dict),
            statistics=_statistics(_take(said, "statistics", dict)),
            subclass=_take(said, "subclass", str),
            driver_only=bool(said.get("driver_only")),
        )


def _take(said: Mapping[str, Any], key: str, kind: type) -> Any:
    """Take one value of a record."""
    if not isinstance(said.get(key), kind | None):
        raise TypeError(f"{key} is a {type(said[key]).__name__}")
    return said.get(key)


def _statistics(said: Mapping[str, Any] | None) -> Statistics | None:
    """Read statistics, which have to be finite."""
    if said is None:
        return None
    mean, var = (tuple(float(number) for number in said[name]) for name in ("mean", "var"))
    statistics = Statistics(mean, var, float(said["epsilon"]), float(said["clip_obs"]))
    numbers = np.array([*mean, *var, statistics.epsilon, statistics.clip_obs])
    if len(mean) != len(var) or not np.isfinite(numbers).all():
        raise ValueError("the statistics of VecNormalize are not finite")
    return statistics


class _PlainLoader(yaml.SafeLoader):
    """Reads the zoo's records, which name Python classes, without building any but mappings."""


def _plain(loader: _PlainLoader, tag: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.SequenceNode):
        items = loader.construct_sequence(node, deep=True)
        return dict(items[0]) if tag.endswith("OrderedDict") and items else items
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    return None


_PlainLoader.add_multi_constructor("tag:yaml.org,2002:python/", _plain)


def record_beside(model: Path) -> TrainingRecord | None:
    """
    Read the zoo's files beside a model: ``config.yml``, ``args.yml``, ``vecnormalize.pkl``.

    They lie in the model's folder, or in a folder below it with the environment's name. The latter
    is the zoo's, for the models that it saves: ``ENV.zip``, ``best_model.zip`` and
    ``rl_model_*.zip``. Folders with other names are not read.

    :param model: the file
    :return: what is known; ``None`` if there is nothing
    :raises ModelMismatch: if one of the files cannot be read
    """
    own = _record(model.parent)
    if own is not None:
        return own
    ours = model.name == BEST_MODEL or model.name.startswith(CHECKPOINT)
    below = [path for path in model.parent.iterdir() if (path / "args.yml").is_file()]
    runs = [path for path in below if ours or path.name == model.stem]
    records = [(path, _record(path)) for path in runs]
    found = [
        record
        for path, record in records
        if record and record.env_id and record.env_id.replace("/", "-") == path.name
    ]
    return found[0] if len(found) == 1 else None


def _record(folder: Path) -> TrainingRecord | None:
    """Read the zoo's files in a folder."""
    arguments, config = folder / "args.yml", folder / "config.yml"
    statistics = folder / STATISTICS
    if not any(file.is_file() for file in (arguments, config, statistics)):
        return None
    return TrainingRecord(
        algo=_read_record(arguments, "algo", str),
        env_id=_read_record(arguments, "env", str),
        env_kwargs=_read_record(config, "env_kwargs", dict) or {},
        hyperparameters=_read_plain(config),
        statistics_file=statistics if statistics.is_file() else None,
    )


def _read_record(file: Path, key: str, kind: type) -> Any:
    """Read one value of the zoo's records."""
    value = _read_plain(file).get(key)
    if not isinstance(value, kind | None):
        raise ModelMismatch(
            f"'{file}', the record of a training: {key} is {value!r}; repair or remove it"
        )
    return value


def _read_plain(file: Path) -> dict[str, Any]:
    """
    Read one of the zoo's records, if it exists.

    A record that cannot be read is an error: without it the model would drive in another
    environment than in its training.
    """
    if not file.is_file():
        return {}
    try:
        content = read_yaml(file.read_text(encoding="utf-8"), _PlainLoader)
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise ModelMismatch(
            f"'{file}', the record of a training, cannot be read ({error}); repair or remove it"
        ) from error
    return content if isinstance(content, dict) else {}
