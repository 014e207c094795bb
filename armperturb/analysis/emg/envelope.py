"""Envelopes of surface EMG: amplitude as a function of time, normalised, with what is wrong with the channels.

EMG is noise whose strength follows the drive of the muscle. In a band of B [Hz] of even spectrum, the amplitude that is
averaged over a time T is known to

    var(a) / a^2 = 1 / (4 B T)    (maximum likelihood; Hogan & Mann 1980, IEEE Trans. Biomed. Eng. 27),

while surface EMG, most of which lies between 40 and 150 Hz, tells far less unless it is whitened first. So each channel
is filtered with zero phase, counting that of the amplifier's high-pass where the recording says it, by

    |H|^2 = S / (S + N)^2    within the band,

S and N being the spectra of the muscle and of the silent channel: where the muscle is far above the noise that is
whitening, elsewhere little is let through (Clancy & Farry 2000, IEEE Trans. Biomed. Eng. 47). One filter serves all
trials of a person, so that amplitudes can be compared. Squared and averaged, it is the power; the amplitude is the root
of what is above the power of the silent channel. Over time, amplitudes are averages of the modulus instead, which for
normal noise is (2 / pi)^(1/2) times its RMS: the root of an average power grows with the changes of amplitude within
the average, which a fit takes for spindles that saturate at a speed some 3 % lower than they do.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from armperturb.analysis.cuts import limit_samples, onset_samples
from armperturb.analysis.emg.channels import (
    ChannelFault,
    Crosstalk,
    correlation,
    crosstalk_of,
    faults_of_channel,
    require_raw,
    said_of,
)
from armperturb.analysis.emg.doubtful import ABOVE_NOISE, remarks_on_amplitudes
from armperturb.analysis.emg.reference import mean_known, means_of_trials, reference_power
from armperturb.analysis.emg.whitening import (
    Intervals,
    Spectra,
    noise_spectra,
    passed_band,
    tone_at_rest,
    whitening,
)
from armperturb.analysis.results import Description, Result, Table, plain
from armperturb.arrays import Array, Indices
from armperturb.copied_trials import without_copies
from armperturb.recording import EXPECTED, REQUIRED_SIGNALS, TEXT_COORDINATES, Action, emg_highpass, muscle_actions
from armperturb.validation import require_number, require_type

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAXIMAL, REST = "MVC", "REST"
"""Conditions whose trials are maximal contractions, and rest."""

LOW, HIGH_SHARE = 20.0, 0.45
"""Lower edge of the band [Hz], and its upper edge over the sampling rate [-]."""

MAINS = (50.0, 60.0)
"""Frequencies of mains whose hum is looked for [Hz]."""

MODULUS = math.sqrt(math.pi / 2.0)
"""RMS of normal noise over the mean of its modulus [-]."""

CORRELATED = 2**19
"""Samples of a trial, the first ones, in which channels are compared for cross-talk: four minutes at 2 kHz."""

NO_NOISE = (
    "the quietest trial has the spectrum of strong contractions, which is white, so that nothing tells the noise of "
    f"the channel (a trial of condition {REST} would)"
)
"""Why noise is not known."""

NEGLIGIBLE = 1e-6
"""Disturbances below this count as none [N]."""

SHORTER = 0.5
"""Time by which EMG may end before the other signals, or after them [s]."""


LABELS = ("subject", "task", "condition", "repetition", "pulse_level", "pulse_direction", "pulse_onset")
"""Coordinates of trials that go with the envelopes."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Envelopes(Result):
    """EMG of one person's trials as amplitudes at the rate of the other signals, and in step with them.

    Attributes:
      muscles: name of each channel that is analysed to what the muscle does.
      labels: one row per trial: `LABELS`, and the first samples that are perturbed at all (start) and by the pulse
        (onset), or the number of samples; a trial that meets the workspace limit ends there.
      rate: of the envelopes [Hz].
      power: of the whitened channels about each sample, (trial, time, muscle), in units of the reference's; NaN where
        a channel is dead, and everywhere of one that is dead in all maximal contractions.
      rectified: (pi / 2)^(1/2) times the mean modulus of the whitened channels about each sample, in units of the root
        of the reference's power, likewise.
      noise: power of the silent channels in the same units, (muscle,); see `whitening`.
      knows_noise: whether anything tells that; if not it is 0, (muscle,).
      reference: what amplitudes are relative to: "maximal contraction", or the condition of the largest mean power.
      reference_volts: its RMS as recorded [V], (muscle,).
      averaging: time over which a sample of the power is averaged [s].
      samples_per_second: independent numbers in a second of the whitened channels [1/s], (trial, muscle).
      faults: of channels, in the order of the trials.
      crosstalk: pairs of channels that share a signal.
      hum: name of each channel that hums to the frequencies that are cut out [Hz].
      doubtful: what else makes amplitudes doubtful, a line each.
      contractions: conditions in which muscles are contracted on purpose, whatever the task is.
      copies: a line on each trial that repeats another and is left out.
    """

    muscles: dict[str, Action]
    labels: pd.DataFrame
    rate: float
    power: Array
    rectified: NDArray[np.float32]
    noise: Array
    knows_noise: NDArray[np.bool_]
    reference: str
    reference_volts: Array
    averaging: float
    samples_per_second: Array
    faults: tuple[ChannelFault, ...]
    crosstalk: tuple[Crosstalk, ...]
    hum: dict[str, list[float]]
    doubtful: tuple[str, ...] = ()
    contractions: tuple[str, ...] = ()
    copies: tuple[str, ...] = ()

    @property
    def is_normalised(self) -> bool:
        """Whether amplitudes are shares of a maximal contraction."""
        return self.reference == "maximal contraction"

    @property
    def unit(self) -> str:
        """What amplitudes are measured in."""
        return "% of maximal contraction" if self.is_normalised else f"% of {self.reference}"

    @property
    def tells_activity(self) -> NDArray[np.bool_]:
        """Whether amplitudes are relative to those of an active muscle, (muscle,).

        Without a maximal contraction they are where the muscle is active in the condition that they are relative to,
        and this is none of the relax task, or a contraction.
        """
        relaxed = set(self.labels["condition"][self.labels["task"] == "RT"]) - set(self.contractions)
        is_active = ABOVE_NOISE * self.noise <= 1.0
        return np.asarray((is_active & (self.reference not in relaxed)) | self.is_normalised)

    @property
    def amplitude(self) -> Array:
        """Amplitude over the reference's [-], (trial, time, muscle)."""
        return self.amplitudes(slice(None))

    def amplitudes(self, trials: slice | Indices) -> Array:
        """Those of some trials: linear in what drives the muscles, as far as these are above the noise."""
        above = np.square(self.rectified[trials], dtype=float)  # in place from here, as an hour of it is long
        above -= self.noise
        return np.sqrt(np.maximum(above, 0.0, out=above), out=above)

    def amplitude_of(self, power: Array) -> Array:
        """Amplitude over the reference's [-] of power that may have been averaged, (..., muscle)."""
        return np.sqrt(np.maximum(power - self.noise, 0.0))

    def relative_variance(self, duration: float) -> Array:
        """Variance over squared mean of amplitudes averaged so long [s], far above the noise, (trial, muscle)."""
        return 1.0 / (2.0 * self.samples_per_second * duration)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is wrong with the channels, a line each."""
        said = [*self.copies, *said_of(self.faults)]
        for name, lines in self.hum.items():
            said.append(f"EMG of {name} hums at {', '.join(f'{line:.1f}' for line in lines)} Hz: cut out")
        said += [*map(str, self.crosstalk), *self.doubtful]
        if no_group := [name for name, action in self.muscles.items() if not action.joints or not action.sign]:
            said.append(
                f"EMG of {', '.join(no_group)}: nobody says what the muscle does; expected signals.emg.muscles in the "
                "sidecar"
            )
        if lost := [name for name, volts in zip(self.muscles, self.reference_volts, strict=True) if math.isnan(volts)]:
            said.append(
                f"EMG of {', '.join(lost)}: dead in every {self.reference}, so that nothing is known of its amplitude; "
                f"without trials of condition {MAXIMAL} it would be relative to the most active condition"
            )
        if noisy := [name for name, known in zip(self.muscles, self.knows_noise, strict=True) if not known]:
            said.append(f"EMG of {', '.join(noisy)}: {NO_NOISE}; amplitudes contain it")
        return tuple(said)

    def describe(self) -> Description:
        """Mean amplitude of each muscle in each condition, and what is wrong with the channels."""
        frame = self.to_frame().pivot(index="muscle", columns="condition", values="amplitude")
        conditions = list(dict.fromkeys(self.labels["condition"]))
        rows = tuple(
            (name, *(plain(100.0 * frame.loc[name, condition], 3) for condition in conditions)) for name in self.muscles
        )
        return Description(
            title=f"EMG of {self.labels['subject'].iloc[0]}: {len(self.muscles)} muscles in {len(self.labels)} trials",
            facts=(f"amplitude before the pulse in {self.unit}",),
            table=Table(("muscle", *conditions), rows),
            remarks=self.remarks,
        )

    def mean_power(self, start: float = 0.0) -> Array:
        """Mean power of each trial from a time [s] to its pulse, (trial, muscle)."""
        return means_of_trials(self.power, self.labels["onset"].to_numpy(), round(start * self.rate))

    def to_frame(self) -> pd.DataFrame:
        """One row per condition and muscle: mean amplitude before the pulse over the reference's, and in volts."""
        amplitude = self.amplitude_of(self.mean_power())
        rows = []
        for condition in dict.fromkeys(self.labels["condition"]):
            mean = mean_known(amplitude[(self.labels["condition"] == condition).to_numpy()])
            for column, name in enumerate(self.muscles):
                rows.append((name, mean[column], mean[column] * self.reference_volts[column], condition))
        frame = pd.DataFrame(rows, columns=["muscle", "amplitude", "amplitude_V", "condition"])
        return frame.assign(subject=self.labels["subject"].iloc[0])

    def to_xarray(self) -> xr.Dataset:
        """`amplitude` along trial, time and muscle, with the labels of the trials."""
        coords = {str(name): ("trial", self.labels[name].to_numpy()) for name in self.labels.columns}
        return xr.Dataset(
            {
                "amplitude": (
                    ("trial", "time", "muscle"),
                    self.amplitude,
                    {"units": "1", "long_name": f"amplitude of the EMG over that of {self.reference}"},
                )
            },
            coords={
                **coords,
                "time": ("time", np.arange(self.power.shape[1]) / self.rate, {"units": "s"}),
                "muscle": list(self.muscles),
            },
        )

    def plot(self, figure: "Figure | None" = None, trial: int = 0, smoothing: float = 0.1) -> Any:
        """Draw the amplitude of every muscle over a trial, antagonists of a joint on one another.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.
          trial: which one.
          smoothing: time over which power is averaged [s].

        Returns:
          Matplotlib axes, (panel,).
        """
        from armperturb.plots.muscles import plot_envelopes

        return plot_envelopes(self, figure, trial, smoothing)


