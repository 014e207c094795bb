"""Surface EMG as a signal model: noise whose strength follows the drive of each muscle (thesis 2.3).

There are no muscle fibres in this arm, so EMG is made from what drives the muscles:

    emg = bandpass(amplitude(t) w(t) + cross-talk + electrode noise),    amplitude = gain x activation
    activation = co-contraction + max(0, reflex excitation towards this muscle) / reflex_torque, at most 1

with w white noise through the filter of Stulen & De Luca (1981, IEEE Trans. Biomed. Eng. 28), which gives surface EMG
its spectrum. Co-contraction is read off the intrinsic stiffness, zero at that of the preset RELAX and
`position_activation` at that of POSITION; reflex excitation is the spindles' (eq. 2.8) after the neural delay, before
the activation dynamics, as electrodes pick up what the nerve sends. Each electrode picks up a share of its neighbours
(`NEIGHBOURS`) as well. In a trial of maximal contraction all muscles are fully active for a while (`CONTRACTED`). With
fatigue, amplitude grows with the activation that was, while the spectrum stays. Remnant and slow corrections show if
`effort` says so; the fast part of the remnant does not, as the activation dynamics would let none of it become torque.
What the model leaves out: tremor, and the fall of the spectrum with fatigue.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from armperturb.arrays import Array
from armperturb.recording import ACTIONS, MUSCLES
from armperturb.subject import POSITION, RELAX, Subject
from armperturb.validation import require_number, require_ranges

Float32 = NDArray[np.float32]


NEIGHBOURS = (
    ("pectoralis_major_clavicular", "deltoideus_anterior"),
    ("latissimus_dorsi", "deltoideus_posterior"),
    ("biceps_short_head", "brachioradialis"),
    ("biceps_short_head", "triceps_longum"),
    ("triceps_lateralis", "triceps_longum"),
)
"""Muscles whose electrodes are near one another."""

CONTRACTED = (1.0, 6.0)
"""When muscles are contracted in a trial of a stated contraction [s]."""

RISE = 0.2
"""Time that they take before to contract, and after to relax [s]."""

STULEN_DE_LUCA = (60.0, 120.0)
"""Lower and upper frequency of the spectrum of surface EMG [Hz]: |H|^2 = f^2 / ((f^2 + low^2) (f^2 + high^2)^2)."""

HIGHPASS_ORDER = 2
"""Of the amplifier's Butterworth high-pass: 12 dB per octave."""

FASTEST_EFFORT = 25.0
"""Frequency above which excitation that makes a torque is cut off [Hz], as muscles hardly follow it."""

CHUNK = 4096
"""Samples that are drawn at a time, as many as caches hold; no effect on the result."""


