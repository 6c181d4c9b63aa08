"""Races of agents and robots in the game's window, or in a video of it."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_torcs.agents.models import driver_name
from sb3_torcs.agents.remote import Agent
from sb3_torcs.agents.robots import drive_log
from sb3_torcs.agents.scripted import SCRIPTED
from sb3_torcs.car import DEFAULT_CAR
from sb3_torcs.errors import GameFailed, InvalidOption, ServerLost
from sb3_torcs.rendering.game_video import FPS, GameVideo, side_by_side
from sb3_torcs.rendering.gap import Passing, draw_gap, time_behind
from sb3_torcs.scr.protocol import plain_name
from sb3_torcs.scr.server import open_ports, start_server
from sb3_torcs.telemetry import DriveLog
from sb3_torcs.torcs.installation import Game
from sb3_torcs.torcs.process import GameProcess
from sb3_torcs.torcs.race_results import RobotResult
from sb3_torcs.torcs.race_setup import SCR_DRIVER, RaceSetup, session_for
from sb3_torcs.torcs.results import read_results
from sb3_torcs.torcs.window import ViewName, Window, window_arguments
from sb3_torcs.tracks.trial import check_track

__all__ = ["Show", "drive_logs", "record_shows", "show_in_window"]

AFTERMATH = 2.0  # [s] of the race that are shown after an agent's drive has ended


@dataclass
class Show:
    """
    A race, and the driver whom the camera follows.

    :param game: the installation
    :param track: as of :class:`~sb3_torcs.torcs.race_setup.RaceSetup`
    :param robot: name and index of the robot that the camera follows; ``None`` for an agent
    :param model: of the agent: what :func:`~sb3_torcs.agents.models.load_driver` loads
    :param settings: of the agent's environment: ``car``, ``action_repeat`` and so on
    :param opponents: names and indices of robots, which start behind
    :param laps: to drive
    :param trust: run what is pickled in the model
    """

    game: Game
    track: str | Path
    robot: tuple[str, int] | None
    model: str = SCRIPTED
    settings: Mapping[str, Any] = field(default_factory=dict)
    opponents: Sequence[tuple[str, int]] = ()
    laps: int = 1
    trust: bool = False
    agent: Agent | None = None
    results: list[RobotResult] = field(default_factory=list)
    passing: Passing = field(default_factory=Passing)  # where the car is in the video
    log: DriveLog = field(default_factory=DriveLog)  # of an agent, a row per timestep

    @property
    def race(self) -> RaceSetup:
        """The set-up of the race."""
        drivers = [self.robot or SCR_DRIVER, *self.opponents]
        car = self.settings.get("car", DEFAULT_CAR)
        return RaceSetup(self.track, drivers, self.laps, session_for(drivers), car)

    @property
    def driver_name(self) -> str:
        """The driver's name, as the game shows it."""
        if self.robot is not None:
            return self.game.find_robot(*self.robot).name
        return plain_name(driver_name(self.model))

    def start(self, window: Window) -> GameProcess:
        """
        Start the game, and connect the agent to its car.

        :param window: of the game
        :return: the game
        """
        if self.robot is not None:
            arguments = window_arguments(self.game, window)
            return GameProcess(self.game, self.race, check=check_track, **arguments)
        (bound,) = open_ports(1)
        with bound:
            port = bound.getsockname()[1]
            process = start_server(self.game, self.race, [bound], window=window)
        try:
            settings = {"track": self.track, "host": "127.0.0.1", "port": port, **self.settings}
            self.agent = Agent(self.model, settings, trust=self.trust, name=self.driver_name)
            self.agent.log = self.log
        except BaseException:
            process.stop()
            raise
        return process

    def finish(self, process: GameProcess) -> None:
        """
        Read the results, if the race has ended.

        :param process: of the game
        """
        if process.poll() == 0:
            self.results = read_results(process, self.race, self.race.cars(self.game))


def drive_logs(shows: Sequence[Show]) -> DriveLog:
    """
    Gather what was driven. A robot is asked again, of the engine: it drives as the game does.

    :param shows: that are over
    :return: rows of all shows, each driver's in one piece
    """
    log = DriveLog()
    for show in shows:
        race = show.race
        again = show.robot is not None
        log.extend(
            drive_log(race.drivers, str(race.track), race.laps, session=race.session)
            if again
            else show.log
        )
    return log


