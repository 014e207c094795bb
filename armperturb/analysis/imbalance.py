"""What is wrong where the force balance of a recording does not hold, see `force_balance`.

Noise of the instruments is all that d - f - E^-1 x may hold, whatever the person does. Where more is left, one of these
may put it right, each of which is fitted together with mass, damping and stiffness to all three signals:

- another gain of the force, one or one per axis, or a share of one axis in the other: a badly calibrated sensor;
- a force, displacement or perturbation that is turned: a sensor mounted at an angle, or axes of another frame;
- mass, damping or stiffness that differ between the axes, or couple them;
- a delay of the force, of the displacement or of the perturbation against the other two.

They are compared by Whittle's likelihood, with white noise of force and displacement whose levels are fitted with each.
Only frequencies that the perturbation excites count: elsewhere noise would make the gain of the force too small.
"""

import math
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from scipy import optimize, stats

from armperturb.analysis.excited_bands import Spectra
from armperturb.arrays import Array

Kind: TypeAlias = Literal[
    "gain", "gains", "crosstalk", "rotation", "displacement axes", "perturbation axes", "load",
    "force", "displacement", "perturbation", "unknown",
]  # fmt: skip
"""What is wrong: the force's gain, gains or crosstalk; axes of a signal; the manipulator; a signal's clock."""

FEWEST = 10
"""Excited bands below which nothing is compared."""

LATEST, STEP = 0.15, 5e-3
"""Largest delay that is looked for, and step of that search [s]."""

ROUNDS = 3
"""How often a candidate and its noise are estimated in turn."""

LOW = 0.1
"""Share of the excited bands that count as low frequencies, at which noise of displacement matters little [-]."""

CHANCE = 1e-4
"""Probability below which noise alone does not explain a likelihood ratio [-]."""

NEARLY = 0.5
"""What a candidate must explain at first of what the best one does, to be fitted [-]."""

PER_TERM = 10.0
"""Likelihood ratio by which a further parameter must be better to be preferred [-]."""

LEAST_BIAS, LEAST_UNEXPLAINED = 0.02, 0.05
"""Error of the arm's impedance below which nothing but a delay is reported, if it is explained and if it is not [-]."""

LEAST_DELAY = 2e-4
"""Delay from which on it is reported, if it is beyond three standard errors [s]."""

MOST = 0.5
"""Share of what the balance leaves that must be explained, unless by a delay [-]."""

SIMPLER, FURTHER, CLEAR, LARGEST_LEAK = ("gain", "gains", "rotation"), 0.02, 0.9, 0.5
"""What crosstalk has in it, the shares that it must explain beyond these and in all, and its largest error [-]."""

NAMED = 0.1
"""Share of what a load explains from which on its mass, damping or stiffness is named [-]."""

AVERAGES = 16.0
"""Independent averages of a band from which on what follows the perturbation is told from noise."""

ANSWER = 8
"""Real numbers in the answer of a band to the perturbation, x and y to x and y."""

FOLLOWS = 2.0
"""What follows the perturbation over what noise would leave of that, from which on a band counts [-]."""


class Imbalance(NamedTuple):
    """Why the force balance does not hold.

    Attributes:
      kind: what explains it best; the name of a signal is a delay of that signal.
      text: it in words: a sentence without capital letter and full stop.
      share: of what the balance leaves at excited frequencies, weighted as noise asks for, what this explains [-].
      bias: error that it makes in the arm's impedance, RMS over those frequencies and relative to the impedance [-].
      delay: of that signal after the other two [s]; NaN of what is no delay.
      standard_error: of the delay [s]; infinite of what is no delay.
    """

    kind: Kind
    text: str
    share: float
    bias: float
    delay: float = math.nan
    standard_error: float = math.inf


class _Fit(NamedTuple):
    """A candidate.

    Attributes:
      values: mass, damping, stiffness, and what is added to them.
      weights: of the ten signals in what is left, (axis, 10).
      power: of what is left, mean over axes, (band,).
      density: of noise, (band,).
      objective: minus the log-likelihood [-].
    """

    values: Array
    weights: Array
    power: Array
    density: Array
    objective: float


