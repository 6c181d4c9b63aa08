"""An opt-in that lets PyTorch use another matrix multiplication on the CPU, guarded by a probe.

PyTorch's oneDNN kernels are much faster than its default ones on some processors. The setting
that selects them also permits 16-bit products, which some processors really use. So it is kept
only where a measurement on this machine finds it both accurate and faster. A virtual machine may
list instructions that it does not allow, and then the kernel kills the process. So a separate
process tries it first.
"""

from __future__ import annotations

import functools
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch as th
from torch.nn import functional

__all__ = ["Probe", "disable", "enable", "probe", "run_once"]

TOLERANCE = 1e-5
"""[-] Largest error relative to the largest value. Single precision has about 1e-6, 16 bit 1e-3."""

MIN_SPEEDUP = 1.05
"""[-] Less is within the noise of the measurement, and not worth another rounding."""

REPEATS = 15
"""Measurements per kernel; the fastest counts."""

TRIAL_TIME = 60.0
"""[s] after which the trial in another process counts as failed; most of it is importing torch."""


class Probe(NamedTuple):
    """What the probe found on this machine."""

    ok: bool  # accurate and faster
    reason: str  # a sentence for people
    error: float  # [-] largest error of output and gradients, relative to the largest value
    speedup: float  # [-] time of the default kernel divided by the time of the other


def enable(batch_size: int = 64) -> Probe:
    """
    Select the other kernel for this process if it is accurate and faster, else change nothing.

    That is measured with products of the post's networks.

    :param batch_size: their rows
    :return: what was found; ``ok`` says whether the setting is now on
    """
    found = probe(batch_size)
    if found.ok:
        _matmul().fp32_precision = "bf16"
    return found


def disable() -> None:
    """Go back to the default kernel."""
    if _has_setting():
        _matmul().fp32_precision = "none"


@functools.cache
def probe(batch_size: int = 64, units: tuple[int, int] = (300, 600)) -> Probe:
    """
    Compare both kernels with double precision and with each other. The setting is left as it was.

    :param batch_size: rows of the products that matter
    :param units: their other two sizes
    :return: what was found; the same again for the same sizes
    """
    if not _has_setting():
        return Probe(False, "this PyTorch has no oneDNN matmul setting", 0.0, 1.0)
    failure = _trial(batch_size, units)
    if failure is not None:
        return Probe(False, f"left off: {failure}", 0.0, 1.0)
    tensors = _tensors(batch_size, units)
    with _setting("none"):
        _linear(*tensors)
    with _setting("bf16"):
        error = _relative_error(tensors)
    speedup = _speedup(tensors)
    ok = error < TOLERANCE and speedup >= MIN_SPEEDUP
    if error >= TOLERANCE:
        reason = f"left off: its error of {error:.1e} is above {TOLERANCE:.0e}"
    elif not ok:
        reason = f"left off: {speedup:.2f} times the default speed, below {MIN_SPEEDUP}"
    else:
        reason = f"on: {speedup:.2f} times the default speed, error {error:.1e}"
    return Probe(ok, reason, error, speedup)


def _tensors(batch_size: int, units: tuple[int, int]) -> list[th.Tensor]:
    # Of a layer: its input, its weight, and the gradient of its output.
    generator = th.Generator().manual_seed(0)
    n_in, n_out = units
    sizes = ((batch_size, n_in), (n_out, n_in), (batch_size, n_out))
    return [th.randn(size, generator=generator) for size in sizes]


def _trial(batch_size: int, units: tuple[int, int]) -> str | None:
    # Why the other kernel cannot be used here at all: a separate process tries it, and may die.
    code = f"from {__name__} import run_once; run_once({batch_size}, {units})"
    call = [sys.executable, "-c", code]
    try:
        ended = subprocess.run(call, capture_output=True, timeout=TRIAL_TIME, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"the trial in another process failed ({type(error).__name__})"
    if ended.returncode < 0:
        return f"the kernel kills the process here ({signal.Signals(-ended.returncode).name})"
    return None if ended.returncode == 0 else f"the trial failed with status {ended.returncode}"


def run_once(batch_size: int, units: tuple[int, int]) -> None:
    """
    Compute the three products of a layer by the other kernel.

    :param batch_size: rows of the products
    :param units: their other two sizes
    """
    with _setting("bf16"):
        _linear(*_tensors(batch_size, units))


def _matmul() -> Any:
    # Older PyTorch has no such module, and the types of the present one do not know it.
    return getattr(th.backends.mkldnn, "matmul", None)


def _has_setting() -> bool:
    return th.backends.mkldnn.is_available() and hasattr(_matmul(), "fp32_precision")


@contextmanager
def _setting(value: str) -> Iterator[None]:
    matmul = _matmul()
    before = matmul.fp32_precision
    matmul.fp32_precision = value
    try:
        yield
    finally:
        matmul.fp32_precision = before


def _linear(x: th.Tensor, weight: th.Tensor, slope: th.Tensor) -> tuple[th.Tensor, ...]:
    # Forward and backward of a layer, the three products of training.
    x, weight = x.detach().requires_grad_(), weight.detach().requires_grad_()
    y = functional.linear(x, weight)
    return (y.detach(), *th.autograd.grad(y, (x, weight), slope))


def _relative_error(tensors: list[th.Tensor]) -> float:
    exact = _linear(*(tensor.double() for tensor in tensors))
    found = _linear(*tensors)
    return max(
        float((single - double).abs().max() / double.abs().max())
        for single, double in zip(found, exact, strict=True)
    )


def _speedup(tensors: list[th.Tensor]) -> float:
    # Interleaved, so that both see a change of the processor's clock rate; the best of each counts.
    best = {"none": float("inf"), "bf16": float("inf")}
    for _ in range(REPEATS):
        for value in best:
            with _setting(value):
                begin = time.process_time()
                for _ in range(4):
                    _linear(*tensors)
                best[value] = min(best[value], time.process_time() - begin)
    return best["none"] / best["bf16"]
