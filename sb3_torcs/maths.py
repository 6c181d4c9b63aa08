"""Trigonometry and the exponential function, with the same bits on every machine.

The processor and the release of the system decide how numpy and the C library compute these, so
that last bits differ; and a car that drives slightly differently is elsewhere after a lap. All that
drives, sees or lays a road uses the functions here. They need additions, multiplications, divisions
and square roots alone, which IEEE 754 rounds in one way, in an order that no compiler may change.

An argument is reduced to near an entry of a table, and the first terms of a Taylor series do the
rest (Tang, "Table-lookup algorithms for elementary functions and their error analysis", 1991).
Errors stay below one unit of the last place. Compiled code calls these functions, too.
"""

from __future__ import annotations

import math
import types

import numpy as np
import numpy.typing as npt
from numba import njit

from sb3_torcs import plain_maths
from sb3_torcs.plain_maths import ARCS, ONE, ROUND, arc, parts

__all__ = [
    "atan",
    "atan2",
    "cos",
    "cos_sin",
    "directions",
    "exp",
    "exps",
    "headings",
    "hypot",
    "lengths",
    "sin",
    "tan",
    "wrong_functions",
]

FloatArray = npt.NDArray[np.float64]

_compiled = njit(cache=True, error_model="numpy")

BENDS = 10  # [-] terms of its series
POWERS = 32  # [-] entries from 1 to 2 in the table of powers
LARGEST, SMALLEST = 710.0, -746.0  # beyond, the exponential function is infinite or 0
LEAST = 1077  # [-] halvings of 1 in the table of scales, before which it has no entries


def _bends(share: int) -> list[float]:
    """Coefficients of the Taylor series of arc tangent - argument about ``share / ARCS``."""
    real, imaginary, sign = share, ARCS, 1
    bends = []
    for n in range(1, BENDS + 1):
        whole = n * (share * share + ARCS * ARCS) ** n
        bends.append(sign * ARCS**n * imaginary / whole)
        real, imaginary = real * share - imaginary * ARCS, real * ARCS + imaginary * share
        sign = -sign
    bends[0] = -share * share / (share * share + ARCS * ARCS)
    return bends


def _power(share: int) -> int:
    """Two to the power of ``share / POWERS`` in parts of ``ONE``."""
    power = ONE << share
    size = POWERS
    while size > 1:
        power, size = math.isqrt(power * ONE), size // 2
    return power


