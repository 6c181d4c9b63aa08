"""Results of races of robots, in the game or in the engine."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Lap", "RobotResult"]


@dataclass(frozen=True)
class Lap:
    """
    A lap that was driven to its end.

    :param time: that it took [s]; the first one counts from the start signal
    :param damage: of the car at its end, in all since the start [-]
    """

    time: float
    damage: int


@dataclass(frozen=True)
class RobotResult:
    """
    The result of one robot.

    :param robot: name of the module
    :param index: of the driver
    :param car: that it drove
    :param laps: one by one; empty where the game keeps only sums, in a race by its text mode
    :param total_time: from the start signal to the end of the last whole lap, penalties included
        [s]; 0 without one
    :param rank: at the end, 1 for the winner
    :param damage: at the end of a race, and at the end of the last whole lap of a practice [-]
    :param out: whether it did not see the flag: wrecked, out of fuel, or a lap too slow
    :param laps_completed: number of whole laps
    :param best_lap: of those that count by the rules: no wall touched, no corner cut [s]
    :param client: the name or the address of the client that drove; empty for a robot
    """

    robot: str
    index: int
    car: str
    laps: list[Lap]
    total_time: float
    rank: int
    damage: int
    out: bool
    laps_completed: int = 0
    best_lap: float | None = None
    client: str = ""

    @property
    def driver(self) -> str:
        """The driver's name for tables, as it is given to commands."""
        return self.client or f"{self.robot}:{self.index}"
