"""Random foreign arms (see `foreign_arms`), perturbed and recorded: arrays, a recording, or a laboratory's files."""

import json
from dataclasses import dataclass, replace

import numpy as np
from foreign_arms import Arm, paths, simulate
from scipy import fft

from armperturb.recording import REQUIRED_SIGNALS, make_recording

KINDS = ("multisine", "noise", "filtered noise", "chirp", "pulses")
LOADS = ((1.6, 12.0, 60.0), (3.3, 20.0, 200.0), (0.9, 25.0, 30.0), (0.9, 25.0, 0.0))
"""Mass, damping and stiffness of manipulators [kg, Ns/m, N/m]."""

FORCE_NOISE, DISPLACEMENT_NOISE = 0.02, 5e-6
"""SD of the white noise of the instruments [N, m]."""

FADE, BEFORE_REST, BEFORE_AMID = 0.1, 3.0, 8.0
"""Fade-in of a disturbance, and time that is simulated but not recorded [s]."""


@dataclass(frozen=True, kw_only=True)
class Setup:
    """An arm, what it holds, how it is perturbed and recorded; `record` makes the trials."""

    arm: Arm
    load: tuple = LOADS[0]
    kind: str = "multisine"
    period: float = 10.0
    lines: str = "full"  # or "odd", or "clusters" of four
    corner: float = 3.0  # [Hz]; amplitudes above it have this share
    share: float = 0.5
    top: float = 20.0
    n_trials: int = 4
    duration: float = 30.0
    rate: float = 200.0
    amid: bool = False  # the perturbation has lasted for some time when the recording starts
    rms: float = 0.015  # displacement [m]
    remnant: float = 0.08  # displacement by the person's own noise, share of the RMS
    remnant_cutoff: float = 2.5
    spread: float = 0.0  # SD of the logarithm of stiffness, damping and gains, each, over trials
    linear: bool = False
    seed: int = 0

    @property
    def truth(self):
        """What an analysis should find, on average over trials; inertia is the whole mass matrix."""
        arm, joints = self.arm, ("s", "se", "e")
        inertia = arm.mass_matrix()[[0, 0, 1], [0, 1, 1]]
        triples = {"k": arm.k, "b": arm.b, "kv": arm.kv, "kp": arm.kp, "inertia": inertia}
        values = {
            f"{name}_{joint}": float(v) for name, t in triples.items() for joint, v in zip(joints, t, strict=True)
        }
        for name, pair in (("Td", arm.delay), ("fact", arm.cutoff)):
            values |= {f"{name}_{joint}": value for joint, value in zip(("s", "e"), pair, strict=True)}
        grip = "rigid" if arm.grip is None else "spring"
        return values | {"zeta_act": arm.zeta, "reflex": arm.reflex, "grip": grip}

    def record(self, engine=simulate, finest=1e-3):
        """d, F and x as recorded, (trial, time, axis) each; engine integrates the equations of motion."""
        rng = np.random.default_rng(self.seed)
        every = int(np.ceil(1.0 / (self.rate * finest)))
        step, before = 1.0 / (self.rate * every), BEFORE_AMID if self.amid else BEFORE_REST
        first, n = (round(time * self.rate) for time in (before, before + self.duration))
        from_d, from_torque = paths(self.arm, self.load, np.fft.rfftfreq(n, 1.0 / self.rate))
        properties = ("k", "b", "kv", "kp")
        signals = []
        for _ in range(self.n_trials):
            factors = np.exp(self.spread * rng.standard_normal(4))
            changed = {
                name: np.multiply(getattr(self.arm, name), c) for name, c in zip(properties, factors, strict=True)
            }
            d = self._disturbance(rng, 2 * every * n + 1, 0.5 * step, before)
            torque = _coloured(rng, len(d), 0.5 * step, lambda f: 1.0 / np.hypot(1.0, (f / self.remnant_cutoff) ** 2))
            d *= self.rms / _rms_of(from_d, d[: -1 : 2 * every])
            torque *= self.remnant * self.rms / _rms_of(from_torque, torque[: -1 : 2 * every])
            f, x = engine(replace(self.arm, **changed), self.load, d, torque, step, every, self.linear)
            signals.append([part[first:n] for part in (d[:: 2 * every], f, x)])
        d, f, x = (np.array(part) for part in zip(*signals, strict=True))
        return d, f + FORCE_NOISE * rng.standard_normal(f.shape), x + DISPLACEMENT_NOISE * rng.standard_normal(x.shape)

    def _disturbance(self, rng, n, step, before):
        """Of arbitrary size, (n, axis)."""
        time = np.arange(n) * step - before
        fade = np.clip((time + (before if self.amid else 0.0)) / FADE, 0.0, 1.0)[:, None]
        if self.kind == "multisine":
            d = np.resize(self._period(rng, step), (n, 2))
        elif self.kind == "chirp":  # up and down again, along a direction of its own in each trial
            sweep = self.duration + (before if self.amid else 0.0)
            angle = rng.uniform(0.0, np.pi)
            cycles = 0.2 * sweep / np.log(self.top / 0.2) * ((self.top / 0.2) ** (np.maximum(time, 0.0) / sweep) - 1.0)
            d = np.sin(2 * np.pi * cycles)[:, None] * [np.cos(angle), np.sin(angle)]
        elif self.kind == "pulses":
            d = np.zeros((n, 2))
            for onset in np.arange(time[0] if self.amid else 1.0, self.duration - 2.0, 3.0):
                angle, width = rng.uniform(0.0, 2 * np.pi), rng.uniform(0.04, 0.2)
                inside = np.clip((time - onset) / width, 0.0, 1.0)
                d += np.sin(np.pi * inside)[:, None] ** 2 * [np.cos(angle), np.sin(angle)]
        else:
            order = 4 if self.kind == "filtered noise" else 0
            d = _coloured(rng, n, step, lambda f: (f <= self.top) / np.sqrt(1.0 + (f / self.corner) ** order))
        return d * fade

    def recording(self, engine=simulate):
        """As the package reads it."""
        return recording_of(self, *self.record(engine))

    def _period(self, rng, step):
        n = round(self.period / step)
        frequency = np.fft.rfftfreq(n, step)
        line = np.arange(len(frequency))
        used = (frequency > 0.0) & (frequency <= self.top)
        if self.lines == "odd":
            used &= line % 2 == 1
        elif self.lines == "clusters":
            starts = np.unique(np.geomspace(1, self.top * self.period, 24).astype(int) // 4 * 4)
            used &= np.isin(line // 4 * 4, starts)
        amplitude = used * np.where(frequency <= self.corner, 1.0, self.share)
        return np.fft.irfft(amplitude[:, None] * np.exp(2j * np.pi * rng.random((len(line), 2))), n, axis=0)


def recording_of(setup, d, f, x):
    """Trials in the package's container."""
    n = len(d)
    trials = {name: np.full(n, value) for name, value in _labels(setup).items()}
    trials |= {"repetition": np.arange(n), "pulse_level": np.zeros(n)}
    trials |= {name: np.full(n, np.nan) for name in ("pulse_direction", "pulse_onset", "limit_time")}
    return make_recording(dict(zip(REQUIRED_SIGNALS, (d, f, x), strict=True)), trials, setup.rate)


def write_csv(setup, d, f, x, folder):
    """One table of all trials and its sidecar, in a laboratory's own units; the path of the table."""
    time = np.tile(np.arange(d.shape[1]) / setup.rate, len(d))
    columns = [np.repeat(np.arange(1.0, len(d) + 1), d.shape[1]), time, *(v.reshape(-1, 2) for v in (d, f, 1e3 * x))]
    path = folder / "foreign.csv"
    header = "trial,t,Dx,Dy,Fx,Fy,X_mm,Y_mm"
    np.savetxt(path, np.column_stack(columns), fmt="%.9g", delimiter=",", header=header, comments="")
    signals = (("perturbation", "Dx", "Dy", "N"), ("force", "Fx", "Fy", "N"), ("displacement", "X_mm", "Y_mm", "mm"))
    sidecar = {
        "rate": setup.rate,
        "trial": "trial",
        "axes": {"x": "right", "y": "forward"},
        "signals": {name: {"channels": {"x": a, "y": b}, "unit": unit} for name, a, b, unit in signals},
        "labels": _labels(setup),
    }
    sidecar["signals"]["force"]["exerted_by"] = "handle"
    path.with_suffix(".json").write_text(json.dumps(sidecar, indent=1), encoding="utf-8")
    return path


def _labels(setup):
    arm = setup.arm
    angles = dict(zip(("theta_s_deg", "theta_e_deg"), arm.posture_deg, strict=True))
    lengths = dict(zip(("l_h", "l_f"), arm.length, strict=True))
    task = "RT" if arm.reflex == "none" else "PT"
    return {"subject": f"F{setup.seed}", "task": task, "condition": setup.kind, **lengths, **angles}


def draw_arm(rng, reflex=None, grip=None):
    """A random arm that soon comes to rest: reflex "none", "velocity" or "position", grip "rigid" or "spring"."""
    reflex = reflex or rng.choice(["none", "velocity", "position"])
    grip = grip or rng.choice(["rigid", "spring"])
    while True:
        k_s = 20.0 * 8.0 ** rng.random()
        k = k_s, 0.0, k_s * rng.uniform(0.6, 1.1)
        k = k_s, rng.uniform(0.15, 0.4) * np.sqrt(k[0] * k[2]), k[2]
        b = (np.array([0.5, 0.1, 0.4]) + rng.uniform(0.02, 0.04) * np.array(k)) * rng.uniform(0.8, 1.25, 3)
        gains = np.array(k) * rng.uniform(0.8, 1.25, (2, 3))
        kv, kp = gains * [[rng.uniform(0.05, 0.15)], [rng.uniform(0.2, 0.6)]]
        arm = Arm(
            mass=(rng.uniform(1.5, 2.6), rng.uniform(1.1, 2.0)),
            length=(rng.uniform(0.28, 0.35), rng.uniform(0.29, 0.37)),
            centre=(rng.uniform(0.41, 0.50), rng.uniform(0.43, 0.65)),
            gyration=(rng.uniform(0.26, 0.33), rng.uniform(0.25, 0.33)),
            posture_deg=(rng.uniform(10.0, 60.0), rng.uniform(60.0, 110.0)),
            k=k,
            b=tuple(b),
            kv=tuple(kv) if reflex != "none" else (0.0,) * 3,
            kp=tuple(kp) if reflex == "position" else (0.0,) * 3,
            delay=tuple(rng.uniform(0.025, 0.05, 2)),
            cutoff=tuple(rng.uniform(2.0, 4.0, 2)),
            zeta=rng.uniform(0.6, 1.0),
            grip=None if grip == "rigid" else (rng.uniform(1e4, 3e4), rng.uniform(30.0, 120.0)),
        )
        if all(_settles(arm, load) for load in LOADS):
            return arm


def _settles(arm, load, step=5e-4):
    """Whether little is left of a push after two seconds."""
    d = np.zeros((round(8.0 / step) + 1, 2))
    d[: round(0.4 / step)] = 1.0
    x = simulate(arm, load, d, np.zeros_like(d), step, 20, True)[1]
    return np.abs(x[-100:]).max() < 0.01 * np.abs(x).max() and np.abs(x[len(x) // 2 :]).max() < 0.1 * np.abs(x).max()


def draw_foreign(rng, kinds=("multisine", "noise", "filtered noise"), **given):
    """A random arm, load, excitation and recording; `given` are fields of `Setup`, `reflex` or `grip`."""
    rng = np.random.default_rng(rng)
    arm = given.pop("arm", None) or draw_arm(rng, given.pop("reflex", None), given.pop("grip", None))
    rate = float(given.pop("rate", rng.choice([200.0, 250.0, 400.0, 500.0])))
    drawn = Setup(
        arm=arm,
        load=LOADS[rng.integers(len(LOADS))],
        kind=str(rng.choice(kinds)),
        period=round(rng.uniform(5.0, 25.0) * 50.0) / 50.0,
        lines=str(rng.choice(["full", "odd", "clusters"])),
        corner=rng.uniform(1.0, 4.0),
        share=rng.uniform(0.3, 0.8),
        top=rng.uniform(15.0, 25.0),
        n_trials=int(rng.integers(4, 9)),
        duration=float(rng.integers(20, 61)),
        rate=rate,
        amid=bool(rng.integers(2)),
        rms=rng.uniform(0.01, 0.02),
        remnant=rng.uniform(0.03, 0.15),
        remnant_cutoff=rng.uniform(1.5, 4.0),
        seed=int(rng.integers(2**31)),
    )
    if "duration" not in given:
        given["duration"] = max(drawn.duration, float(np.ceil(2.0 * given.get("period", drawn.period))))
    return replace(drawn, **given)


def _coloured(rng, n, step, shape):
    """Gaussian noise with this amplitude spectrum, below 60 Hz, (n, 2)."""
    whole = fft.next_fast_len(n, real=True)
    frequency = np.fft.rfftfreq(whole, step)
    frequency = frequency[frequency < 60.0]
    spectrum = shape(frequency)[:, None] * (rng.standard_normal((len(frequency), 2, 2)) @ [1.0, 1.0j])
    spectrum[0] = 0.0
    return fft.irfft(spectrum, whole, axis=0)[:n]


def _rms_of(path, values):
    """RMS over both axes of what a frequency response makes of values."""
    spectrum = np.einsum("fij,fj->fi", path, np.fft.rfft(values, axis=0))
    return np.sqrt(np.mean(np.fft.irfft(spectrum, len(values), axis=0) ** 2))