_ARCS = [arc(share) for share in range(ARCS + 1)]
_PI = 4 * _ARCS[-1]
# What arcs count from, in the octants of atan2: 0, a quarter turn back, half a turn back, a
# quarter turn on.
_BASES = np.array([
    [parts(base + sign * arc, 53, 53) for arc in _ARCS]
    for base, sign in ((0, 1), (_PI // 2, -1), (_PI, -1), (_PI // 2, 1))
])  # fmt: skip
_BENDS = np.array([_bends(share) for share in range(ARCS + 1)])
_POWERS = np.array([parts(_power(share), 53, 53) for share in range(POWERS)])
_SCALES = np.array([math.ldexp(1.0, halvings) for halvings in range(-LEAST, 1024)] + [math.inf])
_LN2 = sum((ONE >> n) // n for n in range(1, ONE.bit_length()))
# Of so few bits that products with the number of reductions are exact, but for the last part.
_STEP_1, _STEP_2 = parts(_LN2 // POWERS, 36, 53)
_STEPS = POWERS * ONE / _LN2


_home = dict(vars(plain_maths))
"""Where the compiled functions find each other, in place of the plain ones."""
for _name in ("reduced", "sine_rest", "cosine_parts", "cos_sin", "cos", "sin"):
    _copy = types.FunctionType(getattr(plain_maths, _name).__code__, _home, _name)
    _copy.__doc__ = getattr(plain_maths, _name).__doc__
    _home[_name] = _compiled(_copy)
_reduced, _sine, _cosine = _home["reduced"], _home["sine_rest"], _home["cosine_parts"]
cos_sin, cos, sin = _home["cos_sin"], _home["cos"], _home["sin"]


@_compiled
def tan(angle: float) -> float:
    """
    Compute the tangent.

    :param angle: [rad]
    """
    quarter, rest, lost = _reduced(angle)
    most, little = _cosine(rest, lost)
    more = _sine(rest, lost)
    sine, cosine = rest + more, most + little
    over, under = more - (sine - rest), little - (cosine - most)  # lost by rounding them
    if quarter % 2:
        sine, cosine, over, under = cosine, -sine, under, -over
    tangent = sine / cosine
    return tangent + (over - tangent * under) / cosine


@_compiled
def _direction(share: float, octant: int) -> float:
    """Return the direction in an octant of the plane [rad], by its tangent from the nearer axis."""
    if not share <= 1.0:
        return np.nan
    entry = int(share * ARCS + 0.5)
    d = share - entry / ARCS
    arc = _BENDS[entry]
    z = d * d
    w = z * z
    slope = (arc[0] + d * arc[1]) + z * (arc[2] + d * arc[3])
    slope += w * ((arc[4] + d * arc[5]) + z * (arc[6] + d * arc[7]) + w * (arc[8] + d * arc[9]))
    if octant == 1 or octant == 2:
        d = -d
    return _BASES[octant, entry, 0] + (d + (_BASES[octant, entry, 1] + d * slope))


@_compiled
def atan2(y: float, x: float) -> float:
    """
    Compute the direction of a vector [rad], from -π to π; 0 if it has no length.

    :param y: its part to the left
    :param x: its part straight ahead
    """
    long, short = abs(x), abs(y)
    octant = 0 if x >= 0.0 else 2
    if short > long:
        long, short, octant = short, long, octant + 1
    if not long > 0.0:
        return 0.0 if long == 0.0 else np.nan
    direction = _direction(short / long, octant)
    return -direction if y < 0.0 else direction


@_compiled
def atan(tangent: float) -> float:
    """
    Compute the arc tangent [rad].

    :param tangent: of the angle
    """
    size = abs(tangent)
    arc = _direction(size, 0) if size <= 1.0 else _direction(1.0 / size, 1)
    return -arc if tangent < 0.0 else arc


@_compiled
def exp(power: float) -> float:
    """
    Compute the exponential function.

    :param power: of e
    """
    if not SMALLEST < power < LARGEST:
        return power if power != power else (np.inf if power > 0.0 else 0.0)
    steps = power * _STEPS + ROUND - ROUND
    rest = (power - steps * _STEP_1) - steps * _STEP_2
    square = rest * rest
    more = rest + square * (
        0.5 + rest / 6.0 + square * (1.0 / 24.0 + rest / 120.0 + square / 720.0)
    )
    whole = int(steps)
    first, second = _POWERS[whole & (POWERS - 1)]
    return (first + (second + first * more)) * _SCALES[(whole >> 5) + LEAST]


@_compiled
def exps(powers: FloatArray) -> FloatArray:
    """
    Compute the exponential function of many numbers.

    :param powers: (n,) of e
    """
    found = np.empty(len(powers))
    for i in range(len(powers)):
        found[i] = exp(powers[i])
    return found


@_compiled
def hypot(x: float, y: float) -> float:
    """
    Compute the length of a vector.

    :param x: one part of it, at most 1e150
    :param y: the other
    """
    return math.sqrt(x * x + y * y)


@_compiled
def directions(angles: FloatArray) -> FloatArray:
    """
    Compute the cosines and sines of many angles.

    :param angles: (n,) [rad]
    :return: (n, 2)
    """
    found = np.empty((len(angles), 2))
    for i, angle in enumerate(angles):
        found[i, 0], found[i, 1] = cos_sin(angle)
    return found


@_compiled
def headings(vectors: FloatArray) -> FloatArray:
    """
    Compute the directions of many vectors.

    :param vectors: (n, 2)
    :return: (n,) [rad]
    """
    found = np.empty(len(vectors))
    for i in range(len(vectors)):
        found[i] = atan2(vectors[i, 1], vectors[i, 0])
    return found


@_compiled
def lengths(vectors: FloatArray) -> FloatArray:
    """
    Compute the lengths of many vectors.

    :param vectors: (n, 2)
    :return: (n,)
    """
    found = np.empty(len(vectors))
    for i in range(len(vectors)):
        found[i] = hypot(vectors[i, 0], vectors[i, 1])
    return found


_KNOWN = (
    (atan, (-7.1,), "-0x1.6e4d9ad83dd98p+0"),
    (atan2, (-5.0, 0.1), "-0x1.8d0129acd6d1cp+0"),
    (cos, (-123.456,), "-0x1.307e5980a1558p-1"),
    (exp, (-12.3,), "0x1.31765fdaf4f37p-18"),
    (hypot, (0.3, -2.0), "0x1.02dd2dc67f097p+1"),
    (sin, (-123.456,), "0x1.9b9dadc41aeb6p-1"),
    (tan, (-123.456,), "-0x1.5a0fe5da94890p+0"),
)
"""What functions return for some arguments on every machine."""


def wrong_functions() -> list[str]:
    """List the functions that compute something else on this machine."""
    return [
        function.__name__
        for function, arguments, known in _KNOWN
        if function(*arguments) != float.fromhex(known)
    ]
