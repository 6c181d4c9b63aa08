"""Mathematics with the same results on every machine, and nothing that goes around it.

That the functions are right at all 2^32 arguments is checked by ``tools/check_maths.cpp``; the
checksums here are of what it has checked.
"""

from __future__ import annotations

import ctypes
import json
import math
import struct
import subprocess
from pathlib import Path

import pytest
from game_copy import compiled, python

from sb3_torcs import _engine
from sb3_torcs.torcs.process import compiled_library

INF, NAN = math.inf, math.nan
LARGEST, SMALLEST = (2.0 - 2.0**-23) * 2.0**127, 2.0**-149  # of floats

STEP, LARGER_STEP = 431, 65537  # of arguments: ten million of each function, or 65,536
CHECKSUMS = {
    "tanf": (0xB96DD782674ADD25, 0xDBE9E56F577E6358),
    "atanf": (0x584194FD79E5532E, 0xE53AFBBB6E6EDA2A),
    "asinf": (0x1F5083958D35A1CF, 0x40A350C81F748ADC),
    "acosf": (0x2B2A36A896F0F96E, 0x6805CEF00D6AC0C3),
    "tanhf": (0xAA245EF1ED7C64FF, 0xCA20178C79F4B81E),
    "atan2f": (0x6746ACEFE514D32, 0x9203595C62425DDA),
    "sinf": (0x60B1574DE95145CA, 0x4DE266FC151E0548),
    "cosf": (0xE5B1CB81D5CB6F54, 0x271351481F424B74),
    "sincosf's sine": (0x60B1574DE95145CA, 0x4DE266FC151E0548),
    "sincosf's cosine": (0xE5B1CB81D5CB6F54, 0x271351481F424B74),
    "expf": (0x57EDBE76D95B2E3C, 0xCA5F84B9AF7955FC),
    "logf": (0x678E4CF6A0932F8E, 0x4CE1731881FA8B86),
}
FUSED = ("sinf", "cosf", "sincosf's sine", "sincosf's cosine", "expf", "logf")

# What IEEE 754 and C say of special arguments.
SPECIAL = [
    ("tanf", -0.0, -0.0),
    ("tanf", SMALLEST, SMALLEST),
    ("tanf", INF, NAN),
    ("atanf", -0.0, -0.0),
    ("atanf", -INF, -math.pi / 2),
    ("atanf", LARGEST, math.pi / 2),
    ("atanf", NAN, NAN),
    ("asinf", -0.0, -0.0),
    ("asinf", 1.0, math.pi / 2),
    ("asinf", -1.0000001, NAN),
    ("acosf", 1.0, 0.0),
    ("acosf", -1.0, math.pi),
    ("acosf", INF, NAN),
    ("tanhf", -0.0, -0.0),
    ("tanhf", -INF, -1.0),
    ("tanhf", 20.0, 1.0),
    ("tanhf", NAN, NAN),
    ("sinf", -0.0, -0.0),
    ("sinf", -INF, NAN),
    ("cosf", SMALLEST, 1.0),
    ("cosf", NAN, NAN),
    ("expf", 0.0, 1.0),
    ("expf", INF, INF),
    ("expf", -INF, 0.0),
    ("expf", 88.72284, INF),
    ("expf", -103.97, SMALLEST),
    ("expf", -104.0, 0.0),
    ("logf", 1.0, 0.0),
    ("logf", 0.0, -INF),
    ("logf", -0.0, -INF),
    ("logf", -1.0, NAN),
    ("logf", INF, INF),
]
SPECIAL_PAIRS = [
    (0.0, 0.0, 0.0),
    (-0.0, 0.0, -0.0),
    (0.0, -0.0, math.pi),
    (-0.0, -1.0, -math.pi),
    (1.0, -0.0, math.pi / 2),
    (-SMALLEST, 0.0, -math.pi / 2),
    (INF, INF, math.pi / 4),
    (-INF, -INF, -0.75 * math.pi),
    (INF, -1.0, math.pi / 2),
    (1.0, INF, 0.0),
    (-1.0, -INF, -math.pi),
    (SMALLEST, LARGEST, 0.0),
    (SMALLEST, 2.0, 0.0),  # the middle between two floats, and the angle is less
    (3 * SMALLEST, 2.0, SMALLEST),
    (NAN, 1.0, NAN),
    (1.0, NAN, NAN),
]

# Of libm, our libraries call what IEEE 754 defines to the bit, and no more.
EXACT = {
    "ceil", "fegetenv", "fesetenv", "floor", "fma", "fmax", "fmod", "lround", "lroundf",
    "remainder", "round", "sqrt", "sqrtf",
}  # fmt: skip
LIBRARIES = ("_engine", "_scr_server", "_game_window", "_game_maths")

