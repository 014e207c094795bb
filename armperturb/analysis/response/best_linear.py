"""The best linear approximation of a nonlinear arm, and how much of its response is noise and how much distortion.

Under random-phase multisines of one power spectrum, a nonlinear arm answers as the linear one that comes closest on
average (its best linear approximation), and adds a stochastic distortion: as periodic as the disturbance, but different
for every realisation. Noise is not periodic. So

- what differs from one period to the next is noise;
- what a smooth response leaves on the excited lines of mean periods is noise and distortion, and so is all that is on
  the quiet lines beside them.

(Pintelon & Schoukens, System Identification, 2nd ed., chapters 3 and 4: robust method, in closed loop by projection on
d.) Two inputs act at once: as their phases are independent, each cluster of lines of each realisation gives as many
equations as it has lines for the two responses, and no trials with one direction alone are needed.

All is said of the force that the arm adds to its linear response, v = H^-1 x - f, with H^-1 interpolated between the
clusters: for three reasons. The noise of x and f has the resonances of arm and environment, that of v hardly any, so
that noise may be compared among lines some tenths of a hertz apart. The edges of a record of a mass, spring and damper
leave in v a polynomial of first order, and where periods fade into one another nearly nothing: mean periods need no
leakage removed, which would take more of the noise around a record's start, where fewer periods are averaged, than of
the rest. And d explains so little of v that the polynomial of a cluster need not follow resonances. Powers are given
as displacement, H v.

Differences between periods are orthonormal contrasts, each of a period (the last may be short) with the mean of those
before.

Assumed: d is known; realisations are independent, of the same power spectrum and of random phases; noise one period
apart is independent; the arm has forgotten its start, and is the same in all periods of a trial. Between trials it may
differ: each has a constant term of its own, and none of that counts as distortion. What is below a thousandth of the
linear response is taken for what interpolation and a start that is not quite forgotten leave.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import xarray as xr
from scipy import interpolate, stats

from armperturb.analysis.cuts import require_two_axes
from armperturb.analysis.defaults import LINES_PER_AVERAGE, SETTLED
from armperturb.analysis.manipulator import copies_left_out
from armperturb.analysis.response.frequency_response import FrequencyResponse
from armperturb.analysis.response.local_polynomial import (
    ComplexArray,
    LocalFit,
    Window,
    fit_locally,
    frequency_response,
    whole_window,
    without,
)
from armperturb.analysis.response.multisines import HIGHEST_ORDER, NARROW, WIDEST, Periodic, periodic_trials
from armperturb.analysis.results import Description, Result, Table, plain
from armperturb.analysis.trials import SeveralTrials, TrialRecord, prepared_condition
from armperturb.arrays import Array
from armperturb.recording import LABELS, labels_of, named

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Impedance = Callable[[Array], ComplexArray]

ORDER = {1: 0, 2: 1}
"""Number of trials to the order of the response's polynomial over a cluster; `HIGHEST_ORDER` of more trials."""

LARGEST_WIDTH = 0.45
"""Width of a group of lines, over its frequency, up to which a response that bends is hardly taken for distortion [-],
where that is more than `WIDEST`."""

LARGEST_ERROR = 0.3
"""Error of the response over its size from which on its inverse is of no use [-]."""

ROUNDS = 2
"""How often what the arm does between clusters is estimated."""

NOISE_LEAKAGE = 1
"""Order of the leakage's polynomial of what differs between periods: that of mass and damping."""

LEAST_NOISE = 6
"""Lines less leakage's terms that tell the noise around a cluster, of all trials."""

WIDENED = 0.05
"""Step by which the band of the noise is widened where they are fewer [Hz]."""

SHORTEST = 4.0
"""Pieces of a period that are shorter than this tell nothing of the noise [s]."""

