"""Vectors of two axes at each frequency, and the rows of real numbers that least squares take of them."""

import numpy as np

from armperturb.arrays import Array, ComplexArray

CACHED = 2**12
"""Frequencies at which derivatives stay in a processor's cache."""


def applied(matrix: ComplexArray, values: ComplexArray) -> ComplexArray:
    """Matrices (axis, axis, frequency) times vectors (..., axis, frequency)."""
    product = np.empty(values.shape, dtype=complex)
    for row, out in zip(matrix, np.moveaxis(product, -2, 0), strict=True):
        np.multiply(row[0], values[..., 0, :], out=out)
        out += row[1] * values[..., 1, :]
    return product


def applied_rows(matrix: ComplexArray, values: ComplexArray) -> Array:
    """Real then imaginary parts of what `applied` gives, its last two axes as one, (..., number)."""
    rows = np.empty((*values.shape[:-2], 2, *values.shape[-2:]))
    for start in range(0, values.shape[-1], CACHED):
        run = slice(start, start + CACHED)
        product = applied(matrix[..., run], values[..., run])
        rows[..., 0, :, run], rows[..., 1, :, run] = product.real, product.imag
    return rows.reshape(*values.shape[:-2], -1)


def complex_values(rows: Array, shape: tuple[int, ...]) -> ComplexArray:
    """What `applied_rows` gives, as complex numbers of a shape (..., axis, frequency)."""
    real, imaginary = np.split(rows, 2, axis=-1)
    return np.asarray((real + 1j * imaginary).reshape(shape))


def orthonormal(rows: Array) -> Array:
    """Orthonormal rows that span the given ones, none of which is zero, (at most row, number)."""
    _, size, basis = np.linalg.svd(rows / np.linalg.norm(rows, axis=1, keepdims=True), full_matrices=False)
    return np.asarray(basis[size > 1e-9 * size[0]])