def require_emg(recording: xr.Dataset) -> None:
    """Refuse a recording whose EMG cannot be analysed.

    Raises:
      ValueError: there is none, or it lasts longer or less long than the other signals.
      TypeError: it is none.
    """
    require_type("recording", recording, xr.Dataset, EXPECTED)
    if "emg" not in recording.data_vars:
        raise ValueError("EMG is missing: the recording has no variable 'emg'; expected one (signals.emg of a sidecar)")
    rate = float(recording.attrs["emg_rate"])
    duration, others = _durations(recording)
    if abs(duration - others) > SHORTER:
        raise ValueError(
            f"EMG is not used: it lasts {duration:.6g} s at emg_rate = {rate:g} Hz, the other signals {others:.6g} s; "
            "expected one duration (signals.emg.rate of the sidecar; of a recording that is cut, "
            f"recording.sel(emg_time=slice(0, {others:.6g})) as well)"
        )
    if rate < 10.0 * LOW:
        raise ValueError(f"EMG is not used: emg_rate = {rate:g} Hz; expected at least {10.0 * LOW:g} Hz")
    if not np.any(recording["emg"].values):
        raise ValueError("EMG is not used: all channels are zero; expected voltages")


def remark_on_duration(recording: xr.Dataset) -> str | None:
    """What is assumed of EMG that ends before or after the other signals; None if it ends with them."""
    duration, others = _durations(recording)
    late = duration - others
    if abs(late) <= 1.5 / float(recording.attrs["rate"]):
        return None
    return (
        f"EMG lasts {abs(late):.3g} s {'more' if late > 0.0 else 'less'} than the other signals: assumed to begin with "
        "them and to have their clock"
    )


