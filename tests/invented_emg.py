"""EMG of known amplitude, as recordings."""

import numpy as np
from scipy import signal

from armperturb.envs.lab.emg import _filters
from armperturb.recording import Action, make_recording

RATE, EMG_RATE = 200.0, 2000.0
PAIR = {"flexor": Action("s", 1), "extensor": Action("s", -1)}
"""Antagonists of one joint."""


def noise(shape, seed=0):
    """Noise with the spectrum of surface EMG and unit RMS, time last."""
    colour, amplifier, _ = (np.asarray(each, dtype=float) for each in _filters(EMG_RATE, 20.0))
    white = np.random.default_rng(seed).standard_normal((*shape[:-1], shape[-1] + 1000))
    return signal.sosfilt(amplifier, signal.sosfilt(colour, white))[..., 1000:]


def recorded(volts, conditions=None, *, muscles=PAIR, moving=True, **labels):
    """A recording of EMG, (trial, muscle, emg_time), in trials that a force which changes sign perturbs."""
    volts = np.asarray(volts, dtype=np.float32).swapaxes(1, 2)
    n, n_time = len(volts), round(volts.shape[1] * RATE / EMG_RATE)
    still = np.zeros((n, n_time, 2))
    force = still + float(moving) * (-1.0) ** np.arange(n_time)[:, None]
    trials = {
        "subject": ["A"] * n,
        "task": ["RT"] * n,
        "condition": list(conditions or ["RT7.5"] * n),
        "repetition": list(range(n)),
        "pulse_level": [0.0] * n,
        **{name: [np.nan] * n for name in ("pulse_direction", "pulse_onset", "limit_time")},
        **{"l_h": [0.33] * n, "l_f": [0.34] * n, "theta_s_deg": [22.5] * n, "theta_e_deg": [82.3] * n},
    }
    return make_recording(
        {"perturbation": force, "force": still, "displacement": still, "emg": volts},
        trials | labels,
        RATE,
        emg_rate=EMG_RATE,
        muscles=muscles,
    )
