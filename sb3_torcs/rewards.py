"""Rewards: weighted sums of named terms.

A term is a rate per second of simulated time, measured over one timestep; a reward is the sum of
weight × term × duration × scale, plus a single crash term when the episode ends badly. So the
return of a drive does not depend on the length of a timestep.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, Literal

import numpy as np
from numba import njit
from numba.extending import register_jitable

from sb3_torcs import maths
from sb3_torcs.car import (
    CAR_NUMBERS,
    CAR_WIDTH,
    CONTACTS,
    FAULTS,
    FIRST_RIVAL,
    RIVALS,
    CarState,
    Controls,
    FloatArray,
    car_from_record,
    controls_from_record,
    is_number,
    is_off_track,
    track_position,
)
from sb3_torcs.errors import InvalidOption, UnknownRewardTerm, near_miss
from sb3_torcs.rivals import clarity, rival

__all__ = [
    "CRASHES",
    "PRESETS",
    "TERMS",
    "Reward",
    "RewardChoice",
    "RewardName",
    "Rewards",
    "Term",
    "safe_speed",
]

cos, sin = map(maths.compiled, (maths.cos, maths.sin))
for _function in (is_off_track, track_position):
    register_jitable(_function)

BRAKING = 10.0  # [m/s²] a car on asphalt can do twice that, but not while it turns in
BEND_SPEED = 12.0  # [m/s] in a bend behind which nothing is seen; the tightest hairpins need it
NO_SLIDE = 0.1  # [-] speed across per speed along of a car that corners on asphalt

Term = Callable[[CarState, CarState, Controls], float]


def speed_along(before: CarState, after: CarState, controls: Controls) -> float:
    """Vx cos θ [m/s]: speed along the road (Lillicrap et al., arXiv:1509.02971, section 4)."""
    return after.speed_x * cos(after.heading_error)


def speed_across(before: CarState, after: CarState, controls: Controls) -> float:
    """Vx sin θ, without its sign [m/s]: speed across the road, of the post's reward."""
    return abs(after.speed_x * sin(after.heading_error))


def speed_off_axis(before: CarState, after: CarState, controls: Controls) -> float:
    """Vx · trackPos, without its sign [m/s]: speed off the road's middle, of the post's reward."""
    return abs(after.speed_x * track_position(after))


def progress(before: CarState, after: CarState, controls: Controls) -> float:
    """Metres of road gained per second [m/s]: exact over a timestep, where speeds are samples."""
    return (after.distance_raced - before.distance_raced) / (after.time - before.time)


def damage(before: CarState, after: CarState, controls: Controls) -> float:
    """Damage per second [points/s]."""
    return (after.damage - before.damage) / (after.time - before.time)


def pedals(before: CarState, after: CarState, controls: Controls) -> float:
    """Throttle × brake [-]: both pedals at once."""
    return controls.throttle * controls.brake


def steering(before: CarState, after: CarState, controls: Controls) -> float:
    """Speed × the square of the steering [m/s]: a car that weaves has much of it."""
    return controls.steering * controls.steering * abs(after.speed_x)


def sliding(before: CarState, after: CarState, controls: Controls) -> float:
    """Speed across the car (Vy) beyond a tenth of that along it (Vx) [m/s]: how much it slides."""
    return max(abs(after.speed_y) - NO_SLIDE * abs(after.speed_x), 0.0)


@register_jitable
def safe_speed(sight: float) -> float:
    """
    Return the speed from which 10 m/s² slow down to 12 m/s within a distance [m/s].

    :param sight: the distance [m]
    """
    return math.sqrt(BEND_SPEED**2 + 2.0 * BRAKING * sight)


def overspeed(before: CarState, after: CarState, controls: Controls) -> float:
    """Speed above v = √(12² + 2 · 10 · d) [m/s], where d [m] is the longest range finder: who
    brakes from v at 10 m/s² has 12 m/s at the end of what it sees.
    """
    sight = max(float(after.range_finders.max()), 0.0)
    return max(after.speed_x - safe_speed(sight), 0.0)


def places(before: CarState, after: CarState, controls: Controls) -> float:
    """Places gained per second [1/s], in a race; those lost count negative."""
    return (before.race_position - after.race_position) / (after.time - before.time)


def contact(before: CarState, after: CarState, controls: Controls) -> float:
    """Contacts with other cars per second [1/s], whosever fault."""
    return (after.race[CONTACTS] - before.race[CONTACTS]) / (after.time - before.time)


def fault(before: CarState, after: CarState, controls: Controls) -> float:
    """Contacts per second in which this car hits another with its front [1/s]."""
    return (after.race[FAULTS] - before.race[FAULTS]) / (after.time - before.time)


