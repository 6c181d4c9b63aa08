"""The loop of all racing environments: reset, step, the end of an episode."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Unpack, get_args

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_torcs.actions import ActionName, action_layout, controls_from_action
from sb3_torcs.backends.base import Backend, optional
from sb3_torcs.car import (
    CONTROL_TICK,
    CarState,
    Controls,
    FloatArray,
    StartName,
    checked_hard_starts,
    checked_start,
    checked_start_speed,
    controls_from_record,
)
from sb3_torcs.envs.aids import NEED_RIVALS, Aids, help_cars
from sb3_torcs.envs.arguments import read_options, takes_options
from sb3_torcs.envs.conditions import Conditions, hold_controls
from sb3_torcs.envs.ends import GRACE_TICKS, LOST, REASONS, STUCK_TICKS, TRUNCATING, end_episodes
from sb3_torcs.envs.episode import (
    RULES,
    Episodes,
    begin_episode,
    car_of,
    copy_of,
    new_episodes,
    numbers_of,
)
from sb3_torcs.envs.info import racing_info
from sb3_torcs.envs.options import AIDS, RACING, RacingOptions, RenderMode
from sb3_torcs.envs.starts import Starts, read_start
from sb3_torcs.errors import CarLost, EnvClosed, InvalidOption, StartBlocked
from sb3_torcs.rewards import CRASHES, Reward, RewardChoice, Rewards
from sb3_torcs.sensors import NEEDS_CAR, NEEDS_RACE, NEEDS_ROAD, Eyes, SensorsName, View
from sb3_torcs.tracks.track import Track

__all__ = ["Observation", "RacingEnv", "RenderMode"]

Observation = npt.NDArray[np.float32]


def _check_tells(world: Backend, view: View, aids: Aids) -> None:
    """Refuse what needs a race, a road or a car's file, in a world that does not know of it."""
    lacking = sorted(NEEDS_RACE.intersection(view.sensors))
    lacking += [name for name in NEED_RIVALS if getattr(aids, name)]
    if lacking and not optional(world, "tells_race"):
        raise InvalidOption(
            "this world does not tell of other cars, which is needed for "
            f"{' and '.join(map(repr, lacking))}; use Torcs-v0 with backend 'native', or on the "
            "command line `sb3-torcs race`, which also makes videos"
        )
    untold = sorted(NEEDS_CAR.intersection(view.sensors))
    if untold and optional(world, "facts") is None:
        raise InvalidOption(
            f"sensors {' and '.join(map(repr, untold))} are of the car's file in the game, which "
            "this world does not read; leave them out, or use backend 'native' of Torcs-v0"
        )
    unseen = sorted(NEEDS_ROAD.intersection(view.sensors))
    if unseen and not optional(world, "knows_road"):
        raise InvalidOption(
            f"sensors {' and '.join(map(repr, unseen))} need the track of the race, and track is "
            "None; name it"
        )


