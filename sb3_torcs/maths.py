"""Trigonometry and the exponential function, with the same bits on every machine.

The processor and the release of the system decide how numpy and the C library compute these, so
that last bits differ; and a car that drives slightly differently is elsewhere after a lap. All that
drives, sees or lays a road uses the functions here. They need additions, multiplications, divisions
and square roots alone, which IEEE 754 rounds in one way, in an order that no compiler may change.

An argument is reduced to near an entry of a table, and the first terms of a Taylor series do the
rest (Tang, "Table-lookup algorithms for elementary functions and their error analysis", 1991).
Errors are within about one unit of the last place. :func:`compiled` makes functions of them that
are fast, and that compiled code can call: numba takes time to load, and few need it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

__all__ = [
    "atan",
    "atan2",
    "compiled",
    "cos",
    "cos_sin",
    "directions",
    "exp",
    "hypot",
    "lengths",
    "sin",
    "tan",
    "wrong_functions",
]

FloatArray = npt.NDArray[np.float64]
Function = TypeVar("Function", bound=Callable[..., Any])

ONE = 1 << 200  # stands for 1 in the whole numbers that make the tables
ARCS = 16  # [-] entries from 0 to 1 in the table of arcs, without the last
BENDS = 10  # [-] terms of its series
POWERS = 32  # [-] entries from 1 to 2 in the table of powers
ROUND = 1.5 * 2.0**52  # added and taken away again, it rounds to a whole number
FAR = 1000.0  # [rad] angles beyond are first reduced by whole turns, which is less precise
LARGEST, SMALLEST = 710.0, -746.0  # beyond, the exponential function is infinite or 0
LEAST = 1077  # [-] halvings of 1 in the table of scales, before which it has no entries


def _arc(share: int) -> int:
    """Arc tangent of ``share / ARCS`` in parts of ``ONE``, by Euler's series."""
    square, whole = share * share, ARCS * ARCS
    term = ONE * share * ARCS // (whole + square)
    total, n = 0, 0
    while term:
        total, n = total + term, n + 1
        term = term * 2 * n * square // ((2 * n + 1) * (whole + square))
    return total


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


def _parts(number: int, *bits: int) -> list[float]:
    """Floats of so many bits each, whose sum is a number in parts of ``ONE``."""
    parts = []
    for size in bits:
        cut = max(number.bit_length() - size, 0)
        part = (number + (1 << cut >> 1)) >> cut << cut
        parts.append(part / ONE)
        number -= part
    return parts


