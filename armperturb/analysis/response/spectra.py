"""Closed-loop spectral estimates of the admittances and the multiple coherence (thesis 2.6, appendix A).

All spectra are taken from the disturbance d, with which neither the remnant of the person nor the noise of the
instruments correlates. With row d and column y, Phi_dy = mean of conj(D) Y^T over the averages, and

    X = H F      =>  Phi_dx = Phi_df H^T  =>  H^T = Phi_df^-1 Phi_dx    (arm, eq. A.14)
    X = E (D-F)  =>  Phi_dx = Phi_dz E^T  =>  E^T = Phi_dz^-1 Phi_dx    (environment, eq. A.19)
    X = P D      =>  Phi_dx = Phi_dd P^T  =>  P^T = Phi_dd^-1 Phi_dx    (arm and environment, eq. A.22)

Here f acts on the hand and d - f on the environment, so that the admittances come out positive; appendix A mixes this
sign with its opposite, and loses transposes (A.12).
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from armperturb.analysis.defaults import LINES_PER_AVERAGE, WINDOW_START
from armperturb.analysis.per_trials import per_trials
from armperturb.analysis.periods import common_period
from armperturb.analysis.response.joint_records import SAME_DIRECTION
from armperturb.analysis.response.local_polynomial import N_INPUTS
from armperturb.analysis.results import Description, Result, Table, plain, response_coordinates, response_frame
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array, ComplexArray
from armperturb.recording import labels_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

EXCITED_LINE, BESIDE_OTHERS, PER_OCTAVE = 1e-4, 3e-3, 3
"""Share of the strongest line's power from which on a line counts as excited, the same of the strongest nearby, and
bands per octave, of which one and those beside it are near [-]: what a fade, clocks or instruments leave between the
lines of a multisine is none of its lines."""

WIDEST_AVERAGE, ENOUGH = 0.4, 4
"""Distance of lines up to which they are averaged [Hz], and averages per point below which those farther apart are [-]:
an arm's response bends over more, and with two averages its coherence is one by construction."""

TWO_DIRECTIONS = 0.1
"""Independence of what pushes along x and y from which on lines may be averaged over trials alone [-]."""

