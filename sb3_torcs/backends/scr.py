"""The game itself behind an environment: a process of its own, driven by the SCR protocol."""

from __future__ import annotations

import os
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from sb3_torcs.actions import checked_gearbox, controls_from_action
from sb3_torcs.car import (
    DEFAULT_CAR,
    MANY_LAPS,
    CarState,
    Controls,
    RangeFinderName,
    Start,
    is_count,
    range_finder_angles,
)
from sb3_torcs.errors import (
    EngineForked,
    GameFailed,
    GameTimeout,
    InvalidOption,
    ServerLost,
    StartBlocked,
)
from sb3_torcs.scr.car_reader import UNKNOWN_ROAD, CarReader, standing
from sb3_torcs.scr.client import ScrClient
from sb3_torcs.scr.gearbox import read_gearbox
from sb3_torcs.scr.protocol import ScrAction, format_action, parse_motor, parse_state
from sb3_torcs.scr.rehearsal import Rehearsal
from sb3_torcs.scr.server import SCR_PORT, open_ports, start_server
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.process import GameProcess, compiled_library
from sb3_torcs.torcs.race_setup import SCR_DRIVER, RaceSetup
from sb3_torcs.torcs.starting_list import AGENT, starting_list
from sb3_torcs.torcs.track_names import find_track, stable_track
from sb3_torcs.tracks.catalogue import load_track
from sb3_torcs.tracks.profile import RoadProfile, game_profile
from sb3_torcs.tracks.track import Track
from sb3_torcs.tracks.trial import engine_arguments, load_road

__all__ = ["ScrBackend"]

MAX_PORT = 65535
HOST = "127.0.0.1"
PATIENCE = 300.0  # [s] with a game of our own, which also has to load on a busy machine
PATIENCE_WITH_OTHERS = 10.0  # [s] with a server that should be there already
SILENCE = 600.0  # [s] of a server elsewhere: the race waits for all clients; somebody may pause it
PAUSE = 0.02  # [s] before an action is said again to our own server, which knows it again
GRACE = 5.0  # [s] for a game whose port is closed to have ended
STANDING = Controls(0.0, 0.0, 1.0, 0)  # until the race begins: as the cars of the engine do


