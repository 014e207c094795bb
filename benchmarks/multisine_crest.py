"""Crest factor and time per axis of random phases, plain clipping and `reduce_crest`, over 100 seeds.

Run by `python -m benchmarks.multisine_crest`. Peaks are taken on the 4096 samples of a period at 200 Hz, and on a
grid four times as fine.
"""

import time
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.fft import irfft, rfft

from armperturb.perturbations import Multisine
from armperturb.perturbations.crest import reduce_crest
from armperturb.perturbations.multisine import REDUCED_RATIO

SEEDS = 100


def clip_crest(
    lines: np.ndarray, amplitudes: np.ndarray, phases: np.ndarray, *, first_level: float, last_level: float
) -> np.ndarray:
    """Swap phases between time and frequency domain 1000 times, clipping at a level (share of the peak) that moves."""
    n_samples = 4096
    for share in np.linspace(first_level, last_level, 1000):
        spectrum = np.zeros(n_samples // 2 + 1, complex)
        spectrum[lines] = amplitudes * np.exp(1j * phases)
        signal = irfft(spectrum, n_samples)
        level = share * np.abs(signal).max()
        phases = np.angle(rfft(np.clip(signal, -level, level))[lines])
    return phases


def main() -> None:
    methods: dict[str, Callable[..., np.ndarray]] = {
        "random phases": lambda lines, amplitudes, phases: phases,
        "clipping, fixed level": partial(clip_crest, first_level=0.8, last_level=0.8),
        "clipping, rising level": partial(clip_crest, first_level=0.7, last_level=1.0),
        "reduce_crest": reduce_crest,
    }
    print(f"{'reduced':10} {'method':24} {'median':>7} {'at 4x':>7} {'worst':>7} {'time per axis':>14}")
    for reduced in REDUCED_RATIO:
        start = [Multisine.draw(seed=seed, rms=1.0, reduced=reduced, crested=False) for seed in range(SEEDS)]
        for name, method in methods.items():
            begin = time.perf_counter()
            phases = [[method(it.lines, it.amplitudes, axis) for axis in it.phases] for it in start]
            spent = (time.perf_counter() - begin) / (2 * SEEDS)
            result = [Multisine(rms=1.0, phases=np.array(both), reduced=reduced) for both in phases]
            coarse = np.median([it.crest_factor(200.0) for it in result])
            fine = np.array([it.crest_factor() for it in result])
            print(
                f"{reduced:10} {name:24} {coarse:7.3f} {np.median(fine):7.3f} {fine.max():7.3f} {1e3 * spent:11.1f} ms"
            )


if __name__ == "__main__":
    main()
