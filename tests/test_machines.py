"""The same figures on every machine, whatever its processor and its system's mathematics."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

FIGURES = {
    "roads": "90ccafd59978d422",
    "lines": "168e72782344e7a8",
    "random roads": "ed4178abfa046532",
    "lines of random roads": "5af2cb6d46d4e9fc",
    "drives on aalborg": "0305983c12a05cbc",
    "drives on alpine-1": "a103ad38f31cd3ab",
    "drives on random roads": "774f8fd95a783123",
    "drives of the scripted driver": "40680863e2865507",
    "actions of ppo-aalborg": "eca2dca452e0b406",
    "actions of ddpg-aalborg": "505bd9cf09c6ebfb",
}
"""What any machine must compute."""

OLD_PROCESSOR = {
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F",
    "NPY_DISABLE_CPU_FEATURES": " ".join(
        name for name in __cpu_dispatch__ if __cpu_features__.get(name)
    ),
    "OPENBLAS_CORETYPE": "Nehalem",
    "NUMBA_CPU_NAME": "generic",
    "NUMBA_CPU_FEATURES": "",
    "ATEN_CPU_CAPABILITY": "default",
    "MKL_CBWR": "COMPATIBLE",
}
"""Lets libraries compute as on a processor of 2010, each in its own way."""


@pytest.mark.parametrize("settings", [{}, OLD_PROCESSOR], ids=["this machine", "old processor"])
def test_roads_drives_and_actions_are_those_of_any_machine(settings, tmp_path):
    """Roads, racing lines, drives on TorcsLite with all that is seen, and agents' actions."""
    if settings:
        settings = {**settings, "NUMBA_CACHE_DIR": str(tmp_path)}  # compiled for another processor
    script = Path(__file__).with_name("figures.py")
    told = subprocess.run(
        [sys.executable, str(script)], env={**os.environ, **settings}, check=True,
        capture_output=True, text=True,
    ).stdout  # fmt: skip
    assert json.loads(told) == FIGURES
