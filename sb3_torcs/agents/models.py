"""Find and load saved models, and check that they fit the environment."""

from __future__ import annotations

import io
import json
import os
import pickle
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_torcs.agents.ghosts import GhostDriver, check_fits, is_ghost, read_ghost
from sb3_torcs.agents.saved.algorithm import algorithm_class, check_same
from sb3_torcs.agents.saved.driver import ModelDriver
from sb3_torcs.agents.saved.file import (
    check_finite,
    find_saved,
    raise_mismatch,
    saved_data,
    saved_weights,
)
from sb3_torcs.agents.saved.policy import Spaces, build_policy
from sb3_torcs.agents.saved.record import (
    BEST_MODEL,
    DRIVEN_WITH,
    TrainingRecord,
    record_beside,
    record_within,
)
from sb3_torcs.agents.scripted import SCRIPTED, ScriptedDriver
from sb3_torcs.agents.wrapping import find_unbuildable, frames_of, normalizes, stack_space
from sb3_torcs.car import range_finder_angles
from sb3_torcs.errors import (
    BackendUnavailable,
    InvalidOption,
    ModelMismatch,
    ModelNotTrusted,
    UnknownDriver,
    near_miss,
)
from sb3_torcs.files import readable
from sb3_torcs.torcs.installation import find_game

__all__ = [
    "AGENTS",
    "ModelDriver",
    "TrainingRecord",
    "check_spaces",
    "driver_name",
    "driver_record",
    "find_model",
    "load_driver",
    "require_one",
    "saved_spaces",
    "saved_timesteps",
    "shipped_agents",
    "training_record",
]

AGENTS = Path(__file__).parent

UNTRUSTED = (
    "'{model}' cannot be driven from plain data alone: {why}. Loading the rest runs whatever code "
    "is pickled in it; if you know who made it, add --trust (from Python: trust=True)"
)


def find_model(path: str | Path, *, prefer_last: bool = False) -> Path:
    """
    Find a saved model.

    :param path: of a ``.zip`` file, with or without its suffix, or of a run's folder; or the name
        of a shipped agent, e.g. ``"ddpg-aalborg"``
    :param prefer_last: of a folder take the last model rather than the best one
    :return: the file
    :raises InvalidOption: if there is none
    :raises UnknownDriver: if nothing has this name
    """
    advice = (
        "give the .zip that a training saved, the folder of its run, or a shipped agent, which "
        "`sb3-torcs drivers` lists"
    )
    if not isinstance(path, str | Path) or not str(path).strip():  # "" is the present folder
        raise InvalidOption(f"{path!r} names no model; {advice}")
    given = find_saved(path)
    if given.is_file():
        return given
    shipped = str(path) in shipped_agents()
    if not given.is_dir() and shipped:
        given = AGENTS / str(path)
    if not given.is_dir():
        if _is_robot(str(path)):
            raise InvalidOption(
                f"'{path}' is a robot of the game, and a model is asked for; to drive the robot "
                f"type: sb3-torcs evaluate {path}"
            )
        known = [*(file.name for file in given.parent.glob("*.zip")), *shipped_agents()]
        raise UnknownDriver(f"there is no model '{given}'{near_miss(given.name, known, advice)}")
    best = given / BEST_MODEL
    last = [
        file for file in (given / f"{sub.name}.zip" for sub in given.iterdir()) if file.is_file()
    ]
    order = [*last, best] if prefer_last else [best, *last]
    for candidate in order:
        if candidate.is_file():
            return candidate
    raise InvalidOption(
        f"the folder '{given}' holds no model; give the .zip that a training saved"
        + (", or rename the folder, which hides a shipped agent" if shipped else "")
    )


def _is_robot(name: str) -> bool:
    try:
        return find_game().has_robot(name)
    except BackendUnavailable:
        return False


def shipped_agents() -> list[str]:
    """
    List the agents that come with the package.

    :return: their names
    """
    return sorted(path.parent.name for path in AGENTS.glob(f"*/{BEST_MODEL}"))


def training_record(model: Path) -> TrainingRecord:
    """
    Read the record of a model's training, from its own file or from the zoo's beside it.

    :param model: the file
    :return: what is known
    :raises ModelMismatch: if something of it cannot be read
    """
    return _record(model, saved_data(model))


def _record(model: Path, data: dict[str, Any]) -> TrainingRecord:
    return record_within(model, data) or record_beside(model) or TrainingRecord()


