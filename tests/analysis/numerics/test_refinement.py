import numpy as np
import pytest

from armperturb.analysis.numerics.refinement import Refinement


def numbers(rng, *shape):
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


@pytest.mark.parametrize(("n", "factor"), [(1, 4), (40, 4), (43, 7), (6, 50)])
def test_polynomials_of_degree_five_are_exact_and_blocks_are_parts(n, factor):
    refinement = Refinement(n, factor)
    polynomial = np.polynomial.Polynomial(numbers(np.random.default_rng(0), 6), domain=[-3.0 * factor, n + factor])
    fine = refinement.fine(polynomial(refinement.places))
    np.testing.assert_allclose(fine, polynomial(np.arange(n)), rtol=1e-10)
    parts = [
        refinement.fine(polynomial(refinement.places), slice(block, block + 2))
        for block in range(0, refinement.n_blocks, 2)
    ]
    np.testing.assert_allclose(np.concatenate(parts), fine, rtol=1e-14)


def test_transpose_gives_the_same_inner_products():
    rng, refinement = np.random.default_rng(1), Refinement(43, 7)
    nodes, values = numbers(rng, 3, len(refinement.places)), numbers(rng, 2, 43)
    expected = refinement.fine(nodes) @ values.T
    np.testing.assert_allclose(nodes @ refinement.transpose(values).T, expected, rtol=1e-12)
