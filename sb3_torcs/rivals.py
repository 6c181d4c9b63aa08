"""The cars around a car: how an agent sees them, and when it has to make room for one."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numba.extending import register_jitable

from sb3_torcs.car import CAR_WIDTH, FIRST_RIVAL, RIVALS, CarState, FloatArray

__all__ = ["clarity", "needed_brake", "needed_turn", "rival", "see_rivals"]

NEARBY = 80.0  # [m] along the road, within which cars are seen
HALF_ALONG, HALF_ACROSS = 10.0, 3.0  # [m] distances that are seen as 0.5

BRAKING = 15.0  # [m/s²] that a car can do while it turns, too
HASTE = 20.0  # [m/s] of spare speed, from which on a car ahead is not urgent
MARGIN = 0.5  # [m] that are kept to the car ahead, and to who is in the way
BESIDE = 2.0  # [m] sidewise between two cars, from which on they are not close
OVERLAP, FADE = 4.0, 3.0  # [m] lengthwise: up to here cars are beside, and so far they fade before

REACTION = 0.12  # [s] until the brake works
HOLD = 0.2  # [s] for which a car goes on sidewise
ROOM, SIDE = 0.4, 0.3  # [m] that a car keeps lengthwise and sidewise
STRONGEST = 0.6  # of the brake, about 25 m/s²

ASIDE = 1.5  # [m] between the sides of two cars, below which a car makes room
CLOSING = 1.0  # [s] for which both are taken to go on sidewise as they do
APART = 1.0  # [m] lengthwise between two cars, up to which they are beside each other
SOON = 0.3  # [s] in which they come beside each other
IN_LINE = 0.9  # [m] by which two cars overlap across the road, where one is ahead, not beside
TURN = 1.5  # [m/s] steering × speed that makes room; with the default car a yaw rate of 0.2 rad/s
OVERDUE = 1.5  # most of this unit, for cars that would touch
MOST_TURN = 0.25  # of the steering
SLOWEST = 5.0  # [m/s] below which steering does not grow
VERGE = 0.5  # [m] to the edge of the road, from which on a car makes less room


@njit(cache=True)
def rival(rivals: FloatArray, number: int) -> tuple[float, float, float, float, float, float]:
    """
    Pick the numbers of one car nearby.

    :param rivals: (6 × ``RIVALS``,) as of :func:`see_rivals`
    :param number: of the car, 0 is the nearest
    :return: how far it is along the road [m] and across it [m], how much faster both ways [m/s],
        its length and its width [m]
    """
    return (
        rivals[number], rivals[RIVALS + number], rivals[2 * RIVALS + number],
        rivals[3 * RIVALS + number], rivals[4 * RIVALS + number], rivals[5 * RIVALS + number],
    )  # fmt: skip


@njit(cache=True)
def clarity(along: float) -> float:
    """
    Return how much a car nearby counts: 1 beside, falling to 0 at 80 m.

    :param along: how far it is ahead along the road, or behind [m]
    """
    return max(0.0, 1.0 - abs(along) / NEARBY)


@njit(cache=True)
def see_rivals(rivals: FloatArray) -> FloatArray:
    """
    Turn the numbers of the cars nearby into those that an agent sees.

    :param rivals: (6 × ``RIVALS``,) along the road [m], across it [m], both velocities against the
        own [m/s], lengths and widths [m]
    :return: (6 × ``RIVALS``,) places and velocities, that fade with the distance along the road,
        then how urgent it is to brake for each, and how close it is beside
    """
    seen = np.zeros(6 * RIVALS)
    for i in range(RIVALS):
        along, across, faster, aside, length, width = rival(rivals, i)
        clear = clarity(along)
        if clear == 0.0:
            continue
        seen[i] = clear * along / (HALF_ALONG + abs(along))
        seen[RIVALS + i] = clear * across / (HALF_ACROSS + abs(across))
        seen[2 * RIVALS + i] = clear * faster
        seen[3 * RIVALS + i] = clear * aside
        if along > 0.0:
            in_way = min(max((width + MARGIN + BESIDE - abs(across)) / BESIDE, 0.0), 1.0)
            spare = faster + math.sqrt(2.0 * BRAKING * max(along - length - MARGIN, 0.0))
            seen[4 * RIVALS + i] = in_way * max(1.0 - spare / HASTE, 0.0)
        overlap = min(max((length + OVERLAP - abs(along)) / FADE, 0.0), 1.0)
        close = min(max(1.0 - (abs(across) - width) / BESIDE, 0.0), 1.0)
        seen[5 * RIVALS + i] = overlap * close * (1.0 if across > 0.0 else -1.0)
    return seen


@register_jitable
def needed_brake(car: CarState) -> float:
    """
    Return the least brake that keeps a car from the one ahead, 0 to 0.6.

    A car is too close if it would hit the other when both brake at 15 m/s² to a stand, and its own
    brake works 0.12 s late (Shalev-Shwartz, Shammah and Shashua, "On a Formal Model of Safe and
    Scalable Self-driving Cars", arXiv:1708.06374). The less room is left, the harder it brakes.
    Cars beside the way, and those that draw away, count for nothing. Compiled code calls it, too.

    :param car: at the beginning of a timestep
    """
    most = 0.0
    speed = max(car.speed_x, 0.0)
    rivals = car.race[FIRST_RIVAL:]
    for i in range(RIVALS):
        along, across, faster, aside, length, width = rival(rivals, i)
        if not 0.5 * length < along <= NEARBY or faster >= 1.0:
            continue
        if min(abs(across), abs(across + HOLD * aside)) > width + SIDE:
            continue
        theirs = max(speed + faster, 0.0)
        room = along - length - ROOM
        needed = speed * REACTION + max(speed * speed - theirs * theirs, 0.0) / (2.0 * BRAKING)
        if room < needed:
            short = (needed - max(room, 0.0)) / max(needed, 0.5)
            most = max(most, min(short, 1.0))
    return STRONGEST * float(most)


@register_jitable
def needed_turn(car: CarState) -> float:
    """
    Return how much to steer away from cars beside, left positive, at most 0.25 to either side.

    A car makes room for each car beside it whose side will be nearer than 1.5 m in a second. The
    nearer that is, the more it turns; at the edge of the road it does not turn. The game's robots
    make room, too ("filterSColl" of `bt`). Compiled code calls this function, too.

    :param car: at the beginning of a timestep
    """
    turn = 0.0
    rivals = car.race[FIRST_RIVAL:]
    for i in range(RIVALS):
        along, across, faster, aside, length, width = rival(rivals, i)
        soon = min(abs(along), abs(along + SOON * faster))
        if abs(along) > 2.0 * length or soon > length + APART:
            continue
        side = 1.0 if across > 0.0 else -1.0
        gap = abs(across) - width
        left = gap - CLOSING * max(-side * aside, 0.0)
        if gap < -IN_LINE or left >= ASIDE:
            continue
        verge = 0.5 * (car.track_width - CAR_WIDTH) + side * car.distance_from_axis
        short = min((ASIDE - left) / ASIDE, OVERDUE)
        turn -= side * short * min(max(verge / VERGE, 0.0), 1.0)
    turn *= TURN / max(car.speed_x, SLOWEST)
    return float(min(max(turn, -MOST_TURN), MOST_TURN))