@dataclass(frozen=True, kw_only=True)
class Emg:
    """Amplifier, converter and strength of the EMG.

    Volts are those behind the amplifier: at its 1000 times, 1 V is 1 mV at the skin.

    The band of 20-1000 Hz ends at half the rate of 2000 Hz: only the high-pass is a filter, the rest is the sampling.

    Attributes:
      rate: samples per second [Hz], above twice the high-pass.
      highpass: cut-off of the amplifier's high-pass [Hz], > 0.
      gain: RMS of a muscle at full activation, in the band [V], >= 0.
      noise: RMS of a silent muscle, in the band: electrode and amplifier [V], >= 0.
      position_activation: co-contraction of the preset POSITION, as a share of full activation [-], 0 to 1.
      reflex_torque: reflex excitation that alone would activate a muscle fully [Nm], > 0.
      crosstalk: share of each neighbour's signal that an electrode picks up [-], 0 to 1.
      effort: share of the torque that people make beside their reflexes (remnant and slow corrections) whose excitation
        shows [-], 0 to 1.
      fatigue: growth of the amplitude per second of full activation [1/s], >= 0.
      full_scale: largest voltage that the 16-bit converter can tell, of either sign [V], > 0.

    Raises:
      TypeError: a value is not a number.
      ValueError: a value is not finite or out of its range.
    """

    rate: float = 2000.0
    highpass: float = 20.0
    gain: float = 1.0
    noise: float = 5e-3
    position_activation: float = 0.2
    reflex_torque: float = 50.0
    crosstalk: float = 0.05
    effort: float = 0.0
    fatigue: float = 0.0
    full_scale: float = 5.0

    def __post_init__(self) -> None:
        require_ranges("Emg", self)
        require_number("Emg", "rate", self.rate, above=2.0 * self.highpass)

    @property
    def adc_step(self) -> float:
        """Voltage of one step of the converter [V]."""
        # A single-precision number: counts times it are then the same in memory and out of a file.
        return float(np.float32(self.full_scale / 2**15))

    def activation(
        self,
        subject: Subject,
        excitation: Array,
        rate: float,
        time: Array | None = None,
        contraction: float | None = None,
    ) -> Array:
        """Share of its full activation at which each muscle is driven [-], (muscle, time).

        Args:
          subject: its stiffness sets the co-contraction, and its delays apply.
          excitation: of the reflexes, undelayed [Nm], (time, joint).
          rate: of the excitation [Hz].
          time: when [s], (time,); None for the samples of the excitation.
          contraction: share of full activation at which all muscles are held, and relaxed before and after; None for
            what stiffness and reflexes say.
        """
        sampled = np.arange(len(excitation)) / rate
        time = sampled if time is None else time
        if contraction is not None:
            inside = np.minimum(time - CONTRACTED[0], CONTRACTED[1] - time)
            # No step, which no person can make and which looks like a fault of the channel.
            held = np.sin(np.pi / 2 * np.clip(inside / RISE + 1.0, 0.0, 1.0)) ** 2
            return np.broadcast_to(contraction * held, (len(MUSCLES), len(time)))
        # A neural delay is longer than a sample, so that what lies between two samples is known.
        delayed = {
            joint: np.interp(time - getattr(subject, f"Td_{joint}"), sampled, excitation[:, column], left=0.0)
            for column, joint in enumerate(("s", "e"))
        }
        delayed["se"] = (delayed["s"] + delayed["e"]) / 2.0
        # A joint that is pushed towards flexion stretches its extensors: the reflex torque is minus the excitation.
        driven = {
            action: self._cocontraction(subject, action.joints)
            + np.maximum(-action.sign * delayed[action.joints], 0.0) / self.reflex_torque
            for action in dict.fromkeys(ACTIONS.values())
        }
        return np.minimum([driven[action] for action in ACTIONS.values()], 1.0)

    def n_samples(self, n_excitation: int, rate: float) -> int:
        """How many samples the converter reads beside so many of the excitation at a rate [Hz]."""
        return round(n_excitation * self.rate / rate)

    def _cocontraction(self, subject: Subject, joints: str) -> float:
        """Activation without reflexes [-]; stiffness grows in proportion with it."""
        field = f"k_{joints}"
        relaxed, held = getattr(RELAX, field), getattr(POSITION, field)
        return self.position_activation * max(0.0, (getattr(subject, field) - relaxed) / (held - relaxed))

    def read(
        self,
        subject: Subject,
        excitation: Array,
        rate: float,
        rng: np.random.Generator,
        contraction: float | None = None,
        out: Float32 | None = None,
    ) -> Float32:
        """What the converter reads [V], whole numbers of `adc_step`, (emg_time, muscle).

        A longer excitation does not change the first samples.

        Args:
          subject: as in `activation`.
          excitation: as in `activation`.
          rate: as in `activation`.
          rng: what the noise is drawn from.
          contraction: as in `activation`.
          out: to fill, (emg_time, muscle); by default a new array.
        """
        from armperturb.envs.lab.amplifier import amplify

        n_samples, tired = self.n_samples(len(excitation), rate), np.zeros(len(MUSCLES))
        mixing = np.eye(len(MUSCLES), dtype=np.float32)
        for one_side, other_side in NEIGHBOURS:
            pair = MUSCLES.index(one_side), MUSCLES.index(other_side)
            mixing[pair] = mixing[pair[::-1]] = self.crosstalk
        colour, amplifier, quiet = _filters(self.rate, self.highpass)
        read = np.empty((n_samples, len(MUSCLES)), dtype=np.float32) if out is None else out
        # One stream for each muscle and one for its electrode, drawn in the order of time.
        muscles, electrodes = zip(*(stream.spawn(2) for stream in rng.spawn(len(MUSCLES))), strict=True)
        white = np.empty((2 * len(MUSCLES), CHUNK), dtype=np.float32)
        work = np.zeros((2 * (len(colour) + len(amplifier)) + 2, len(MUSCLES)), dtype=np.float32)
        noise, step = np.float32(self.noise * quiet), np.float32(self.adc_step)
        for first in range(0, n_samples, CHUNK):
            chunk = slice(first, min(first + CHUNK, n_samples))
            for stream, row in zip(muscles + electrodes, white, strict=True):
                stream.standard_normal(out=row[: chunk.stop - first], dtype=np.float32)
            time = np.arange(chunk.start, chunk.stop) / self.rate
            amplitude = self.activation(subject, excitation, rate, time, contraction)
            if self.fatigue:
                spent = tired[:, None] + np.cumsum(amplitude, axis=1) / self.rate
                tired, amplitude = spent[:, -1], amplitude * (1.0 + self.fatigue * spent)
            driven = np.ascontiguousarray((self.gain * amplitude).T, dtype=np.float32)
            amplify(white, driven, mixing, colour, amplifier, noise, step, work, read[chunk])
        return read