def _durations(recording: xr.Dataset) -> tuple[float, float]:
    """Of the EMG and of the other signals [s]."""
    duration = recording.sizes["emg_time"] / float(recording.attrs["emg_rate"])
    return duration, recording.sizes["time"] / float(recording.attrs["rate"])


def envelopes(
    recording: xr.Dataset,
    *,
    low: float = LOW,
    high: float | None = None,
    mains: Sequence[float] = MAINS,
    whiten: bool = True,
    maximal: str = MAXIMAL,
    rest: str = REST,
    contractions: Sequence[str] = (),
) -> Envelopes:
    """Envelopes of one person's EMG.

    Amplitudes are relative to the seconds of a maximal contraction in which a muscle is strongest, if there is a
    condition of such trials, and otherwise to the condition of its largest mean. Noise is the power of rest, if there
    is such a condition, and otherwise what is white in the quietest trial (`whitening.noise_spectra`).

    Args:
      recording: of one person, with EMG.
      low: lower edge of the band [Hz].
      high: upper edge of the band [Hz]; None for 45 % of the sampling rate, or less where the amplifier passes less,
        see `whitening.passed_band`.
      mains: frequencies whose hum is looked for, with their multiples [Hz].
      whiten: whether to whiten; if not, the band alone is let through.
      maximal: condition of the trials of maximal contraction.
      rest: condition of the trials at rest.
      contractions: conditions in which muscles are contracted on purpose, so that nobody relaxes in them.

    Raises:
      ValueError: as `require_emg` and `channels.require_raw`; there are several people; or the band is empty.
    """
    require_emg(recording)
    if len(people := dict.fromkeys(recording["subject"].values.tolist())) > 1:
        raise ValueError(f"envelopes: EMG of {', '.join(map(str, people))}; expected one person's")
    rate, mechanical = float(recording.attrs["emg_rate"]), float(recording.attrs["rate"])
    require_number("envelopes", "low", low, above=0.0, below=rate / 4.0)
    require_number("envelopes", "high", high, above=low, at_most=rate / 2.0, optional=True)
    moves = "displacement" in recording.data_vars
    each_once = without_copies(recording, REQUIRED_SIGNALS if moves else ("emg",))
    recording = each_once.recording
    volts, actions = recording["emg"].values, muscle_actions(recording)
    names, conditions = list(actions), recording["condition"].values.astype(str)
    spectra = Spectra.of(volts, rate, low, mains)
    require_raw(volts, rate, names)
    high = passed_band(spectra, low, HIGH_SHARE * rate) if high is None else high
    noise, tone = (of(spectra, (low, high), conditions == rest) for of in (noise_spectra, tone_at_rest))
    knows_noise, noise = np.isfinite(noise).all(axis=-1), np.nan_to_num(noise)
    filtered = whitening(
        spectra, noise, volts.shape[1], rate, (low, high), highpass=emg_highpass(recording), whiten=whiten
    )
    half, n_time = 1.0 / mechanical, recording.sizes["time"]
    # The other signals, which are late by the lead, show at a time what the EMG showed before it. What the lead leaves
    # of a trial without EMG is as its end.
    centre = np.arange(n_time) / mechanical - float(recording["emg"].attrs.get("lead", 0.0))
    centre = np.clip(centre, 0.0, volts.shape[1] / rate)
    intervals = Intervals(volts.shape[1], rate, centre - half, centre + half)
    power = np.empty((len(volts), n_time, len(names)))
    rectified = np.empty(power.shape, dtype=np.float32)
    shared, faults = np.zeros((len(names), len(names))), list[ChannelFault]()
    compared = np.empty((len(names), min(volts.shape[1], CORRELATED)), dtype=np.float32)
    for trial, values in enumerate(volts):
        for column, name in enumerate(names):  # one after the other, for the sake of memory
            channel = np.ascontiguousarray(values[:, column])
            white = filtered(channel, column)
            compared[column] = white[: compared.shape[1]]
            power[trial, :, column] = intervals.mean(white, np.square)
            rectified[trial, :, column] = MODULUS * intervals.mean(white, np.abs)
            slow = spectra.below[trial, column], spectra.drift[trial, column]
            of_channel = faults_of_channel(channel, white, *slow, rate, trial, name)
            for fault in of_channel:
                if fault.kind == "dead":
                    dead = slice(int(fault.start * mechanical), int(np.ceil(fault.end * mechanical)) + 1)
                    power[trial, dead, column] = rectified[trial, dead, column] = np.nan
            faults += of_channel
        shared += correlation(compared) / len(volts)
    labels = _labels(recording)
    reference, largest = reference_power(power, labels, maximal, mechanical)
    # A muscle that never rises above the noise is silent, not fully active.
    above = np.maximum(np.maximum(largest - filtered.noise, filtered.noise), np.finfo(np.float32).tiny)
    power /= above
    rectified /= np.sqrt(above)
    of_maximal = maximal if reference == "maximal contraction" else None
    means, silent = means_of_trials(power, labels["onset"].to_numpy(), 0), filtered.noise / above
    return Envelopes(
        muscles=actions,
        labels=labels,
        rate=mechanical,
        power=power,
        rectified=rectified,
        noise=silent,
        knows_noise=np.asarray(knows_noise),
        reference=reference,
        reference_volts=np.sqrt(above / filtered.gain),
        averaging=2.0 * half,
        samples_per_second=filtered.samples_per_second,
        faults=tuple(faults),
        crosstalk=crosstalk_of(shared, names),
        hum={names[column]: lines for column, lines in filtered.hum.items()},
        doubtful=tuple(remarks_on_amplitudes(names, labels, means, silent, tone, maximal=of_maximal, rest=rest)),
        contractions=tuple(contractions),
        copies=each_once.remarks,
    )


def _labels(recording: xr.Dataset) -> pd.DataFrame:
    frame = pd.DataFrame({name: recording[name].values for name in LABELS})
    frame = frame.astype(dict.fromkeys(TEXT_COORDINATES, str))
    moves = np.abs(recording["perturbation"].values).max(axis=2) > NEGLIGIBLE
    start = np.where(moves.any(axis=1), moves.argmax(axis=1), recording.sizes["time"])
    # Nothing counts once a trial has met the workspace limit, nor does a pulse after that.
    onset, limit = onset_samples(recording), limit_samples(recording)
    frame.loc[limit <= onset, "pulse_onset"] = np.nan
    return frame.assign(start=start, onset=np.minimum(onset, limit).astype(np.intp))