class ScrBackend:
    """
    One agent in the stock game with our driver module, or on any SCR server.

    Our driver module sends all digits, other servers send six. Values that a server does not send
    are computed: the position by the track, the yaw rate by the turn during a step, laps and times
    by the lap clock. The best lap time is that of any whole lap, one with a cut corner or a touched
    wall included.

    :param track: ``"aalborg"``, ``"road/aalborg"``, or the path of a TORCS XML file; that of the
        server, if one is named, or ``None`` if nobody knows it: positions are those on a straight
        then, and nothing is told of the road ahead
    :param car: any of the game's; that of the server, if one is named
    :param range_finders: see :func:`sb3_torcs.car.range_finder_angles`
    :param opponents: robots, e.g. ``("inferno", "berniw:3")``
    :param laps: of the race with opponents, who take fuel for so many; ``None`` drives on
    :param grid_place: of the agent among them, 1 in front; ``None`` is behind them all
    :param host: of a server that runs already; ``None`` starts a game
    :param port: of the driver there; ``None`` is the first one, 3001
    :param gearbox: see :data:`sb3_torcs.actions.GEARBOXES`
    """

    def __init__(
        self,
        track: str | Path | None = "aalborg",
        *,
        car: str = DEFAULT_CAR,
        range_finders: RangeFinderName | Sequence[float] = "scr",
        opponents: Sequence[str] = (),
        laps: int | None = None,
        grid_place: int | None = None,
        host: str | None = None,
        port: int | None = None,
        gearbox: str = "automatic",
    ) -> None:
        self._settings: dict[str, Any] = {
            "track": stable_track(track),
            "car": car,
            "range_finders": range_finders,
            "opponents": opponents,
            "laps": laps,
            "grid_place": grid_place,
            "host": host,
            "port": port,
            "gearbox": gearbox,
        }
        if host is not None and not (isinstance(host, str) and host):
            raise InvalidOption(f"host is {host!r}; expected a name, e.g. 'localhost', or None")
        self._own = host is None
        self._address = (HOST if host is None else host, SCR_PORT if port is None else port)
        game = self._game = find_game()
        self.car = car
        self.range_finder_angles = range_finder_angles(range_finders)
        self._gearbox = read_gearbox(game.find_car(car), checked_gearbox(gearbox))
        self.gears = len(self._gearbox.ratios)
        if self._own and track is None:
            raise InvalidOption(
                "track is None, which is for a race at a host of its own; name a track, such as "
                "'aalborg', or add scr={'host': 'localhost'}"
            )
        self.knows_road = track is not None
        self.track: Track = UNKNOWN_ROAD if track is None else load_track(find_track(track, game))
        entries = starting_list(game, opponents, grid_place)
        if self._own:
            compiled_library(
                "_scr_server"
            )  # reports libraries that are not built now, not at a reset
        if not self._own and (len(entries) > 1 or grid_place is not None):
            raise InvalidOption(
                f"opponents and grid_place are those of the race at {host}; name them there, e.g. "
                "`sb3-torcs serve --robots inferno`, or leave out scr"
            )
        if self._own and port is not None:
            raise InvalidOption(f"port is {port!r} without a host; add scr={{'host': 'localhost'}}")
        if not is_count(self._address[1]) or self._address[1] > MAX_PORT:
            raise InvalidOption(f"port is {port!r}; expected 1 to {MAX_PORT}")
        self._race = RaceSetup(
            self._settings["track"] or "",  # a race elsewhere is not set up here
            [SCR_DRIVER if entry == AGENT else entry for entry in entries],
            laps=laps if len(entries) > 1 and laps else MANY_LAPS,
            session="race" if len(entries) > 1 else "practice",
            car=car,
        )
        self._process: GameProcess | None = None
        self._client: ScrClient | Rehearsal | None = None
        self._stand_in: Rehearsal | None = None
        self._reader = CarReader(self.track)
        self._lost_before = 0  # of a client that has left
        self.driver_name = ""
        """What our own server shows and writes down; empty for the address."""
        self.patience = PATIENCE_WITH_OTHERS
        """Until a server at a host of its own has to answer [s]."""
        self.watch: Callable[[], None] = self._watch
        """Called while the server is silent; raises if it has ended."""
        self.latencies = array("d")
        """From the arrival of each state to our answer [s], at a host of its own."""
        self._owner = os.getpid()
        self._drive: list[Any] = []  # since the reset, so that a copy can follow
        if not self._own:
            self._rehearse()

    def reset(self, rng: np.random.Generator, start: Start | None) -> CarState:
        """Begin an episode; see :class:`~sb3_torcs.backends.base.Backend`."""
        del rng  # the game is deterministic
        if start is not None and not self._own:
            raise InvalidOption(
                "a race at a host of its own begins on the grid; use start='grid' and no options "
                "of reset, or leave out scr"
            )
        self._check_owner()
        self._drive = []
        try:
            self._connect(start)
            self._message = self._first_state(start)
            self._state = self._reader.begin(parse_state(self._message))
        except BaseException:
            self._hang_up()
            raise
        self._drive.append(start)
        return self._state

    def step(self, controls: Controls, ticks: int) -> CarState:
        """Drive on; see :class:`~sb3_torcs.backends.base.Backend`."""
        self._check_owner()
        client = self._client
        if client is None:
            raise ServerLost("the game has ended; call reset, which starts it again")
        self._drive.append((controls, ticks))
        try:
            driven = self._hold(client, controls, ticks)
            if driven:
                self._state = self._reader.read(parse_state(self._message), driven, self._earlier)
            if driven < ticks:
                self._state = standing(self._state, ticks - driven)
        except ServerLost as error:
            failure = self._failure(error)
            self._hang_up()
            raise failure from error
        except BaseException:  # Ctrl-C comes between two messages
            self._hang_up()
            raise
        return self._state

    @cached_property
    def profile(self) -> RoadProfile:
        """The road with its hills as the engine loads it, since the server does not send them."""
        if not self.knows_road:
            raise InvalidOption(
                "track is None, and this needs the road ahead; give the track of the race"
            )
        path = find_track(self._settings["track"], self._game).path
        race = engine_arguments(
            self._game, path, [AGENT], cars=[self.car], session="practice", laps=0
        )
        return game_profile(load_road(path, race))

    @property
    def over(self) -> bool:
        """Whether the race has ended or has not begun; its cars stand still then."""
        return self._client is None or self._client.over

    @property
    def restarted(self) -> bool:
        """Whether the race ended because another client restarts it."""
        return self._client is not None and self._client.restarted

    @property
    def lost_ticks(self) -> int:
        """Control ticks for which an answer came too late, or none; since the world was made."""
        return self._lost_before + (0 if self._client is None else self._client.lost)

    @contextmanager
    def rehearsal(self) -> Iterator[None]:
        """
        Drive against a stand-in for the server. In a race that does not wait, first calls would be
        too slow, e.g. because they load compiled code.
        """
        self._stand_in = Rehearsal()
        try:
            yield
        finally:
            self._hang_up()
            self._stand_in = None
            self._drive = []

    def close(self) -> None:
        """End the game, or leave the server."""
        self._hang_up()

    def __getstate__(self) -> dict[str, Any]:
        if not self._own and self._drive:
            raise InvalidOption(
                f"a race at {self._settings['host']} cannot be driven twice; make another "
                "environment, with another port"
            )
        # A game of our own is deterministic, so its controls determine it.
        return {"settings": self._settings, "drive": self._drive}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state["settings"])  # type: ignore[misc]
        if not state["drive"]:
            return
        start, *steps = state["drive"]
        self.reset(np.random.default_rng(), start)
        for controls, ticks in steps:
            self.step(controls, ticks)

    def _rehearse(self) -> None:
        """Call everything that an environment calls of this world."""
        with self.rehearsal():
            self.reset(np.random.default_rng(), None)
            self.step(controls_from_action(np.zeros(3, np.float32)), 5)

    def _connect(self, start: Start | None) -> None:
        """
        Begin the race: by a restart if a game runs, else with a new game.

        :param start: as of ``reset``
        """
        if self._stand_in is not None:
            self._client = self._stand_in
            self._client.identify(start)
            return
        if isinstance(self._client, ScrClient) and not self._client.over:
            try:
                self._client.restart(start)
            except (GameFailed, ServerLost):
                if not self._own:
                    raise
            else:
                return
        self._hang_up()
        if self._own:
            (bound,) = open_ports(1)  # any that is free
            with bound:
                self._process = start_server(self._game, self._race, [bound])
                self._address = bound.getsockname()
        manners: dict[str, Any] = {"name": self.driver_name, "watch": self.watch}
        if self._own:
            manners |= {"patience": PATIENCE, "pause": PAUSE}
        else:
            manners |= {"patience": self.patience, "silence": SILENCE, "skips_broken": True}
            manners["latencies"] = self.latencies
        self._client = ScrClient(*self._address, self.range_finder_angles, **manners)
        self._client.identify(start)

    def _watch(self) -> None:
        """Raise if the game of our own has ended."""
        if self._process is not None and self._process.poll() is not None:
            raise GameFailed(f"{self._process.epitaph()}; call reset to begin anew")

    def _failure(self, error: ServerLost) -> Exception:
        """Make the error of a lost server."""
        if self._process is None:
            return error
        with suppress(GameTimeout, GameFailed):
            self._process.wait(GRACE)  # its port closes a moment before it has ended
        return GameFailed(f"{self._process.epitaph()}; call reset to begin anew")

    def _first_state(self, start: Start | None) -> bytes:
        """
        Brake until the race begins.

        :param start: as of ``reset``; there is no countdown but on the grid
        """
        client = self._client
        assert client is not None, "_connect makes it"
        while (message := client.receive()) is not None or client.restarted:
            if message is None:  # another client restarts the race
                client.identify(start)
                continue
            lap_time = parse_motor(message).lap_time
            if lap_time >= 0.0:
                return message
            if start is not None:
                raise StartBlocked(
                    f"the game begins on the grid instead of at {start}: a car would stand in a "
                    "wall or in another car there; start elsewhere, or nearer to the middle of the "
                    "road"
                )
            client.send(_action(STANDING, lap_time))
        raise ServerLost(f"the race at {client.address} ended before it began; join the next one")

    def _hold(self, client: ScrClient | Rehearsal, controls: Controls, ticks: int) -> int:
        """
        Drive one tick after the other; the last message is that of the new state.

        :param client: our side of the conversation
        :param controls: as of ``step``
        :param ticks: as of ``step``
        :return: for how many of them the race went on
        """
        for tick in range(ticks):
            if client.over:
                return tick
            reading = parse_motor(self._message)
            asked = self._gearbox.shift(controls, reading) if controls.gear is None else controls
            client.send(_action(asked, reading.lap_time))
            message = client.receive()
            if message is None:
                return tick
            self._earlier, self._message = self._message, message
        return ticks

    def _hang_up(self) -> None:
        """Leave the server, and end the game if it is ours."""
        if self._client is not None:
            self._lost_before += self._client.lost
            self._client.close()
            self._client = None
        if self._process is not None:
            self._process.stop()
            self._process = None

    def _check_owner(self) -> None:
        """Raise in a child process, whose messages would disturb the parent's."""
        if os.getpid() != self._owner:
            raise EngineForked(
                "this game belongs to the parent process; make the environment after the fork"
            )


def _action(controls: Controls, lap_time: float) -> bytes:
    """
    Write an action.

    :param controls: what was asked for, with a gear
    :param lap_time: of the state that is answered [s]
    """
    steering, throttle, brake, gear, clutch = controls
    assert gear is not None, "the gearbox has chosen one"
    action = ScrAction(steering, throttle, brake, gear, clutch, focus=None, lap_time=lap_time)
    return format_action(action)
