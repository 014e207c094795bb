"""What a laboratory might bring: a handle that moves as a known mass, spring and damper, and its files."""

import json
from functools import lru_cache

import numpy as np

from armperturb.recording import REQUIRED_SIGNALS, make_recording

RATE, N_TIME, N_TRIALS = 200.0, 1200, 2
MASS, DAMPING, STIFFNESS = 3.0, 2.0, 40.0


def handle(seed=0, rate=RATE, duration=N_TIME / RATE, late=0.0):
    """Disturbance d, reaction force f and displacement x of a trial [N, N, m], (time, axis) each, not to be changed.

    The path is a sum of sinusoids under a window, so that velocity and acceleration are known in closed form: nothing
    here is computed as the package does it. Force is recorded late [s], by a number or by one for each sample.
    """
    return _handle(seed, rate, duration, late) if np.isscalar(late) else _handle.__wrapped__(seed, rate, duration, late)


@lru_cache(maxsize=64)
def _handle(seed, rate, duration, late):
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.3, 6.0, (30, 2)), rng.uniform(0.0, 2 * np.pi, (30, 2))
    amplitude = 0.006 / (1.0 + frequency**2)

    def path(t):
        w, s = 2 * np.pi * frequency, np.sin(np.pi * t / duration)[:, None]
        ds = (np.pi / duration) * np.cos(np.pi * t / duration)[:, None]
        angle = w * t[:, None, None] + phase
        p, dp = (amplitude * np.sin(angle)).sum(axis=1), (amplitude * w * np.cos(angle)).sum(axis=1)
        ddp = -(amplitude * w**2 * np.sin(angle)).sum(axis=1)
        g, dg = s**2, 2 * s * ds
        ddg = 2 * ds**2 - 2 * (np.pi / duration) ** 2 * s**2
        return p * g, dp * g + p * dg, ddp * g + 2 * dp * dg + p * ddg

    def push(t):
        of_push = np.random.default_rng([seed, 1])
        w, shift = 2 * np.pi * of_push.uniform(0.3, 20.0, (40, 2)), of_push.uniform(0.0, 2 * np.pi, (40, 2))
        return 0.5 * np.sin(w * t[:, None, None] + shift).sum(axis=1)

    time = np.arange(round(duration * rate)) / rate
    d, x = push(time), path(time)[0]
    past = time - late
    x_past, v_past, a_past = path(past)
    f = push(past) - MASS * a_past - DAMPING * v_past - STIFFNESS * x_past
    for values in (d, f, x):
        values.flags.writeable = False
    return d, f, x


LABELS = {
    "subject": "S01",
    "task": "PT",
    "condition": "PT7.5",
    "l_h": 0.31,
    "l_f": 0.34,
    "theta_s_deg": 22.5,
    "theta_e_deg": 82.3,
}


def meaning(**changes):
    """Sidecar of `table`: SI, our axes."""
    pairs = {"perturbation": ("Dx", "Dy", "N"), "force": ("Fx", "Fy", "N"), "displacement": ("X", "Y", "m")}
    signals = {name: {"channels": {"x": x, "y": y}, "unit": unit} for name, (x, y, unit) in pairs.items()}
    signals["force"]["exerted_by"] = "handle"
    return {
        "rate": RATE,
        "trial": "trial",
        "axes": {"x": "right", "y": "forward"},
        "signals": signals,
        "labels": dict(LABELS),
        **changes,
    }


COLUMNS = ("trial", "t", "Dx", "Dy", "Fx", "Fy", "X", "Y")


def table(n_trials=N_TRIALS, **options):
    """All trials below one another, as `COLUMNS` say."""
    rows = []
    for trial in range(n_trials):
        signals = np.concatenate(handle(trial, **options), axis=1)
        time = np.arange(len(signals)) / options.get("rate", RATE)
        rows.append(np.column_stack([np.full(len(signals), trial + 1.0), time, signals]))
    return np.concatenate(rows)


def as_text(values, columns=COLUMNS, delimiter=",", decimal="."):
    line = delimiter.join(["%r"] * len(columns)) + "\n"
    text = "".join(line % tuple(row) for row in np.asarray(values).tolist())
    return delimiter.join(columns) + "\n" + text.replace(".", decimal)


@lru_cache(maxsize=1)
def _text_of_table():
    return as_text(table())


def write(folder, values=None, sidecar=None, name="lab", text=None):
    """A text file and its sidecar; returns the path of the former."""
    path = folder / f"{name}.csv"
    if text is None:
        text = _text_of_table() if values is None else as_text(values)
    path.write_text(text, encoding="utf-8")
    path.with_suffix(".json").write_text(json.dumps(meaning() if sidecar is None else sidecar))
    return path


def laboratory_recording(*trials, limit_time=np.nan):
    """A recording of trials as `handle` gives them."""
    signals = {name: np.stack(parts) for name, parts in zip(REQUIRED_SIGNALS, zip(*trials, strict=True), strict=True)}
    labels = LABELS | {"repetition": 0, "pulse_level": 0.0, "pulse_direction": np.nan, "pulse_onset": np.nan}
    labels["limit_time"] = limit_time
    return make_recording(signals, {name: [value] * len(trials) for name, value in labels.items()}, RATE)
