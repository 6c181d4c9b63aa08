"""Ghosts: drives that are kept as their actions, and drive again, to the bit, as any driver."""

from __future__ import annotations

import json
import os
import tokenize
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from sb3_torcs.agents.rollout import Timestep, drive
from sb3_torcs.agents.saved.file import BROKEN
from sb3_torcs.envs.aids import Aids
from sb3_torcs.errors import InvalidOption, ModelMismatch, near_miss
from sb3_torcs.files import atomic_file, writable_file
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.track_names import find_track
from sb3_torcs.tracks.catalogue import load_track

__all__ = [
    "Demonstration",
    "Ghost",
    "GhostDriver",
    "check_fits",
    "check_laps",
    "demonstration",
    "is_ghost",
    "read_ghost",
    "shipped_ghosts",
]

SUFFIX = ".npz"
SHIPPED = Path(__file__).parents[1] / "data" / "ghosts"
VERSION = 1
WORLD = "Torcs-v0"
MAX_SIZE = 2**24  # [bytes] of a ghost's file, and of what is in it
AFTERWARDS = -0.3  # [-] the pedal of a ghost that has no actions left: it brakes

FloatArray = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Ghost:
    """
    A drive from the grid, kept as its actions.

    :param env_kwargs: of the ``Torcs-v0`` that it was driven in, track, car and laps among them
    :param actions: (timesteps, numbers of the action)
    :param lap_times: of its whole laps [s], the first one from the grid
    :param agent: in whose environment it was searched
    :param start: whose drive the search began with: the agent's, or a robot's
    :param rollouts: candidates that were driven to find it
    """

    env_kwargs: Mapping[str, Any]
    actions: FloatArray
    lap_times: tuple[float, ...]
    agent: str
    start: str
    rollouts: int

    def make_env(self) -> gym.Env[Any, Any]:
        """Make the environment in which the actions give this drive."""
        return gym.make(
            f"sb3_torcs:{WORLD}", max_episode_steps=len(self.actions) + 1, **self.env_kwargs
        )

    def drive(self) -> Iterator[Timestep]:
        """
        Drive again.

        :return: the timesteps, one by one
        """
        env = self.make_env()
        try:
            yield from drive(env, GhostDriver(self), seed=0)
        finally:
            env.close()

    def write(self, path: str | Path) -> Path:
        """
        Write the ghost to a file, whole or not at all.

        :param path: ending in ``.npz``
        :return: the file
        :raises OutputNotWritable: if that cannot be done
        """
        file = writable_file(path, (SUFFIX,))
        record = {
            "version": VERSION,
            "env_kwargs": dict(self.env_kwargs),
            "lap_times": list(self.lap_times),
            "agent": self.agent,
            "start": self.start,
            "rollouts": self.rollouts,
        }
        with atomic_file(file) as aside, aside.open("wb") as output:
            np.savez_compressed(output, actions=self.actions, record=np.array(json.dumps(record)))
        return file


def is_ghost(driver: str | Path) -> bool:
    """
    Tell by its name whether a driver is a ghost.

    :param driver: a path, or the name of any driver
    """
    return str(driver).lower().endswith(SUFFIX) or str(driver) in shipped_ghosts()


def shipped_ghosts() -> list[str]:
    """List the ghosts that come with the package."""
    return sorted(path.stem for path in SHIPPED.glob(f"*{SUFFIX}"))


def read_ghost(path: str | Path) -> Ghost:
    """
    Read a ghost. Nothing is unpickled.

    :param path: of the file, or the name of a shipped ghost, e.g. ``"ghost-aalborg"``
    :raises InvalidOption: if there is no such file
    :raises ModelMismatch: if it is not a ghost
    """
    shipped = SHIPPED / f"{path}{SUFFIX}"
    file = shipped if str(path) in shipped_ghosts() else Path(os.path.expanduser(path))
    if not file.is_file():
        hint = near_miss(file.name, shipped_ghosts(), "`sb3-torcs optimize-lap` makes one")
        raise InvalidOption(f"there is no ghost '{file}'{hint}")
    try:
        _check_size(file)
        with np.load(file, allow_pickle=False) as content:
            actions, record = content["actions"], json.loads(str(content["record"]))
        return _ghost(actions, record)
    except (*BROKEN, OverflowError, SyntaxError, tokenize.TokenError) as error:
        raise ModelMismatch(
            f"'{file}' is not a ghost ({error}); give one that `sb3-torcs optimize-lap` wrote"
        ) from error


def _check_size(file: Path) -> None:
    with zipfile.ZipFile(file) as archive:
        size = sum(item.file_size for item in archive.infolist())
    if size > MAX_SIZE:
        raise ValueError(f"it would take {size} bytes of memory; at most {MAX_SIZE} are read")


def _ghost(actions: npt.NDArray[Any], record: Any) -> Ghost:
    """Check what a file holds."""
    if not isinstance(record, dict) or record.get("version") != VERSION:
        raise ValueError(f"its version is not {VERSION}")
    kwargs = record["env_kwargs"]
    if not isinstance(kwargs, dict) or not {"track", "car", "action_repeat", "laps"} <= set(kwargs):
        raise ValueError("it does not say track, car, action repeat and laps")
    if actions.dtype != np.float32 or actions.ndim != 2 or not len(actions):
        raise ValueError(f"its actions are {actions.dtype}, {actions.shape}")
    if not np.isfinite(actions).all():
        raise ValueError("an action is not finite")
    times = tuple(float(time) for time in record["lap_times"])
    agent, start = str(record["agent"]), str(record["start"])
    return Ghost(kwargs, actions, times, agent, start, int(record["rollouts"]))


