"""Forces of a short period, to ask of every frequency what linear theory says in less time than the multisine takes."""

from dataclasses import dataclass

import numpy as np

PERIOD = 4.0
"""[s]; that of the thesis's multisine is 20.48 s."""

FREQUENCIES = np.unique(np.rint(np.geomspace(1, 160, 40))) / PERIOD
"""Some lines over the band of that multisine, 0.25 to 40 Hz, (line,)."""


@dataclass(frozen=True)
class Tones:
    """Sinusoids with random phases along some axes, weaker above 1.5 Hz as those of the thesis."""

    rms: float
    duration: float
    seed: int = 0
    axes: tuple[int, ...] = (0, 1)

    @property
    def highest_frequency(self):
        return float(FREQUENCIES[-1])

    def sample(self, rate, n_samples, start=0.0):
        amplitude = np.where(FREQUENCIES < 1.5, 1.0, 0.387)
        amplitude *= self.rms / np.sqrt(np.sum(amplitude**2) / 2.0)
        time, force = start + np.arange(n_samples) / rate, np.zeros((n_samples, 2))
        phases = np.random.default_rng(self.seed).uniform(-np.pi, np.pi, (2, len(FREQUENCIES)))
        for axis in self.axes:
            force[:, axis] = np.cos(2 * np.pi * time[:, None] * FREQUENCIES + phases[axis]) @ amplitude
        force[(time < 0.0) | (time >= self.duration)] = 0.0
        return force