def driver_record(driver: str | Path) -> TrainingRecord:
    """
    Read how a driver was trained.

    :param driver: as in :func:`find_model`; a ghost's file, which says where it was driven; or
        ``"scripted"``, of whom nothing is known
    :return: what is known
    """
    if is_ghost(driver):
        return TrainingRecord(env_id="Torcs-v0", env_kwargs=read_ghost(driver).env_kwargs)
    return TrainingRecord() if str(driver) == SCRIPTED else training_record(find_model(driver))


def driver_name(driver: str | Path) -> str:
    """
    Return a driver's name for boards and tables.

    :param driver: as in :func:`find_model`, or ``"scripted"``
    :return: a shipped agent's name, e.g. ``"ddpg-aalborg"``, else that of the file; of its folder
        if the file is called as in every run
    """
    given = Path(os.path.expanduser(driver))
    if given.name == BEST_MODEL or given.name == Path(BEST_MODEL).stem:
        given = given.absolute().parent
    return readable(given.absolute().name.removesuffix(".zip").removesuffix(".npz"))


def require_one(option: str, choice: Any) -> Any:
    """
    Make sure that there is one track, or one car: a training may have had several.

    :param option: ``"track"`` or ``"car"``
    :param choice: of the record, or what was given instead
    :return: the same
    :raises InvalidOption: if it is a list
    """
    if isinstance(choice, list):
        names = list(dict.fromkeys(choice))  # one may be listed twice, to be drawn more often
        raise InvalidOption(
            f"the model was trained with {len(names)} {option}s, {', '.join(names)}; say which "
            f"one it shall drive: --{option} {choice[0]}"
        )
    return choice


def saved_timesteps(model: Path) -> int:
    """
    Return how many timesteps the last training of a model had.

    :param model: the file
    :return: ``num_timesteps``
    """
    return int(saved_data(model)["num_timesteps"])


def saved_spaces(model: Path, *, trust: bool = False) -> Spaces:
    """
    Return the spaces of a model.

    :param model: the file
    :param trust: unpickle it, if it cannot be read otherwise
    :return: the observation space and the action space
    :raises ModelNotTrusted: if it cannot be read otherwise
    """
    data = saved_data(model)
    known = _record(model, data).spaces
    if known is not None:
        return known
    if not trust:
        raise ModelNotTrusted(UNTRUSTED.format(model=model, why="it has no record of its training"))
    from stable_baselines3.common.save_util import json_to_data

    with raise_mismatch(f"'{model}' does not tell what it sees and does", "give"):
        wanted = {name: data[name] for name in ("observation_space", "action_space")}
        loaded = json_to_data(json.dumps(wanted))
        return loaded["observation_space"], loaded["action_space"]


def check_spaces(
    model: Path, saved: Spaces, env: gym.Env[Any, Any], frames: int | None = None
) -> None:
    """
    Make sure that a model fits an environment.

    :param model: the file, for the message
    :param saved: the spaces of the model
    :param env: that it is to drive
    :param frames: observations that the model is to see at once
    :raises ModelMismatch: if the layouts differ
    """
    given = (stack_space(env.observation_space, frames), env.action_space)
    for what, has, needs in zip(("observations", "actions"), saved, given, strict=True):
        if has == needs:
            continue
        record = training_record(model)
        hint = f" (it was trained on {record.env_id})" if record.env_id else ""
        name = env.spec.id if env.spec else "Torcs-v0"  # cars of one race have no spec
        advice = f"train a model for this one: sb3-torcs train --env {name}"
        if record.known:
            said = ", ".join(f"{key}={value!r}" for key, value in _task(record).items())
            advice = f"it learned with {said}; give it the same, or {advice}"
        raise ModelMismatch(
            f"'{model}'{hint} has {what} {_layout(has)}, but {name} has {_layout(needs)}; {advice}"
        )


def _task(record: TrainingRecord) -> dict[str, Any]:
    """Collect what of a training decides on the layout of observations and actions."""
    wrappers = ("env_wrapper", "frame_stack")
    found = {key: record.hyperparameters[key] for key in wrappers if key in record.hyperparameters}
    kept = record.select(DRIVEN_WITH)
    usual = {"sensors": ["base"], "action": "pedals"}  # what else may have been given here
    return {**kept, **{key: value for key, value in usual.items() if key not in kept}, **found}


def _layout(space: spaces.Space[Any]) -> str:
    """Describe a space in a few words."""
    if isinstance(space, spaces.Box):
        low, high = float(np.min(space.low)), float(np.max(space.high))
        return f"{space.shape} {space.dtype} within [{low:g}, {high:g}]"
    return str(space)