def passing(before: CarState, after: CarState, controls: Controls) -> float:
    """Metres per second gained on each of the nearest cars [m/s], full beside it, none from 80 m.

    So it is earned before a place is won, and after it (Wurman et al., Nature 602, 2022).
    """
    gained = 0.0
    rivals = after.race[FIRST_RIVAL:]
    for i in range(RIVALS):
        along, _, faster, _, _, _ = rival(rivals, i)
        gained -= clarity(along) * faster
    return float(gained)


def off_line(before: CarState, after: CarState, controls: Controls) -> float:
    """Speed × how far the car's outer side is over the edge of the road [m²/s]."""
    over = abs(after.distance_from_axis) + 0.5 * (CAR_WIDTH - after.track_width)
    return max(over, 0.0) * abs(after.speed_x)


def leaving(before: CarState, after: CarState, controls: Controls) -> float:
    """Speed² where the car leaves the road, else 0 [m²/s²]: the energy that gravel or a wall takes
    (Wurman et al., Nature 602, 2022, charge both so). So a car that cannot stay on the road still
    learns to brake.
    """
    # As products: Python's power differs in the last bit from what compiled code makes of it.
    speed_x, speed_y = after.speed_x, after.speed_y
    return speed_x * speed_x + speed_y * speed_y if is_off_track(after) else 0.0


TERMS: dict[str, Term] = {
    term.__name__: term
    for term in (
        speed_along, speed_across, speed_off_axis, progress, damage, pedals, steering, sliding,
        overspeed, places, contact, fault, passing, off_line, leaving,
    )
}  # fmt: skip
"""By name. Own ones may be added: functions of the car before and after, and of the controls."""

OWN_TERMS: tuple[Term, ...] = tuple(TERMS.values())
"""Those of this package, which are compiled."""

# So that no reward is infinite in single precision, in which SB3 sums them up.
LARGEST = 1e9  # of a weight
LARGEST_VALUE = 1e24  # of a term that was added
SCALE = 0.1  # [1/m] a reward of 1 for ten metres along the road
CRASH = -1.0  # when an episode ends off the road, backwards, stuck or damaged

RewardName = Literal["progress", "blog", "apex"]
RewardChoice = RewardName | Mapping[str, float]
"""A preset, or a mapping from terms to weights."""

PRESETS: dict[RewardName, dict[str, float]] = {
    "progress": {"speed_along": 1.0, "scale": SCALE, "crash": CRASH},
    "blog": {
        "speed_along": 1.0,
        "speed_across": -1.0,
        "speed_off_axis": -1.0,
        "scale": SCALE,
        "crash": CRASH,
    },
    "apex": {"speed_along": 1.0, "speed_across": -1.0, "scale": SCALE, "crash": CRASH},
}
"""``progress``: Lillicrap et al.; ``blog``: the post's; ``apex``: its final update, which leaves
out the pull to the middle of the road."""

CRASHES = ("off_track", "backwards", "stuck", "damage", "lost")


class Reward:
    """
    A weighted sum of terms.

    :param reward: the name of a preset, or a mapping from names of terms to weights; the
        mapping may also hold ``scale`` (a factor on all terms, 1 if left out) and ``crash`` (added
        once, unscaled, when the episode ends badly, 0 if left out)
    :raises UnknownRewardTerm: if a name is unknown
    :raises InvalidOption: if a weight is no number from -1e9 to 1e9, or if an added term is no
        function, or has a name that means something else
    """

    def __init__(self, reward: RewardChoice) -> None:
        if isinstance(reward, str):
            if reward not in PRESETS:
                advice = (
                    f"rewards: {', '.join(PRESETS)}, or a dict of weights over {', '.join(TERMS)}"
                )
                raise UnknownRewardTerm(f"no reward '{reward}'{near_miss(reward, PRESETS, advice)}")
            weights = PRESETS[reward]
        elif isinstance(reward, Mapping):
            weights = dict(reward)
        else:
            raise InvalidOption(
                f"reward is {reward!r}; expected one of {', '.join(PRESETS)}, or a dict of weights"
            )
        for name, weight in weights.items():
            if not isinstance(name, str) or name not in (*TERMS, "scale", "crash"):
                advice = f"terms: {', '.join(TERMS)}; besides them 'scale' and 'crash'"
                raise UnknownRewardTerm(f"no reward term '{name}'{near_miss(name, TERMS, advice)}")
            if not is_number(weight) or abs(weight) > LARGEST:
                raise InvalidOption(
                    f"weight of reward term '{name}' is {weight!r}; expected a number from "
                    f"{-LARGEST:g} to {LARGEST:g}"
                )
        self.weights = {name: float(weight) for name, weight in weights.items()}
        for name in ("scale", "crash"):
            if name in TERMS:
                raise InvalidOption(
                    f"a reward term is called '{name}', which is no term of a reward; add it to "
                    "TERMS by another name"
                )
        scale = self.weights.get("scale", 1.0)
        self._crash = float(weights.get("crash", 0.0))
        self.terms = tuple(
            (name, _checked_term(name, TERMS[name]), float(weight) * scale)
            for name, weight in weights.items()
            if name in TERMS
        )
        self.names = tuple(name for name, _, _ in self.terms)

    def explain(self, terms: Sequence[float], end: str | None) -> dict[str, float]:
        """
        Name the weighted terms of a timestep, and add what its end costs.

        :param terms: one for each of the names
        :param end: why the episode ended, or ``None``
        :return: the terms, ``crash`` last; their sum is the reward
        """
        # Rewards of a batch may have more terms than this one: zeros after its own.
        named = dict(zip(self.names, terms, strict=False))
        named["crash"] = self._crash if end in CRASHES else 0.0
        return named