@takes_options(RACING)
class RacingEnv(gym.Env[Observation, npt.NDArray[np.float32]]):
    """
    A car on a track, driven by steering and pedals.

    :param backend: the world
    :raises InvalidOption: if an option has a value that is not allowed
    """

    metadata: dict[str, Any] = {"render_modes": [*get_args(RenderMode)], "render_fps": 10.0}  # noqa: RUF012

    def __init__(self, backend: Backend, **options: Unpack[RacingOptions]) -> None:
        given = read_options("RacingEnv.__init__", RACING, options)
        render_mode = given["render_mode"]
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            modes = ", ".join(repr(mode) for mode in self.metadata["render_modes"])
            raise InvalidOption(f"render_mode is {render_mode!r}; expected None or one of {modes}")
        self.backend = backend
        self._draw_track = optional(backend, "draw_track")
        self.action_repeat: int = given["action_repeat"]
        self.laps: int | None = given["laps"]
        self.runoff: float = given["ends"]["runoff"]
        self.recovery_ticks = round(given["ends"]["recovery"] / CONTROL_TICK)
        self.aids = Aids.of(given["aids"])
        self.render_mode = render_mode
        self.metadata = {
            **self.metadata,
            "render_fps": 1.0 / (self.action_repeat * CONTROL_TICK),
        }
        self.view = View(given["sensors"])
        _check_tells(backend, self.view, self.aids)
        self.observation_space = spaces.Box(self.view.low, self.view.high, dtype=np.float32)
        self.action: ActionName = given["action"]
        self.layout = action_layout(self.action, optional(backend, "gears"))
        self.action_space = spaces.Box(
            np.array(self.layout.low, np.float32), np.array(self.layout.high, np.float32)
        )
        self.set_reward(given["reward"])
        self._starts = Starts(given["start"])
        self.conditions = Conditions(given["conditions"])
        self.conditions.check(backend)
        self.episode: Episodes = new_episodes(1)
        """The state of the episode, an array of one record."""
        self.rules: Episodes = np.zeros(1, RULES)
        """What stays the same all through the episode, an array of one record."""
        self._eyes = Eyes(self.view, 1)
        self._begun = self._closed = False
        self._viewer: Any = None
        self.warns_after_end = True
        """Whether the next step after the end of an episode is worth a warning."""

    def __getstate__(self) -> dict[str, Any]:
        # pygame's surfaces cannot be pickled; and the eyes look at what a copied world makes.
        return {**self.__dict__, "_viewer": None, "_eyes": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._eyes = Eyes(self.view, 1)
        if self._begun:
            self._eyes.open(0, self.backend)

    @property
    def track(self) -> Track:
        """The track of the present episode."""
        return self.backend.track

    @property
    def sensors(self) -> tuple[SensorsName, ...]:
        """Names of the groups of sensors in an observation."""
        return self.view.sensors

    @property
    def car(self) -> CarState | None:
        """The car now; ``None`` before the first reset."""
        return car_of(self.episode) if self._begun else None

    @property
    def controls(self) -> Controls:
        """What the driver asked for in the last timestep, after the aids have changed it.

        With a delay, earlier controls were held meanwhile.
        """
        return controls_from_record(self.episode["controls"][0])

    @property
    def range_finder_angles(self) -> FloatArray:
        """Angles of the range finders [rad], (19,), left negative."""
        return self.backend.range_finder_angles

    def set_reward(self, reward: RewardChoice) -> RewardChoice | None:
        """
        Change the reward from the next timestep on.

        :param reward: as in the constructor
        :return: the previous reward
        """
        previous = getattr(self, "_reward_choice", None)
        self.reward = Reward(reward)
        self._rewards = Rewards([self.reward])
        self._reward_choice = reward
        return previous

    def set_start(self, start: StartName) -> StartName:
        """
        Change the start of episodes from the next reset on.

        :param start: ``"grid"`` or ``"random"``
        :return: the previous start
        """
        previous, self._starts.start = self._starts.start, checked_start(start)
        return previous

    def set_random_speed(self, speed: float) -> float:
        """
        Change the highest speed of random starts from the next reset on.

        :param speed: highest speed [m/s]
        :return: the previous one
        """
        previous, self._starts.speed = self._starts.speed, checked_start_speed(speed)
        return previous

    def set_hard_starts(self, share: float) -> float:
        """
        Let random starts of the next resets begin where this environment's episodes end badly.

        :param share: of random starts that lie 20 to 300 m before a place where one of the last 32
            such episodes of the track ended, at a speed that can be lost on the way there [0 to 1]
        :return: the previous one
        """
        previous, self._starts.hard = self._starts.hard, checked_hard_starts(share)
        return previous

    def mishaps(self) -> dict[str, list[float]]:
        """Return where the latest episodes ended badly, by track [m from the start line]."""
        return {track: list(places) for track, places in self._starts.mishaps.items()}

    def set_mishaps(self, mishaps: Mapping[str, Sequence[float]]) -> None:
        """
        Let hard starts go on from what another environment has met.

        :param mishaps: from :meth:`mishaps` of that one
        """
        self._starts.set_mishaps(mishaps)

    def set_conditions(self, choice: Mapping[str, Any]) -> dict[str, Any]:
        """
        Change the conditions from the next reset on.

        :param choice: those that change, by name, as in the constructor
        :return: all of them before
        """
        conditions = self.conditions.instead(choice)
        conditions.check(self.backend)
        previous, self.conditions = self.conditions.choice, conditions
        return previous

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """
        Begin an episode.

        :param seed: of the random numbers of this and the following episodes
        :param options: where to start: ``distance`` [m] along the road, ``track_position``
            [-1 to 1], ``heading_error`` [rad] and ``speed`` [m/s]; what is left out is 0
        :return: the observation and ``info``
        """
        if self._closed:
            raise EnvClosed("reset after close; make a new environment")
        is_given = self.check_start(options)  # a wrong one leaves the episode as it is
        super().reset(seed=seed)
        self._begun = False  # if the reset fails, no step is possible
        if self._draw_track is not None:
            self._draw_track(self.np_random)
        start = (
            read_start(options, self.track.length)  # of the track of this episode
            if is_given
            else self._starts.draw(self.np_random, self.track)
        )
        self._late = self.conditions.draw(self.np_random, self.backend)
        aids = [getattr(self.aids, name) for name in AIDS]
        laps = math.inf if self.laps is None else self.laps
        self.rules[0] = laps, self.runoff, self.recovery_ticks, self.action_repeat, *aids
        self._helps = any(aids)
        self._eyes.open(0, self.backend)
        self._compile()
        try:
            car = self.backend.reset(self.np_random, start)
        except StartBlocked:
            if start is None or is_given:
                raise
            # A wall stands where a start was drawn: rare, but a training draws thousands.
            start = None
            car = self.backend.reset(self.np_random, start)
        grace = STUCK_TICKS if start is not None and start.speed > 0.0 else GRACE_TICKS
        begin_episode(self.episode, car, self._late, max(grace, self.recovery_ticks))
        self._begun = True
        if self.render_mode == "human":
            self.render()
        nothing = self.reward.explain([0.0] * len(self.reward.names), None)
        return self._eyes.see(self.episode)[0], racing_info(car, 0.0, nothing, None)

    def _compile(self) -> None:
        """Call what a step calls: a game over the network does not wait for a compiler."""
        episode = new_episodes(1)
        numbers_of(episode)[:] = 1.0
        if self._helps:
            help_cars(episode, self.rules)
        if self._late:
            hold_controls(episode, self.rules, np.empty((2, 1, 5)), np.empty((2, 1), np.int64))
        end_episodes(episode, self.rules)
        self._rewards.value(episode, episode, [False])
        self._eyes.see(episode)

    def check_start(self, options: dict[str, Any] | None) -> bool:
        """
        Check the options of a reset, which are for the track of now.

        :param options: as of ``reset``
        :return: whether they name a place
        :raises InvalidOption: if a name or a value is wrong
        """
        if options is None or (isinstance(options, Mapping) and not options):
            return False
        read_start(options, self.track.length)
        return True

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """
        Hold an action for ``action_repeat`` control ticks.

        :param action: as the layout says; of ``"pedals"``: steering [-1, 1], throttle [0, 1] and
            brake [0, 1]
        :return: observation, reward, terminated, truncated, info
        :raises InvalidAction: if the action has another shape or is not a number
        """
        self.check_ready()
        before, episode = self.episode, copy_of(self.episode)
        controls = self._ask(action, episode)
        lost = False
        try:
            car = episode["car"][0] = self._drive(controls, episode)
        except CarLost:  # end the episode, and not a training of millions of timesteps
            car, lost = car_of(before), True
        end_episodes(episode, self.rules)
        if lost:
            episode["over"] = LOST
        self.episode = episode
        end = REASONS[int(episode["over"].item())]
        if end in CRASHES:
            self._starts.remember(self.track, car.distance_from_start)
        (values,) = self._rewards.value(before, episode)
        terms = self.reward.explain(values, end)
        info = racing_info(car, episode["lap_time"].item(), terms, end)
        if self.render_mode == "human":
            self.render()
        if end and before["over"].item() and self.warns_after_end:
            self._warn_after_end()
        truncated = end in TRUNCATING
        seen = self._eyes.see(episode)[0]
        return seen, sum(terms.values()), bool(end) and not truncated, truncated, info

    def _ask(self, action: npt.NDArray[np.float32], episode: Episodes) -> Controls:
        """Read an action; driver aids may change what it asks for."""
        episode["controls"][0] = controls = controls_from_action(action, self.layout)
        if not self._helps:
            return controls
        help_cars(episode, self.rules)
        return controls_from_record(episode["controls"][0])

    def _drive(self, controls: Controls, episode: Episodes) -> CarState:
        """Hold the controls, or those that were late before; return the car at the end."""
        if not self._late:
            return self.backend.step(controls, self.action_repeat)
        held, ticks = np.empty((2, 1, 5)), np.empty((2, 1), np.int64)
        hold_controls(episode, self.rules, held, ticks)
        if ticks[0, 0]:
            self.backend.step(controls_from_record(held[0, 0]), int(ticks[0, 0]))
        return self.backend.step(controls_from_record(held[1, 0]), int(ticks[1, 0]))

    def _warn_after_end(self) -> None:
        self.warns_after_end = False
        gym.logger.warn(
            "step after the end of an episode, where rewards mean nothing; call reset when "
            "terminated or truncated is true"
        )

    def check_ready(self, what: str = "step") -> None:
        """
        Check that there is an episode.

        :param what: is to be done, for the error
        :raises EnvClosed: before a reset and after ``close``
        """
        if self._closed:
            raise EnvClosed(f"{what} after close; make a new environment")
        if not self._begun:
            raise EnvClosed(f"{what} before reset; call reset first")

    def render(self) -> npt.NDArray[np.uint8] | None:
        """
        Draw the road and the car from above.

        :return: (height, width, 3) in the mode ``"rgb_array"``, else ``None``
        """
        if self.render_mode is None:
            gym.logger.warn('render without a mode: gym.make(..., render_mode="rgb_array")')
            return None
        self.check_ready("render")
        if self._viewer is None:
            # Imported here because graphics take long to load.
            from sb3_torcs.rendering.viewer import Viewer

            self._viewer = Viewer(mode=self.render_mode, fps=self.metadata["render_fps"])
        frame: npt.NDArray[np.uint8] = self._viewer.frame(
            self.track, car_of(self.episode), self.controls, self.range_finder_angles
        )
        return frame if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window and the world. A second call does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            if self._viewer is not None:
                self._viewer.close()
        finally:
            self.backend.close()
