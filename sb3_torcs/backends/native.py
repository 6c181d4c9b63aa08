"""The real TORCS behind an environment: its physics, tracks, cars and robots, in this process."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from sb3_torcs.actions import checked_gearbox
from sb3_torcs.backends.engine_world import EngineWorld, align
from sb3_torcs.backends.seats import SeatWorld
from sb3_torcs.car import (
    DEFAULT_CAR,
    MANY_LAPS,
    CarState,
    Controls,
    FloatArray,
    RangeFinderName,
    Start,
    checked_choice,
    checked_laps,
    range_finder_angles,
)
from sb3_torcs.errors import BackendUnavailable, EnvClosed, InvalidOption, TrackFileError
from sb3_torcs.torcs.building import build_command
from sb3_torcs.torcs.installation import Game, find_game
from sb3_torcs.torcs.race_setup import SCR_DRIVER, SESSIONS, RaceSetup, Session, session_for
from sb3_torcs.torcs.starting_list import AGENT, starting_list
from sb3_torcs.torcs.track_names import TrackFile, find_track
from sb3_torcs.torcs.trial_child import encoded
from sb3_torcs.tracks.catalogue import load_track
from sb3_torcs.tracks.track import Track
from sb3_torcs.tracks.trial import check_road, engine_arguments, try_race

if TYPE_CHECKING:
    from sb3_torcs._engine import Engine, Rollouts

__all__ = [
    "NativeBackend",
    "NativeFleet",
    "check_layout",
    "load_race",
    "make_engine",
    "make_rollouts",
]


def make_engine(
    game: Game,
    track: str | os.PathLike[str] | TrackFile,
    entries: Sequence[tuple[str, int]],
    *,
    car: str | Sequence[str] = DEFAULT_CAR,
    session: Session = "practice",
    laps: int = 0,
    angles: FloatArray | None = None,
    gearbox: str | Sequence[str] = "automatic",
    flagged: bool = False,
) -> Engine:
    """
    Load a race of the real game.

    :param game: the installation
    :param track: ``"aalborg"``, ``"road/aalborg"``, or the path of an XML file
    :param entries: the starting list: robots' names and indices, and agents, ``("", 0)`` and up
    :param car: of all agents, or one for each
    :param session: whose rules and grid count, ``"practice"`` or ``"race"``
    :param laps: of the race; 0 drives on
    :param angles: (19,) of the range finders [rad], left negative; or (agents, 19)
    :param gearbox: of all agents, or one for each; see :data:`sb3_torcs.actions.GEARBOXES`
    :param flagged: whether agents are flagged off after the last lap, as robots are
    :return: the engine, not yet started
    :raises InvalidOption: if a driver is named twice, or there is no such session
    :raises BackendUnavailable: if the extension or the game is missing, or not as expected
    :raises TrackNotFound: if there is no such track
    :raises TrackFileError: if the track's file is broken, or its grid too small
    :raises UnknownCar: if there is no such car
    :raises CarFileError: if the car's file is broken
    :raises UnknownRobot: if there is no such robot
    """
    native = _extension()
    checked_choice("session", session, SESSIONS)
    agents = sum(name == AGENT[0] for name, _ in entries)
    cars = _for_each(car, agents)
    for name in cars:
        game.find_car(name)
    for name, index in entries:
        if entries.count((name, index)) > 1:
            raise InvalidOption(
                f"{name or 'agent'}:{index} is named twice; name another driver of it, "
                "`sb3-torcs robots` lists them"
            )
        if name != AGENT[0]:
            game.find_robot(name, index)
    file = find_track(track, game)
    path = file.path
    load_track(file)  # reports a broken file before the game's own loader reads it
    race = engine_arguments(game, path, entries, cars=cars, session=session, laps=laps)
    try_race(path, race)
    angles = range_finder_angles("scr") if angles is None else angles
    gearboxes = [checked_gearbox(choice) for choice in _for_each(gearbox, agents)]
    engine: Engine = native.Engine(
        **encoded(race),
        angles=np.broadcast_to(angles, (max(agents, 1), angles.shape[-1])).tolist(),
        road_speed=[choice == "road_speed" for choice in gearboxes],
        flagged=flagged,
    )
    try:
        check_road(path, engine.road())
    except TrackFileError:
        engine.close()
        raise
    return engine


def _for_each(choice: str | Sequence[str], agents: int) -> list[str]:
    """Repeat what is for all agents; a race of robots has it once."""
    several = isinstance(choice, (list, tuple))
    return list(choice) if several else [cast(str, choice)] * max(agents, 1)


def load_race(
    track: str | Path,
    entries: Sequence[tuple[str, int]],
    *,
    cars: Sequence[str],
    gearboxes: Sequence[str],
    angles: Sequence[FloatArray],
    laps: int,
    flagged: bool,
) -> tuple[Engine, Track]:
    """
    Load a race of robots and agents, whose positions are those of the track's file.

    :param track: as of :class:`NativeBackend`
    :param entries: as of :func:`make_engine`
    :param cars: of the agents
    :param gearboxes: of the agents
    :param angles: (19,) of the range finders of each agent [rad]
    :param laps: of the race; 0 drives on
    :param flagged: whether agents are flagged off after the last lap
    :return: the engine, not yet started, and the road
    """
    game = find_game()
    file = find_track(track, game)
    engine = make_engine(
        game, file, entries, session=session_for(entries), laps=laps, flagged=flagged,
        car=list(cars) or DEFAULT_CAR, gearbox=list(gearboxes) or "automatic",
        angles=np.stack(angles) if angles else None,
    )  # fmt: skip
    road = load_track(file)
    align(engine, road)
    return engine, road


def make_rollouts(engines: Sequence[Engine]) -> Rollouts:
    """
    Drive copies of one race at once, one thread each, to compare candidates.

    :param engines: of the same race, at the same moment
    :return: the rollouts, which begin where the engines stand; see ``native/rollouts.h``
    """
    rollouts: Rollouts = _extension().Rollouts(list(engines))
    rollouts.mark()
    return rollouts


class NativeBackend(EngineWorld):
    """
    One agent in the real game, alone or among its robots.

    :param track: ``"aalborg"``, ``"road/aalborg"``, or the path of a TORCS XML file
    :param car: any of the game's
    :param range_finders: see :func:`sb3_torcs.car.range_finder_angles`
    :param opponents: robots, e.g. ``("inferno", "berniw:3")``
    :param laps: of the race with opponents, who take fuel for so many; ``None`` drives on
    :param grid_place: of the agent among them, 1 in front; ``None`` is behind them all
    :param sensor_noise: whether sensors err as those of the SCR server's ``-noisy``
    :param gearbox: see :data:`sb3_torcs.actions.GEARBOXES`
    """

    conditions = ("grip", "mass", "sensor_noise")

    tells_race = True

    def __init__(
        self,
        track: str | Path = "aalborg",
        *,
        car: str = DEFAULT_CAR,
        range_finders: RangeFinderName | Sequence[float] = "scr",
        opponents: Sequence[str] = (),
        laps: int | None = None,
        grid_place: int | None = None,
        sensor_noise: bool = False,
        gearbox: str = "automatic",
    ) -> None:
        entries = starting_list(find_game(), opponents, grid_place)
        checked_laps(laps)
        self.car = car
        self.range_finder_angles = range_finder_angles(range_finders)
        self._settings: dict[str, Any] = {
            "track": track,
            "car": car,
            "range_finders": range_finders,
            "opponents": tuple(opponents),
            "laps": laps,
            "grid_place": grid_place,
            "sensor_noise": sensor_noise,
            "gearbox": gearbox,
        }
        self._entries = entries
        self.engine, self.track = load_race(
            track, entries, cars=[car], gearboxes=[gearbox], angles=[self.range_finder_angles],
            laps=laps if opponents and laps else 0, flagged=False,
        )  # fmt: skip
        self.seat = entries.index(AGENT)  # in the starting list
        self.gears = self.engine.gears(self.seat)
        self._noise = sensor_noise
        self._conditions = 1.0, 1.0
        self._drive: list[Any] = []  # steps since the reset, for copies

    def race_setup(self) -> RaceSetup:
        """
        Describe the same race for the game itself, with a driver of our module as the agent.

        :raises InvalidOption: if the game cannot run it
        """
        drivers = [SCR_DRIVER if entry == AGENT else entry for entry in self._entries]
        return RaceSetup(
            self._settings["track"],
            drivers,
            self._settings["laps"] or MANY_LAPS,
            "race" if self._settings["opponents"] else "practice",
            self.car,
        )

    def set_conditions(self, grip: float, mass: float) -> None:
        """Change the next episode's world; see :class:`~sb3_torcs.backends.base.Backend`."""
        self._conditions = grip, mass

    def reset(self, rng: np.random.Generator, start: Start | None) -> CarState:
        """Begin an episode; see :class:`~sb3_torcs.backends.base.Backend`."""
        noise = int(rng.integers(2**63)) if self._noise else None
        return self._begin(start, noise, self._conditions)

    def _begin(
        self, start: Start | None, noise: int | None, conditions: tuple[float, float]
    ) -> CarState:
        self._drive = []
        self.engine.set_noise(noise)
        self.engine.set_conditions(*conditions)
        if start is None:
            self.engine.start()
        else:
            self.engine.start_at(*start)
        self._drive.append((start, noise, conditions))
        self._state: CarState = self.engine.read(self.seat)
        return self._state

    def step(self, controls: Controls, ticks: int) -> CarState:
        """Drive on; see :class:`~sb3_torcs.backends.base.Backend`."""
        steering, throttle, brake, gear, clutch = controls
        state = self.engine.step(steering, throttle, brake, gear, ticks, clutch)
        self.arrive(controls, ticks, state)
        return state

    def arrive(self, controls: Controls, ticks: int, state: CarState) -> None:
        """
        Take the result of a step. The engine may have been driven by a :class:`NativeFleet`.

        :param controls: as of ``step``
        :param ticks: as of ``step``
        :param state: the car after it
        """
        self._state = state
        self._drive.append((controls, ticks))

    def focus(self, direction: float) -> FloatArray:
        """
        Look ahead as the SCR server's ``focus`` sensors do, without their pause of a second.

        :param direction: against the car's axis [rad], left negative
        :return: (5,) distances to the road's edge [m] at 1 degree from each other; -1 off the road
        """
        return self.engine.focus(self.seat, direction)

    def save(self) -> Any:
        """
        Keep the whole race, robots and noise included.

        :return: a moment, for :meth:`restore` of this backend
        :raises EnvClosed: before the first reset
        """
        if not self._drive:
            raise EnvClosed("save before reset; call reset first")
        return self.engine.save(), list(self._drive), self._state

    def restore(self, moment: Any) -> CarState:
        """
        Go back to a moment. The same controls then give the same drive, to the bit.

        :param moment: from :meth:`save`
        :return: the agent's car then
        """
        race, drive, self._state = moment
        self.engine.restore(race)
        self._drive = list(drive)
        return self._state

    def close(self) -> None:
        """Close the race; its libraries are there for the next one."""
        self.engine.close()

    def __getstate__(self) -> dict[str, Any]:
        # A race holds addresses, so it cannot be pickled; its controls determine it.
        return {"settings": self._settings, "drive": self._drive}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state["settings"])  # type: ignore[misc]
        if not state["drive"]:
            return
        begin, *steps = state["drive"]
        self._begin(*begin)
        for controls, ticks in steps:
            self.step(controls, ticks)


