"""Whittle's likelihood against many short records whose truth is known: errors are as large as it says."""

import numpy as np
import pytest
from scipy import fft

from armperturb.analysis.fit.frequency_rows import least_squares_rows
from armperturb.analysis.fit.whittle import Whittle

N, N_TRIALS, USED = 256, 5, slice(1, 50)


def spectrum(values, taper):
    return fft.rfft(values * taper, axis=-1)[..., USED]


def spectra_of_drift(taper):
    """Of an offset and eleven powers of time, on either axis, (drift, output, frequency)."""
    powers = np.linspace(-1.0, 1.0, N) ** np.arange(12)[:, None]
    drift = spectrum(powers, taper)[:, None, None] * np.eye(2)[..., None]
    return drift.reshape(-1, 2, drift.shape[-1])


class Gain(Whittle):
    """Outputs that are one gain times the inputs, in noise that is white in both, with an offset and a drift."""

    def __init__(self, force, observed, taper, drift):
        self._drift = drift
        force, observed = spectrum(force, taper), spectrum(observed, taper)
        frequency = np.arange(N // 2 + 1.0)[USED]
        ones = np.ones(len(frequency), complex)
        super().__init__(frequency, force, observed, slice(None), scale=ones, least=1e-30, taper=taper)

    def _predicted(self, values, trials=slice(None)):
        return values[0] * self._force[trials]

    def _slopes(self, values, mixing):
        yield slice(None), self._force[None]

    def _to_smooth(self, values):
        return np.eye(2)[..., None] * np.ones(len(self._frequency), complex)

    def _unknowns(self, values):
        return self._drift


def estimated(likelihood):
    """The gain, and its variance as the information says, with the noise as known and as estimated."""
    values, mixing = np.zeros(1), np.eye(1)
    for _ in range(3):
        likelihood.weigh(values)
        normal = likelihood.normal(values, mixing)
        values = values + normal.slope / normal.information[0]
    known, left = likelihood.informations(values, mixing)
    return values[0], 1.0 / known[0, 0], 1.0 / left[0, 0]


@pytest.mark.slow(reason="400 estimates of each kind")
@pytest.mark.parametrize(("tapered", "with_drift"), [(True, False), (True, True)])
def test_errors_are_as_large_as_the_information_says(tapered, with_drift):
    rng = np.random.default_rng(5)
    taper = np.ones(N)
    if tapered:
        taper[-N // 2 :] = np.cos(0.5 * np.pi * np.linspace(0.0, 1.0, N // 2)) ** 2
    # Inputs are strong where offset and drift are, and where few frequencies are averaged.
    shape = 1.0 / (1.0 + (np.arange(N // 2 + 1) / 8.0) ** 2)
    drift = spectra_of_drift(taper) if with_drift else None
    found = []
    for _ in range(400):
        force = fft.irfft(fft.rfft(rng.standard_normal((N_TRIALS, 2, N))) * shape, N)
        found.append(estimated(Gain(force, rng.standard_normal((N_TRIALS, 2, N)), taper, drift)))
    gains, as_known, as_estimated = np.array(found).T
    # The standard deviation of 400 gains is known to 3.5 %.
    assert np.mean(as_known) < 0.95 * np.mean(as_estimated)
    assert np.sqrt(np.var(gains) / np.mean(as_estimated)) == pytest.approx(1.0, abs=0.05)


class Drifting(Gain):
    """What is unknown depends on the value."""

    def _unknowns(self, values):
        return self._drift[2:10] if values[0] > 0.5 else self._drift[10:18]


@pytest.mark.parametrize("with_drift", [False, True])
def test_what_was_weighed_before_leaves_no_trace(with_drift):
    """Whatever values were asked about, and in which order; the noise that is left has settled after some rounds."""
    rng, taper = np.random.default_rng(6), np.ones(N)
    signals = rng.standard_normal((2, N_TRIALS, 2, N))
    costs = []
    for order in ((0.3, 0.9, 0.9), (0.9, 0.3, 0.9), (0.9, 0.9, 0.9)):
        kind = Drifting if with_drift else Gain
        likelihood = kind(*signals, taper, spectra_of_drift(taper) if with_drift else None)
        for value in (*order, 0.9, 0.9, 0.9, 0.9):
            likelihood.weigh(np.array([value]))
        costs.append([likelihood.objective(np.array([0.9])), likelihood.cost(np.array([0.3]))])
    np.testing.assert_allclose(costs[1:], [costs[0]] * 2, rtol=1e-6)
    assert abs(costs[0][0] - likelihood.objective(np.array([0.3]))) > 1.0


def test_least_squares_of_rows_is_numpys():
    rng = np.random.default_rng(1)
    columns, rows = rng.standard_normal((3, 20)), rng.standard_normal((4, 20))
    amounts, basis = least_squares_rows(columns, rows)
    np.testing.assert_allclose(amounts.T, np.linalg.lstsq(columns.T, rows.T)[0], rtol=1e-10)
    np.testing.assert_allclose(basis @ basis.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rows @ basis.T @ basis, amounts @ columns, rtol=1e-10)