def signal_row(place: int, mixed: Array | None = None) -> Array:
    """x and y of d, f, acceleration, velocity or displacement, 0 to 4, mixed if asked, (axis, 10)."""
    weights = np.zeros((2, 10))
    weights[:, 2 * place : 2 * place + 2] = np.eye(2) if mixed is None else mixed
    return weights


def inner_products(products: Array, terms: Array) -> Array:
    """Of what terms (..., term, axis, 10) make of signals, by products of these (..., 10, 10), (..., term, term)."""
    made = terms @ products[..., None, :, :]
    rows = made.reshape(*made.shape[:-2], -1)
    return np.asarray(rows @ terms.reshape(*terms.shape[:-2], -1).swapaxes(-1, -2))


_LOAD = [-signal_row(place) for place in (2, 3, 4)]
_BALANCE = signal_row(0) - signal_row(1)
_DIFFERENT, _COUPLED = np.diag([1.0, -1.0]), np.array([[0.0, 1.0], [1.0, 0.0]])
_TURNED = np.array([[0.0, -1.0], [1.0, 0.0]])
_LINEAR: dict[Kind, tuple[Array, list[Array]]] = {
    "gain": (signal_row(0), [*_LOAD, -signal_row(1)]),
    "gains": (signal_row(0), [*_LOAD, -signal_row(1), -signal_row(1, _DIFFERENT)]),
    "crosstalk": (signal_row(0), [*_LOAD, *(-signal_row(1, np.eye(4)[k].reshape(2, 2)) for k in range(4))]),
    "rotation": (signal_row(0), [*_LOAD, -signal_row(1), -signal_row(1, _TURNED)]),
    "displacement axes": (_BALANCE, [*_LOAD, *(-signal_row(place, _TURNED) for place in (2, 3, 4))]),
    "perturbation axes": (signal_row(0), [*_LOAD, -signal_row(1), -signal_row(0, _TURNED)]),
    "load": (
        _BALANCE,
        [*_LOAD, *(-signal_row(place, mixed) for mixed in (_DIFFERENT, _COUPLED) for place in (2, 3, 4))],
    ),
}
"""What is left of the balance without free parameters, and with each of them, (axis, 10) each."""

_REASONS: dict[Kind, str] = {
    "gain": "its calibration, or that of the perturbation",
    "gains": "its calibration",
    "crosstalk": "crosstalk of its sensor: take it off",
    "rotation": "the mounting of its sensor: turn x and y of it back",
    "displacement axes": "the axes of its sensor: turn x and y of it back",
    "perturbation axes": "the axes of the motors: turn x and y of it back",
}

_DELAYED: dict[Kind, slice] = {"force": slice(2, 4), "displacement": slice(4, 10), "perturbation": slice(0, 2)}
"""Where in the products each signal is."""


def find_imbalance(spectra: Spectra) -> Imbalance | None:
    """What explains best why a force balance does not hold; None where it does, or too little is known."""
    if len(spectra.frequency) < FEWEST or min(spectra.least) <= 0.0:
        return None
    try:
        with np.errstate(all="ignore"):  # a force that is zero has no gain
            return _imbalance(spectra)
    except (ValueError, np.linalg.LinAlgError):
        return None