RESOLUTION = 1e-3
"""Distortion over linear response, in amplitude, that cannot be told from what is left of leakage and interpolation."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class BestLinear(Result):
    """Best linear approximation, with the levels of noise and distortion.

    Powers are mean squares of the displacement's sine wave at one excited line of one period [m^2], means over the
    lines of a cluster and over trials.

    Attributes:
      response: of the arm, at the middle of each cluster; its covariance holds noise and distortion.
      linear: power of the linear response H f, (frequency, output).
      noise: power of the noise in a single period, (frequency, output).
      distortion: power of the distortion; unbiased, so that it may come out negative, (frequency, output).
      distortion_error: standard error that it has if the arm is linear, (frequency, output).
      statistic: distortion over its standard error, of all frequencies and outputs together, each weighed by its noise
        and by how fast the linear response moves [-]; of linear arms standard normal.
      n_periods: periods per trial, with parts, (trial,); several short ones count as one.
    """

    response: FrequencyResponse
    linear: Array
    noise: Array
    distortion: Array
    distortion_error: Array
    statistic: float
    n_periods: Array

    def describe(self) -> Description:
        """The share of the distortion, and the levels at each frequency."""
        shares = zip(LABELS["axis"], self.share, self.share_error, strict=True)
        each = " and ".join(f"{max(share, 0.0):.1%} (+/- {error:.1%}) in {axis}" for axis, share, error in shares)
        kinds = ("linear", "noise", "distortion")
        levels = [1e3 * np.sqrt(np.maximum(getattr(self, kind), 0.0)) for kind in kinds]
        least, most = f"{self.n_periods.min():.3g}", f"{self.n_periods.max():.3g}"
        label = f" ({self.response.label})" if self.response.label else ""
        return Description(
            title=f"Best linear approximation of the arm{label}",
            facts=(
                f"nonlinear distortion: of the response's power {each}; p = {self.p_value:.2g} if the arm is linear",
                f"{least if least == most else f'{least} to {most}'} periods per trial; RMS at a line [mm]",
            ),
            table=Table(
                ("frequency [Hz]", *(f"{kind} {axis}" for axis in LABELS["axis"] for kind in kinds)),
                tuple(
                    (plain(f), *(plain(float(level[k, i]), 3) for i in range(2) for level in levels))
                    for k, f in enumerate(self.response.frequency)
                ),
            ),
            remarks=self.response.remarks,
        )

    def to_frame(self) -> "pd.DataFrame":
        """One row per frequency and output: mean squares of the sine wave at a line [m^2]."""
        import pandas as pd

        frequency = self.response.frequency
        return pd.DataFrame(
            {
                "frequency_hz": np.repeat(frequency, 2),
                "output": np.tile(LABELS["axis"], len(frequency)),
                "linear_m2": self.linear.ravel(),
                "noise_m2": self.noise.ravel(),
                "distortion_m2": self.distortion.ravel(),
                "distortion_standard_error_m2": self.distortion_error.ravel(),
                **self.response.labels,
            }
        )

    def to_xarray(self) -> xr.Dataset:
        """That of the response, and `linear`, `noise`, `distortion` and `distortion_error` (frequency, output)."""
        element, names = ("frequency", "output"), ("linear", "noise", "distortion", "distortion_error")
        return self.response.to_xarray().assign(
            {name: (element, getattr(self, name), {"units": "m^2"}) for name in names}
        )

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw the levels of linear response, distortion and noise.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (output,).
        """
        from armperturb.plots.bands import plot_distortion

        limit = 1.645 * self.distortion_error  # one-sided, as `p_value`
        return plot_distortion(self.response.frequency, self.linear, self.distortion, self.noise, limit, figure)

    @property
    def p_value(self) -> float:
        """Chance of so large a statistic if the arm is linear [-]."""
        return float(stats.norm.sf(self.statistic))

    @property
    def share(self) -> Array:
        """Power of the distortion over that of linear response and distortion, all frequencies together, (output,)."""
        distortion = self.distortion.sum(axis=0)
        return np.asarray(distortion / (self.linear.sum(axis=0) + distortion))

    @property
    def share_error(self) -> Array:
        """Standard error that `share` has if the arm is linear, (output,)."""
        error = np.sqrt(np.sum(self.distortion_error**2, axis=0))
        return np.asarray(error / (self.linear + self.distortion).sum(axis=0))