class Rewards:
    """
    The rewards of some cars, which are valued at once.

    :param rewards: of each car
    """

    def __init__(self, rewards: Sequence[Reward]) -> None:
        self.rewards = list(rewards)
        self._shape = len(self.rewards), max(len(reward.terms) for reward in self.rewards)
        compiled: dict[Term, FloatArray] = {}
        self._in_python: list[tuple[int, int, Term, float]] = []
        for row, reward in enumerate(self.rewards):
            for column, (_, term, weight) in enumerate(reward.terms):
                if term in OWN_TERMS:
                    weights = compiled.setdefault(term, np.full(self._shape, np.nan))
                    weights[row, column] = weight
                else:
                    self._in_python.append((row, column, term, weight))
        self._compiled = [(_compiled(term), weights) for term, weights in compiled.items()]

    def __reduce__(self) -> tuple[type[Rewards], tuple[list[Reward]]]:
        return Rewards, (self.rewards,)  # without compiled functions, which are of this process

    def value(self, before: Any, after: Any, going: Any = None) -> list[list[float]]:
        """
        Value a timestep of each car.

        :param before: (n,) records with the fields ``car`` and ``controls``, before the timestep
        :param after: (n,) at its end, with the controls that were asked for in it, after the aids
            have changed them; with a delay, earlier ones were held meanwhile
        :param going: (n,) of which cars to ask terms that were added; ``None`` is all
        :return: the weighted terms of each car
        :raises InvalidOption: if a term that was added returns no finite number
        """
        terms = np.zeros(self._shape)
        for fill, weights in self._compiled:
            fill(before, after, weights, terms)
        for row, column, term, weight in self._in_python:
            if going is None or going[row]:
                terms[row, column] = _ask(term, weight, before, after, row)
        return terms.tolist()


@lru_cache
def _compiled(term: Term) -> Callable[[Any, Any, FloatArray, FloatArray], None]:
    """Compile what values a term of this package for all cars, but where its weight is nan."""
    rate = register_jitable(term)

    @njit(cache=True)
    def fill(before: Any, after: Any, weights: FloatArray, terms: FloatArray) -> None:
        for row in range(len(after)):
            was, car, controls = before[row].car, after[row].car, after[row].controls
            seconds = car.time - was.time
            for column in range(weights.shape[1]):
                weight = weights[row, column]
                # The state of a lost car does not advance: without time there is no rate.
                if weight == weight and seconds != 0.0:
                    terms[row, column] = weight * seconds * rate(was, car, controls)

    return fill


def _ask(term: Term, weight: float, before: Any, after: Any, row: int) -> float:
    """Value a term that was added for one car."""
    was, car = (
        car_from_record(each[row : row + 1].view(np.float64)[:CAR_NUMBERS])
        for each in (before, after)
    )
    seconds = car.time - was.time
    controls = controls_from_record(after["controls"][row])
    return weight * seconds * term(was, car, controls) if seconds else 0.0


def _checked_term(name: str, term: Term) -> Term:
    """Let the values of a term be checked, if somebody has added it."""
    if term in OWN_TERMS:
        return term
    if not callable(term):
        raise InvalidOption(
            f"reward term '{name}' is {term!r}; expected a function of the car before, the car "
            "after and the controls"
        )
    return partial(_finite, name, term)  # no closure, which could not be pickled


def _finite(name: str, term: Term, before: CarState, after: CarState, controls: Controls) -> float:
    value = term(before, after, controls)
    if not (is_number(value) and abs(value) <= LARGEST_VALUE):
        raise InvalidOption(
            f"reward term '{name}' returned {value!r}; expected a finite number from "
            f"{-LARGEST_VALUE:g} to {LARGEST_VALUE:g}"
        )
    return float(value)