class NativeFleet:
    """
    Several worlds that are driven at once, by threads that live as long as this object.

    :param worlds: one for each agent; seats of one race follow each other
    :param threads: that drive, with the calling one among them
    """

    def __init__(self, worlds: Sequence[NativeBackend | SeatWorld], threads: int) -> None:
        self._worlds = list(worlds)
        engines = list(dict.fromkeys(world.engine for world in worlds))
        self._engines = np.array([engines.index(world.engine) for world in worlds])
        self._seats = np.array([world.seat for world in worlds])
        self._fleet = _extension().Fleet(engines, threads)

    def put(self, index: int, world: NativeBackend | SeatWorld) -> None:
        """Give an environment a world; see :class:`~sb3_torcs.backends.base.Fleet`."""
        if self._worlds[index] is world:
            return
        self._worlds[index], self._seats[index] = world, world.seat
        self._fleet.put(int(self._engines[index]), world.engine)

    def step(
        self,
        indices: npt.NDArray[np.int64],
        controls: FloatArray,
        ticks: npt.NDArray[np.int64],
        cars: FloatArray,
    ) -> list[int]:
        """Drive some of them; see :class:`~sb3_torcs.backends.base.Fleet`."""
        engines, seats = self._engines[indices], self._seats[indices]
        failed: list[int] = self._fleet.step(engines, seats, controls, ticks, cars)
        return failed

    def failure(self, index: int) -> Exception:
        """Return what stopped a world; see :class:`~sb3_torcs.backends.base.Fleet`."""
        try:
            self._fleet.check(int(self._engines[index]))
        except Exception as error:
            return error
        raise AssertionError("the world has not failed")

    def arrive(self, index: int, steps: Iterable[tuple[Controls, int]], car: CarState) -> None:
        """Report what a world has been driven; see :class:`~sb3_torcs.backends.base.Fleet`."""
        for controls, ticks in steps:
            self._worlds[index].arrive(controls, ticks, car)

    def close(self) -> None:
        """End the threads; see :class:`~sb3_torcs.backends.base.Fleet`."""
        del self._fleet


@lru_cache
def check_layout(game: Game) -> str:
    """
    Check that the installed game has the structures that the engine expects.

    :param game: the installation
    :return: what was compared
    :raises BackendUnavailable: if it is another version, or does not load
    """
    name = "road/aalborg" if "road/aalborg" in game.tracks() else min(game.tracks())
    engine = make_engine(game, name, [AGENT])
    summary = engine.track_summary()
    engine.close()
    return (
        f"as TORCS 1.3.7, by {summary['name']} ({summary['segments']} segments) and {DEFAULT_CAR}"
    )


def _extension() -> Any:
    try:
        from sb3_torcs import _engine
    except ImportError as error:
        raise BackendUnavailable(
            f"the extension sb3_torcs._engine does not load ({error}); TorcsLite-v0 has the same "
            f"contract without it, and this builds it: {build_command()}"
        ) from error
    return _engine