def _imbalance(spectra: Spectra) -> Imbalance | None:
    spectra, none = _started(spectra)
    weight = spectra.counts / none.density
    before, summed = 2.0 * float(weight @ none.power), _summed(spectra, weight)
    n_more = {kind: len(terms) - len(_LOAD) for kind, (_, terms) in _LINEAR.items()} | dict.fromkeys(_DELAYED, 1)
    explained = {kind: before - float(_least_squares(summed, *of_kind)[1]) for kind, of_kind in _LINEAR.items()}
    explained |= {kind: before - _Delayed(spectra, place, weight).nearest()[1] for kind, place in _DELAYED.items()}
    best, simpler, ratio, most = None, None, 0.0, max(explained.values())
    for kind, by_kind in explained.items():
        # With the noise of none the right one explains nearly as much as with its own.
        by_chance = 0.5 * spectra.shorter * float(stats.chi2.isf(CHANCE, n_more[kind]))
        if not by_kind > max(by_chance, NEARLY * most):
            continue
        candidate, fit = _linear(spectra, kind, none) if kind in _LINEAR else _late(spectra, kind, weight)
        by_noise = spectra.counts / fit.density
        candidate = candidate._replace(share=1.0 - float(by_noise @ fit.power) / float(by_noise @ none.power))
        if kind == "crosstalk" and (candidate.bias > LARGEST_LEAK or candidate.share < CLEAR):
            continue  # other axes, or what leaks in another signal
        if kind in SIMPLER and candidate.share > (simpler.share if simpler else 0.0):
            simpler = candidate
        better = 2.0 * (none.objective - fit.objective) / spectra.shorter - PER_TERM * n_more[kind]
        if better > ratio:
            best, ratio = candidate, better
    if best and best.kind == "crosstalk" and simpler and simpler.share > best.share - FURTHER:
        best = simpler
    if best is not None and best.kind in _DELAYED and abs(best.delay) > max(LEAST_DELAY, 3.0 * best.standard_error):
        return _explained(best)
    if best is not None and best.share > MOST:
        return _explained(best) if best.kind not in _DELAYED and best.bias > LEAST_BIAS else None
    left = _following(spectra, none)
    if not left > LEAST_UNEXPLAINED:
        return None
    return Imbalance(
        "unknown",
        f"what the force balance leaves is {_percent(left)} of the force and follows the perturbation, though no gain, "
        "rotation or delay of a signal and no manipulator of mass, damping and stiffness explains most of it (a filter "
        "that one signal alone passes?)",
        0.0,
        left,
    )


def _explained(candidate: Imbalance) -> Imbalance:
    explains = f"which explains {min(100.0 * candidate.share, 99.9):.3g} % of what the force balance leaves"
    return candidate._replace(
        text=f"{candidate.text}, {explains} and makes the arm's impedance wrong by about {_percent(candidate.bias)}"
    )


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %" if share > 0.1 else f"{100.0 * share:.2g} %"


def _summed(spectra: Spectra, weight: Array) -> Array:
    return np.asarray(np.einsum("b,bij->ij", weight, spectra.products.real))


def _least_squares(summed: Array, base: Array, terms: list[Array]) -> tuple[Array, Array]:
    """Factors of terms that leave least of a base, (..., term), and how much they leave, (...,).

    Products are summed over bands, (..., 10, 10).
    """
    inner = inner_products(summed, np.stack([base, *terms]))
    scale = np.sqrt(np.diagonal(inner, axis1=-2, axis2=-1))
    if not (scale > 0.0).all():
        raise np.linalg.LinAlgError("a signal is zero")
    scaled = inner / (scale[..., :, None] * scale[..., None, :])
    of_base = scaled[..., 1:, 0]
    inverse = np.linalg.pinv(scaled[..., 1:, 1:], rcond=1e-12, hermitian=True)
    factors = -np.einsum("...ij,...j->...i", inverse, of_base)
    left = inner[..., 0, 0] * (1.0 + np.sum(factors * of_base, axis=-1))
    return factors * scale[..., :1] / scale[..., 1:], left


def _fitted(spectra: Spectra, base: Array, terms: list[Array]) -> _Fit:
    """Fit a linear candidate and its noise in turn."""
    s = 2j * np.pi * spectra.frequency
    density = spectra.noise
    for _ in range(ROUNDS):
        values, _ = _least_squares(_summed(spectra, spectra.counts / density), base, terms)
        weights = base + np.tensordot(values, np.stack(terms), 1)
        power = _power(spectra, weights)
        stiffness = np.abs(values[0] * s**2 + values[1] * s + values[2]) ** 2
        density, objective = _noise(power, stiffness, spectra)
    return _Fit(values, weights, power, density, objective)