class GhostDriver:
    """
    Drives as a ghost did. It goes by the count of timesteps and looks at nothing.

    After its last action it brakes.

    :param ghost: whose actions
    """

    def __init__(self, ghost: Ghost) -> None:
        self.ghost = ghost

    def predict(
        self,
        observation: npt.NDArray[np.float32],
        state: int | None = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[FloatArray, int]:
        """
        Give the next action.

        :param observation: unused, but for its shape: (n,), or (cars, n)
        :param state: timesteps driven; ``None`` begins
        :param episode_start: (1,) whether an episode begins here
        :param deterministic: unused; it always is
        :return: the action, and the state for the next call
        """
        del deterministic
        begins = state is None or (episode_start is not None and bool(np.any(episode_start)))
        step = 0 if begins or state is None else state
        actions = self.ghost.actions
        if step < len(actions):
            action, step = actions[step], step + 1
        else:
            brake = [0.0, AFTERWARDS] if actions.shape[1] == 2 else [0.0, 0.0, -AFTERWARDS]
            action = np.array(brake, np.float32)
        return np.broadcast_to(action, (*np.shape(observation)[:-1], action.size)), step


USUAL: Mapping[str, Any] = {
    "action": "pedals", "gearbox": "automatic", "start": "grid", "opponents": (), "aids": (),
    "delay": 0, "grip": 1.0, "mass": 1.0,
}  # fmt: skip
"""Options that change a drive, and their usual values."""


def check_fits(ghost: Ghost, env: gym.Env[Any, Any], name: str | Path) -> None:
    """
    Make sure that an environment is the one that a ghost was driven in.

    :param ghost: that is to drive
    :param env: a racing environment
    :param name: of the ghost, for the message
    :raises ModelMismatch: if the drive would be another one
    """
    if env.spec is not None and env.spec.id != WORLD:
        raise ModelMismatch(
            f"the ghost '{name}' was driven in {WORLD}, not in {env.spec.id}: give --env {WORLD}"
        )
    backend = env.get_wrapper_attr("backend")
    has = {
        **USUAL,
        **(env.spec.kwargs if env.spec is not None else {}),  # cars of one race have none
        **env.get_wrapper_attr("conditions").choice,
        "car": backend.car,
        "action_repeat": env.get_wrapper_attr("action_repeat"),
        "action": env.get_wrapper_attr("action"),
        "aids": env.get_wrapper_attr("aids").names,
    }
    needs = {**USUAL, **ghost.env_kwargs, **(ghost.env_kwargs.get("conditions") or {})}
    needs["aids"] = Aids.of(needs["aids"]).names
    own_track = load_track(find_track(needs["track"], find_game()))
    needs["track"], has["track"] = own_track.name, backend.track.name
    if needs["track"] == has["track"]:  # which two roads may have
        needs["track"], has["track"] = str(own_track.file), str(backend.track.file)
    for what in ("track", "car", "action_repeat", *USUAL):
        value = needs[what] or USUAL.get(what)  # no opponents may be None, [] or ()
        if (has[what] or USUAL.get(what)) != value:
            raise ModelMismatch(
                f"the ghost '{name}' was driven with {what} {value!r}, not {has[what]!r}: its "
                "actions fit no other race; search one there: sb3-torcs optimize-lap"
            )
    check_laps(ghost, env.get_wrapper_attr("laps"), name)


def check_laps(ghost: Ghost, laps: int | None, name: str | Path) -> None:
    """
    Make sure that a ghost has enough laps.

    :param ghost: that is to drive
    :param laps: to drive; ``None`` drives as many as there are
    :param name: of the ghost, for the message
    :raises ModelMismatch: if it has fewer
    """
    driven = ghost.env_kwargs.get("laps")
    if laps is not None and driven is not None and laps > driven:
        raise ModelMismatch(
            f"the ghost '{name}' drove {driven} laps, so it cannot drive {laps}; ask for no more"
        )


class Demonstration(NamedTuple):
    """A drive as it would lie in a replay buffer, one row per timestep."""

    observations: FloatArray  # (n, numbers of the observation)
    next_observations: FloatArray
    actions: FloatArray  # (n, numbers of the action)
    rewards: FloatArray  # (n,)
    terminated: npt.NDArray[np.bool_]  # (n,) left the road and such; a ghost never does
    truncated: npt.NDArray[np.bool_]  # (n,) the last is: all laps are driven


def demonstration(ghost: Ghost) -> Demonstration:
    """
    Drive a ghost again, and return what an agent would have seen and been rewarded for.

    :param ghost: that drives, in its own environment
    """
    steps = list(ghost.drive())
    return Demonstration(
        np.array([step.observation for step in steps], np.float32),
        np.array([step.next_observation for step in steps], np.float32),
        np.array([step.action for step in steps], np.float32),
        np.array([step.reward for step in steps], np.float32),
        np.array([step.terminated for step in steps]),
        np.array([step.truncated for step in steps]),
    )
