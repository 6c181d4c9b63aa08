"""The same races, held by the installed game: agents are clients of its SCR server."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_torcs.agents.remote import Agent, check_told
from sb3_torcs.agents.saved.record import DRIVEN_WITH
from sb3_torcs.errors import GameFailed, InvalidOption, ServerLost
from sb3_torcs.races import text_mode
from sb3_torcs.races.entrants import Entrant
from sb3_torcs.races.protocol import Race, Standing
from sb3_torcs.scr.server import open_ports, start_server
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.race_results import RobotResult
from sb3_torcs.torcs.race_setup import SCR_DRIVERS, SCR_SERVER, RaceSetup, session_for
from sb3_torcs.torcs.results import read_results
from sb3_torcs.tracks.catalogue import load_track

if TYPE_CHECKING:
    from sb3_torcs.torcs.process import GameProcess

__all__ = ["run_game_race", "setup_in_the_game"]

LOOK = 0.2  # [s] between two reports of how far the race is
PATIENCE = 60.0  # [s] for the game to load, on a busy machine
ENDED = (ServerLost, GameFailed)  # what agents say when the game is gone; its own words say more
GRACE = 20.0  # [s] for the game to end after its race


def setup_in_the_game(order: Sequence[Entrant], track: str, laps: int) -> RaceSetup:
    """
    Describe a race to the game, whose SCR server has a seat for each agent.

    :param order: the drivers, the one in front first
    :param track: as of ``Torcs-v0``
    :param laps: to drive
    :raises InvalidOption: if there are more agents than the game has seats
    """
    seats = itertools.count()
    drivers = [entrant.robot or (SCR_SERVER, next(seats)) for entrant in order]
    cars = [entrant.agent.car for entrant in order if entrant.agent is not None]
    if len(cars) > SCR_DRIVERS:
        raise InvalidOption(
            f"{len(cars)} agents in a race of the game, which has {SCR_DRIVERS} seats for them; "
            "name fewer, or leave out --game and --view"
        )
    return RaceSetup(track, drivers, laps, session_for(drivers), cars)


def run_game_race(
    order: Sequence[Entrant],
    track: str,
    *,
    laps: int,
    seed: int = 0,
    trust: bool = False,
    progress: Callable[[float], object] = float,
) -> Race:
    """
    Hold a race in the installed game, without a window, as fast as its drivers answer.

    :param order: the drivers, the one in front first
    :param track: as of ``Torcs-v0``
    :param laps: to drive
    :param seed: which is kept with the race
    :param trust: as of :class:`~sb3_torcs.agents.remote.Agent`
    :param progress: as of :func:`~sb3_torcs.races.protocol.run_race`; only agents tell it
    :return: the race, without a trace, contacts and distances, which the game does not tell
    :raises InvalidOption: if there are more agents than the game has seats
    :raises ModelMismatch: if an agent does not fit this race
    :raises GameFailed: if the game ends without results
    """
    race = setup_in_the_game(order, track, laps)
    agents = [entrant for entrant in order if entrant.agent is not None]
    if agents:
        goal = laps * load_track(track).length
        results = _with_clients(
            agents, race, trust, lambda distance: progress(min(distance / goal, 1.0))
        )
    else:
        results = text_mode.run(find_game(), track, race.drivers, laps, race.session)
    names = [entrant.name for entrant in order]
    standings = [
        _standing(result, race.drivers.index((result.robot, result.index)), names)
        for result in results
    ]
    nothing = np.empty((0, len(order)))
    return Race(seed, standings, {}, names, nothing, nothing)


def _with_clients(
    agents: Sequence[Entrant], race: RaceSetup, trust: bool, tell: Callable[[float], object]
) -> list[RobotResult]:
    """
    Hold a race of the game in which agents drive.

    :param agents: for the seats of the game's server, in this order
    :param race: who races where
    :param trust: run code that is pickled in the models
    :param tell: called with the distance that an agent has driven, the longest [m]
    """
    game = find_game()
    sockets = open_ports(len(agents))
    try:
        clients = [
            _client(entrant, race, bound.getsockname()[1], trust)
            for entrant, bound in zip(agents, sockets, strict=True)
        ]
        process = start_server(game, race, sockets)
    finally:
        for bound in sockets:
            bound.close()
    with process:
        _drive(clients, process, tell)
        return read_results(process, race, race.cars(game))


def _client(entrant: Entrant, race: RaceSetup, port: int, trust: bool) -> Agent:
    """Load an agent with what it sees and drives as in its training."""
    pilot = entrant.agent
    assert pilot is not None, "robots are the game's"
    options = pilot.kept(DRIVEN_WITH)
    check_told(entrant.name, options, "leave out --game")
    settings: dict[str, Any] = {
        **options,
        "track": race.track, "car": pilot.car, "host": "127.0.0.1", "port": port,
    }  # fmt: skip
    return Agent(pilot.driver, settings, trust=trust, name=entrant.name)


def _drive(clients: Sequence[Agent], process: GameProcess, tell: Callable[[float], object]) -> None:
    """
    Let agents drive until the game has ended.

    :param clients: of the game
    :param process: which is stopped if one of them fails
    :param tell: as of :func:`_with_clients`
    """
    threads = [_begin(client, process) for client in clients]
    try:
        while driving := [thread for thread in threads if thread.is_alive()]:
            driving[0].join(LOOK)
            tell(max(client.distance for client in clients))
    except BaseException:
        process.stop()
        raise
    finally:
        for thread in threads:
            thread.join()
    for client in clients:
        if client.error is not None and not isinstance(client.error, ENDED):
            raise client.error
    process.wait(GRACE)


def _begin(client: Agent, process: GameProcess) -> threading.Thread:
    """Let an agent drive on a thread, which stops the game if the agent fails."""

    def watch() -> None:
        if process.poll() is not None:
            raise GameFailed(process.epitaph())

    def drive() -> None:
        client.backend.patience, client.backend.watch = PATIENCE, watch
        try:
            client.drive()
        except BaseException as error:
            client.error = error
            if not isinstance(error, ENDED):
                process.stop()  # it would wait for an answer

    thread = threading.Thread(target=drive, name="agent")
    thread.start()
    return thread


def _standing(result: RobotResult, slot: int, names: Sequence[str]) -> Standing:
    """
    Say what the game says of a driver.

    :param result: of the driver
    :param slot: on the grid, from 0
    :param names: of all drivers, by slot
    """
    return Standing(
        names[slot], result.rank, slot + 1, result.laps_completed, result.total_time,
        result.best_lap, float(result.damage), None, result.out, None,
    )  # fmt: skip