def _started(spectra: Spectra) -> tuple[Spectra, _Fit]:
    """The spectra with noise from which fits may start, and the fit of mass, damping and stiffness alone.

    Where displacement is noisy, its acceleration at high frequencies is noise, which makes a mass too small that starts
    with equal weights. If that is less likely, these frequencies weigh less.
    """
    steep = 1.0 + (spectra.frequency / np.quantile(spectra.frequency, LOW)) ** 4
    tried = [spectra, spectra._replace(noise=steep)]
    fits = [_fitted(each, _BALANCE, _LOAD) for each in tried]
    better = int(fits[1].objective < fits[0].objective - PER_TERM)
    return tried[better], fits[better]


def _power(spectra: Spectra, weights: Array) -> Array:
    """Of what weights make of the signals, mean over axes, (band,)."""
    return np.maximum(np.einsum("ac,bcd,ad->b", weights, spectra.products, weights, optimize=True).real / 2.0, 1e-300)


def _noise(power: Array, stiffness: Array, spectra: Spectra) -> tuple[Array, float]:
    """Most likely density of noise in force and displacement, (band,), and minus the log-likelihood."""
    shapes = np.stack([np.ones_like(power), stiffness], axis=1)
    counts = 2.0 * spectra.counts

    def deviance(logarithms: Array) -> tuple[float, Array]:
        parts = shapes * np.exp(logarithms)
        density = parts.sum(axis=1)
        return float(counts @ (np.log(density) + power / density)), (counts * (1.0 - power / density) / density) @ parts

    least = np.square(spectra.least)
    start = np.maximum([np.quantile(power, 0.1), np.median(power / stiffness)], least)
    bounds = [(np.log(value), None) for value in least]
    solution = optimize.minimize(deviance, np.log(start), jac=True, bounds=bounds, method="L-BFGS-B")
    return np.asarray(shapes @ np.exp(solution.x)), float(solution.fun)


class _Delayed:
    """A signal that is put earlier, by least squares with the noise of some fit."""

    def __init__(self, spectra: Spectra, place: slice, weight: Array) -> None:
        self._turn, self._place = 2j * np.pi * spectra.frequency, place
        self._others = np.delete(np.arange(10), place)
        self._summed = _summed(spectra, weight)
        self._cross = weight[:, None, None] * spectra.products[:, place, self._others]

    def left(self, delay: float | Array) -> Array:
        """What is left, weighted, if the signal is as late as given [s], for each delay."""
        cross = np.tensordot(np.exp(np.multiply.outer(delay, self._turn)), self._cross, 1).real
        summed = np.broadcast_to(self._summed, (*np.shape(delay), 10, 10)).copy()
        summed[..., self._place, self._others] = cross
        summed[..., self._others, self._place] = cross.swapaxes(-1, -2)
        return _least_squares(summed, _BALANCE, _LOAD)[1]

    def nearest(self) -> tuple[float, float]:
        """Delay that leaves least, to `STEP`, and what it leaves."""
        delays = np.arange(-LATEST, LATEST + 0.5 * STEP, STEP)
        delay, _ = self.near(float(delays[np.argmin(self.left(delays))]), STEP)
        return delay, float(self.left(delay))

    def near(self, delay: float, within: float) -> tuple[float, float]:
        """The same near a delay [s], and how quickly what is left grows around it [1/s^2]."""
        bounds = (delay - within, delay + within)
        delay = float(optimize.minimize_scalar(self.left, bounds=bounds, method="bounded", options={"xatol": 1e-7}).x)
        step = 1e-4
        around = self.left(delay - step) - 2.0 * self.left(delay) + self.left(delay + step)
        return delay, float(around) / step**2


