"""Vectors at each frequency, and the rows of real numbers that least squares make of them."""

import numpy as np

from armperturb.arrays import Array, ComplexArray

CACHED = 2**12
"""Frequencies at which derivatives stay in a processor's cache."""

SINGULAR = 1e-9
"""Singular value over the largest up to which a direction counts as none [-]."""


def applied(matrix: ComplexArray, values: ComplexArray) -> ComplexArray:
    """Matrices (row, column, frequency) times vectors (..., column, frequency)."""
    product = np.empty((*values.shape[:-2], len(matrix), values.shape[-1]), dtype=complex)
    for row, of_row in enumerate(matrix):
        out = product[..., row, :]
        np.multiply(of_row[0], values[..., 0, :], out=out)
        for column in range(1, len(of_row)):
            out += of_row[column] * values[..., column, :]
    return product


def applied_rows(matrix: ComplexArray, values: ComplexArray) -> Array:
    """Real then imaginary parts of what `applied` gives, its last two axes as one, (..., number)."""
    rows = np.empty((*values.shape[:-2], 2, len(matrix), values.shape[-1]))
    for start in range(0, values.shape[-1], CACHED):
        run = slice(start, start + CACHED)
        product = applied(matrix[..., run], values[..., run])
        rows[..., 0, :, run], rows[..., 1, :, run] = product.real, product.imag
    return rows.reshape(*values.shape[:-2], -1)


def whitened(covariance: ComplexArray, matrix: ComplexArray) -> ComplexArray:
    """L^-1 times matrices (row, column, frequency), with L the Cholesky root of covariances (row, row, frequency).

    Of covariances the lower triangles are read. Where one is not positive definite, the result is not finite.
    """
    root, white = np.zeros_like(covariance), np.array(matrix, dtype=complex)
    for row in range(len(covariance)):
        for column in range(row):
            known = np.sum(root[row, :column] * root[column, :column].conj(), axis=0)
            root[row, column] = (covariance[row, column] - known) / root[column, column].real
            white[row] -= root[row, column] * white[column]
        left = covariance[row, row].real - np.sum(np.abs(root[row, :row]) ** 2, axis=0)
        root[row, row] = np.sqrt(left)
        white[row] /= root[row, row].real
    return white


def complex_values(rows: Array, shape: tuple[int, ...]) -> ComplexArray:
    """What `applied_rows` gives, as complex numbers of a shape (..., row, frequency)."""
    real, imaginary = np.split(rows, 2, axis=-1)
    return np.asarray((real + 1j * imaginary).reshape(shape))


def orthonormal(rows: Array) -> Array:
    """Orthonormal rows that span the given ones, none of which is zero, (at most row, number)."""
    return _decomposed(rows)[3]


def least_squares_rows(columns: Array, rows: Array) -> tuple[Array, Array]:
    """How much of some rows, none of which is zero, is in others, and an orthonormal basis of the former.

    Args:
      columns: that are fitted, (column, number).
      rows: to which, (row, number).

    Returns:
      Amounts, (row, column), and the basis, (at most column, number).
    """
    scale, directions, size, basis = _decomposed(columns)
    return np.asarray(rows @ basis.T / size @ directions.T / scale), basis


def _decomposed(rows: Array) -> tuple[Array, Array, Array, Array]:
    """Lengths of rows, (row,), and the singular value decomposition of the rows over these, as far as they span."""
    scale = np.linalg.norm(rows, axis=1)
    # As columns: LAPACK is three times as quick with them.
    basis, size, directions = np.linalg.svd((rows / scale[:, None]).T, full_matrices=False)
    rank = int(np.sum(size > SINGULAR * size[0]))
    return scale, directions[:rank].T, size[:rank], basis[:, :rank].T