LEAST_POWER = 1e-12
"""Share of the other axis's power below which a disturbance counts as none: rounding leaves less [-]."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class SpectralEstimate(Result):
    """Frequency responses and coherence at the averaged frequencies.

    Attributes:
      frequency: mean of each group of averaged lines [Hz], (frequency,).
      arm: admittance H_xf from f to x [m/N], (frequency, output, input).
      environment: admittance E_xz from d - f to x [m/N], (frequency, output, input).
      total: admittance P_dx from d to x [m/N], (frequency, output, input).
      coherence: multiple coherence from both disturbances to each displacement [-], (frequency, output).
      n_averages: lines times trials behind each point, (frequency,).
      labels: condition and subject, as the last columns of tables have them.
    """

    frequency: Array
    arm: ComplexArray
    environment: ComplexArray
    total: ComplexArray
    coherence: Array
    n_averages: NDArray[np.int64]
    labels: Mapping[str, str] = field(default_factory=dict)

    def describe(self) -> Description:
        """Gains of the arm's admittance and coherences at each frequency."""
        return Description(
            title=f"Spectral estimate of the arm's admittance at {len(self.frequency)} frequencies, "
            f"{self.frequency[0]:.3g} to {self.frequency[-1]:.3g} Hz",
            facts=(f"{self.n_averages.min()} to {self.n_averages.max()} averages; gains in m/N",),
            table=Table(
                ("frequency [Hz]", *(f"|H_{y}{x}|" for y in "xy" for x in "xy"), "coherence x", "coherence y"),
                tuple(
                    (plain(f), *(f"{gain:.2e}" for gain in np.abs(h).ravel()), *(f"{value:.3f}" for value in c))
                    for f, h, c in zip(self.frequency, self.arm, self.coherence, strict=True)
                ),
            ),
        )

    def to_frame(self) -> "pd.DataFrame":
        """One row per frequency, output and input of the arm's admittance, with the coherence of the output.

        The last columns are `labels`.
        """
        frame = response_frame(self.frequency, self.arm)
        return frame.assign(coherence=np.repeat(self.coherence.ravel(), N_INPUTS), **self.labels)

    def to_xarray(self) -> xr.Dataset:
        """Variables `arm`, `environment`, `total` (frequency, output, input), `coherence` and `n_averages`."""
        element, metres = ("frequency", "output", "input"), {"units": "m/N"}
        return xr.Dataset(
            {
                "arm": (element, self.arm, metres | {"long_name": "admittance from f to x"}),
                "environment": (element, self.environment, metres | {"long_name": "admittance from d - f to x"}),
                "total": (element, self.total, metres | {"long_name": "admittance from d to x"}),
                "coherence": (element[:2], self.coherence, {"units": "1", "long_name": "multiple coherence"}),
                "n_averages": (element[:1], self.n_averages, {"long_name": "lines times trials behind each point"}),
            },
            coords=response_coordinates(self.frequency),
            attrs=self.labels,
        )

    def interpolated(self, frequency: Array) -> "SpectralEstimate":
        """The estimate between its frequencies, gains and phases along the logarithm of the frequency.

        Args:
          frequency: where it is wanted [Hz], (frequency,); beyond the ends, that at the ends is held.
        """

        def between(values: Array) -> Array:
            every = values.reshape(len(values), -1).T
            moved = [np.interp(np.log(frequency), np.log(self.frequency), each) for each in every]
            return np.array(moved).T.reshape(len(frequency), *values.shape[1:])

        def response(values: ComplexArray) -> ComplexArray:
            phase = between(np.unwrap(np.angle(values), axis=0))
            return np.asarray(np.exp(between(np.log(np.abs(values))) + 1j * phase))

        return replace(
            self,
            frequency=np.asarray(frequency, dtype=float),
            arm=response(self.arm),
            environment=response(self.environment),
            total=response(self.total),
            coherence=between(self.coherence),
            n_averages=np.round(between(self.n_averages.astype(float))).astype(np.int64),
        )

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw the arm's admittance.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (output, input, 2): gain and phase of each element.
        """
        from armperturb.plots.bands import Curve, plot_responses

        return plot_responses([Curve("estimate", self.frequency, self.arm)], figure=figure)


@dataclass(frozen=True, kw_only=True, eq=False)
class LineSpectra:
    """DFT of the signals at the excited lines, mean over whole periods.

    Attributes:
      line: number of the line, cycles per period, (line,).
      frequency: [Hz], (line,).
      perturbation: D [N samples], (trial, line, axis).
      force: F [N samples], (trial, line, axis).
      displacement: X [m samples], (trial, line, axis).
    """

    line: NDArray[np.int64]
    frequency: Array
    perturbation: ComplexArray
    force: ComplexArray
    displacement: ComplexArray

    def of_trial(self, trial: int) -> "LineSpectra":
        """The coefficients of one trial."""
        signals = ("perturbation", "force", "displacement")
        return replace(self, **{name: getattr(self, name)[[trial]] for name in signals})


@per_trials
def line_spectra(
    trials: ConditionTrials, *, window_start: float = WINDOW_START, period: float | None = None
) -> LineSpectra:
    """Fourier coefficients at the lines that a periodic disturbance excites.

    Args:
      trials: of one person in one condition, or their recording.
      window_start: start of the window, after the transient has died away [s].
      period: of the disturbance [s]; None to find it. Whole periods from `window_start` to the first pulse, or to the
        end, are used.

    Raises:
      ValueError: the recording is refused (see `check_recording`), holds no whole period, a trial met the workspace
        limit, or the perturbation is zero.
    """
    trials.require_inside()
    if period is None:
        period = common_period([trials], window_start)
    window = trials.window(window_start, period)
    n_period = round(period * trials.rate)
    d, f, x = (_spectrum(values[:, window], n_period) for values in trials.signals)
    for name, values in (("force", f), ("displacement", x)):
        if not values.any():
            raise ValueError(
                f"{name} is constant from {window_start:g} s on; expected the response to the perturbation"
            )
    power = np.sum(np.abs(d) ** 2, axis=0)
    power[0] = 0.0
    if not power.any():
        raise ValueError(
            f"the perturbation is zero from {window_start:g} s on; expected a disturbance with a period of {period:g} s"
        )
    line = excited_lines(power)
    return LineSpectra(
        line=line, frequency=line / period, perturbation=d[:, line], force=f[:, line], displacement=x[:, line]
    )


@per_trials
def averaged_spectra(
    trials: ConditionTrials,
    *,
    window_start: float = WINDOW_START,
    period: float | None = None,
    lines_per_average: int = LINES_PER_AVERAGE,
) -> SpectralEstimate:
    """Admittances and coherence over all trials; arguments and errors as `line_spectra` and `estimate_spectra`."""
    lines = line_spectra(trials, window_start=window_start, period=period)
    return replace(estimate_spectra(lines, lines_per_average=lines_per_average), labels=labels_of(trials.recording))


@per_trials
def single_trial_spectra(
    trials: ConditionTrials,
    *,
    window_start: float = WINDOW_START,
    period: float | None = None,
    lines_per_average: int = LINES_PER_AVERAGE,
) -> tuple[SpectralEstimate, ...]:
    """Admittances and coherence of each trial, averaged over adjacent lines only; arguments as `averaged_spectra`."""
    lines = line_spectra(trials, window_start=window_start, period=period)
    each = (lines.of_trial(trial) for trial in range(trials.n_trials))
    return tuple(estimate_spectra(of_trial, lines_per_average=lines_per_average) for of_trial in each)


def estimate_spectra(lines: LineSpectra, *, lines_per_average: int = LINES_PER_AVERAGE) -> SpectralEstimate:
    """Estimate admittances and coherence.

    Spectra (not gains) are averaged over `lines_per_average` adjacent lines (fewer where the run of lines is shorter, a
    few more at its end where it leaves a rest) and over all trials. Lines are adjacent that are as close as the closest
    two: of a multisine of odd lines, every second one. Unless more than `LINES_PER_AVERAGE` are asked for, those that
    are farther apart than `WIDEST_AVERAGE` are averaged over trials alone, if these are enough.

    Args:
      lines: Fourier coefficients of trials of one subject in one condition.
      lines_per_average: 4 averages over the clusters of the thesis's multisine; 1 keeps every line.

    Raises:
      ValueError: there are fewer averages than inputs, or the disturbances along x and y are not independent,
        or there is none along one of them.
    """
    if lines_per_average < 1:
        raise ValueError(f"lines_per_average = {lines_per_average!r}; expected a whole number of at least 1")
    d, f, x = lines.perturbation, lines.force, lines.displacement
    gaps = np.diff(lines.line)
    runs = np.split(np.arange(len(lines.line)), np.flatnonzero(gaps > gaps.min(initial=gaps.max(initial=1))) + 1)
    apart = np.diff(lines.frequency).min(initial=np.inf)
    # Lines that are far apart are averaged over trials alone, as far as these are enough averages.
    near, needed = int(WIDEST_AVERAGE / apart + 1e-6) + 1, -(-ENOUGH // len(d))
    size = lines_per_average if lines_per_average > LINES_PER_AVERAGE else min(lines_per_average, max(near, needed))
    groups = _groups(runs, size)

    def cross(y: ComplexArray) -> ComplexArray:
        return np.array([np.einsum("tki,tkj->ij", d[:, g].conj(), y[:, g]) / (len(g) * len(d)) for g in groups])

    # Trials of one realisation do not tell what x does from what y does, however many they are.
    if size < lines_per_average and _independence(cross(d)).min() < TWO_DIRECTIONS:
        groups = _groups(runs, lines_per_average)
    n_averages = np.array([len(group) * len(d) for group in groups])
    frequency = np.array([lines.frequency[group].mean() for group in groups])
    if n_averages.min() < N_INPUTS:
        worst = int(np.argmin(n_averages))
        raise ValueError(
            f"{n_averages[worst]} average at {frequency[worst]:.3f} Hz for {N_INPUTS} inputs; expected at least "
            f"{N_INPUTS} (more trials, or more lines per average)"
        )
    if n_averages.min() == N_INPUTS:
        warnings.warn(
            "as many averages as inputs: the multiple coherence is one by construction", RuntimeWarning, stacklevel=2
        )
    phi_dd, phi_df, phi_dx = cross(d), cross(f), cross(x)
    phi_xx = np.array([np.mean(np.abs(x[:, group]) ** 2, axis=(0, 1)) for group in groups])
    _require_two_directions(phi_dd, frequency)
    total = _transposed_solve(phi_dd, phi_dx)
    # Eq. 2.4 with the conjugate that it lacks: P Phi_dd P^H over Phi_xx.
    explained = np.einsum("fij,fji->fi", total.conj(), phi_dx).real
    return SpectralEstimate(
        frequency=frequency,
        arm=_transposed_solve(phi_df, phi_dx),
        environment=_transposed_solve(phi_dd - phi_df, phi_dx),
        total=total,
        coherence=np.clip(explained / phi_xx, 0.0, 1.0),
        n_averages=n_averages,
    )


def _groups(runs: Sequence[NDArray[np.int64]], size: int) -> list[NDArray[np.int64]]:
    """Places of adjacent lines, those of each average together.

    A rest is spread over the highest groups: how far up lines are excited moves no point at low frequencies.
    """
    return [each[::-1] for run in runs for each in np.array_split(run[::-1], max(1, len(run) // size))[::-1]]


def _independence(phi_dd: ComplexArray) -> Array:
    """One less the squared coherence of what pushes along x and along y [-], (frequency,); 0 without either.

    Zero for disturbances that are proportional, whatever their sizes.
    """
    both = np.prod(np.einsum("fii->fi", phi_dd).real, axis=1)
    return np.divide(np.linalg.det(phi_dd).real, both, out=np.zeros(len(both)), where=both > 0.0)


def excited_lines(power: Array) -> NDArray[np.int64]:
    """Numbers of the lines that a periodic disturbance excites along either axis.

    Args:
      power: of its lines, from that of the mean on, which is zero, (line, axis).
    """
    # The lowest lines are near each other, too.
    band = (PER_OCTAVE * np.log2(np.arange(len(power)) + PER_OCTAVE)).astype(int)
    strongest = np.zeros((band[-1] + 3, power.shape[1]))
    np.maximum.at(strongest, band + 1, power)
    nearby = np.maximum.reduce([strongest[band], strongest[band + 1], strongest[band + 2]])
    is_line = power.sum(axis=1) > EXCITED_LINE * power.sum(axis=1).max()
    return np.flatnonzero(is_line & (power > BESIDE_OTHERS * nearby).any(axis=1))


def _spectrum(values: Array, n_period: int) -> ComplexArray:
    """DFT of the mean period, (trial, line, axis)."""
    mean = values.reshape(len(values), -1, n_period, values.shape[-1]).mean(axis=1)
    return np.asarray(np.fft.rfft(mean, axis=1), dtype=np.complex128)


def _transposed_solve(phi_du: ComplexArray, phi_dx: ComplexArray) -> ComplexArray:
    return np.asarray(np.linalg.solve(phi_du, phi_dx).swapaxes(-1, -2), dtype=np.complex128)


def _require_two_directions(phi_dd: ComplexArray, frequency: Array) -> None:
    power = np.einsum("fii->fi", phi_dd).real
    silent = power < LEAST_POWER * power.max(axis=1, keepdims=True)
    if silent.any():
        line, axis = np.argwhere(silent)[0]
        raise ValueError(
            f"the disturbance along {'xy'[axis]} has no power at {frequency[line]:.3f} Hz; expected a disturbance "
            "along both axes, or a trial for each direction"
        )
    independence = _independence(phi_dd)
    worst = int(np.argmin(independence))
    if independence[worst] < SAME_DIRECTION:
        raise ValueError(
            f"the disturbances along x and y are not independent at {frequency[worst]:.3f} Hz; expected independent "
            "disturbances (other realisations, or one trial for each direction)"
        )
