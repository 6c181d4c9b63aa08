"""A stand-in for an SCR server, to warm up a client before a race."""

from __future__ import annotations

from sb3_torcs.car import CONTROL_TICK, Start
from sb3_torcs.scr.protocol import ScrState, format_state

__all__ = ["Rehearsal"]

COUNTDOWN = 2  # [ticks]
LAST_TICK = 15
HALF_TICK = 0.5 * CONTROL_TICK  # [s] the clock of the game is not at 0 when a race begins


class Rehearsal:
    """
    Replaces an :class:`~sb3_torcs.scr.client.ScrClient` without a network: a short race whose
    states do not depend on the actions.
    """

    address = "nowhere"
    lost = 0
    restarted = False

    def __init__(self) -> None:
        self._tick = -COUNTDOWN

    @property
    def over(self) -> bool:
        """Whether the race has ended."""
        return self._tick > LAST_TICK

    def identify(self, start: Start | None = None) -> None:
        """
        Begin the race.

        :param start: is ignored
        """
        del start
        self._tick = -COUNTDOWN

    def send(self, message: bytes) -> None:
        """
        Let the race go on by a tick.

        :param message: is ignored
        """
        del message
        self._tick += 1

    def receive(self) -> bytes | None:
        """Return the present state, or ``None`` after the last one."""
        if self.over:
            return None
        state = ScrState(
            lap_time=self._tick * CONTROL_TICK + HALF_TICK,
            gear=1,
            engine_speed=500.0,
            speed_x=30.0,
            range_finders=(5.0,) * 19,
            wheel_speeds=(100.0,) * 4,
        )
        return format_state(state)

    def close(self) -> None:
        """Do nothing."""