def effort_excitation(subject: Subject, torque: Array, rate: float) -> Array:
    """Excitation like that of the reflexes, undelayed, that makes a torque [Nm], (time, joint).

    It is that torque before the activation dynamics, with the opposite sign, as reflexes oppose what excites them, and
    as early as reflexes are late.

    Args:
      subject: whose activation dynamics and delays.
      torque: on the joints, zero before its start [Nm], (time, joint).
      rate: of the torque [Hz].
    """
    n_padded = 2 * len(torque)
    frequency = np.fft.rfftfreq(n_padded, 1.0 / rate)
    s = 2j * np.pi * frequency
    cut = 1.0 / (1.0 + (frequency / FASTEST_EFFORT) ** 4)
    excitation = np.empty_like(torque)
    for column, joint in enumerate("se"):
        omega = 2.0 * np.pi * getattr(subject, f"fact_{joint}")
        activation = omega**2 / (s**2 + 2.0 * subject.zeta_act * omega * s + omega**2)
        early = cut / activation * np.exp(s * getattr(subject, f"Td_{joint}"))
        excitation[:, column] = -np.fft.irfft(early * np.fft.rfft(torque[:, column], n_padded), n_padded)[: len(torque)]
    return excitation


@lru_cache(maxsize=8)
def _filters(rate: float, highpass: float) -> tuple[Float32, Float32, float]:
    """Colour of EMG and amplifier as second-order sections, and what unit noise has to be before the amplifier.

    White noise of unit RMS comes out of both filters, or out of the amplifier if it was scaled, with unit RMS.
    """
    low, high = (2.0 * np.pi * frequency for frequency in STULEN_DE_LUCA)
    colour = signal.zpk2sos(*signal.bilinear_zpk([0.0], [-low, -high, -high], 1.0, rate))
    amplifier = signal.butter(HIGHPASS_ORDER, highpass, "highpass", fs=rate, output="sos")
    # All poles are real or well damped: the response to an impulse is over within 20 periods of the slowest.
    impulse = np.zeros(int(np.ceil(20.0 * rate / min(highpass, STULEN_DE_LUCA[0]))))
    impulse[0] = 1.0
    both = np.sqrt(np.sum(signal.sosfilt(amplifier, signal.sosfilt(colour, impulse)) ** 2))
    alone = np.sqrt(np.sum(signal.sosfilt(amplifier, impulse) ** 2))
    colour[0, :3] /= both
    return colour.astype(np.float32), amplifier.astype(np.float32), float(1.0 / alone)
