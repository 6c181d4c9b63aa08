"""The installed game as an SCR server: our driver module in it, on ports that were bound before.

Ports that are taken are reported before the game starts. The game inherits the sockets, so that a
private game can use any free port.
"""

from __future__ import annotations

import errno
import socket
from collections.abc import Sequence

from sb3_torcs.errors import InvalidOption, PortTaken
from sb3_torcs.torcs.installation import Game
from sb3_torcs.torcs.process import GameProcess
from sb3_torcs.torcs.race_setup import RaceSetup
from sb3_torcs.torcs.window import Window, WindowArguments, window_arguments
from sb3_torcs.tracks.trial import check_track

__all__ = ["SCR_PORT", "open_ports", "start_server"]

SCR_PORT = 3001
"""Of the first driver; the others follow. As the SCR server has it."""
LAST_PORT = 65535


def open_ports(
    drivers: int, port: int | None = None, host: str = "127.0.0.1"
) -> list[socket.socket]:
    """
    Bind one UDP port per driver.

    :param drivers: how many
    :param port: of the first driver; the others follow. ``None`` takes any that are free
    :param host: the address to listen at
    :return: the sockets; the caller closes them
    :raises PortTaken: if one cannot be bound; then all are closed
    """
    if not host:
        raise InvalidOption("host is empty; give an address of this machine, or 0.0.0.0 for all")
    sockets: list[socket.socket] = []
    for number in range(drivers):
        wanted = 0 if port is None else port + number
        bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sockets.append(bound)
        try:
            if not 0 <= wanted <= LAST_PORT:
                raise OSError(errno.EINVAL, f"ports end at {LAST_PORT}")
            bound.bind((host, wanted))
        except (OSError, TypeError, UnicodeError) as error:  # the last two: no name of a host
            for opened in sockets:
                opened.close()
            why = getattr(error, "strerror", None) or error
            taken = getattr(error, "errno", None) == errno.EADDRINUSE
            remedy = "end the program that has it, or choose another" if taken else "choose another"
            raise PortTaken(
                f"UDP port {wanted} at {host} cannot be had ({why}); {remedy} "
                "with --port, or another address with --host"
            ) from error
    return sockets


def start_server(
    game: Game,
    race: RaceSetup,
    sockets: Sequence[socket.socket],
    *,
    deadline: float | None = None,
    options: Sequence[str] = (),
    window: Window | None = None,
) -> GameProcess:
    """
    Start a race in which clients drive.

    :param game: the installation
    :param race: with ``("scr_server", 0)`` and on among its drivers
    :param sockets: bound, the k-th for driver k; they can be closed here afterwards
    :param deadline: for an answer [s]; ``None`` waits for it, however long it takes
    :param options: ``nofuel``, ``nodamage``, ``nolaptime`` and ``noisy``, as patched servers call
        them; the game refuses others
    :param window: in which the race is shown or recorded; ``None`` runs it without one
    :return: the game, which waits for its clients
    """
    numbers = [bound.fileno() for bound in sockets]
    arguments = WindowArguments(environment={}, descriptors=[], preload=None, files={})
    if window is not None:
        arguments = window_arguments(game, window)
    arguments["descriptors"] += numbers
    arguments["environment"] |= {
        "SB3_TORCS_SCR_SOCKETS": ",".join(str(number) for number in numbers),
        "SB3_TORCS_SCR_DEADLINE": "wait" if deadline is None else f"{deadline * 1e6:.0f}",
        "SB3_TORCS_SCR_OPTIONS": ",".join(options),
    }
    return GameProcess(game, race, check=check_track, **arguments)