def _late(spectra: Spectra, kind: Kind, weight: Array) -> tuple[Imbalance, _Fit]:
    """A signal that is late or early."""
    place = _DELAYED[kind]
    delay, _ = _Delayed(spectra, place, weight).nearest()
    for _ in range(ROUNDS - 1):
        turn = np.ones((len(spectra.frequency), 10), dtype=complex)
        turn[:, place] = np.exp(2j * np.pi * spectra.frequency * delay)[:, None]
        in_time = spectra._replace(products=spectra.products * turn[:, :, None] * turn[:, None, :].conj())
        fit = _fitted(in_time, _BALANCE, _LOAD)
        delay, growth = _Delayed(spectra, place, spectra.counts / fit.density).near(delay, STEP)
    error = math.sqrt(spectra.shorter / growth) if growth > 0.0 else math.inf
    alone = np.zeros_like(fit.weights)
    alone[:, place] = fit.weights[:, place]
    moved = np.abs(1.0 - np.exp(2j * np.pi * spectra.frequency * delay)) ** 2 * _power(spectra, alone)
    others = " and ".join(name for name in _DELAYED if name != kind)
    text = (
        f"{kind} is recorded {1e3 * abs(delay):.2f} ms {'later' if delay > 0.0 else 'earlier'} than {others} (standard "
        f"error {1e3 * error:.2g} ms)"
    )
    if kind == "perturbation" and delay < 0.0:
        text += ", as if these two alone passed a low-pass filter or the command were held between its samples"
    return Imbalance(kind, text, 0.0, _relative(spectra, moved), delay, error), fit


def _linear(spectra: Spectra, kind: Kind, none: _Fit) -> tuple[Imbalance, _Fit]:
    """Another gain of the force, other axes of a signal, or another manipulator."""
    fit = _fitted(spectra, *_LINEAR[kind])
    if kind == "load":
        change = np.where(np.arange(10) < 4, 0.0, fit.weights - none.weights)
        bias = _relative(spectra, _power(spectra, change))
        return Imbalance(kind, f"the manipulator appears to have {_manipulator(spectra, fit)}", 0.0, bias), fit
    if kind == "displacement axes":
        along, across = fit.values.reshape(2, 3)
        powers = np.array([spectra.counts @ _power(spectra, signal_row(2 + k)) for k in range(3)])
        angle = math.atan2(-float(powers @ (along * across)), float(powers @ along**2))
        return Imbalance(kind, f"displacement {_by_angle(angle)} ({_REASONS[kind]})", 0.0, _chord(angle)), fit
    gain, more = float(fit.values[3]), float(fit.values[4]) if len(fit.values) > 4 else 0.0
    if kind == "perturbation axes":
        bias = _chord(math.atan(more)) * _relative(spectra, _power(spectra, signal_row(0)))
        return Imbalance(kind, f"perturbation {_by_angle(math.atan(more))} ({_REASONS[kind]})", 0.0, bias), fit
    if kind == "crosstalk":
        recorded_as = np.linalg.inv(fit.values[3:].reshape(2, 2))
        (x, of_y), (of_x, y) = recorded_as.tolist()
        shares = [f"{round(100.0 * share, 1) + 0.0:g} %" for share in (of_y, of_x)]
        text = f"force along x appears to hold {shares[0]} of that along y, and y {shares[1]} of x"
        if gains := [f"{_too_large(g)} in {name}" for name, g in (("x", x), ("y", y)) if abs(g - 1.0) > LEAST_BIAS]:
            text += f", and to be {' and '.join(gains)}"
        bias = float(np.linalg.norm(recorded_as - np.eye(2), 2))
        return Imbalance(kind, f"{text} ({_REASONS[kind]})", 0.0, bias), fit
    if kind == "gains":
        x, y = 1.0 / (gain + more), 1.0 / (gain - more)
        text, bias = f"force appears to be {_too_large(x)} in x and {_too_large(y)} in y", max(abs(x - 1), abs(y - 1))
    else:
        recorded = 1.0 / complex(gain, more)
        text, bias = f"force appears to be {_too_large(recorded.real)}", abs(recorded - 1.0)
        if kind == "gain" and gain < 0.0:
            return Imbalance(kind, f"{text} (it must be the force that the handle exerts on the hand)", 0.0, bias), fit
        if kind == "rotation":
            text = f"force {_by_angle(math.atan2(recorded.imag, recorded.real))}"
            text += f", and {_too_large(abs(recorded))}" if abs(abs(recorded) - 1.0) > LEAST_BIAS else ""
    return Imbalance(kind, f"{text} ({_REASONS[kind]})", 0.0, bias), fit


