"""``TorcsLite-v0``: the racing environment with no TORCS installed."""

from __future__ import annotations

from functools import partial
from typing import Unpack

from sb3_torcs.actions import choose_gearbox
from sb3_torcs.backends.lite.backend import LiteBackend
from sb3_torcs.backends.several import one_or_several
from sb3_torcs.envs.arguments import read_options, select, takes_options
from sb3_torcs.envs.options import LITE, RACING, TORCS, LiteOptions
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.errors import InvalidOption

__all__ = ["TorcsLiteEnv"]


@takes_options(LITE)
class TorcsLiteEnv(RacingEnv):
    """
    A planar ``car1-trb1`` on a TORCS track, with no TORCS installed.

    Action space
        ``Box([-1, 0, 0], [1, 1, 1], (3,), float32)``: steering (1 is full lock to the left),
        throttle, brake. With ``action="pedal"``, ``Box(-1, 1, (2,), float32)``: steering, and one
        pedal that is throttle above 0 and brake below. With ``action="manual"`` gear and clutch
        come after the first three. Values outside their range are clipped; NaN is an error.

    Observation space
        ``Box(29,), float32``: the 29 numbers of the original post, scaled as there;
        :data:`sb3_torcs.sensors.SENSORS` is the table.

    Rewards
        See :data:`sb3_torcs.rewards.PRESETS`; ``info["reward_terms"]`` sums to the reward.

    Starting state
        ``"grid"``: standing in the first grid slot. ``"random"``: anywhere, moving, and one
        time in ten on the grid.
        ``reset(options={"distance": 100.0, "speed": 20.0})`` starts at a given point.

    Episode end
        Terminated: ``"off_track"`` (the mass centre is more than ``runoff`` beside the road),
        ``"backwards"`` (more than 90 degrees off its direction, without ``recovery``), ``"stuck"``
        (below 5 km/h for 1.5 s; 3 s after a standing start), ``"damage"`` (10,000 points),
        ``"lost"`` (the car has no position any more).
        Truncated: ``"laps"`` driven, or the time limit of the registration. ``info["end"]`` says
        which.

    Units are SI and radians; left is positive.

    """

    def __init__(self, **options: Unpack[LiteOptions]) -> None:
        of_the_game = [name for name in options if name in TORCS and name not in LITE]
        for name in of_the_game:
            raise InvalidOption(
                f"{name} is {dict(options)[name]!r}, which needs the installed game, so it is for "
                "Torcs-v0; leave it out for TorcsLite-v0"
            )
        given = read_options("TorcsLiteEnv.__init__", LITE, options)
        make = partial(
            LiteBackend,
            range_finders=given["range_finders"],
            gearbox=choose_gearbox(given["gearbox"], given["action"]),
        )
        world = one_or_several(make, given["track"], given["car"])
        super().__init__(world, **select(RACING, given))
