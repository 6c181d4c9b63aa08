"""Rewards: weighted sums of named terms.

A term is a rate per second of simulated time, measured over one timestep; a reward is the sum of
weight × term × duration × scale, plus a single crash term when the episode ends badly. So the
return of a drive does not depend on the length of a timestep.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Literal

from sb3_torcs import maths
from sb3_torcs.car import CAR_WIDTH, FIRST_RIVAL, RIVALS, CarState, Controls, is_number
from sb3_torcs.errors import InvalidOption, UnknownRewardTerm, near_miss
from sb3_torcs.rivals import clarity, rival

__all__ = [
    "CRASHES",
    "PRESETS",
    "TERMS",
    "Reward",
    "RewardChoice",
    "RewardName",
    "Term",
    "safe_speed",
]

cos, sin = map(maths.compiled, (maths.cos, maths.sin))

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
    return abs(after.speed_x * after.track_position)


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
    return (after.contacts - before.contacts) / (after.time - before.time)


def fault(before: CarState, after: CarState, controls: Controls) -> float:
    """Contacts per second in which this car hits another with its front [1/s]."""
    return (after.faults - before.faults) / (after.time - before.time)


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
    return speed_x * speed_x + speed_y * speed_y if after.off_track else 0.0


TERMS: dict[str, Term] = {
    term.__name__: term
    for term in (
        speed_along, speed_across, speed_off_axis, progress, damage, pedals, steering, sliding,
        overspeed, places, contact, fault, passing, off_line, leaving,
    )
}  # fmt: skip
"""By name. Own ones may be added: functions of the car before and after, and of the controls."""

OWN_TERMS: tuple[Term, ...] = tuple(TERMS.values())
"""Those of this package, which return numbers."""

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

    def nothing(self) -> dict[str, float]:
        """
        Return the terms of an episode that has just begun.

        :return: all terms, each 0
        """
        return dict.fromkeys((*(name for name, _, _ in self.terms), "crash"), 0.0)

    def __call__(
        self, before: CarState, after: CarState, controls: Controls, end: str | None
    ) -> dict[str, float]:
        """
        Value one timestep.

        :param before: the car at the beginning of the timestep
        :param after: the car at its end
        :param controls: that were asked for, after the aids have changed them; with a delay,
            earlier ones were held meanwhile
        :param end: why the episode ended, or ``None``
        :return: the weighted terms, ``crash`` last; their sum is the reward
        :raises InvalidOption: if a term that was added returns no finite number
        """
        seconds = after.time - before.time
        terms = {}  # filled in a loop: a comprehension is one more call per timestep
        for name, term, weight in self.terms:
            # The state of a lost car does not advance: without time there is no rate.
            terms[name] = weight * seconds * term(before, after, controls) if seconds else 0.0
        return self.ended(terms, end)

    def ended(self, terms: dict[str, float], end: str | None) -> dict[str, float]:
        """
        Add what an end costs.

        :param terms: the weighted terms of a timestep, changed
        :param end: why the episode ended, or ``None``
        :return: the same, with ``crash`` last
        """
        terms["crash"] = self._crash if end in CRASHES else 0.0
        return terms


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
