"""Cosine and sine by plain Python, as :mod:`sb3_torcs.maths` has them compiled, to the bit.

They are for what is done without a compiler, whose import takes longer than to read all tracks.
"""

from __future__ import annotations

import math

__all__ = [
    "ARCS",
    "ONE",
    "ROUND",
    "arc",
    "cos",
    "cos_sin",
    "cosine_parts",
    "parts",
    "reduced",
    "sin",
    "sine_rest",
]

ONE = 1 << 200  # stands for 1 in the whole numbers that make the tables
ARCS = 16  # [-] entries from 0 to 1 in the table of arcs, without the last
ROUND = 1.5 * 2.0**52  # added and taken away again, it rounds to a whole number
FAR = 1000.0  # [rad] angles beyond are first reduced by whole turns, which is less precise


def arc(share: int) -> int:
    """Arc tangent of ``share / ARCS`` in parts of ``ONE``, by Euler's series."""
    square, whole = share * share, ARCS * ARCS
    term = ONE * share * ARCS // (whole + square)
    total, n = 0, 0
    while term:
        total, n = total + term, n + 1
        term = term * 2 * n * square // ((2 * n + 1) * (whole + square))
    return total


def parts(number: int, *bits: int) -> list[float]:
    """Floats of so many bits each, whose sum is a number in parts of ``ONE``."""
    parts = []
    for size in bits:
        cut = max(number.bit_length() - size, 0)
        part = (number + (1 << cut >> 1)) >> cut << cut
        parts.append(part / ONE)
        number -= part
    return parts


_PI = 4 * arc(ARCS)
# Of so few bits that products with the number of reductions are exact, but for the last part.
_QUARTER_1, _QUARTER_2, _QUARTER_3 = parts(_PI // 2, 33, 33, 53)
_EIGHTH = parts(_PI // 4, 53)[0]
_QUARTERS = 2 * ONE / _PI  # [1/rad]

_S3, _S5, _S7, _S9 = -1.0 / 6.0, 1.0 / 120.0, -1.0 / 5040.0, 1.0 / 362880.0
_S11, _S13 = -1.0 / 39916800.0, 1.0 / 6227020800.0
_S15, _S17 = -1.0 / 1307674368000.0, 1.0 / 355687428096000.0
_C4, _C6, _C8, _C10 = 1.0 / 24.0, -1.0 / 720.0, 1.0 / 40320.0, -1.0 / 3628800.0
_C12, _C14, _C16 = 1.0 / 479001600.0, -1.0 / 87178291200.0, 1.0 / 20922789888000.0


def reduced(angle: float) -> tuple[int, float, float]:
    """Return how many quarter turns an angle has, and the rest in two parts [rad]."""
    if abs(angle) <= _EIGHTH:
        return 0, angle, 0.0
    if abs(angle) > FAR:
        angle %= math.tau
    quarters = angle * _QUARTERS + ROUND - ROUND
    near, taken = angle - quarters * _QUARTER_1, quarters * _QUARTER_2
    rest = near - taken
    back = near - rest
    lost = (near - (rest + back)) + (back - taken)  # by rounding the rest
    return int(quarters) & 3, rest, lost - quarters * _QUARTER_3


def sine_rest(rest: float, lost: float) -> float:
    """What is to be added to an angle of at most an eighth turn to get its sine."""
    z = rest * rest
    w = z * z
    even = _S3 + w * (_S7 + w * (_S11 + w * _S15))
    odd = _S5 + w * (_S9 + w * (_S13 + w * _S17))
    return rest * z * (even + z * odd) + lost * (1.0 - 0.5 * z)


def cosine_parts(rest: float, lost: float) -> tuple[float, float]:
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
    quarter, rest, lost = reduced(angle)
    most, little = cosine_parts(rest, lost)
    sine, cosine = rest + sine_rest(rest, lost), most + little
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
