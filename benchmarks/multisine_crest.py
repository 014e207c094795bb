"""Crest factor and time per axis of random phases, clipping and `reduce_crest`, over 100 seeds.

Run by `python -m benchmarks.multisine_crest`; about 2 min. Peaks are taken on the 4096 samples of a period at 200 Hz,
and on a grid four times as fine. Time is that of the processor, as others may use the machine. All methods get the
same random phases; clipping uses the first start of each axis only.
"""

import time
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.fft import irfft, rfft

from armperturb.perturbations import CLUSTERS, Multisine
from armperturb.perturbations.crest import N_STARTS, reduce_crest
from armperturb.perturbations.multisine import DESIGN_RATE, REDUCED_RATIO

SEEDS = 100


def clip_crest(
    lines: np.ndarray, amplitudes: np.ndarray, starts: np.ndarray, *, first_level: float, last_level: float
) -> np.ndarray:
    """Swap phases between time and frequency domain 1000 times, clipping at a level (share of the peak) that moves."""
    n_samples = 4096
    phases = starts[0]
    for share in np.linspace(first_level, last_level, 1000):
        spectrum = np.zeros(n_samples // 2 + 1, complex)
        spectrum[lines] = amplitudes * np.exp(1j * phases)
        signal = irfft(spectrum, n_samples)
        level = share * np.abs(signal).max()
        phases = np.angle(rfft(np.clip(signal, -level, level))[lines])
    return phases


def main() -> None:
    methods: dict[str, Callable[..., np.ndarray]] = {
        "random phases": lambda lines, amplitudes, starts: starts[0],
        "clipping, fixed level": partial(clip_crest, first_level=0.8, last_level=0.8),
        "clipping, rising level": partial(clip_crest, first_level=0.7, last_level=1.0),
        "reduce_crest": lambda lines, amplitudes, starts: reduce_crest(lines, amplitudes, starts[np.newaxis])[0],
    }
    starts = [  # as `Multisine.draw` has them
        np.random.default_rng(seed).uniform(-np.pi, np.pi, (2, N_STARTS, CLUSTERS.size)) for seed in range(SEEDS)
    ]
    print(f"{'reduced':10} {'method':24} {'median':>7} {'worst':>7} {'at 4x':>7} {'worst':>7} {'time per axis':>14}")
    for reduced in REDUCED_RATIO:
        plain = Multisine(rms=1.0, phases=starts[0][:, 0], reduced=reduced)
        for name, method in methods.items():
            begin = time.process_time()
            phases = [[method(plain.lines, plain.amplitudes, of_axis) for of_axis in both] for both in starts]
            spent = (time.process_time() - begin) / (2 * SEEDS)
            result = [Multisine(rms=1.0, phases=np.array(both), reduced=reduced) for both in phases]
            crest = [np.array([it.crest_factor(rate) for it in result]) for rate in (DESIGN_RATE, 4.0 * DESIGN_RATE)]
            columns = " ".join(f"{np.median(it):7.3f} {it.max():7.3f}" for it in crest)
            print(f"{reduced:10} {name:24} {columns} {1e3 * spent:11.1f} ms")


if __name__ == "__main__":
    main()