def load_driver(
    path: str | Path, env: gym.Env[Any, Any], algo: str | None = None, trust: bool = False
) -> Any:
    """
    Load a driver. No code of the file runs, unless it is trusted.

    :param path: of a saved model or its run's folder, of a ghost, or ``"scripted"``
    :param env: that it is to drive, with the wrappers of the training
    :param algo: as the zoo calls it; ``None`` finds out
    :param trust: load the model as SB3 does, which runs code that is pickled in it
    :return: something with SB3's ``predict``
    :raises InvalidOption: if there is no such file or algorithm
    :raises ModelMismatch: if the file is not a model, or is one for another environment
    :raises ModelNotTrusted: if the model needs more than plain data and known classes
    """
    if str(path) == SCRIPTED:
        return _make_scripted(env)
    if is_ghost(path):
        ghost = read_ghost(path)
        check_fits(ghost, env, path)
        return GhostDriver(ghost)
    file = find_model(path)
    data = saved_data(file)
    record = _record(file, data)
    reason = find_unbuildable(record.hyperparameters)
    if reason is not None:
        raise ModelMismatch(f"'{file}' cannot be driven as it was trained: {reason}")
    frames = frames_of(record.hyperparameters)
    seen = saved_spaces(file, trust=trust)
    check_spaces(file, seen, env, frames)
    if algo is not None:
        check_same(file, record.algo, algo)
    model = _as_sb3_does(file, algo or record.algo) if trust else _policy(file, record, seen)
    return ModelDriver(model, _statistics(file, record, trust), frames)


def _policy(file: Path, record: TrainingRecord, seen: Spaces) -> Any:
    """Build the policy that a record describes, with its weights."""
    if record.policy is None:
        raise ModelNotTrusted(UNTRUSTED.format(model=file, why="it has no record of its training"))
    weights = saved_weights(file)
    with raise_mismatch(f"'{file}' does not load", "give"):
        try:
            policy = build_policy(record.policy, seen)
        except ModelNotTrusted as error:
            raise ModelNotTrusted(UNTRUSTED.format(model=file, why=error)) from None
        policy.load_state_dict(weights)
        return policy


def _as_sb3_does(file: Path, algo: str | None) -> Any:
    """Load a model with everything that is pickled in it."""
    if algo is None:
        raise ModelMismatch(f"'{file}' does not say its algorithm; give it, e.g. --algo ddpg")
    algorithm = algorithm_class(algo)
    # On the CPU, which is always available, and the fastest for single timesteps. A driver does not
    # need the schedules, which may be from another version, nor a replay buffer, about whose class
    # SB3 would warn after a training with returns over several timesteps.
    kwargs = {"device": "cpu", "buffer_size": 1, "replay_buffer_class": None}
    with raise_mismatch(f"'{file}' does not load as {algo}", "give an --algo that fits, or"):
        model = algorithm.load(io.BytesIO(file.read_bytes()), **kwargs)
        check_finite(file, model.policy.state_dict())
        return model


def _statistics(file: Path, record: TrainingRecord, trust: bool) -> Any:
    """Find the statistics of a model that learned from normalized observations."""
    from stable_baselines3.common.vec_env import VecNormalize

    if record.statistics is not None:
        return record.statistics
    if record.statistics_file is None:
        if normalizes(record.hyperparameters.get("normalize")):
            raise ModelMismatch(
                f"'{file}' has learned from normalized observations, and their statistics are not "
                "there; put the vecnormalize.pkl of its training beside its config.yml"
            )
        return None
    if not trust:
        why = f"its statistics, '{record.statistics_file}', are pickled"
        raise ModelNotTrusted(UNTRUSTED.format(model=file, why=why))
    with raise_mismatch(f"'{record.statistics_file}' holds no statistics of VecNormalize", "give"):
        statistics = pickle.loads(record.statistics_file.read_bytes())
        if not isinstance(statistics, VecNormalize):
            raise TypeError(f"a {type(statistics).__name__}")
        return statistics


def _make_scripted(env: gym.Env[Any, Any]) -> Any:
    """Make the scripted driver, and check that its range finders are those of SCR."""
    angles = env.get_wrapper_attr("range_finder_angles")
    if not np.allclose(angles, range_finder_angles("scr")):
        raise InvalidOption(
            f"the scripted driver looks around with range_finders 'scr', not with "
            f"{np.degrees(angles).round(3).tolist()}; leave --range-finders out"
        )
    return ScriptedDriver(env.get_wrapper_attr("action"))
