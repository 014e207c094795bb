"""Does the estimator of my laboratory find the truth, and does it know how well?

Run `python examples/validate_my_pipeline.py [--out FOLDER] [--fast]`. Put your own function in the place of
`my_estimator`: it gets a recording, as it would of a person, and returns values with standard errors. Synthetic
people whose truth is known judge it, next to the package's estimator: bias, error, and how often the 95 % intervals
hold the truth.

The function that is here is a textbook's: low-pass, differentiate, and regress joint torque on acceleration, velocity
and angle. It treats the arm as the only cause of the movement. But a person's own noise moves the handle too and
returns as force through the closed loop, so that more data make this estimator more certain of a wrong value.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from scipy import signal

import armperturb as ap

NAMES = ("b_s", "b_se", "b_e", "k_s", "k_se", "k_e")
"""Damping [Nms/rad] and stiffness [Nm/rad] of the joints: shoulder, between both, elbow."""


TRIALS = 4
"""Trials that are identified together."""


def simulate(group: int, noise: ap.HumanNoise | None = ap.HUMAN_NOISE["RT"]) -> xr.Dataset:
    """Trials of the mean relaxed arm, linear and equal in all of them, with noise of person and instruments."""
    steady = None if noise is None else replace(noise, spread_b=0.0, spread_k=0.0, spread_kv=0.0, spread_kp=0.0)
    seeds = range(TRIALS * group, TRIALS * (group + 1))
    trials = [
        ap.Trial(subject=ap.RELAX, perturbation=ap.Multisine.draw(seed=seed, rms=0.9), seed=seed, noise=steady)
        for seed in seeds
    ]
    return ap.run_experiment(trials, linear=True, instruments=ap.Instruments(marker_noise=None, emg=None))


def my_estimator(recording: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Values of `NAMES` and their standard errors, (6,) each."""
    rate = float(recording.attrs["rate"])
    l_h, l_f = float(recording["l_h"][0]), float(recording["l_f"][0])
    shoulder, elbow = (np.radians(float(recording[name][0])) for name in ("theta_s_deg", "theta_e_deg"))
    hand = np.array([-np.sin(shoulder + elbow), np.cos(shoulder + elbow)]) * l_f  # moved by the elbow
    jacobian = np.column_stack([np.array([-np.sin(shoulder), np.cos(shoulder)]) * l_h + hand, hand])

    lowpass = signal.butter(2, 8.0, fs=rate, output="sos")
    moved, force = (signal.sosfiltfilt(lowpass, recording[name].values, axis=1) for name in ("displacement", "force"))
    angle = moved @ np.linalg.inv(jacobian).T
    velocity = np.gradient(angle, 1.0 / rate, axis=1)
    acceleration = np.gradient(velocity, 1.0 / rate, axis=1)
    torque = force @ jacobian

    def columns(motion: np.ndarray) -> np.ndarray:
        """Of the three entries of a symmetric matrix times motion, (sample and joint, entry)."""
        s, e = motion.reshape(-1, 2).T
        zero = np.zeros_like(s)
        return np.stack([np.column_stack([s, e, zero]), np.column_stack([zero, s, e])], axis=1).reshape(-1, 3)

    regressors = np.concatenate([columns(motion) for motion in (acceleration, velocity, angle)], axis=1)
    target = torque.reshape(-1)
    values, *_ = np.linalg.lstsq(regressors, target, rcond=None)
    left = np.var(target - regressors @ values)
    # What was low-passed at 8 Hz has 16 independent samples per second, whatever the rate.
    independent = len(target) * 16.0 / rate
    covariance = left * len(target) / independent * np.linalg.inv(regressors.T @ regressors)
    return values[3:], np.sqrt(np.diag(covariance))[3:]


def of_the_package(recording: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    fit = ap.identify(recording, model="1").fit
    return np.array([fit.values[name] for name in NAMES]), np.array([fit.standard_error[name] for name in NAMES])


def main(folder: Path, groups: int) -> None:
    truth = np.array([getattr(ap.RELAX, name) for name in NAMES])
    estimators = {"mine": my_estimator, "package": of_the_package}
    estimates: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {name: [] for name in estimators}
    for number in range(groups):
        recording = simulate(number)
        for name, estimator in estimators.items():
            estimates[name].append(estimator(recording))

    print(f"{groups} groups of {TRIALS} trials, with all noise\n")
    print(f"{'':10}{'':6}{'truth':>9}{'bias':>9}{'RMS error':>11}{'reported':>9}{'coverage':>10}")
    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    axes = figure.subplots()
    for place, (name, results) in enumerate(estimates.items()):
        values, errors = (np.array(part) for part in zip(*results, strict=True))
        off = values - truth
        for i, parameter in enumerate(NAMES):
            share = 100.0 / truth[i]
            covered = np.mean(np.abs(off[:, i]) <= 1.96 * errors[:, i])
            rms = np.sqrt(np.mean(off[:, i] ** 2))
            print(
                f"{name:10}{parameter:6}{truth[i]:9.2f}{share * off[:, i].mean():7.1f} %{share * rms:9.1f} %"
                f"{share * errors[:, i].mean():7.1f} %{covered:9.0%}"
            )
            at = i + 0.4 * place - 0.2 + np.linspace(-0.15, 0.15, groups)
            bar = share * 1.96 * errors[:, i]
            label = name if i == 0 else None
            axes.errorbar(at, share * off[:, i], bar, fmt=".", color=f"C{place}", lw=0.8, label=label)
    print("\nbias, RMS error, and the standard error that the estimator reports, in percent of the true value")
    axes.axhline(0.0, color="k", lw=0.8)
    axes.set_xticks(range(len(NAMES)), NAMES)
    axes.set(ylabel="error, with its own 95 % interval [% of the truth]")
    axes.legend(frameon=False)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "validate_my_pipeline.png", dpi=110)
    print(f"wrote {folder / 'validate_my_pipeline.png'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("example"), metavar="FOLDER")
    parser.add_argument("--fast", action="store_true", help="4 groups instead of 20")
    given = parser.parse_args()
    main(given.out, 4 if given.fast else 20)