def _too_large(factor: float) -> str:
    """What a gain does to a signal, in words."""
    size = f"{_percent(abs(abs(factor) - 1.0))} too {'large' if abs(factor) > 1.0 else 'small'}"
    if factor > 0.0:
        return size
    return f"of the wrong sign{f' and {size}' if abs(abs(factor) - 1.0) > LEAST_BIAS else ''}"


def _by_angle(angle: float) -> str:
    return f"appears to be turned by {abs(math.degrees(angle)):.3g}° from {'x to y' if angle > 0.0 else 'y to x'}"


def _chord(angle: float) -> float:
    """How far a rotation moves what is turned, relative to it [-]."""
    return 2.0 * abs(math.sin(0.5 * angle))


def _manipulator(spectra: Spectra, fit: _Fit) -> str:
    """Which of mass, damping and stiffness differ between the axes or couple them, in words."""
    mean, different, coupled = fit.values.reshape(3, 3)
    of_each = [
        (
            _power(spectra, signal_row(2 + k, different[k] * _DIFFERENT)),
            _power(spectra, signal_row(2 + k, coupled[k] * _COUPLED)),
        )
        for k in range(3)
    ]
    sums = np.array([[spectra.counts @ power for power in powers] for powers in of_each])
    said = []
    for k, (name, unit) in enumerate((("mass", "kg"), ("damping", "Ns/m"), ("stiffness", "N/m"))):
        if sums[k].sum() > NAMED * sums.sum():
            said.append(
                f"a {name} of {mean[k] + different[k]:.3g} {unit} along x, {mean[k] - different[k]:.3g} {unit} along y"
            )
            said[-1] += f" and {coupled[k]:.3g} {unit} between them" if sums[k, 1] > NAMED * sums.sum() else ""
    return ", and ".join(said)


def _relative(spectra: Spectra, power: Array) -> float:
    """RMS of what makes a force, relative to that of the force."""
    force = _power(spectra, signal_row(1))
    return math.sqrt(float(spectra.counts @ power) / float(spectra.counts @ force))


def _following(spectra: Spectra, fit: _Fit) -> float:
    """RMS of what is left that follows the perturbation, relative to that of the force; 0 where noise explains it."""
    of_left = np.concatenate([np.eye(10)[:2], fit.weights])
    products = of_left @ spectra.products @ of_left.T
    size = math.ceil(AVERAGES * spectra.shorter / float(np.median(spectra.counts)))
    first = np.arange(0, len(products), size)
    counts = np.add.reduceat(spectra.counts, first)
    mean = np.add.reduceat(spectra.counts[:, None, None] * products, first) / counts[:, None, None]
    answer = mean[:, 2:, :2] @ np.linalg.pinv(mean[:, :2, :2], rcond=1e-6, hermitian=True)
    follows = np.einsum("bij,bij->b", answer, mean[:, 2:, :2].conj()).real / 2.0
    left = np.maximum(np.einsum("bii->b", mean[:, 2:, 2:]).real / 2.0 - follows, 0.0)
    averages = counts / spectra.shorter
    by_chance = 2.0 * left / np.maximum(averages - 2.0, 1.0)
    # Each band counts by its own noise: one that is far noisier than others would decide alone.
    times = follows / by_chance
    if not ANSWER * float(times.sum()) > stats.chi2.isf(CHANCE, ANSWER * len(times)):
        return 0.0
    beyond = np.where(times > FOLLOWS, follows - by_chance, 0.0)
    force = float(spectra.counts @ _power(spectra, signal_row(1)))
    return math.sqrt(float(counts @ beyond) / force)