def best_linear(
    recordings: SeveralTrials,
    *,
    period: float | None = None,
    window_start: float = SETTLED,
    lines_per_average: int = LINES_PER_AVERAGE,
) -> BestLinear:
    """Best linear approximation of the arm, from multisines.

    Args:
      recordings: trials of one subject in one condition, with different multisines of one power spectrum, each longer
        than a period by a fifth or more. Of a single trial, the distortion is that of its realisation alone.
      period: of the disturbance [s]; None to find it.
      window_start: start of what is used [s]; later for loads that ring on, whose transient otherwise passes for
        distortion.
      lines_per_average: as in `estimate_multisine`; 3 or more.

    Raises:
      TypeError: recordings are no `Dataset`.
      ValueError: as `estimate_multisine`; there is one axis; trials differ in subject, task, condition or posture; or
        lines of a cluster or periods are too few.
    """
    several = prepared_condition(recordings)
    require_two_axes(several[0].recording)
    trials = periodic_trials(
        several, period=period, window_start=window_start, lines_per_average=lines_per_average, shortest=SHORTEST
    )
    _require_close_lines(trials, lines_per_average)
    n_period = trials.period * trials.rate
    n_periods = np.array([1.0 + sum(map(len, trial.contrasts)) / n_period for trial in trials.trials])
    # What differs between periods, where it is long enough to tell of noise.
    pieces = [piece for trial in trials.trials for piece in trial.contrasts if len(piece) >= SHORTEST * trials.rate]
    contrasts = [whole_window(TrialRecord(piece[:, :0], piece, trials.rate)) for piece in pieces]
    if not contrasts:
        raise ValueError(
            f"trials hold {n_periods.max():.2f} periods from {window_start:g} s on; expected at least "
            f"{1 + SHORTEST / trials.period:.2f}"
        )
    order = ORDER.get(len(trials.trials), HIGHEST_ORDER)
    fits = trials.fit(order, own_levels=True)
    if min(fit.excited_dof for fit in fits) < 0.5:
        raise ValueError(
            f"{min(map(len, trials.groups))} lines of {len(trials.trials)} trials are all taken by the response; "
            "expected more lines per average, or more trials"
        )
    windows = [trials.windows(group) for group in trials.groups]
    response = frequency_response(fits, "arm", [(fit.excited_noise, fit.excited_dof) for fit in fits])
    around, own_fits = _own_forces(windows, fits, response, order)

    def own_forces(clusters: list[list[Window]]) -> list[list[Window]]:
        return [[_own_force(each, of_arm) for each in near] for near, of_arm in zip(clusters, around, strict=True)]

    quiet = own_forces([[window.only(~window.excited) for window in near] for near in windows])
    noises = own_forces([_near(contrasts, near[0].frequency) for near in windows])
    uneven = _unevenness(n_periods)
    share = float(np.mean([trial.share for trial in trials.trials]))
    # From |Z|^2 over the number of samples to the mean square of a sine wave.
    scale = 2.0 / n_period
    linear, noise, distortion, error, excess, precision = [], [], [], [], [], []
    for group, fit, impedance, of_arm, near, quiet_uses, near_noises, noise_uses in zip(
        trials.groups, fits, around, own_fits, quiet, _uses(quiet), noises, _uses(noises), strict=True
    ):
        arm = np.linalg.inv(impedance(np.array([fit.frequency])))[0]
        force = np.concatenate([trial.answer[group, :2] for trial in trials.trials]) @ arm.T
        linear.append(scale * share * np.mean(np.abs(force) ** 2, axis=0))
        floor = np.diag(RESOLUTION**2 * np.mean(np.abs(force) ** 2, axis=0)).astype(complex)

        def moves(covariance: ComplexArray, arm: ComplexArray = arm) -> ComplexArray:
            return np.asarray(arm @ covariance @ arm.conj().T)

        of_noise, noise_dof = without(near_noises, NOISE_LEAKAGE)
        on_lines = _Excess(moves(of_arm.excited_noise), of_arm.excited_dof / uneven, moves(of_noise), noise_dof, floor)
        noise.append(scale * np.diagonal(on_lines.noise).real)
        distortion.append(scale * share * np.diagonal(on_lines.total - on_lines.noise).real)
        error.append(scale * share * np.sqrt(on_lines.variance) * np.diagonal(on_lines.pooled).real)
        # Distortion falls between the excited lines as well, and there it shows best. Each line counts once.
        of_quiet, quiet_dof = without(near, -1, quiet_uses)
        of_noise, noise_dof = without(near_noises, NOISE_LEAKAGE, noise_uses)
        dof = of_arm.excited_dof + quiet_dof
        total = (of_arm.excited_dof * of_arm.excited_noise + quiet_dof * of_quiet) / dof
        everywhere = _Excess(moves(total), dof / uneven, moves(of_noise), noise_dof, floor)
        excess.append(everywhere.relative)
        precision.append(1.0 / everywhere.relative_variance)
    # Arms depart from a linear one where they move.
    speed = np.array([fit.frequency * np.sqrt(of_one.sum()) for fit, of_one in zip(fits, linear, strict=True)])
    weight = speed * precision
    return BestLinear(
        response=replace(
            response,
            label=named([part.recording for part in several]),
            labels=labels_of(several[0].recording),
            remarks=(*copies_left_out(several), *trials.remarks, *_on_single_trials(trials)),
        ),
        linear=np.array(linear),
        noise=np.array(noise),
        distortion=np.array(distortion),
        distortion_error=np.array(error),
        statistic=float(np.dot(weight, excess) / np.sqrt(np.dot(weight, speed))),
        n_periods=n_periods,
    )


