"""Functions whose last bits no machine changes."""

from __future__ import annotations

import json
import math
import subprocess
import sys

import mpmath
import numpy as np
import pytest

from sb3_torcs import maths

ONE = ("sin", "cos", "tan", "atan", "exp")
TWO = ("atan2", "hypot")
WORST = {"tan": 2.0, "atan2": 1.3, "atan": 1.3, "hypot": 1.2}  # units of the last place; else 0.8


@pytest.fixture(scope="module")
def numbers():
    """Small and large ones, and those near where a function changes its way."""
    rng = np.random.default_rng(0)
    edges = [k * math.pi / 4 for k in range(-40, 41)] + [k / 32 for k in range(-64, 65)]
    return [*rng.uniform(-900.0, 900.0, 500).tolist(), *rng.normal(size=500).tolist(), *edges]


def error(found, exact):
    """Of a float, in units of the last place of the exact result."""
    return float(abs(found - exact) / math.ulp(float(exact)))


@pytest.mark.parametrize("name", ONE)
def test_a_function_is_exact_but_for_its_last_place(name, numbers):
    function, exact = getattr(maths, name), getattr(mpmath, name)
    taken = [x for x in numbers if name != "exp" or abs(x) < 700.0]
    with mpmath.workprec(200):
        worst = max(error(function(x), exact(mpmath.mpf(x))) for x in taken)
    assert worst < WORST.get(name, 0.8)


@pytest.mark.parametrize("name", TWO)
def test_a_function_of_a_vector_is_exact_but_for_its_last_place(name, numbers):
    function, exact = getattr(maths, name), getattr(mpmath, name)
    pairs = list(zip(numbers, reversed(numbers), strict=True))
    with mpmath.workprec(200):
        worst = max(error(function(x, y), exact(x, y)) for x, y in pairs if x and y)
    assert worst < WORST[name]


def test_compiled_functions_return_the_same(numbers):
    for name in ONE:
        function = getattr(maths, name)
        again = maths.compiled(function)
        assert [again(x) for x in numbers] == [function(x) for x in numbers]
    for name in TWO:
        function = getattr(maths, name)
        again = maths.compiled(function)
        pairs = list(zip(numbers, reversed(numbers), strict=True))
        assert [again(*pair) for pair in pairs] == [function(*pair) for pair in pairs]


def test_many_angles_are_computed_as_one(numbers):
    np.testing.assert_array_equal(
        maths.directions(np.array(numbers)), [maths.cos_sin(x) for x in numbers]
    )
    vectors = np.array(numbers).reshape(-1, 2)
    np.testing.assert_array_equal(maths.lengths(vectors), [maths.hypot(*row) for row in vectors])


@pytest.mark.parametrize("made", [lambda f: f, maths.compiled], ids=["plain", "compiled"])
def test_what_is_no_number_stays_none_and_infinity_has_a_limit(made):
    for name in ONE:
        assert math.isnan(made(getattr(maths, name))(math.nan))
    assert math.isnan(made(maths.sin)(math.inf))
    assert made(maths.atan)(math.inf) == math.pi / 2.0
    assert made(maths.exp)(-math.inf) == 0.0
    assert made(maths.exp)(math.inf) == made(maths.exp)(709.9) == math.inf
    assert math.isnan(made(maths.atan2)(math.nan, 1.0))
    assert made(maths.atan2)(0.0, 0.0) == 0.0
    assert abs(made(maths.sin)(1e300)) <= 1.0


def test_angles_in_all_directions_are_found():
    for x, y in [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)]:
        assert maths.atan2(float(y), float(x)) == math.atan2(y, x)


def test_it_loads_no_compiler():
    """Reading a track needs none, and numba takes longer to load than that."""
    code = "import json, sys; import sb3_torcs.maths; print(json.dumps('numba' in sys.modules))"
    told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert json.loads(told.stdout) is False
