"""Loading a saved model: which algorithm it is, how it was trained, whether it fits."""

from __future__ import annotations

import contextlib
import io
import json
import os
import pickle
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import yaml
from gymnasium import spaces

from sb3_torcs.drivers import SCRIPTED, ScriptedDriver
from sb3_torcs.errors import InvalidOption, ModelMismatch, near_miss
from sb3_torcs.sensors import range_finder_angles

__all__ = [
    "Driver",
    "TrainingRecord",
    "check_resumable",
    "check_spaces",
    "driver_record",
    "find_model",
    "load_driver",
    "one_track",
    "saved_spaces",
    "saved_steps",
    "shipped_agents",
    "training_record",
]

BEST_MODEL = "best_model.zip"
AGENTS = Path(__file__).parent / "agents"

SAVED_AS = {"ddpg": "td3"}  # a model of one does not tell that it is not of the other

NEEDED_KEYS = ("observation_space", "action_space", "num_timesteps")

# What only one family of algorithms saves; the first that is there names it. DDPG saves what TD3
# does, and either class drives the other's models.
TELLING_KEYS = (
    ("top_quantiles_to_drop_per_net", "tqc"),
    ("line_search_shrinking_factor", "trpo"),
    ("clip_range", "ppo"),
    ("exploration_fraction", "dqn"),
    ("target_entropy", "sac"),
    ("target_policy_noise", "td3"),
    ("vf_coef", "a2c"),
)


@dataclass(frozen=True)
class TrainingRecord:
    """What the zoo wrote down beside a model; empty where it was not trained by the zoo."""

    algo: str | None = None
    env_id: str | None = None
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)  # the entry, as it was read
    statistics: Path | None = None  # of VecNormalize

    def kept(self, names: Iterable[str]) -> dict[str, Any]:
        """
        Pick what another environment shall have in common with that of the training.

        :param names: of keyword arguments
        :return: those that the training's environment was given
        """
        return {name: self.env_kwargs[name] for name in names if name in self.env_kwargs}