# A system whose functions all differ from this one's in the last digit.
OTHER_LIBM = """
#include <dlfcn.h>
#include <string.h>
#define ONE(type, bits, name)                                                        \\
    extern "C" type name(type x) {                                                   \\
        static type (*real)(type) = (type (*)(type))dlsym(RTLD_NEXT, #name);         \\
        type y = real(x); bits b; memcpy(&b, &y, sizeof b); b++; memcpy(&y, &b, sizeof b); \\
        return y;                                                                    \\
    }
#define TWO(type, bits, name)                                                        \\
    extern "C" type name(type x, type z) {                                           \\
        static type (*real)(type, type) = (type (*)(type, type))dlsym(RTLD_NEXT, #name); \\
        type y = real(x, z); bits b; memcpy(&b, &y, sizeof b); b++; memcpy(&y, &b, sizeof b); \\
        return y;                                                                    \\
    }
#define FLOAT(name) ONE(float, unsigned, name)
#define DOUBLE(name) ONE(double, unsigned long, name)
FLOAT(sinf) FLOAT(cosf) FLOAT(tanf) FLOAT(asinf) FLOAT(acosf) FLOAT(atanf) FLOAT(expf) FLOAT(logf)
FLOAT(tanhf) TWO(float, unsigned, atan2f) TWO(float, unsigned, hypotf)
DOUBLE(sin) DOUBLE(cos) DOUBLE(tan) DOUBLE(asin) DOUBLE(acos) DOUBLE(atan) DOUBLE(log)
TWO(double, unsigned long, atan2) TWO(double, unsigned long, hypot)
extern "C" void sincosf(float x, float* s, float* c) { *s = sinf(x); *c = cosf(x); }
extern "C" void sincos(double x, double* s, double* c) { *s = sin(x); *c = cos(x); }
"""

# Cars of a robot that uses floats only, and one of ours behind them. At the start they touch.
RACE = """
import hashlib, json, math
from sb3_torcs.backends.native import make_engine
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.starting_list import AGENT
import numpy as np

game = find_game()
robots = [("bt", robot.index) for robot in game.robots()["bt"] if robot.car in game.cars()][:9]
engine = make_engine(game, "aalborg", [*robots, AGENT], session="race")
engine.start()
for tick in range(1000):
    engine.hold(len(robots), 0.01 * (tick % 7 - 3), 1.0, 0.0, None)
    engine.advance(1)
cars = [np.float64(value).tobytes() for car in range(len(robots) + 1) for value in engine.read(car)]
damage = sum(result[4] for result in engine.results())
print(json.dumps([math.sin(0.5), damage, hashlib.sha256(b"".join(cars)).hexdigest()]))
"""


@pytest.fixture(scope="module")
def functions():
    """The library that the game's own process loads, whose functions have libm's names."""
    library = ctypes.CDLL(str(compiled_library("_game_maths")))
    for name in ("tanf", "atanf", "asinf", "acosf", "tanhf", "sinf", "cosf", "expf", "logf"):
        function = getattr(library, name)
        function.restype, function.argtypes = ctypes.c_float, [ctypes.c_float]
    library.atan2f.restype, library.atan2f.argtypes = ctypes.c_float, [ctypes.c_float] * 2
    return library


def float_bits(number):
    return "nan" if math.isnan(number) else struct.pack("<f", number).hex()


def test_known_values_are_right_here():
    assert _engine.wrong_functions() == []


@pytest.mark.parametrize("name", CHECKSUMS)
def test_ten_million_results_are_those_that_were_checked(name):
    assert _engine.maths_checksum(name, STEP) == CHECKSUMS[name][0]


@pytest.mark.parametrize("name", FUSED)
def test_a_processor_without_fused_operations_computes_the_same(name):
    assert _engine.maths_checksum(name, LARGER_STEP, added=True) == CHECKSUMS[name][1]
    assert _engine.maths_checksum(name, LARGER_STEP) == CHECKSUMS[name][1]


@pytest.mark.parametrize(("name", "argument", "expected"), SPECIAL)
def test_special_arguments(functions, name, argument, expected):
    assert float_bits(getattr(functions, name)(argument)) == float_bits(expected)


@pytest.mark.parametrize(("y", "x", "expected"), SPECIAL_PAIRS)
def test_special_pairs(functions, y, x, expected):
    assert float_bits(functions.atan2f(y, x)) == float_bits(expected)


def test_a_sine_with_its_cosine(functions):
    sine, cosine = ctypes.c_float(), ctypes.c_float()
    for angle in (0.0, 1e-5, 0.5, -2.0, 3.0, 4.0, 100.0, -1e10, INF):
        functions.sincosf(ctypes.c_float(angle), ctypes.byref(sine), ctypes.byref(cosine))
        assert float_bits(sine.value) == float_bits(functions.sinf(angle))
        assert float_bits(cosine.value) == float_bits(functions.cosf(angle))


@pytest.mark.parametrize("name", LIBRARIES)
def test_our_libraries_call_nothing_that_differs_between_systems(name):
    libm = next(
        Path(line.split()[-1])
        for line in Path("/proc/self/maps").read_text().splitlines()
        if Path(line.split()[-1]).name.startswith("libm.so")
    )
    theirs = symbols(libm, "--defined-only")
    assert {"sin", "atan2f", "hypot"} <= theirs
    assert symbols(compiled_library(name), "--undefined-only") & theirs <= EXACT


def symbols(library, which):
    done = subprocess.run(
        ["nm", "-D", which, str(library)], capture_output=True, text=True, check=True
    )
    return {line.split()[-1].partition("@")[0] for line in done.stdout.splitlines()}


def test_a_race_is_the_same_on_a_system_with_other_functions(game, tmp_path):
    """The game's modules, libplibsg, which finds contacts, and our own code: all of them."""
    library = compiled(OTHER_LIBM, tmp_path / "libm.so")
    sine, damage, cars = json.loads(python(RACE))
    other_sine, other_damage, other_cars = json.loads(python(RACE, LD_PRELOAD=str(library)))
    assert damage > 0
    assert other_sine == math.nextafter(sine, 1.0)
    assert (other_damage, other_cars) == (damage, cars)
