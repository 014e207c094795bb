"""How likely EMG is under an arm model, so that it tells of reflexes together with the movement.

What reflexes see of the rotations q, u = (Ka s^2 + Kv s + Kp) q, drives antagonists with opposite signs. So of each
group of muscles (shoulder, elbow, both) the difference between the amplitudes of extensors and flexors is

    y(s) = sum over its joints of g_j e^(-s (Td_j - T_em)) u_j(s) + w,

with an unknown gain g_j [1/(Nm)] for each joint that a group crosses, in each condition unless it is shared, and an
electromechanical delay T_em by which the muscles answer later than their EMG, beyond the activation dynamics. In place
of torques u_j, groups may follow their own stretch (`emg_laws`). What rectification adds to each amplitude is the same
in both, and falls out of the difference. The noise w is that of EMG, of an unknown smooth spectrum; it is taken to move
no arm, so that

    p(x, y | d) = p(x | d) p(y | q),

and the logarithms of both likelihoods add (`trials_with_emg`). A window w is put on the recorded y, after delay and
derivatives. On q it is therefore put as it was: with T for the delay and F for the Fourier transform,

    F[w(t) u(t - T)] = e^(-s T) F[w(t + T) u(t)], where w(t + T) is w + T w',
    F[w q'] = s F[w q] - F[w' q],    F[w q''] = s^2 F[w q] - 2 s F[w' q] + F[w'' q].

Rotations are those of the recorded joint angles, or
follow from the handle's displacement x and its force f on the hand: q = J^-1 (x - f / (b_h s + k_h)).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Self

import numpy as np
from scipy import fft

from armperturb.analysis.arm.parameters import DELAYS, GRIP_DAMPING, GRIP_STIFFNESS, MATRIX, PARAMETERS
from armperturb.analysis.defaults import FEWEST_TRIALS
from armperturb.analysis.emg.outputs import ReflexOutputs
from armperturb.analysis.fit.emg_laws import TORQUE, Law
from armperturb.analysis.fit.likelihood import judged_part
from armperturb.analysis.fit.trial_effects import ASSUMED
from armperturb.analysis.fit.whittle import ALL, Whittle
from armperturb.arrays import Array, ComplexArray
from armperturb.validation import require_number

BAND = (0.3, 20.0)
"""Frequencies of the EMG that count [Hz]."""

LARGEST_GAIN = 10.0
"""Upper bound of gains [1/(Nm)]: a torque of 0.1 Nm would activate a muscle as the reference does."""

DELAY_NAME = "T_em"

N_ARM = len(PARAMETERS)

FEEDBACK = ("kp", "kv", "ka")
"""Gains by the power of s that they go with."""

ENTRIES = {name: [int(MATRIX[name][place]) for place in ((0, 0), (0, 1), (1, 1))] for name in FEEDBACK}
"""Places of the entries s, se and e of their matrices among the parameters of an arm."""

FEW_WITH_EMG = (
    f"EMG of fewer than {FEWEST_TRIALS} trials, which do not tell how a person differs from trial to trial: intervals "
    f"assume {ASSUMED:.0%} (other conditions in the same fit would tell: --share gain)"
)
"""Remark on an assumption without which EMG would make errors smaller than the differences between trials."""

UNTIMELY = "EMG and movement disagree on the delay of reflexes"
"""Start of the remark on EMG that is late or early."""

DISAGREEMENT = 4.0
"""Standard errors from which on they do [-]: of 36 fits of synthetic linear people the largest was 3.2."""


def remarks_on_delay(later: float, error: float, *, lacks: bool) -> tuple[str, ...]:
    """What to say of muscles that answer later than their EMG by other than is assumed.

    Args:
      later: by how much [s].
      error: its standard error [s].
      lacks: whether the fit has a lack of fit, which may be the reason.
    """
    if not abs(later) > DISAGREEMENT * error:
        return ()
    word, lead = ("early", "larger") if later > 0.0 else ("late", "smaller")
    return (
        f"{UNTIMELY}, as if EMG were {1e3 * abs(later):.1f} ms {word} (standard error {1e3 * error:.1f} ms): expected "
        f"a lead of emg in the sidecar that is {lead} by that, and may be negative, or a delay that is estimated "
        f"(--emg-delay 0 0.02){', unless the lack of fit is the reason' if lacks else ''}",
    )


@dataclass(frozen=True, kw_only=True)
class ElectromechanicalDelay:
    """What is known of the time by which muscles answer later than their EMG, beyond the activation dynamics.

    Attributes:
      mean: [s].
      sd: [s]; zero if it is known.

    Raises:
      TypeError: a value is not a number.
      ValueError: the mean is not 0 to 0.1 s, or the standard deviation not 0 to 0.05 s.
    """

    mean: float = 0.0
    sd: float = 0.0

    def __post_init__(self) -> None:
        require_number("electromechanical delay", "mean", self.mean, at_least=0.0, at_most=0.1)
        require_number("electromechanical delay", "sd", self.sd, at_least=0.0, at_most=0.05)


class EmgSpectra(NamedTuple):
    """How trials of a condition become spectra in the band that counts.

    Attributes:
      frequency: [Hz], (frequency,).
      rate: of the samples [Hz].
      taper: window, (time,).
      judged: samples that it is of.
      used: places of the frequencies in a DFT.
    """

    frequency: Array
    rate: float
    taper: Array
    judged: slice
    used: slice

    @classmethod
    def of(cls, outputs: ReflexOutputs) -> Self:
        """Those of the trials of EMG outputs."""
        judged, taper = judged_part(outputs.difference.shape[1], outputs.rate, from_rest=outputs.from_rest)
        frequency = fft.rfftfreq(len(taper), 1.0 / outputs.rate)
        used = slice(int(np.searchsorted(frequency, BAND[0])), int(np.searchsorted(frequency, BAND[1])))
        return cls(frequency[used], outputs.rate, taper, judged, used)

    def __call__(self, values: Array, order: int = 0) -> ComplexArray:
        """DFT of signals (trial, time, channel) without their mean, (trial, channel, frequency).

        Args:
          values: the signals.
          order: of the window's derivative [1/s^order], with which they are weighed in place of the window.
        """
        window = self.taper
        for _ in range(order):
            window = np.gradient(window, 1.0 / self.rate)
        part = (values - values.mean(axis=1, keepdims=True))[:, self.judged] * window[:, None]
        return np.asarray(fft.rfft(part, axis=1)[:, self.used].swapaxes(1, 2))

    def with_jump(self, values: Array) -> list[ComplexArray]:
        """DFT with the window and its first two derivatives, of signals that change later than the window starts.

        From rest it starts at one: its derivatives hold a pulse, in which the signal is as far as it is from its mean.
        """
        start = (values[:, self.judged.start] - values.mean(axis=1))[..., None] * self.taper[0] * self.rate
        s = 2j * np.pi * self.frequency
        return [self(values), self(values, 1) + start, self(values, 2) + start * s]


class GainsOfJoints(Whittle):
    """Likelihood of EMG that follows from what reflexes see, of each joint or of each component of a law.

    Args:
      outputs: EMG and rotation.
      spectra: of these.
      cause: DFT of what a lack of fit is looked for with, (trial, channel, frequency).
      law: what EMG follows.
    """

    def __init__(self, outputs: ReflexOutputs, spectra: EmgSpectra, cause: ComplexArray, law: Law = TORQUE) -> None:
        frequency = spectra.frequency
        self._s = 2j * np.pi * frequency
        # Each gain, and of which output and component it is.
        self._gains = [
            (output, component)
            for output, group in enumerate(outputs.groups)
            for component in law.gains[group].values()
        ]
        super().__init__(
            frequency,
            cause,
            spectra(outputs.difference) / np.sinc(frequency * outputs.averaging),
            ALL,
            scale=np.ones(len(frequency), complex),
            least=np.finfo(float).tiny,
            taper=spectra.taper,
        )

    def _mixed(self, seen: ComplexArray, gains: Array) -> ComplexArray:
        """Outputs that follow from what reflexes see, (..., output, frequency)."""
        outputs = np.zeros((*seen.shape[:-2], self._n_outputs, seen.shape[-1]), dtype=complex)
        for (output, component), gain in zip(self._gains, gains, strict=False):
            outputs[..., output, :] += gain * seen[..., component, :]
        return outputs

    def _to_smooth(self, values: Array) -> ComplexArray:
        """EMG noise is nearly white."""
        return np.multiply.outer(np.eye(self._n_outputs, dtype=complex), np.ones(len(self._s)))


class EmgLikelihood(GainsOfJoints):
    """Likelihood of the EMG of the trials of one condition.

    Values are the parameters of an arm, as `Likelihood` has them, followed by those of `names`.

    Args:
      outputs: EMG and rotation.
      delay: what is known of the electromechanical delay.
      law: what EMG follows.
    """

    def __init__(self, outputs: ReflexOutputs, delay: ElectromechanicalDelay, law: Law = TORQUE) -> None:
        self._outputs, self.law = outputs, law
        spectra = EmgSpectra.of(outputs)
        self._rotations = spectra.with_jump(outputs.rotation)
        self._grip_loads = None if outputs.grip_load is None else spectra.with_jump(outputs.grip_load)
        self.names = tuple(name for group in outputs.groups for name in law.gains[group])
        self._delay = delay
        if delay.sd > 0.0:
            self.names = (*self.names, DELAY_NAME)
        super().__init__(outputs, spectra, self._rotations[0], law)
        s, ones, zeros = self._s, np.ones_like(self._s), np.zeros_like(self._s)
        # Powers of s with their derivatives over the factorials of their orders, (power, order, frequency).
        self._powers = np.array([[ones, zeros, zeros], [s, ones, zeros], [s**2, 2.0 * s, ones]])

    def under(self, law: Law) -> "EmgLikelihood":
        """The same EMG, by another law."""
        return EmgLikelihood(self._outputs, self._delay, law)

    @property
    def rows(self) -> list[int]:
        """Places of the values that EMG depends on."""
        of_grip = [] if self._grip_loads is None else [GRIP_STIFFNESS, GRIP_DAMPING]
        feedback = np.unique([MATRIX[name] for name in FEEDBACK]).tolist()
        return [*feedback, *range(N_ARM)[DELAYS], *of_grip, *range(N_ARM, N_ARM + len(self.names))]

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Of the parameters beyond those of the arm."""
        half = 10.0 * self._delay.sd
        of_delay = {DELAY_NAME: (self._delay.mean - half, self._delay.mean + half)} if half else {}
        return {name: of_delay.get(name, (0.0, LARGEST_GAIN)) for name in self.names}

    @property
    def prior(self) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation of what is known of these beside the trials."""
        return {DELAY_NAME: (self._delay.mean, self._delay.sd)} if self._delay.sd > 0.0 else {}

    def start(self, arm: Array) -> Array:
        """Values of the parameters beyond those of the arm, as they follow from one, by least squares."""
        seen = self._seen(np.append(arm, self._delay.mean))
        values = np.zeros(len(self.names))
        for output in range(self._n_outputs):
            its = [k for k, (of, _) in enumerate(self._gains) if of == output]
            columns = np.array([seen[:, self._gains[k][1]].ravel() for k in its])
            gram = (columns @ columns.conj().T).real
            along = (columns.conj() @ self._observed[:, output].ravel()).real
            values[its] = np.clip(np.linalg.lstsq(gram, along)[0], 0.0, LARGEST_GAIN)
        if self._delay.sd > 0.0:
            values[-1] = self._delay.mean
        return values

    def _delay_of(self, values: Array) -> float:
        return float(values[-1]) if self._delay.sd > 0.0 else self._delay.mean

    def _delays(self, values: Array) -> Array:
        """From rotation to EMG [s], (component, 1)."""
        return np.asarray(self.law.delays @ values[DELAYS] - self._delay_of(values))[:, None]

    def _feedback(self, values: Array) -> ComplexArray:
        """From rotation to what reflexes see, and its derivatives by s over their factorials, (order, component, joint,
        frequency)."""
        gains = np.array([self.law.feedback @ values[ENTRIES[name]] for name in FEEDBACK])
        return np.asarray(np.einsum("pci,pof->ocif", gains, self._powers))

    def _responses(self, values: Array, by_s: ComplexArray) -> ComplexArray:
        """From rotations to what reflexes see, as late as EMG shows it, by the order of the window's derivative.

        Args:
          values: of the parameters.
          by_s: response without a delay and its derivatives, as `_feedback` gives them.
        """
        late = self._delays(values)[:, None]
        whole, first, second = by_s
        orders = np.stack([whole, late * whole - first, second - late * first])
        return np.asarray(np.exp(-self._s * late) * orders)

    def _answers(self, responses: ComplexArray, rotations: Sequence[ComplexArray]) -> ComplexArray:
        """Of components to rotations, (trial, component, frequency)."""
        pairs = zip(responses, rotations, strict=True)
        return np.asarray(sum(np.einsum("cif,tif->tcf", each, of_order) for each, of_order in pairs))

    def _turned(self, values: Array, trials: slice = ALL) -> list[ComplexArray]:
        """Rotations by the order of the window's derivative, (trial, joint, frequency); none of it is the grip's."""
        rotations = [each[trials] for each in self._rotations]
        if self._grip_loads is None:
            return rotations
        grip = self._grip(values)
        return [turned - grip * load[trials] for turned, load in zip(rotations, self._grip_loads, strict=True)]

    def _grip(self, values: Array) -> ComplexArray:
        """Admittance of the grip [m/N], (frequency,)."""
        return np.asarray(1.0 / (values[GRIP_DAMPING] * self._s + values[GRIP_STIFFNESS]))

    def _seen(self, values: Array, trials: slice = ALL) -> ComplexArray:
        """What reflexes see, as late as EMG shows it, (trial, component, frequency)."""
        return self._answers(self._responses(values, self._feedback(values)), self._turned(values, trials))

    def _predicted(self, values: Array, trials: slice = ALL) -> ComplexArray:
        return self._mixed(self._seen(values, trials), values[N_ARM:])

    def _slopes(self, values: Array, mixing: Array) -> Iterator[tuple[slice, ComplexArray]]:
        feedback, turned, gains = self._feedback(values), self._turned(values), values[N_ARM:]
        responses = self._responses(values, feedback)
        seen = self._answers(responses, turned)
        derivatives = np.zeros((mixing.shape[1], len(seen), self._n_outputs, seen.shape[-1]), dtype=complex)

        def add(row: int, change: Callable[[], ComplexArray]) -> None:
            """Count the derivative by a value, one after the other for the sake of memory, where it is free."""
            if mixing[row].any():
                of_row = change()
                for column in np.flatnonzero(mixing[row]):
                    derivatives[column] += mixing[row, column] * of_row

        def of_feedback(power: int, entry: int) -> ComplexArray:
            by_s = np.einsum("ci,of->ocif", self.law.feedback[..., entry], self._powers[power])
            return self._mixed(self._answers(self._responses(values, by_s), turned), gains)

        # The window that is put earlier grows with the delay, too.
        growth = np.exp(-self._s * self._delays(values))[:, None] * np.stack([feedback[0], -feedback[1]])
        later = self._answers(growth, turned[1:]) - self._s * seen

        def of_delay(joint: int) -> ComplexArray:
            return self._mixed(self.law.delays[:, joint, None] * later, gains)

        for power, name in enumerate(FEEDBACK):
            for entry, row in enumerate(ENTRIES[name]):
                add(row, partial(of_feedback, power, entry))
        for joint in range(2):
            add(DELAYS.start + joint, partial(of_delay, joint))
        if self._grip_loads is not None and np.isfinite(values[GRIP_STIFFNESS]):
            by_stiffness = self._answers(responses * self._grip(values) ** 2, self._grip_loads)
            add(GRIP_STIFFNESS, lambda: self._mixed(by_stiffness, gains))
            add(GRIP_DAMPING, lambda: self._mixed(self._s * by_stiffness, gains))
        for k, (output, component) in enumerate(self._gains):
            for column in np.flatnonzero(mixing[N_ARM + k]):
                derivatives[column, :, output] += mixing[N_ARM + k, column] * seen[:, component]
        if self._delay.sd > 0.0:
            add(N_ARM + len(self._gains), lambda: self._mixed(-later, gains))
        yield ALL, derivatives