class Driver:
    """
    A saved model at the wheel, with the statistics of the observations that it learned with.

    :param model: an algorithm or a policy of Stable-Baselines3
    :param statistics: something with VecNormalize's ``normalize_obs``; ``None`` if the model
        learned from the observations as they are
    """

    def __init__(self, model: Any, statistics: Any = None) -> None:
        self.model = model
        self.statistics = statistics

    def predict(
        self,
        observation: npt.NDArray[np.float32],
        state: Any = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """
        Choose an action.

        :param observation: as the environment gives it
        :param state: of a recurrent model, as the call before returned it
        :param episode_start: (1,) whether an episode begins here
        :param deterministic: whether to leave out chance
        :return: the action and the model's state
        """
        if self.statistics is not None:
            observation = self.statistics.normalize_obs(observation)
        answer: tuple[npt.NDArray[np.float32], Any] = self.model.predict(
            observation, state, episode_start, deterministic
        )
        return answer


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


def find_model(path: str | Path, *, prefer_last: bool = False) -> Path:
    """
    Find a saved model.

    :param path: of a ``.zip`` file, with or without its suffix, or of a run's folder; or the name
        of a shipped agent, e.g. ``"ddpg-aalborg"``
    :param prefer_last: of a folder take the last model rather than the best one
    :return: the file
    :raises InvalidOption: if there is none
    """
    given = Path(os.path.expanduser(path))
    if given.is_file():
        return given
    if Path(f"{given}.zip").is_file():
        return Path(f"{given}.zip")
    if not given.is_dir() and str(path) in shipped_agents():
        given = AGENTS / str(path)
    if not given.is_dir():
        known = [*(file.name for file in given.parent.glob("*.zip")), *shipped_agents()]
        raise InvalidOption(
            f"there is no model '{given}'{near_miss(given.name, known)} give the .zip that a "
            "training saved, the folder of its run, or a shipped agent: "
            f"{', '.join(shipped_agents())}"
        )
    best = given / BEST_MODEL
    last = [
        file for file in (given / f"{sub.name}.zip" for sub in given.iterdir()) if file.is_file()
    ]
    order = [*last, best] if prefer_last else [best, *last]
    for candidate in order:
        if candidate.is_file():
            return candidate
    raise InvalidOption(f"the folder '{given}' holds no model; give the .zip that a training saved")


def shipped_agents() -> list[str]:
    """
    List the agents that come with the package.

    :return: their names
    """
    return sorted(path.parent.name for path in AGENTS.glob(f"*/{BEST_MODEL}"))


def training_record(model: Path) -> TrainingRecord:
    """
    Read what the zoo wrote beside a model: ``config.yml``, ``args.yml``, ``vecnormalize.pkl``.

    They lie in the model's folder, or in the one folder below it that has some.

    :param model: the file
    :return: what is known
    :raises ModelMismatch: if something of it cannot be read
    """
    own = _record(model.parent)
    if own is not None:
        return own
    below = [_record(path) for path in model.parent.iterdir() if path.is_dir()]
    records = [record for record in below if record is not None]
    return records[0] if len(records) == 1 else TrainingRecord()


def _record(folder: Path) -> TrainingRecord | None:
    """Read what the zoo wrote in a folder."""
    arguments, config = folder / "args.yml", folder / "config.yml"
    statistics = folder / "vecnormalize.pkl"
    if not any(file.is_file() for file in (arguments, config, statistics)):
        return None
    return TrainingRecord(
        algo=_recorded(arguments, "algo", str),
        env_id=_recorded(arguments, "env", str),
        env_kwargs=_recorded(config, "env_kwargs", dict) or {},
        hyperparameters=_read_plain(config),
        statistics=statistics if statistics.is_file() else None,
    )


def _recorded(file: Path, key: str, kind: type) -> Any:
    """Read one value of the zoo's records."""
    value = _read_plain(file).get(key)
    if not isinstance(value, kind | None):
        raise ModelMismatch(
            f"'{file}', the record of a training: {key} is {value!r}; repair or remove it"
        )
    return value


def _read_plain(file: Path) -> dict[str, Any]:
    """
    Read one of the zoo's records, if it is there.

    Without it a model would drive in another environment than the one it learned in, so what is
    there and cannot be read is an error.
    """
    if not file.is_file():
        return {}
    try:
        content = yaml.load(file.read_text(encoding="utf-8"), Loader=_PlainLoader)
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise ModelMismatch(
            f"'{file}', the record of a training, cannot be read ({error}); repair or remove it"
        ) from error
    return content if isinstance(content, dict) else {}


def driver_record(driver: str | Path) -> TrainingRecord:
    """
    Read how that was trained which is to drive.

    :param driver: as in :func:`find_model`, or ``"scripted"``, of whom nothing is known
    :return: what is known
    """
    return TrainingRecord() if str(driver) == SCRIPTED else training_record(find_model(driver))


def one_track(track: Any) -> Any:
    """
    Make sure that a drive has one track, where a training may have had several.

    :param track: of the record, or what was given instead
    :return: the same
    :raises InvalidOption: if it is a list
    """
    if isinstance(track, list):
        raise InvalidOption(
            f"the model was trained on {len(track)} tracks, {', '.join(track)}; say which one it "
            f"shall drive on: --track {track[0]}"
        )
    return track


def _saved_data(model: Path) -> dict[str, Any]:
    """Read the readable part of a saved model, without unpickling anything."""
    try:
        with zipfile.ZipFile(model) as archive:
            data: dict[str, Any] = dict(json.loads(archive.read("data")))
        for name in NEEDED_KEYS:
            data[name]
    except (OSError, KeyError, TypeError, ValueError, zipfile.BadZipFile) as error:
        raise ModelMismatch(
            f"'{model}' is not a model that Stable-Baselines3 saved ({error}); give the .zip that "
            "a training saved"
        ) from error
    return data


def saved_steps(model: Path) -> int:
    """
    Return how many decisions the last training of a model had.

    :param model: the file
    :return: ``num_timesteps``
    """
    return int(_saved_data(model)["num_timesteps"])


def saved_spaces(model: Path) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
    """
    Return what a model sees and does.

    :param model: the file
    :return: the observation space and the action space
    """
    from stable_baselines3.common.save_util import json_to_data

    data = _saved_data(model)
    wanted = {name: data[name] for name in ("observation_space", "action_space")}
    with _as_mismatch(f"'{model}' does not tell what it sees and does", "give"):
        loaded = json_to_data(json.dumps(wanted))
    return loaded["observation_space"], loaded["action_space"]


def check_spaces(
    model: Path,
    saved: tuple[spaces.Space[Any], spaces.Space[Any]],
    env: gym.Env[Any, Any],
) -> None:
    """
    Make sure that a model fits an environment.

    :param model: the file, for the message
    :param saved: what the model sees and does
    :param env: that it is to drive
    :raises ModelMismatch: if the layouts differ
    """
    given = (env.observation_space, env.action_space)
    for what, has, needs in zip(("observations", "actions"), saved, given, strict=True):
        if has == needs:
            continue
        record = training_record(model)
        hint = f" (it was trained on {record.env_id})" if record.env_id else ""
        name = env.spec.id if env.spec else "the environment"
        raise ModelMismatch(
            f"'{model}'{hint} has {what} {_layout(has)}, but {name} has {_layout(needs)}; give the "
            "--env that it was trained on, or train a model for this one: sb3-torcs train "
            f"--env {name}"
        )


def check_resumable(model: Path, env: gym.Env[Any, Any], algo: str, n_envs: int) -> bool:
    """
    Make sure that a training can go on from a model.

    :param model: the file; its memory and its record lie beside it
    :param env: that the training is to go on in
    :param algo: that is to learn, as the zoo calls it
    :param n_envs: number of environments in which it is to learn
    :return: whether there is a memory to go on with
    :raises ModelMismatch: if they do not belong together
    """
    from stable_baselines3.common.save_util import load_from_pkl

    data = _saved_data(model)
    check_spaces(model, saved_spaces(model), env)
    record = training_record(model)
    saved = record.algo or _told_algorithm(data)
    if saved is not None and SAVED_AS.get(saved, saved) != SAVED_AS.get(algo, algo):
        raise ModelMismatch(f"'{model}' is a model of {saved}, not of {algo}; give --algo {saved}")
    seen, angles = record.env_kwargs.get("range_finders", "scr"), "range_finder_angles"
    sees = env.get_wrapper_attr(angles) if env.has_wrapper_attr(angles) else None
    if record.env_id and sees is not None and not np.allclose(range_finder_angles(seen), sees):
        raise ModelMismatch(
            f"'{model}' has learned with range_finders {seen!r}, and would go on with others; give "
            "the --env, --entry or --conf-file of before"
        )
    memory = model.parent / "replay_buffer.pkl"
    if not memory.is_file():
        return False
    said = f"'{memory}' is no memory that can be gone on with"
    with _as_mismatch(said, "remove it, or give"), memory.open("rb") as file:
        buffer = load_from_pkl(file)
        if buffer.n_envs != n_envs:
            raise ValueError(f"of {buffer.n_envs} cars at once, not {n_envs}")
    return True


def _layout(space: spaces.Space[Any]) -> str:
    """Say in a few words what a space is."""
    if isinstance(space, spaces.Box):
        low, high = float(np.min(space.low)), float(np.max(space.high))
        return f"{space.shape} {space.dtype} within [{low:g}, {high:g}]"
    return str(space)


def load_driver(path: str | Path, env: gym.Env[Any, Any], algo: str | None = None) -> Any:
    """
    Load what is to drive.

    :param path: of a saved model or its run's folder, or ``"scripted"``
    :param env: that it is to drive
    :param algo: as the zoo calls it; ``None`` finds out
    :return: something with ``predict(observation, deterministic=...)``
    :raises InvalidOption: if there is no such file or algorithm
    :raises ModelMismatch: if the file is no model, or one for another environment
    """
    if str(path) == SCRIPTED:
        return _scripted(env)
    from stable_baselines3.common.vec_env import VecNormalize

    model_file = find_model(path)
    data = _saved_data(model_file)
    check_spaces(model_file, saved_spaces(model_file), env)
    record = training_record(model_file)
    name, algorithm = _algorithm(algo or record.algo, data, model_file)
    # On the CPU: for one decision at a time it is the fastest, and it is always there. The
    # schedules are of no use to a driver, and the saved ones may be from another version.
    # Nor is a memory: SB3 warns of the class that it chose itself for returns over several steps.
    kwargs = {"device": "cpu", "buffer_size": 1, "replay_buffer_class": None}
    with _as_mismatch(f"'{model_file}' does not load as {name}", "give an --algo that fits, or"):
        model = algorithm.load(io.BytesIO(model_file.read_bytes()), **kwargs)
    if record.statistics is None:
        return Driver(model)
    with _as_mismatch(f"'{record.statistics}' holds no statistics of VecNormalize", "give"):
        statistics = pickle.loads(record.statistics.read_bytes())
        if not isinstance(statistics, VecNormalize):
            raise TypeError(f"a {type(statistics).__name__}")
    return Driver(model, statistics)


def _scripted(env: gym.Env[Any, Any]) -> Any:
    """Let the driver without a network see what it is made for."""
    angles = env.get_wrapper_attr("range_finder_angles")
    if not np.allclose(angles, range_finder_angles("scr")):
        raise InvalidOption(
            f"the scripted driver looks around with range_finders 'scr', not with "
            f"{np.degrees(angles).round(3).tolist()}; leave --range-finders out"
        )
    return ScriptedDriver()


@contextlib.contextmanager
def _as_mismatch(what: str, hint: str) -> Iterator[None]:
    """Tell a file that is not what it should be: SB3 and pickle raise whatever comes of it."""
    try:
        yield
    except Exception as error:
        raise ModelMismatch(
            f"{what} ({type(error).__name__}: {error}); {hint} a model that is whole"
        ) from error


def _told_algorithm(data: dict[str, Any]) -> str | None:
    """Find out the algorithm of a model by what it saved."""
    if "recurrent" in str(data.get("policy_class")).lower():
        return "ppo_lstm"
    return next((algo for key, algo in TELLING_KEYS if key in data), None)


def _algorithm(name: str | None, data: dict[str, Any], model: Path) -> tuple[str, Any]:
    """Find the algorithm of a saved model: its name and its class."""
    from rl_zoo3.utils import ALGOS

    name = name or _told_algorithm(data)
    if name is None:
        raise ModelMismatch(f"'{model}' does not tell its algorithm; say it: --algo ddpg")
    if name not in ALGOS:
        raise InvalidOption(
            f"the RL Zoo has no algorithm '{name}'{near_miss(name, ALGOS)} it has: "
            f"{', '.join(sorted(ALGOS))}"
        )
    return name, ALGOS[name]
