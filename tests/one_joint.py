"""Simulated people of one joint, from equations of their own: Newton's law and a delayed second-order reflex, by RK4.

Nothing here is shared with the package but the format of recordings.
"""

from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numba import njit
from scipy import signal

from armperturb.recording import make_recording

RATE = 1000
BANDWIDTH = 2.0**0.5
"""Of an imposed movement, over the natural frequency of a joint."""
FINE = 8
"""Instants in a sample at which the torques on a force servo are known: half steps of RK4."""


@dataclass(frozen=True, kw_only=True)
class Joint:
    inertia: float
    damping: float
    stiffness: float
    reflex_gain: float = 0.0
    reflex_delay: float = 0.04
    reflex_frequency: float = 2.0  # Hz
    reflex_damping_ratio: float = 1.0
    reflex_threshold: float = 0.0  # rad/s
    reflex: str = "half-wave"
    speed: float = 0.28  # RMS velocity that the perturbation causes, rad/s
    side: int = 1


JOINTS = {
    "ankle": Joint(inertia=0.016, damping=0.8, stiffness=60.0, reflex_gain=8.0, reflex_delay=0.042),
    "wrist": Joint(
        inertia=0.004,
        damping=0.06,
        stiffness=3.5,
        reflex_gain=0.25,
        reflex_delay=0.032,
        reflex_frequency=3.0,
        speed=0.57,
    ),
    "elbow": Joint(
        inertia=0.08, damping=1.2, stiffness=35.0, reflex_gain=3.5, reflex_delay=0.028, speed=0.47, reflex_frequency=2.5
    ),
}


def person(name, seed, reflex="half-wave"):
    rng = np.random.default_rng(seed)
    base = JOINTS[name]
    factor = {each: np.exp(0.2 * rng.normal()) for each in ("inertia", "damping", "stiffness", "reflex_gain")}
    varied = {each: getattr(base, each) * factor[each] for each in factor}
    varied["reflex_delay"] = base.reflex_delay + 0.005 * rng.normal()
    varied["reflex_frequency"] = base.reflex_frequency * np.exp(0.15 * rng.normal())
    varied["reflex_threshold"] = base.speed * rng.uniform(0.2, 0.6) if reflex == "half-wave" else 0.0
    if reflex == "none":
        varied["reflex_gain"] = 0.0
    if reflex == "linear":
        varied["reflex_gain"] *= 0.5
    return replace(base, reflex=reflex, side=int(rng.choice([-1, 1])), **varied)


def impedance(joint, frequency):
    """Of a joint with a linear reflex, from angle to torque, (frequency,)."""
    s, wn = 2j * np.pi * frequency, 2 * np.pi * joint.reflex_frequency
    path = wn**2 / (s**2 + 2 * joint.reflex_damping_ratio * wn * s + wn**2) * np.exp(-s * joint.reflex_delay)
    return joint.inertia * s**2 + joint.damping * s + joint.stiffness + joint.reflex_gain * s * path


def coloured(rng, n, low, high, white=0.02):
    sections = signal.butter(1, [low, high], "bandpass", fs=RATE, output="sos")
    noise = signal.sosfilt(sections, rng.normal(size=n + 5 * RATE))[5 * RATE :]
    return noise / noise.std() + white * rng.normal(size=n)


def natural_frequency(joint):
    """Of the intrinsic path without damping [Hz]."""
    return float(np.sqrt(joint.stiffness / joint.inertia) / (2 * np.pi))


def smooth_random(rng, n, corner, order):
    """Random movement of RMS velocity one with its exact derivatives at double rate, for RK4's half steps.

    It is Gaussian, below 55 Hz, with the power of a Butterworth low-pass.
    """
    m = 2 * n
    frequency = np.fft.rfftfreq(m, 0.5 / RATE)
    amplitude = 1.0 / np.sqrt(1 + (frequency / corner) ** (2 * order)) * (frequency > 0.05) * (frequency < 55)
    spectrum = amplitude * (rng.normal(size=len(frequency)) + 1j * rng.normal(size=len(frequency)))
    s = 2j * np.pi * frequency
    x, v, a = (np.fft.irfft(spectrum * s**k, m) for k in (0, 1, 2))
    return x / v.std(), v / v.std(), a / v.std()


@njit(cache=True)
def _drive(v, threshold, side, halfwave):
    return side * max(side * v - threshold, 0.0) if halfwave else v