def _require_close_lines(trials: Periodic, lines_per_average: int) -> None:
    """Refuse groups of too few lines, or of lines between which a linear response bends.

    Raises:
      ValueError: there is such a group.
    """
    shortest = min(map(len, trials.groups))
    if shortest < 3:
        mend = "more lines per average" if lines_per_average < 3 else "a multisine whose lines are closer together"
        raise ValueError(f"a group has {shortest} excited lines; expected at least 3 ({mend})")
    for group in trials.groups:
        width, middle = float(np.ptp(group)) / trials.period, float(group.mean()) / trials.period
        if width > max(WIDEST, LARGEST_WIDTH * middle):
            raise ValueError(
                f"lines that tell distortion together are {width:.3g} Hz apart near {middle:.3g} Hz; expected at most "
                f"{WIDEST:g} Hz, over which a linear response hardly bends (a multisine of a longer period, whose "
                "lines are closer together)"
            )


def _on_single_trials(trials: Periodic) -> tuple[str, ...]:
    """A remark where the response is taken for constant over groups of lines that are wide."""
    if len(trials.trials) > 1 or not any(np.ptp(group) > NARROW * group.mean() for group in trials.groups):
        return ()
    return ("of a single trial, an arm whose response bends within a group of lines passes for a nonlinear one",)


def _own_forces(
    windows: Sequence[Sequence[Window]], fits: Sequence[LocalFit], arm: FrequencyResponse, order: int
) -> tuple[list[Impedance], list[LocalFit]]:
    """The arm's impedance H^-1 [N/m] around each cluster, and what d explains of the arm's own force there.

    That is little, as the impedance beside the middle of a cluster comes from its neighbours, and what is left is no
    larger for a polynomial that cannot follow the arm's response. What d does explain in the middle corrects the
    impedance there. Where it is poorly determined, it is taken to be constant, and has no
    influence on its neighbours.
    """
    frequency, covariance = arm.frequency, np.asarray(arm.covariance)
    impedance = np.linalg.inv(arm.response)
    known = np.sqrt(np.sum(covariance, axis=(1, 2)) / np.sum(np.abs(arm.response) ** 2, axis=(1, 2))) < LARGEST_ERROR
    # A real system at -f is the conjugate of that at f, so that nothing is extrapolated towards zero.
    knots = np.concatenate([-frequency[known][::-1], frequency[known]])
    for _ in range(ROUNDS):
        around: list[Impedance] = [_constant(values) for values in impedance]
        if known.any():
            both = np.concatenate([impedance[known][::-1].conj(), impedance[known]])
            spline = interpolate.make_interp_spline(knots, both, min(3, len(knots) - 1))
            around = [spline if is_known else constant for is_known, constant in zip(known, around, strict=True)]
        own_fits = []
        for near, fit, of_arm in zip(windows, fits, around, strict=True):
            excited = [_own_force(window.only(window.excited), of_arm) for window in near]
            own_fits.append(fit_locally(excited, fit.frequency, order=order, leakage_order=-1, own_levels=True))
        moved = [of_arm.answer @ np.linalg.inv(fit.answer[2:]) for of_arm, fit in zip(own_fits, fits, strict=True)]
        impedance = impedance - np.array(moved)
    return around, own_fits


