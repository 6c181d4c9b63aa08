"""The line that a model drives: where it was, how fast, and a picture of it."""

from __future__ import annotations

import tempfile
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_torcs.agents.rollout import drive
from sb3_torcs.car import CarState
from sb3_torcs.tracks.track import Track

__all__ = ["DrivenLine", "LineRecorder", "drive_lap", "line_image"]


class DrivenLine(NamedTuple):
    """The line that a car drove, one row per timestep."""

    track: Track
    x: npt.NDArray[np.float64]  # (n,) [m] in the track's frame
    y: npt.NDArray[np.float64]  # (n,) [m]
    speed: npt.NDArray[np.float64]  # (n,) [m/s] along the car
    distance: float  # [m] along the road
    lap_time: float | None  # [s] of the lap; None if it was not completed


class _FirstOf:
    """
    The first environment of a vector, for :func:`~sb3_torcs.agents.rollout.drive`.

    The model drives all environments of the vector; only what the first one does is returned.

    :param env: the vector
    :param model: drives all of them
    """

    def __init__(self, env: VecEnv, model: BaseAlgorithm) -> None:
        self._env = env
        self._model = model

    def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in each, by the generators that they have."""
        observation = self._env.reset()
        (self.track,) = self._env.get_attr("track", 0)  # at its end the next may be on another
        self._begun = np.ones(self._env.num_envs, dtype=bool)
        return observation, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step each of them; those that end begin again."""
        observation, rewards, self._begun, infos = self._env.step(action)
        return observation, rewards[0], self._begun[0], False, infos[0]

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """Choose an action for each; the state of those that have just begun is forgotten."""
        del episode_start  # of one car; each of the vector has its own
        return self._model.predict(observation, state, self._begun, deterministic)


class LineRecorder(gym.Wrapper[Any, Any, Any, Any]):
    """
    Records the line of the first lap of an episode.

    :param env: a racing environment
    """

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode and its line."""
        self._cars: list[CarState] = []
        self._lap_time: float | None = None
        return self.env.reset(**arguments)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and record where the car is."""
        result = self.env.step(action)
        if self._lap_time is None:
            self._cars.append(result[4]["car"])
            self._lap_time = result[4]["lap_time"] or None
        return result

    def line(self) -> DrivenLine:
        """Return the line of the present episode."""
        return _line(self.get_wrapper_attr("track"), self._cars, self._lap_time)


def _line(track: Track, cars: list[CarState], lap_time: float | None) -> DrivenLine:
    x, y, speed = np.array([(car.x, car.y, car.speed_x) for car in cars]).T
    return DrivenLine(track, x, y, speed, cars[-1].distance_raced, lap_time)


def drive_lap(model: BaseAlgorithm, env: VecEnv, limit: int = 1500) -> DrivenLine:
    """
    Drive one lap, deterministically.

    :param model: the driver
    :param env: racing environments; what the first one does is kept
    :param limit: timesteps after which to give up
    :return: the line of the lap, or of the part that was driven
    """
    first = _FirstOf(env, model)
    cars: list[CarState] = []
    lap_time = 0.0
    for step in islice(drive(first, first), limit):
        cars.append(step.car)
        lap_time = step.info["lap_time"]
        if lap_time:
            break
    return _line(first.track, cars, lap_time or None)


def line_image(line: DrivenLine) -> npt.NDArray[np.uint8]:
    """
    Draw a driven line, coloured by speed, over the track's outline.

    :param line: what was driven
    :return: (height, width, 3)
    """
    # Imported here because graphics take long to load.
    from matplotlib.image import imread

    from sb3_torcs.tracks.plot import plot_track

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "line.png"
        plot_track(line.track, path, line=np.column_stack([line.x, line.y]), speed=line.speed)
        pixels = imread(path)[..., :3]  # in [0, 1]
    return np.round(255.0 * pixels).astype(np.uint8)