@njit(cache=True)
def _reflex_torque(drive, delay, gain, wn, ratio, dt):
    """Second-order response to a delayed drive that is known at half steps, by RK4."""
    n = len(drive) // 2
    out = np.zeros(n)
    y, w = 0.0, 0.0
    shift = 2.0 * delay / dt

    for k in range(n):
        out[k] = gain * y
        u = np.zeros(3)
        for j in range(3):
            place = 2.0 * k + j - shift
            if place >= 0:
                low = int(place)
                part = place - low
                u[j] = drive[low] * (1 - part) + drive[min(low + 1, len(drive) - 1)] * part
        k1y, k1w = w, wn * wn * (u[0] - y) - 2 * ratio * wn * w
        k2y, k2w = w + 0.5 * dt * k1w, wn * wn * (u[1] - y - 0.5 * dt * k1y) - 2 * ratio * wn * (w + 0.5 * dt * k1w)
        k3y, k3w = w + 0.5 * dt * k2w, wn * wn * (u[1] - y - 0.5 * dt * k2y) - 2 * ratio * wn * (w + 0.5 * dt * k2w)
        k4y, k4w = w + dt * k3w, wn * wn * (u[2] - y - dt * k3y) - 2 * ratio * wn * (w + dt * k3w)
        y += dt / 6 * (k1y + 2 * k2y + 2 * k3y + k4y)
        w += dt / 6 * (k1w + 2 * k2w + 2 * k3w + k4w)
    return out


@njit(cache=True)
def _slopes(state, push, drive, env, joint):
    """Derivatives of angle, velocity, reflex torque over its gain, and its rate."""
    inertia, damping, stiffness, gain, _, wn, ratio, _ = joint
    m, b, k = env
    x, v, y, w = state
    a = (push - (b + damping) * v - (k + stiffness) * x - gain * y) / (m + inertia)
    return v, a, w, wn * wn * (drive - y) - 2 * ratio * wn * w


@njit(cache=True)
def _moved(state, time, slopes):
    (x, v, y, w), (dx, dv, dy, dw) = state, slopes
    return x + time * dx, v + time * dv, y + time * dy, w + time * dw


@njit(cache=True)
def _mean(k1, k2, k3, k4):
    """Six times the mean slope of RK4."""
    (x1, v1, y1, w1), (x2, v2, y2, w2), (x3, v3, y3, w3), (x4, v4, y4, w4) = k1, k2, k3, k4
    return (
        x1 + 2 * x2 + 2 * x3 + x4,
        v1 + 2 * v2 + 2 * v3 + v4,
        y1 + 2 * y2 + 2 * y3 + y4,
        w1 + 2 * w2 + 2 * w3 + w4,
    )


@njit(cache=True)
def _closed_loop(load, noise, env, joint, dt, halfwave, side):
    """Angle and torque of joint and device under a load, by RK4; signals are known at `FINE` instants in a sample."""
    inertia, damping, stiffness, gain, delay, _, _, threshold = joint
    n, substeps = len(load) // FINE, FINE // 2
    state = (0.0, 0.0, 0.0, 0.0)
    h = dt / substeps
    lag = delay / h
    whole = int(lag)
    part = lag - whole
    memory = np.zeros(whole + 3)
    size, at = len(memory), 0
    angle, torque = np.zeros(n), np.zeros(n)
    for i in range(n):
        for j in range(substeps):
            memory[at] = _drive(state[1], threshold, side, halfwave)
            start = memory[(at - whole) % size] * (1 - part) + memory[(at - whole - 1) % size] * part
            end = memory[(at - whole + 1) % size] * (1 - part) + memory[(at - whole) % size] * part
            at = (at + 1) % size
            at_half = i * FINE + 2 * j
            last = (at_half + 2) % len(load)
            here, half = load[at_half] - noise[at_half], load[at_half + 1] - noise[at_half + 1]
            there = load[last] - noise[last]
            k1 = _slopes(state, here, start, env, joint)
            if j == 0:
                angle[i] = state[0]
                torque[i] = (
                    inertia * k1[1] + damping * state[1] + stiffness * state[0] + gain * state[2] + noise[at_half]
                )
            k2 = _slopes(_moved(state, 0.5 * h, k1), half, 0.5 * (start + end), env, joint)
            k3 = _slopes(_moved(state, 0.5 * h, k2), half, 0.5 * (start + end), env, joint)
            k4 = _slopes(_moved(state, h, k3), there, end, env, joint)
            state = _moved(state, h / 6, _mean(k1, k2, k3, k4))
    return angle, torque


