"""What a person does beside answering the perturbation: remnant, slow corrections, trials that differ (thesis 2.6).

Remnant and corrections are the N of figure 2.6: torque on the joints that does not correlate with the disturbance. That
they grow with the effort is the classical finding on remnant (Levison, Baron & Kleinman 1969, IEEE Trans. Man-Mach.
Syst. 10: its power is proportional to the variance of what the person controls) and on motor noise (Jones, Hamilton &
Wolpert 2002, J. Neurophysiol. 88: its SD is proportional to the mean torque); without it one setting could not give
both PT2.5 and PT22.5 their published VAF (table C.12).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy import signal

from armperturb.arrays import Array
from armperturb.files import packaged_table
from armperturb.subject import Subject
from armperturb.validation import require_number, require_ranges

REMNANT_ORDER = 2
"""Order of the Butterworth low-pass that colours the remnant."""

VOLUNTARY_ORDER = 4
"""Order of the Butterworth low-pass that keeps corrections slow."""

MAX_REDRAWS = 1000

_PARTS = ((REMNANT_ORDER, "remnant"), (VOLUNTARY_ORDER, "voluntary"), (REMNANT_ORDER, "fast"))
"""Order of the low-pass of each part of the noise, and what the names of its fields begin with."""

_VARIED = ("b", "k", "kv", "kp")


@dataclass(frozen=True, kw_only=True)
class HumanNoise:
    """How noisy a person is in one task; every part is off at zero, and all are by default.

    The torque at a joint is three low-passed white noises, independent between joints, each with an RMS of
    hypot(floor, share x demand), where the demand is the RMS torque with which the perturbation of the trial loads the
    joint. All start at zero with the person at rest, and reach their RMS after about one period of their cut-off.

    Attributes:
      remnant_share: RMS of the remnant as a share of the demand [-], >= 0.
      remnant_floor: RMS of the remnant without a perturbation [Nm], >= 0.
      remnant_cutoff: of the remnant's second-order low-pass [Hz], > 0.
      voluntary_share: RMS of the slow corrections as a share of the demand [-], >= 0.
      voluntary_floor: RMS of the slow corrections without a perturbation [Nm], >= 0.
      voluntary_cutoff: of the corrections' fourth-order low-pass [Hz], > 0. At 0.3 Hz, 97 % of their power is below the
        0.40 Hz from which on the thesis takes the VAF (2.7).
      fast_share: RMS of the fast part of the remnant as a share of the demand [-], >= 0.
      fast_floor: RMS of the fast part without a perturbation [Nm], >= 0.
      fast_cutoff: of the fast part's second-order low-pass [Hz], > 0.
      spread_b: SD over trials of the logarithm of one factor on all intrinsic damping [-], >= 0.
      spread_k: the same of intrinsic stiffness, long-range and short-range [-], >= 0.
      spread_kv: the same of velocity feedback [-], >= 0.
      spread_kp: the same of position feedback [-], >= 0.

    Raises:
      TypeError: a value is not a number.
      ValueError: a value is not finite or out of its range.
    """

    remnant_share: float = 0.0
    remnant_floor: float = 0.0
    remnant_cutoff: float = 2.0
    voluntary_share: float = 0.0
    voluntary_floor: float = 0.0
    voluntary_cutoff: float = 0.3
    fast_share: float = 0.0
    fast_floor: float = 0.0
    fast_cutoff: float = 20.0
    spread_b: float = 0.0
    spread_k: float = 0.0
    spread_kv: float = 0.0
    spread_kp: float = 0.0

    def __post_init__(self) -> None:
        require_ranges("HumanNoise", self)

    def scaled(self, factor: float) -> Self:
        """The noise with `factor` times the torque; what differs from trial to trial stays."""
        names = [f"{part}_{level}" for _, part in _PARTS for level in ("share", "floor")]
        return replace(self, **{name: factor * getattr(self, name) for name in names})

    def without_fast_part(self) -> Self:
        """Remnant and slow corrections alone, each as it was beside the fast part."""
        return replace(self, fast_share=0.0, fast_floor=0.0)

    def vary(self, subject: Subject, rng: np.random.Generator, accept: Callable[[Subject], bool]) -> Subject:
        """The subject as it is in one trial; the subject itself if all spreads are zero.

        Args:
          subject: the person on average.
          rng: what the factors are drawn from.
          accept: whether a draw may be used, as it may not if the arm is unstable; others are drawn again.

        Raises:
          RuntimeError: no draw was accepted.
        """
        spreads = np.array([getattr(self, f"spread_{quantity}") for quantity in _VARIED])
        if not spreads.any():
            return subject
        for _ in range(MAX_REDRAWS):
            factors = np.exp(spreads * rng.standard_normal(len(spreads)))
            changes: dict[str, Any] = {
                f"{quantity}_{joint}": float(factor) * value
                for quantity, factor in zip(_VARIED, factors, strict=True)
                for joint, value in zip(("s", "se", "e"), subject.joint_triple(quantity), strict=True)
            }
            drawn = replace(subject, muscle=subject.muscle and subject.muscle.scaled(float(factors[1])), **changes)
            if accept(drawn):
                return drawn
        raise RuntimeError(f"no stable variation of subject {subject.name!r} in {MAX_REDRAWS} draws with {self}")

    def rms(self, demand: ArrayLike) -> tuple[Array, ...]:
        """RMS torque of remnant, slow corrections and fast part [Nm], (joint,) each, at a demand [Nm], (joint,)."""
        demand = np.asarray(demand, dtype=float)
        return tuple(
            np.hypot(getattr(self, f"{part}_floor"), getattr(self, f"{part}_share") * demand) for _, part in _PARTS
        )

    def torque_spectrum(self, demand: ArrayLike, timestep: float, frequency: ArrayLike) -> Array:
        """One-sided power spectrum of what `torque` draws [Nm^2/Hz], (frequency, joint); linear in the demand squared.

        Args:
          demand: RMS torque with which the perturbation loads each joint [Nm], (joint,).
          timestep: of the simulation [s].
          frequency: [Hz], (frequency,).

        Raises:
          ValueError: a cut-off is not below half the simulation's rate.
        """
        spectrum = np.zeros((np.size(frequency), 2))
        for part, rms in zip(_PARTS, self.rms(demand), strict=True):
            if not rms.any():
                continue
            _, response = signal.sosfreqz(self._lowpass(*part, timestep), frequency, fs=1.0 / timestep)
            spectrum += 2.0 * timestep * rms**2 * np.abs(response)[:, None] ** 2
        return spectrum

    def torque(self, demand: ArrayLike, timestep: float, n_steps: int, rng: np.random.Generator) -> Array:
        """Torque to add at the joints, held over each step [Nm], (step, joint).

        More steps do not change the first ones, so that a trial is the same beside longer ones.

        Args:
          demand: RMS torque with which the perturbation loads each joint [Nm], (joint,).
          timestep: of the simulation [s].
          n_steps: how many steps.
          rng: what the noise is drawn from.

        Raises:
          ValueError: a cut-off is not below half the simulation's rate.
        """
        torque = np.zeros((n_steps, 2))
        # One stream for each part: switching one off leaves the other as it was.
        for part, rms, stream in zip(_PARTS, self.rms(demand), rng.spawn(len(_PARTS)), strict=True):
            if rms.any():
                white = stream.standard_normal((n_steps, 2))
                torque += rms * signal.sosfilt(self._lowpass(*part, timestep), white, axis=0)
        return torque

    def _lowpass(self, order: int, part: str, timestep: float) -> Array:
        field = f"{part}_cutoff"
        require_number("HumanNoise", field, getattr(self, field), above=0.0, below=0.5 / timestep)
        return _unit_lowpass(order, getattr(self, field), timestep)


@lru_cache(maxsize=64)
def _unit_lowpass(order: int, cutoff: float, timestep: float) -> Array:
    """Low-pass that turns unit white noise into noise of unit RMS, second-order sections."""
    sections = signal.butter(order, cutoff, fs=1.0 / timestep, output="sos")
    # White noise comes out with the power of the impulse response, which has died down after 20 periods.
    impulse = np.zeros(int(np.ceil(20.0 / (cutoff * timestep))))
    impulse[0] = 1.0
    sections[0, :3] /= np.sqrt(np.sum(signal.sosfilt(sections, impulse) ** 2))
    return sections


_NOISE = packaged_table(__package__, "human_noise.toml")

HUMAN_NOISE = {task: HumanNoise(**values) for task, values in _NOISE.items()}
"""Task to how noisy people are in it; relaxed people make no slow corrections.

Set on criterion and VAF of the thesis's tables C.12 and C.22; docs/calibration.md has how, and the coherence.
"""
