"""Frequency responses from any excitation: accuracy, and coverage of their bands.

Run by `python -m benchmarks.frequency_response`; `benchmarks.distortion` judges the levels of noise and distortion.

A load of known mass, damping and stiffness takes the place of the arm; it is moved by d, and by a force of its own as a
person's remnant. Its simulation is exact. Nothing that is estimated knows the truth.
"""

import time
from collections.abc import Callable

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import fft, signal

from armperturb.analysis.arm.linear_arm import environment_admittance
from armperturb.analysis.response.closed_loop import estimate_noise
from armperturb.analysis.response.multisines import estimate_multisine
from armperturb.environment import Environment
from armperturb.envs.lab.instruments import Instruments
from armperturb.perturbations import Multisine
from armperturb.recording import make_recording

Array = NDArray[np.float64]

RATE = 200.0
DURATION = 32.0
N_TRIALS = 4
N_SEEDS = 200

MASS = np.array([[1.8, 0.3], [0.3, 1.2]])
DAMPING = np.array([[18.0, 4.0], [4.0, 14.0]])
STIFFNESS = np.array([[240.0, 60.0], [60.0, 160.0]])

LOADS = {
    "default": (MASS, DAMPING, STIFFNESS),
    "0.5 kg": (0.5 * np.eye(2), 5.0 * np.eye(2), 60.0 * np.eye(2)),
    "8 kg": (8.0 * np.eye(2), 40.0 * np.eye(2), 300.0 * np.eye(2)),
    "2000 N/m": (1.5 * np.eye(2), 30.0 * np.eye(2), 2000.0 * np.eye(2)),
    "20 N/m": (1.5 * np.eye(2), 10.0 * np.eye(2), 20.0 * np.eye(2)),
    "one-sided": (np.diag([3.0, 0.6]), np.diag([30.0, 5.0]), np.array([[800.0, 100.0], [100.0, 60.0]])),
}
"""Known loads: mass, damping and stiffness."""

TOP = 20.0
"""Highest frequency at which accuracy is judged [Hz]."""

FREQUENCY = np.geomspace(0.3, 30.0, 20)
"""Where the response to noise is estimated [Hz]."""


def load_admittance(
    frequency: Array, load: tuple[Array, Array, Array] = (MASS, DAMPING, STIFFNESS)
) -> NDArray[np.complex128]:
    """Of a load of mass, damping and stiffness [m/N], (frequency, output, input)."""
    s = 2j * np.pi * frequency[:, None, None]
    return np.asarray(np.linalg.inv(load[0] * s**2 + load[1] * s + load[2]))


def simulate_load(
    perturbation: Array,
    rng: np.random.Generator,
    own: float = 0.0,
    load: tuple[Array, Array, Array] = (MASS, DAMPING, STIFFNESS),
) -> xr.Dataset:
    """A recording of a load and the thesis's manipulator, from rest, by the thesis's gauge and encoders.

    Args:
      perturbation: d [N], (trial, time, axis).
      rng: of the noise.
      own: RMS of the load's own force, below 3 Hz [N].
      load: mass, damping and stiffness, (2, 2) each.
    """
    n_trials, n, _ = perturbation.shape
    n_padded = fft.next_fast_len(n + round(20.0 * RATE), real=True)
    frequency = np.maximum(fft.rfftfreq(n_padded, 1.0 / RATE), 1e-6)
    moved, held = load_admittance(frequency, load), environment_admittance(Environment(), frequency)
    remnant = signal.lfilter(*signal.butter(2, 3.0, fs=RATE), rng.normal(size=(n_trials, n + 1000, 2)), axis=1)
    remnant = fft.rfft((own / remnant.std() * remnant)[:, 1000:], n_padded, axis=1)
    d = fft.rfft(perturbation, n_padded, axis=1)
    # x = H (f + remnant) = E (d - f)
    drive = np.einsum("fij,tfj->tfi", held, d) - np.einsum("fij,tfj->tfi", moved, remnant)
    force = np.einsum("fij,tfj->tfi", np.linalg.inv(moved + held), drive)
    displacement = np.einsum("fij,tfj->tfi", held, d - force)
    force, displacement = (fft.irfft(values, n_padded, axis=1)[:, :n] for values in (force, displacement))
    instruments = Instruments(emg=None, marker_noise=None)
    signals = {
        "perturbation": perturbation,
        "force": instruments.read_force(force, rng),
        "displacement": instruments.read_displacement(displacement),
    }
    numbers = {"repetition": 0, "pulse_level": 0.0, "l_h": 0.3, "l_f": 0.3, "theta_s_deg": 22.5, "theta_e_deg": 82.3}
    absent = dict.fromkeys(("pulse_direction", "pulse_onset", "limit_time"), np.nan)
    labels = {"subject": "load", "task": "RT", "condition": "RT", **numbers, **absent}
    return make_recording(signals, {name: [value] * n_trials for name, value in labels.items()}, RATE)


