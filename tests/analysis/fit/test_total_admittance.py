"""Admittance and derivatives of an arm at many frequencies, against those of the linear arm at each."""

import numpy as np
import pytest

from armperturb.analysis.arm.linear_arm import LinearArm
from armperturb.analysis.arm.parameters import parameter_vector
from armperturb.analysis.fit import total_admittance
from armperturb.analysis.fit.structures import STRUCTURES
from armperturb.analysis.fit.total_admittance import TotalAdmittance
from armperturb.environment import Environment
from armperturb.subject import POSITION, RELAX

ENVIRONMENT = Environment()
EVEN = np.arange(20_000) / 1000.0
UNEVEN = np.sort(np.random.default_rng(0).uniform(0.1, 20.0, 3000))


@pytest.mark.slow(reason="computes a quarter of a million frequencies")
@pytest.mark.parametrize("arm", [RELAX, POSITION], ids=lambda arm: arm.task)
@pytest.mark.parametrize(
    ("frequency", "in_runs", "asked", "tolerance"),
    [(EVEN, True, 3000, 1e-6), (EVEN[1:8001], False, 1200, 1e-6),
     (UNEVEN, True, 3000, 1e-12), (EVEN[::20], False, 1000, 1e-12)],
    ids=["even", "from above zero", "uneven", "far apart"],
)  # fmt: skip
def test_many_frequencies_are_interpolated(arm, frequency, in_runs, asked, tolerance, monkeypatch):
    if in_runs:
        monkeypatch.setattr(total_admittance, "LONGEST_RUN", 1000)
        monkeypatch.setattr(total_admittance, "SHORTER_RUN", 500)
    total, values = TotalAdmittance(arm, frequency, ENVIRONMENT), parameter_vector(arm)
    at_each = LinearArm(arm, np.maximum(frequency, 1e-6))
    expected, by_all = at_each.total_and_gradient(values, ENVIRONMENT)
    assert len(total._arm.frequency) <= asked
    largest = np.abs(expected).max()
    np.testing.assert_allclose(np.moveaxis(total(values), -1, 0), expected, rtol=0, atol=tolerance * largest)

    rng, mixing = np.random.default_rng(1), STRUCTURES["3"].mixing
    loads, directions = (
        rng.normal(size=(2, 2, len(frequency))) + 1j * rng.normal(size=(2, 2, len(frequency))) for _ in range(2)
    )
    slopes = np.einsum("foip,pq,tif->tqof", by_all, mixing, loads)
    for found, right in zip(total.driven_slopes(values, mixing, loads), slopes, strict=True):
        size = np.abs(right).max(axis=(1, 2), keepdims=True)
        assert (np.abs(found - right) <= 20 * tolerance * size).all()
    along = np.einsum("tqof,tof->tq", slopes, directions.conj()).real
    found = total.slopes_along(values, mixing, loads, directions)
    np.testing.assert_allclose(found, along, rtol=0, atol=20 * tolerance * np.abs(along).max())
