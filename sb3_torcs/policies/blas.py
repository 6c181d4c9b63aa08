"""Matrix products inside compiled functions, by the fastest library that is already loaded.

PyTorch brings a BLAS of its own, as a rule Intel's MKL, half again as fast here as SciPy's, which
numba takes by itself.
"""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numpy as np
import torch as th
from numba import njit, types
from numba.extending import get_cython_function_address, overload

__all__ = ["product"]


def _address(name: str) -> int:
    """Find ``sgemm`` or ``dgemm``, whose Fortran interface all libraries share."""
    try:
        library = ctypes.CDLL(str(Path(th.__file__).parent / "lib" / "libtorch_cpu.so"))
        address = ctypes.cast(library[f"{name}_"], ctypes.c_void_p).value
    except (OSError, AttributeError):
        address = None
    return address or get_cython_function_address("scipy.linalg.cython_blas", name)


def _external(name: str) -> Any:
    """Make the function known to compiled ones, whose files keep its name only."""
    symbol = f"sb3_torcs_{name}"
    llvm.add_symbol(symbol, _address(name))
    return types.ExternalFunction(symbol, types.void(*[types.voidptr] * 13))


_GEMM = {types.float32: _external("sgemm"), types.float64: _external("dgemm")}
_LETTERS = np.frombuffer(b"NT", np.uint8)


def _product(a: Any, turn_a: bool, b: Any, turn_b: bool, out: Any) -> None:
    raise NotImplementedError("for compiled functions only")


@overload(_product)
def _compile_product(a: Any, turn_a: Any, b: Any, turn_b: Any, out: Any) -> Any:  # noqa: ARG001
    gemm = _GEMM[a.dtype]

    def compiled(a: Any, turn_a: Any, b: Any, turn_b: Any, out: Any) -> Any:
        # Fortran's arrays are ours transposed, so it multiplies b and a. It takes all arguments by
        # address; where it expects 32 bits, the low half of a 64-bit number is that number.
        rows, columns = out.shape
        inner = a.shape[0] if turn_a else a.shape[1]
        sizes = np.array([columns, rows, inner, b.shape[1], a.shape[1], columns], np.int64)
        factors = np.zeros(2, out.dtype)
        factors[0] = 1
        first, second = _LETTERS[int(turn_b) :], _LETTERS[int(turn_a) :]
        gemm(
            first.ctypes, second.ctypes, sizes.ctypes, sizes[1:].ctypes, sizes[2:].ctypes,
            factors.ctypes, b.ctypes, sizes[3:].ctypes, a.ctypes, sizes[4:].ctypes,
            factors[1:].ctypes, out.ctypes, sizes[5:].ctypes,
        )  # fmt: skip

    return compiled


@njit(cache=True)
def product(a: Any, turn_a: bool, b: Any, turn_b: bool, out: Any) -> None:
    """
    Multiply two matrices.

    :param a: (n, k), or (k, n) if transposed
    :param turn_a: transpose it
    :param b: (k, m), or (m, k) if transposed
    :param turn_b: transpose it
    :param out: (n, m), overwritten
    """
    _product(a, turn_a, b, turn_b, out)
