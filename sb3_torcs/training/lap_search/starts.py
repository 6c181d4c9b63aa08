"""Where the search for a lap begins: drives of the agent, of robots and of the scripted driver."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from sb3_torcs.agents.drivers import NamedDriver
from sb3_torcs.agents.models import driver_record, load_driver, require_one
from sb3_torcs.agents.rollout import drive
from sb3_torcs.agents.scripted import SCRIPTED
from sb3_torcs.agents.wrapping import wrap_env
from sb3_torcs.backends.native import make_engine
from sb3_torcs.car import DEFAULT_CAR, CarState, Controls, FloatArray
from sb3_torcs.errors import InvalidOption, RobotUnavailable
from sb3_torcs.evaluation.protocol import KEPT, RACE_LAPS, time_limit
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.track_names import stable_track
from sb3_torcs.training.lap_search.line import waypoint

__all__ = ["FirstDrive", "find_starts", "ghost_environment"]


class FirstDrive(NamedTuple):
    """A drive of three laps."""

    driver: str
    rows: FloatArray  # (n, 7) waypoints
    lap_times: tuple[float, ...]  # [s]

    @property
    def seconds(self) -> float:
        """Of the whole race; infinite if it was not finished."""
        return sum(self.lap_times) if len(self.lap_times) == RACE_LAPS else math.inf


def ghost_environment(driver: NamedDriver, given: Mapping[str, Any]) -> dict[str, Any]:
    """
    Choose the environment of a ghost: that of an agent, so that the agent can learn from it.

    :param driver: whose drive the search begins with
    :param given: keyword arguments that replace those of the training
    :return: keyword arguments of ``Torcs-v0``
    :raises InvalidOption: if the training had several cars or tracks, and none is given
    """
    car = DEFAULT_CAR if driver.robot is None else find_game().find_robot(*driver.robot).car
    usual = {"track": "aalborg", "car": car, "action_repeat": 5, "action": "pedals"}
    kwargs = {**usual, **driver.record.select(KEPT), **given, "laps": RACE_LAPS}
    require_one("track", kwargs["track"])
    require_one("car", kwargs["car"])
    kwargs["track"] = stable_track(kwargs["track"])
    if kwargs["action"] == "manual":  # the search leaves the gears to the gearbox
        kwargs["action"] = "pedals"
    return kwargs


def find_starts(
    named: NamedDriver, env_kwargs: Mapping[str, Any], *, alone: bool = False, trust: bool = False
) -> list[FirstDrive]:
    """
    Find drives of three laps to begin a search with.

    :param named: the driver to begin with
    :param env_kwargs: of :func:`ghost_environment`
    :param alone: whether to take its drive only, however slow it is
    :param trust: run code that is pickled in the model
    :return: the fastest first
    :raises InvalidOption: if no driver finishes three laps there
    """
    track, car, ticks = (env_kwargs[name] for name in ("track", "car", "action_repeat"))
    if named.robot is not None:
        starts = [_robots_start(track, named.robot, ticks)]
    else:
        starts = [agents_start(named.source, env_kwargs, trust)]
    if not alone:
        starts += robots_starts(track, car, ticks)
    whole = [start for start in starts if start.seconds < math.inf]
    if not whole and not alone:
        scripted = scripted_start(env_kwargs)
        whole = [scripted] if scripted.seconds < math.inf else []
    if not whole:
        raise InvalidOption(
            f"{named.source if alone else 'no driver'} finishes no race of {RACE_LAPS} laps on "
            f"{env_kwargs['track']} in {env_kwargs['car']}, and a search begins with one; give "
            "another driver" + (", or leave out --alone" if alone else "")
        )
    return sorted(whole, key=lambda start: start.seconds)


def agents_start(agent: str, env_kwargs: Mapping[str, Any], trust: bool) -> FirstDrive:
    """
    Let an agent drive.

    :param agent: what :func:`~sb3_torcs.agents.models.load_driver` loads
    :param env_kwargs: of ``Torcs-v0``, as in its training, with ``laps``
    :param trust: run code that is pickled in the model
    """
    bare = gym.make("sb3_torcs:Torcs-v0", max_episode_steps=time_limit(env_kwargs), **env_kwargs)
    try:
        env = wrap_env(bare, driver_record(agent).hyperparameters, trust=trust)
        driver = load_driver(agent, env, trust=trust)
        bare.reset(seed=0)
        cars: list[CarState] = [bare.get_wrapper_attr("car")]
        controls: list[Controls] = []
        laps = []
        for step in drive(env, driver, seed=0):
            cars.append(step.car)
            controls.append(bare.get_wrapper_attr("controls"))
            laps += [step.info["lap_time"]] if step.info["lap_time"] else []
    finally:
        bare.close()
    return FirstDrive(agent, _rows(cars, controls), tuple(laps))


def scripted_start(env_kwargs: Mapping[str, Any]) -> FirstDrive:
    """
    Let the scripted driver drive.

    :param env_kwargs: as of :func:`agents_start`
    """
    plain = {name: env_kwargs[name] for name in ("track", "car", "laps")}
    return agents_start(SCRIPTED, {**plain, "action_repeat": env_kwargs["action_repeat"]}, False)


def robots_starts(track: str, car: str, ticks: int) -> Iterator[FirstDrive]:
    """
    Let all robots drive that have a driver of the car.

    Their own set-up of the car may be another, so what they do is a line to follow and no more.

    :param track: as of ``Torcs-v0``
    :param car: e.g. ``"car1-trb1"``
    :param ticks: control ticks per timestep
    """
    game = find_game()
    for name, entries in game.robots().items():
        for entry in entries:
            if entry.car != car:
                continue
            try:
                yield _robots_start(track, (name, entry.index), ticks)
            except RobotUnavailable:
                continue
            break


def _robots_start(track: str, robot: tuple[str, int], ticks: int) -> FirstDrive:
    engine = make_engine(find_game(), track, [robot], laps=RACE_LAPS)
    try:
        engine.start()
        cars = [engine.read(0)]
        controls: list[Controls] = []
        limit = time_limit({"track": track, "laps": RACE_LAPS, "action_repeat": ticks})
        while not engine.ended and len(controls) < limit:
            engine.advance(ticks)
            cars.append(engine.read(0))
            controls.append(Controls(*engine.controls(0)))
        laps = tuple(time for time, _ in engine.laps(0))
    finally:
        engine.close()
    return FirstDrive(f"{robot[0]}:{robot[1]}", _rows(cars, controls), laps)


def _rows(cars: list[CarState], controls: list[Controls]) -> FloatArray:
    last = controls[-1]
    return np.array([waypoint(*pair) for pair in zip(cars, [*controls, last], strict=True)])