def recording(joint, seed, servo="position", *, duration=60.0, decibel=15.0, name="ankle", bandwidth=BANDWIDTH):
    """A trial. A position servo moves the joint up to `bandwidth` times the natural frequency of joints of its name.

    Up to the root of two of that no movement needs more torque than the stiffness alone takes of a slow one, and noise
    is in proportion to the torque.
    """
    rng = np.random.default_rng([seed, 7])
    n = round(duration * RATE)
    lead = 5 * RATE
    labels = {"subject": ["S"], "task": ["PT"], "condition": ["PT"], "repetition": [0], "pulse_level": [0.0]}
    empty = ("pulse_direction", "pulse_onset", "l_h", "l_f", "theta_s_deg", "theta_e_deg", "limit_time")
    labels |= {each: [np.nan] for each in empty}
    wn, halfwave = 2 * np.pi * joint.reflex_frequency, joint.reflex == "half-wave"
    noise = coloured(rng, n + lead, 0.2, 3.0)
    if servo == "position":
        corner = bandwidth * natural_frequency(JOINTS[name])
        x, v, a = (joint.speed * each for each in smooth_random(rng, n + lead, corner, 4))
        drive = joint.side * np.maximum(joint.side * v - joint.reflex_threshold, 0.0) if halfwave else v
        reflex = _reflex_torque(
            drive, joint.reflex_delay, joint.reflex_gain, wn, joint.reflex_damping_ratio, 1.0 / RATE
        )
        torque = joint.inertia * a[::2] + joint.damping * v[::2] + joint.stiffness * x[::2] + reflex
        torque = (torque + torque.std() * 10 ** (-decibel / 20) / noise.std() * noise)[lead:]
        signals = {"displacement": x[::2][lead:], "force": torque + 3.0}
    else:
        env = (0.25 * joint.inertia, 0.3 * joint.damping, 0.1 * joint.stiffness)
        load = smooth_random(rng, n + lead, 15.0, 2)[0][::2]
        parameters = (
            joint.inertia, joint.damping, joint.stiffness, joint.reflex_gain, joint.reflex_delay, wn,
            joint.reflex_damping_ratio, joint.reflex_threshold,
        )  # fmt: skip

        def run(load, noise):
            return _closed_loop(load, noise, env, parameters, 1.0 / RATE, halfwave, joint.side)

        def speed_of(angle):
            return np.std(np.gradient(angle, 1.0 / RATE))

        # With what is linear between samples, the torque would hold an acceleration that the sampled angle lacks: 0.8 %
        # of it at 50 Hz, and inertia would come out too large by 0.2 %.
        load, noise = (signal.resample(each, FINE * len(each)) for each in (load, noise))
        load *= joint.speed / speed_of(run(load, 0 * load)[0])
        for _ in range(2):  # a threshold makes the size matter
            load *= joint.speed / speed_of(run(load, 0 * load)[0])
        clean, alone = run(load, 0 * load)[0], run(0 * load, noise)[0]
        noise *= clean.std() / alone.std() * 10 ** (-decibel / 20)
        angle, torque = run(load, noise)
        signals = {"perturbation": load[lead * FINE :: FINE], "displacement": angle[lead:], "force": torque[lead:]}
    arrays = {each: values[None, :, None] for each, values in signals.items()}
    return make_recording(arrays, labels, RATE, servo=servo, joint=name, angular=True)


def trials(joint, seed, spread, *, servo="position", n_trials=5, duration=6.0):
    """Trials in which damping, stiffness and reflex gain differ by a factor each of mean one."""
    rng, parts = np.random.default_rng([seed, 1]), []
    for number in range(n_trials):
        factors = 1.0 + spread * rng.normal(size=3)
        names = ("damping", "stiffness", "reflex_gain")
        changed = {name: factor * getattr(joint, name) for name, factor in zip(names, factors, strict=True)}
        parts.append(recording(replace(joint, **changed), 100 * seed + number, servo, duration=duration))
    return xr.concat(parts, "trial", data_vars="minimal").assign_coords(repetition=("trial", np.arange(n_trials)))