def multisines(n: int, seed: int, duration: float = DURATION) -> Array:
    """Thesis multisines of 2 N, (trial, time, axis)."""
    drawn = [Multisine.draw(seed=1000 * seed + i, rms=2.0, duration=duration, crested=False) for i in range(n)]
    return np.stack([entry.sample(RATE, round(duration * RATE)) for entry in drawn])


def odd_multisines(n: int, seed: int, duration: float = DURATION) -> Array:
    """Multisines of the same period on all odd lines from 0.15 to 25 Hz, falling with frequency from 2 Hz on."""
    n_period = 4096
    lines = np.arange(3, 512, 2)
    phases = np.random.default_rng([seed, 1]).uniform(-np.pi, np.pi, (n, len(lines), 2))
    spectrum = np.zeros((n, n_period // 2 + 1, 2), dtype=complex)
    spectrum[:, lines] = np.exp(1j * phases) / np.maximum(1.0, lines / 41.0)[:, None]
    period = fft.irfft(spectrum, n_period, axis=1)
    n_time = round(duration * RATE)
    return np.take(2.0 * period / period.std(), np.arange(n_time), axis=1, mode="wrap")


def noises(n: int, seed: int, duration: float = DURATION) -> Array:
    """Noise of 2 N below 8 Hz (first order), (trial, time, axis)."""
    white = np.random.default_rng([seed, 2]).normal(size=(n, round(duration * RATE), 2))
    coloured = signal.lfilter(*signal.butter(1, 8.0, fs=RATE), white, axis=1)
    return 2.0 * coloured / coloured.std()


def accuracy() -> None:
    """Largest error over the largest element, to 20 Hz, with the thesis's instruments and loads that only give way."""
    print(f"known loads, error over the largest element, worst to {TOP:g} Hz of 10 seeds [%]")
    print(f"  {'':26}" + "".join(f"{name:>12}" for name in LOADS))
    ways: dict[str, Callable[[int], tuple[Array, ...]]] = {
        "thesis multisines": lambda seed: (multisines(N_TRIALS, seed),),
        "odd multisines": lambda seed: (odd_multisines(N_TRIALS, seed),),
        "multisines, 25 s and 44 s": lambda seed: tuple(
            multisines(2, 10 * seed + n, duration) for n, duration in enumerate((25.0, 44.0))
        ),
        "noise": lambda seed: (noises(N_TRIALS, seed),),
        "noise, 40 s, 25 s and 60 s": lambda seed: tuple(
            noises(n, 10 * seed + n, duration) for n, duration in ((2, 40.0), (1, 25.0), (1, 60.0))
        ),
    }
    for name, draw in ways.items():
        cells = []
        for load in LOADS.values():
            errors = []
            for seed in range(10):
                rng = np.random.default_rng(seed)
                recordings = [simulate_load(d, rng, load=load) for d in draw(seed)]
                result = estimate_multisine(recordings) if "sines" in name else estimate_noise(recordings)
                truth = load_admittance(result.frequency, load)
                relative = np.abs(result.response - truth) / np.abs(truth).max(axis=(1, 2), keepdims=True)
                errors.append(relative[result.frequency <= TOP].max())
            cells.append(f"{100 * max(errors):12.2f}")
        print(f"  {name:26}" + "".join(cells), flush=True)


def coverage() -> None:
    """Share of the seeds in which the 95 % circle holds the truth."""
    print(f"coverage of 95 % circles over {N_SEEDS} seeds [%]: all, and the extremes of single frequencies")
    for name, draw in (("multisine", multisines), ("odd multisine", odd_multisines), ("noise", noises)):
        for n_trials in (1, 2, N_TRIALS):
            began = time.process_time()
            covered = []
            for seed in range(N_SEEDS):
                rng = np.random.default_rng([seed, 3])
                recording = simulate_load(draw(n_trials, seed), rng, own=0.3)
                if name == "noise":
                    result = estimate_noise(recording, frequency=FREQUENCY)
                else:
                    result = estimate_multisine(recording)
                covered.append(result.covers(load_admittance(result.frequency)))
            mean = 100 * np.mean(covered, axis=(0, 2, 3))
            print(
                f"  {name:14} {n_trials} trials: {mean.mean():5.1f} ({mean.min():5.1f} to {mean.max():5.1f}), "
                f"CPU {time.process_time() - began:.0f} s"
            )


def main() -> None:
    accuracy()
    coverage()


if __name__ == "__main__":
    main()