def show_in_window(show: Show, window: Window) -> None:
    """
    Show a race in real time, to its end or until the window is closed.

    :param show: the race
    :param window: of the game
    :raises GameFailed: if the game ends with an error
    """
    with show.start(window) as process:
        if show.agent is not None:
            try:
                show.agent.drive(AFTERMATH)
            except ServerLost as error:
                if not process.is_ending():
                    raise
                raise GameFailed(process.epitaph()) from error
            if show.agent.end is not None:
                return
        process.wait()
        show.finish(process)


def record_shows(
    shows: Sequence[Show],
    path: Path,
    *,
    size: tuple[int, int] = (1280, 720),
    view: ViewName = "behind",
    fps: float = FPS,
) -> None:
    """
    Record races, side by side if there are several.

    :param shows: the races, from left to right
    :param path: of the video, ending in ``.mp4``
    :param size: width and height of the whole picture [pixels]
    :param view: one of :data:`sb3_torcs.torcs.window.VIEWS`
    :param fps: frames per second of simulated time
    :raises InvalidOption: if the picture cannot be divided among the races
    :raises DisplayUnavailable: if there is no virtual display
    :raises OutputNotWritable: if the file cannot be written; no part of it is left behind
    :raises GameFailed: if a game ends too early; no part of the file is left behind
    """
    from sb3_torcs.rendering.encoder import PHOTOGRAPHIC, write_video

    part = (size[0] // len(shows), size[1])
    if len(shows) > 1 and size[0] % (2 * len(shows)):
        raise InvalidOption(
            f"size is {size[0]}x{size[1]}; the width of a video with {len(shows)} side by side has "
            f"to be a multiple of {2 * len(shows)}"
        )
    with ExitStack() as stack:
        videos = [
            stack.enter_context(
                GameVideo(show.start, size=part, view=view, fps=fps, driver=show.driver_name)
            )
            for show in shows
        ]
        threads = [_begin(show, video) for show, video in zip(shows, videos, strict=True)]
        pictures = [_pictures(show, video) for show, video in zip(shows, videos, strict=True)]
        try:
            joint = _with_gap(side_by_side(*pictures), shows)
            write_video(
                path, joint, fps, encoding=PHOTOGRAPHIC,
                share=lambda: min(show.passing.share for show in shows),
            )  # fmt: skip
        finally:
            for video in videos:
                video.game.stop()
            for thread in threads:
                thread.join()


def _with_gap(
    pictures: Iterator[npt.NDArray[np.uint8]], shows: Sequence[Show]
) -> Iterator[npt.NDArray[np.uint8]]:
    """Write on each picture of two races by how much the second driver is behind the first."""
    for picture in pictures:
        behind = time_behind(shows[0].passing, shows[1].passing) if len(shows) == 2 else None
        if behind is not None:
            picture = draw_gap(picture, shows[1].driver_name, behind)
        yield picture


def _begin(show: Show, video: GameVideo) -> threading.Thread:
    """
    Start the agent's drive on a thread.

    :param show: with the agent
    :param video: of it
    :return: the thread
    """

    def drive() -> None:
        if show.agent is None:
            return
        try:
            show.agent.drive(AFTERMATH)
        except BaseException as error:
            # If the game ended by itself, its own error is more precise.
            if not isinstance(error, ServerLost) or not video.game.is_ending():
                show.agent.error = error
            video.game.stop()  # the game would wait for an answer

    thread = threading.Thread(target=drive, name="agent")
    thread.start()
    return thread


def _pictures(show: Show, video: GameVideo) -> Iterator[npt.NDArray[np.uint8]]:
    """
    Yield a video to the end of the race, or a little beyond the end of the agent's drive.

    :param show: the race
    :param video: of it
    """
    agent = show.agent
    try:
        for frame in video.frames():
            show.passing.note(frame.time, frame.share)
            yield frame.picture
            if agent is not None and agent.end_time is not None:
                left = agent.end_time + AFTERMATH - frame.time
                if left < 1.0 / video.fps:
                    return
    except GameFailed:
        if agent is not None and agent.error is not None:
            raise agent.error from None
        raise
    show.finish(video.game)
