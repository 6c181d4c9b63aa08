"""Layers of small networks between and around their matrix products, compiled by numba.

``own`` is the part of a vector that begins with a layer's own parameters: as a rule its bias, then
the weight and the bias of its norm.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

__all__ = [
    "compiled",
    "hidden",
    "hidden_backward",
    "join",
    "join_backward",
    "layer",
    "matrix",
    "outputs",
    "outputs_backward",
]

EPSILON = 1e-5
"""[-] PyTorch's own, added to the variance in a layer norm."""

compiled = njit(
    cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy"
)


@compiled
def matrix(vector: Any, start: int, rows: int, columns: int) -> Any:
    """
    Look at a matrix.

    :param vector: in which it stands
    :param start: where
    :param rows: number of them
    :param columns: number of them
    :return: a view, and where it ends
    """
    end = start + rows * columns
    return vector[start:end].reshape(rows, columns), end


@compiled
def hidden(own: Any, norm: bool, x: Any, y: Any, deviation: Any) -> None:
    """
    Add the bias, normalise, and apply ReLU.

    :param own: bias, and with a norm its weight and bias
    :param norm: normalise
    :param x: product, (batch, units); left normalised
    :param y: result, written
    :param deviation: 1 / standard deviation of each row, written with a norm
    """
    batch, units = x.shape
    real = x.dtype.type
    bias, gain, shift = own[:units], own[units : 2 * units], own[2 * units : 3 * units]
    for j in range(batch):
        row, out = x[j], y[j]
        if not norm:
            for i in range(units):
                out[i] = max(row[i] + bias[i], real(0))
            continue
        total = real(0)
        for i in range(units):
            row[i] += bias[i]
            total += row[i]
        mean = total / real(units)
        total = real(0)
        for i in range(units):
            total += (row[i] - mean) * (row[i] - mean)
        scale = real(1) / np.sqrt(total / real(units) + real(EPSILON))
        deviation[j] = scale
        for i in range(units):
            row[i] = (row[i] - mean) * scale
            out[i] = max(row[i] * gain[i] + shift[i], real(0))


@compiled
def hidden_backward(
    own: Any, norm: bool, slope: Any, x: Any, y: Any, deviation: Any, gradient: Any
) -> None:
    """
    Turn the gradient of the result into that of the product.

    :param own: as in ``hidden``
    :param norm: as in ``hidden``
    :param slope: gradient of the result; overwritten with that of the product
    :param x: as ``hidden`` left it
    :param y: from ``hidden``
    :param deviation: from ``hidden``
    :param gradient: of ``own``, written
    """
    batch, units = slope.shape
    real = slope.dtype.type
    gradient[: (3 if norm else 1) * units] = 0
    d_bias, d_gain, d_shift = gradient[:units], gradient[units : 2 * units], gradient[2 * units :]
    gain = own[units : 2 * units]
    for j in range(batch):
        d, out, row = slope[j], y[j], x[j]
        if not norm:
            for i in range(units):
                d[i] *= real(out[i] > 0)
                d_bias[i] += d[i]
            continue
        for i in range(units):
            e = d[i] * real(out[i] > 0)
            d_gain[i] += e * row[i]
            d_shift[i] += e
            d[i] = e * gain[i]
        mean, along = real(0), real(0)
        for i in range(units):
            mean += d[i]
            along += d[i] * row[i]
        mean /= real(units)
        along /= real(units)
        scale = deviation[j]
        for i in range(units):
            d[i] = scale * (d[i] - mean - row[i] * along)
            d_bias[i] += d[i]


@compiled
def outputs(own: Any, x: Any, y: Any) -> None:
    """
    Apply a layer of few outputs.

    :param own: its weight, (outputs, units), and its bias
    :param x: input, (batch, units)
    :param y: result, (batch, outputs), written
    """
    batch, units = x.shape
    outputs = y.shape[1]
    for j in range(batch):
        row = x[j]
        for o in range(outputs):
            weight = own[o * units : (o + 1) * units]
            total = own[outputs * units + o]
            for i in range(units):
                total += row[i] * weight[i]
            y[j, o] = total


@compiled
def outputs_backward(own: Any, slope: Any, x: Any, dx: Any, gradient: Any) -> None:
    """
    Turn the gradient of the result into that of the input.

    :param own: as in ``outputs``
    :param slope: gradient of the result
    :param x: input
    :param dx: its gradient, written
    :param gradient: of ``own``, written
    """
    batch, units = x.shape
    outputs = slope.shape[1]
    gradient[: outputs * (units + 1)] = 0
    for j in range(batch):
        row, d = x[j], dx[j]
        d[:] = 0
        for o in range(outputs):
            e = slope[j, o]
            weight, d_weight = own[o * units : (o + 1) * units], gradient[o * units :]
            gradient[outputs * units + o] += e
            for i in range(units):
                d[i] += e * weight[i]
                d_weight[i] += e * row[i]


@compiled
def join(own: Any, actions: Any, x: Any) -> None:
    """
    Add the layer of the actions to a product.

    :param own: the product's bias, the actions' matrix, (units, actuators), and their bias
    :param actions: (batch, actuators)
    :param x: product, (batch, units); overwritten with the sum
    """
    batch, units = x.shape
    n = actions.shape[1]
    bias, other = own[:units], own[(1 + n) * units : (2 + n) * units]
    weights = own[units : (1 + n) * units].reshape(units, n).T.copy()
    for j in range(batch):
        row = x[j]
        for i in range(units):
            row[i] += bias[i] + other[i]
        for a in range(n):
            weight, action = weights[a], actions[j, a]
            for i in range(units):
                row[i] += action * weight[i]


@compiled
def join_backward(slope: Any, actions: Any, gradient: Any) -> None:
    """
    Find the gradient of what ``join`` adds.

    :param slope: gradient of the sum
    :param actions: (batch, actuators)
    :param gradient: of ``own``, written
    """
    batch, units = slope.shape
    n = actions.shape[1]
    gradient[: (2 + n) * units] = 0
    d_bias, other = gradient[:units], gradient[(1 + n) * units : (2 + n) * units]
    d_weights = np.zeros((n, units), slope.dtype)
    for j in range(batch):
        d = slope[j]
        for i in range(units):
            d_bias[i] += d[i]
        for a in range(n):
            d_weight, action = d_weights[a], actions[j, a]
            for i in range(units):
                d_weight[i] += action * d[i]
    gradient[units : (1 + n) * units].reshape(units, n)[:] = d_weights.T
    other[:] = d_bias


@compiled
def layer(work: Any, start: int, batch: int, units: int) -> Any:
    """
    View the work space of a hidden layer.

    :param work: in which it stands
    :param start: where
    :param batch: number of rows
    :param units: of the layer
    :return: product, result, gradient and deviations, and where they end
    """
    x, start = matrix(work, start, batch, units)
    y, start = matrix(work, start, batch, units)
    slope, start = matrix(work, start, batch, units)
    return x, y, slope, work[start : start + batch], start + batch