_ARCS = [_arc(share) for share in range(ARCS + 1)]
_PI = 4 * _ARCS[-1]
# What arcs count from, in the octants of atan2: 0, a quarter turn back, half a turn back, a
# quarter turn on.
_BASES = np.array([
    [_parts(base + sign * arc, 53, 53) for arc in _ARCS]
    for base, sign in ((0, 1), (_PI // 2, -1), (_PI, -1), (_PI // 2, 1))
])  # fmt: skip
_BENDS = np.array([_bends(share) for share in range(ARCS + 1)])
_POWERS = np.array([_parts(_power(share), 53, 53) for share in range(POWERS)])
_SCALES = np.array([math.ldexp(1.0, halvings) for halvings in range(-LEAST, 1024)] + [math.inf])
_LN2 = sum((ONE >> n) // n for n in range(1, ONE.bit_length()))
# Of so few bits that products with the number of reductions are exact, but for the last part.
_QUARTER_1, _QUARTER_2, _QUARTER_3 = _parts(_PI // 2, 33, 33, 53)
_STEP_1, _STEP_2 = _parts(_LN2 // POWERS, 36, 53)
_EIGHTH = _parts(_PI // 4, 53)[0]
_QUARTERS = 2 * ONE / _PI  # [1/rad]
_STEPS = POWERS * ONE / _LN2

_S3, _S5, _S7, _S9 = -1.0 / 6.0, 1.0 / 120.0, -1.0 / 5040.0, 1.0 / 362880.0
_S11, _S13 = -1.0 / 39916800.0, 1.0 / 6227020800.0
_S15, _S17 = -1.0 / 1307674368000.0, 1.0 / 355687428096000.0
_C4, _C6, _C8, _C10 = 1.0 / 24.0, -1.0 / 720.0, 1.0 / 40320.0, -1.0 / 3628800.0
_C12, _C14, _C16 = 1.0 / 479001600.0, -1.0 / 87178291200.0, 1.0 / 20922789888000.0


def _reduced(angle: Any) -> tuple[Any, Any, Any]:
    """Return how many quarter turns an angle has, and the rest in two parts [rad]."""
    quarters = angle * _QUARTERS + ROUND - ROUND
    near, taken = angle - quarters * _QUARTER_1, quarters * _QUARTER_2
    rest = near - taken
    back = near - rest
    lost = (near - (rest + back)) + (back - taken)  # by rounding the rest
    return quarters, rest, lost - quarters * _QUARTER_3


def _sine(rest: Any, lost: Any) -> Any:
    """What is to be added to an angle of at most an eighth turn to get its sine."""
    z = rest * rest
    w = z * z
    even = _S3 + w * (_S7 + w * (_S11 + w * _S15))
    odd = _S5 + w * (_S9 + w * (_S13 + w * _S17))
    return rest * z * (even + z * odd) + lost * (1.0 - 0.5 * z)


def _cosine(rest: Any, lost: Any) -> tuple[Any, Any]:
    """The cosine of an angle of at most an eighth turn, in two parts."""
    z = rest * rest
    w = z * z
    even = _C4 + w * (_C8 + w * (_C12 + w * _C16))
    odd = _C6 + w * (_C10 + w * _C14)
    half = 0.5 * z
    most = 1.0 - half
    return most, (1.0 - most - half) + (w * (even + z * odd) - rest * lost)


def cos_sin(angle: float) -> tuple[float, float]:
    """
    Compute cosine and sine together, which is faster than one after the other.

    :param angle: [rad]
    """
    quarter, rest, lost = 0, angle, 0.0
    if not abs(angle) <= _EIGHTH:
        if not abs(angle) < FAR:
            angle = angle % math.tau if abs(angle) < math.inf else math.nan
        quarters, rest, lost = _reduced(angle)
        quarter = int(quarters) if quarters == quarters else 0
    most, little = _cosine(rest, lost)
    sine, cosine = rest + _sine(rest, lost), most + little
    if quarter & 1:
        cosine, sine = -sine, cosine
    return (-cosine, -sine) if quarter & 2 else (cosine, sine)


def cos(angle: float) -> float:
    """
    Compute the cosine.

    :param angle: [rad]
    """
    return cos_sin(angle)[0]


def sin(angle: float) -> float:
    """
    Compute the sine.

    :param angle: [rad]
    """
    return cos_sin(angle)[1]


def tan(angle: float) -> float:
    """
    Compute the tangent.

    :param angle: [rad]
    """
    cosine, sine = cos_sin(angle)
    return sine / cosine


def _direction(share: float, octant: int) -> float:
    """Return the direction in an octant of the plane [rad], by its tangent from the nearer axis."""
    if not share <= 1.0:
        return math.nan
    entry = int(share * ARCS + 0.5)
    d = share - entry / ARCS
    arc = _BENDS[entry]
    z = d * d
    w = z * z
    slope = (arc[0] + d * arc[1]) + z * (arc[2] + d * arc[3])
    slope += w * ((arc[4] + d * arc[5]) + z * (arc[6] + d * arc[7]) + w * (arc[8] + d * arc[9]))
    if octant == 1 or octant == 2:
        d = -d
    return float(_BASES[octant, entry, 0] + (d + (_BASES[octant, entry, 1] + d * slope)))


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
        return 0.0 if long == 0.0 else math.nan
    direction = _direction(short / long, octant)
    return -direction if y < 0.0 else direction


def atan(tangent: float) -> float:
    """
    Compute the arc tangent [rad].

    :param tangent: of the angle
    """
    size = abs(tangent)
    arc = _direction(size, 0) if size <= 1.0 else _direction(1.0 / size, 1)
    return -arc if tangent < 0.0 else arc


def exp(power: float) -> float:
    """
    Compute the exponential function.

    :param power: of e
    """
    if not SMALLEST < power < LARGEST:
        return power if power != power else (math.inf if power > 0.0 else 0.0)
    steps = power * _STEPS + ROUND - ROUND
    rest = (power - steps * _STEP_1) - steps * _STEP_2
    square = rest * rest
    more = rest + square * (
        0.5 + rest / 6.0 + square * (1.0 / 24.0 + rest / 120.0 + square / 720.0)
    )
    whole = int(steps)
    first, second = _POWERS[whole & (POWERS - 1)]
    return float((first + (second + first * more)) * _SCALES[(whole >> 5) + LEAST])


def hypot(x: float, y: float) -> float:
    """
    Compute the length of a vector.

    :param x: one part of it, at most 1e150
    :param y: the other
    """
    return math.sqrt(x * x + y * y)


def directions(angles: FloatArray) -> FloatArray:
    """
    Compute the cosines and sines of many angles.

    :param angles: (n,) [rad], of at most 1000
    :return: (n, 2)
    """
    quarters, rest, lost = _reduced(angles)
    most, little = _cosine(rest, lost)
    found = np.stack([most + little, rest + _sine(rest, lost)], axis=1)
    quarter = quarters.astype(np.int64) & 3
    odd, back = (quarter & 1) == 1, (quarter & 2) == 2
    found[odd] = found[odd, ::-1] * [-1.0, 1.0]
    found[back] *= -1.0
    return found


def lengths(vectors: FloatArray) -> FloatArray:
    """
    Compute the lengths of many vectors.

    :param vectors: (n, 2)
    :return: (n,)
    """
    squares = vectors * vectors
    return np.asarray(np.sqrt(squares[:, 0] + squares[:, 1]))


@functools.cache
def compiled(function: Function) -> Function:
    """
    Compile a function of one or two numbers.

    :param function: of this module
    :return: one that returns the same
    """
    from numba import njit

    _register()
    made: Function = njit(cache=True, error_model="numpy")(function)
    return made


@functools.cache
def _register() -> None:
    """Let compiled functions call those of which they consist."""
    from numba.extending import register_jitable

    for helper in _HELPERS:
        register_jitable(helper)


_HELPERS = (_reduced, _sine, _cosine, _direction, atan2, cos_sin)


_KNOWN = (
    (atan, (-7.1,), "-0x1.6e4d9ad83dd98p+0"),
    (atan2, (-5.0, 0.1), "-0x1.8d0129acd6d1cp+0"),
    (cos, (-123.456,), "-0x1.307e5980a1558p-1"),
    (exp, (-12.3,), "0x1.31765fdaf4f37p-18"),
    (hypot, (0.3, -2.0), "0x1.02dd2dc67f097p+1"),
    (sin, (-123.456,), "0x1.9b9dadc41aeb6p-1"),
    (tan, (-123.456,), "-0x1.5a0fe5da94891p+0"),
)
"""What functions return for some arguments on every machine."""


def wrong_functions() -> list[str]:
    """List the functions that compute something else on this machine."""
    return [
        function.__name__
        for function, arguments, known in _KNOWN
        if compiled(function)(*arguments) != float.fromhex(known)
    ]