def _constant(values: ComplexArray) -> Impedance:
    return lambda frequency: np.broadcast_to(values, (*np.shape(frequency), *values.shape))


def _own_force(window: Window, impedance: Impedance) -> Window:
    """Lines with the force that the arm adds to its linear response, H^-1 x - f, (line, 2), as their answer."""
    force, displacement = window.answer[:, :2], window.answer[:, 2:]
    return window._replace(answer=np.einsum("kij,kj->ki", impedance(window.frequency), displacement) - force)


class _Excess(NamedTuple):
    """Covariance of noise and distortion beside that of noise, (2, 2) each, with their degrees of freedom.

    Far below `floor`, (2, 2), both count as nothing. Far above it and without distortion, total over pooled is
    independent of pooled and has a (matrix) beta distribution: its moments are exact, however few the degrees of
    freedom.
    """

    total: ComplexArray
    total_dof: float
    noise: ComplexArray
    noise_dof: float
    floor: ComplexArray

    @property
    def pooled(self) -> ComplexArray:
        both = self.total_dof * self.total + self.noise_dof * self.noise
        return np.asarray(both / (self.total_dof + self.noise_dof) + self.floor)

    @property
    def variance(self) -> float:
        """Of (total - noise) over pooled, of one output."""
        dof = self.total_dof + self.noise_dof
        return dof**2 / (self.total_dof * self.noise_dof * (dof + 1))

    @property
    def relative(self) -> float:
        """Total less noise over pooled, mean over outputs; its mean is zero without distortion."""
        return 0.5 * float(np.trace(np.linalg.solve(self.pooled, self.total - self.noise)).real)

    @property
    def relative_variance(self) -> float:
        return 0.5 * self.variance * (1 - 1 / (self.total_dof + self.noise_dof - 1))


def _unevenness(n_periods: Array) -> float:
    """Mean square over squared mean of the noise's power in the course of a mean period [-], >= 1.

    Where it is not even, neighbouring lines correlate, and tell less.
    """
    whole = np.floor(n_periods)
    part = n_periods - whole
    power = (1 - part) / whole + part / (whole + 1)
    return float(np.mean(((1 - part) / whole**2 + part / (whole + 1) ** 2) / power**2))


def _near(contrasts: Sequence[Window], frequency: Array) -> list[Window]:
    """Lines of the noise where a cluster has its lines, or around those if they are too few."""
    half = 0.0
    while True:
        near = [piece.within(frequency[0] - half, frequency[-1] + half) for piece in contrasts]
        if sum(max(0, len(piece.frequency) - NOISE_LEAKAGE - 1) for piece in near) >= LEAST_NOISE:
            return near
        half += WIDENED


def _uses(clusters: Sequence[Sequence[Window]]) -> list[list[Array]]:
    """One over the number of clusters that use a line, of each line of each record: (cluster, record), (line,)."""
    records = []
    for of_record in zip(*clusters, strict=True):
        lines, counts = np.unique(np.concatenate([window.frequency for window in of_record]), return_counts=True)
        records.append([1.0 / counts[np.searchsorted(lines, window.frequency)] for window in of_record])
    return [list(weights) for weights in zip(*records, strict=True)]
