"""A record of the drives of an evaluation: the best lap as a video and as a line on the map."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from sb3_torcs.car import RESTING, CarState, Controls
from sb3_torcs.evaluation.ticks import TickedWorld
from sb3_torcs.telemetry import CONTROL_FIELDS, STATE_FIELDS, write_telemetry
from sb3_torcs.tracks.track import Track

__all__ = ["Recorded", "Recorder", "Stretch", "best_stretch"]

VIDEO_TICKS = 2  # control ticks per frame: 25 frames per second, in real time
VIDEO_FPS = 25


class Recorded(NamedTuple):
    """One timestep of a recorded drive."""

    action: npt.NDArray[np.float32]
    car: CarState
    lap_time: float  # [s] if it completed a lap, else 0
    controls: Controls = RESTING  # that the action stands for


class Stretch(NamedTuple):
    """A range of timesteps of an episode."""

    episode: int
    first: int
    last: int  # exclusive


def best_stretch(episodes: list[list[Recorded]]) -> Stretch:
    """
    Find the fastest whole lap, or the longest drive if there is none.

    :param episodes: of an evaluation, each with at least one timestep
    :return: where it is
    """
    best, best_time = None, float("inf")
    for number, timesteps in enumerate(episodes):
        first = 0
        for index, timestep in enumerate(timesteps):
            if not timestep.lap_time:
                continue
            if timestep.lap_time < best_time:
                best, best_time = Stretch(number, first, index + 1), timestep.lap_time
            first = index + 1
    if best is not None:
        return best
    farthest = max(range(len(episodes)), key=lambda n: episodes[n][-1].car.distance_raced)
    return Stretch(farthest, 0, len(episodes[farthest]))


class Recorder(gym.Wrapper[Any, Any, Any, Any]):
    """
    An environment that records the drives of an evaluation.

    :param env_id: a registered environment
    :param kwargs: of the environment
    :param max_episode_steps: timesteps after which an episode is truncated
    """

    def __init__(self, env_id: str, kwargs: dict[str, Any], max_episode_steps: int) -> None:
        self.env_id = env_id
        self.episodes: list[list[Recorded]] = []
        self._tracks: list[Track] = []  # of the episodes
        self._kwargs = kwargs
        self._limit = max_episode_steps
        self._resets: list[dict[str, Any]] = []  # what began the episodes
        super().__init__(gym.make(env_id, max_episode_steps=max_episode_steps, **kwargs))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """
        Begin an episode, as ``gymnasium.Env.reset``.

        :param seed: of the environment's generator
        :param options: of the environment
        :return: observation and info
        """
        begun = self.env.reset(seed=seed, options=options)
        self.episodes.append([])
        self._resets.append({"seed": seed, "options": options})
        self._tracks.append(self.get_wrapper_attr("backend").track)
        return begun

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """
        Do one timestep, as ``gymnasium.Env.step``.

        :param action: of the driver
        :return: observation, reward, terminated, truncated, info
        """
        result = self.env.step(action)
        info = result[4]
        controls = self.get_wrapper_attr("controls")
        self.episodes[-1].append(Recorded(action, info["car"], info["lap_time"], controls))
        return result

    def names(self) -> dict[str, str]:
        """Return the track's and the car's names."""
        backend = self.get_wrapper_attr("backend")
        return {"track": backend.track.name, "car": backend.car}

    def write(self, path: Path, driver: str) -> None:
        """
        Write the drives to a table like those of robots; the index is the episode, from 1.

        :param path: of the CSV file
        :param driver: its name
        """
        state, controls = len(STATE_FIELDS), len(CONTROL_FIELDS)
        write_telemetry(
            path,
            (
                (driver, number, *timestep.car[:state], *timestep.controls[:controls])
                for number, timesteps in enumerate(self.episodes, 1)
                for timestep in timesteps
            ),
        )

    def draw_line(self, path: Path) -> None:
        """
        Draw the line of the best lap, coloured by speed.

        :param path: of the picture
        """
        from sb3_torcs.tracks.plot import plot_track

        stretch = best_stretch(self.episodes)
        cars = [d.car for d in self.episodes[stretch.episode][stretch.first : stretch.last]]
        line = np.array([(car.x, car.y) for car in cars])
        speed = np.array([car.speed_x for car in cars])
        plot_track(self._tracks[stretch.episode], path, line=line, speed=speed)

    def save_video(self, path: Path) -> None:
        """
        Record the best lap from above, in real time.

        :param path: of the video
        """
        from sb3_torcs.rendering.encoder import write_video

        stretch = best_stretch(self.episodes)
        repeat = self.get_wrapper_attr("action_repeat")
        total = (stretch.last - stretch.first) * repeat // VIDEO_TICKS
        write_video(path, self._frames(stretch, repeat), VIDEO_FPS, total=total)

    def _frames(self, stretch: Stretch, repeat: int) -> Iterator[npt.NDArray[np.uint8]]:
        """Drive the episode again, and render the stretch: some frames of each timestep."""
        timesteps = self.episodes[stretch.episode]
        with self._again(stretch.episode) as env:
            racing: Any = env.unwrapped
            ticks = itertools.count(1)
            frames: list[npt.NDArray[np.uint8]] = []

            def show(car: CarState, controls: Controls) -> None:
                del controls  # the picture has those of the timestep
                tick = next(ticks)
                if tick > stretch.first * repeat and tick % VIDEO_TICKS == 0:
                    before, racing.car = racing.car, car  # within a timestep, for the picture
                    frames.append(racing.render())
                    racing.car = before

            racing.backend = TickedWorld(racing.backend, show)
            for timestep in timesteps[: stretch.last]:
                env.step(timestep.action)
                yield from frames
                frames.clear()

    def _again(self, episode: int) -> gym.Env[Any, Any]:
        """Build the environment anew with pictures, at the beginning of an episode."""
        kwargs = {**self._kwargs, "render_mode": "rgb_array"}
        env = gym.make(self.env_id, max_episode_steps=self._limit + 1, **kwargs)
        for begun in self._resets[: episode + 1]:  # each reset draws from the same generator
            env.reset(**begun)
        return env
