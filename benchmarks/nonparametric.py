"""Estimates without an arm model beside each other, and beside the parametric one, where the truth is known.

Run by `python -m benchmarks.nonparametric [NAME ...]`; some 3 min of one core for all cases, less for those whose names
begin with one of `NAME` ("PT"). For each case and method: the RMS over frequencies
to 20 Hz of |estimate - truth| / |truth| (norms of the matrices; mean and largest of the seeds), the order that was
chosen (median), the largest pole of any seed, how large the error is beside its own standard deviation (1 if the
covariance is right), and processor time from the recording on. Frequencies are those at which the spectral estimates
stand. "direct" is what the models from d avoid: an ARX model straight from f to x, of as many lags as "arx" may choose.
A second table has the error of ARX models by the order that is chosen for the response, by that of the least Bayesian
information criterion, and by that which would have been best.
"""

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from scipy import fft

from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.fit.identify import identify
from armperturb.analysis.response.arx import HIGHEST_ORDER, Regression, fit_arx
from armperturb.analysis.response.estimate import response
from armperturb.analysis.response.joint_records import admittance_of, joint_records
from armperturb.analysis.response.spectra import estimate_spectra, line_spectra
from armperturb.analysis.response.subspace import fit_subspace
from armperturb.analysis.trials import TrialRecord
from armperturb.environment import Environment
from armperturb.perturbations import Multisine
from armperturb.recording import TRIAL_COORDINATES, make_recording
from armperturb.study.validation.validate import ValidateSettings, simulate_group

SEEDS = 5
TOP = 20.0
"""Highest frequency that is judged [Hz]."""

MASS = np.array([[1.6, 0.3], [0.3, 1.1]])
DAMPING = np.array([[25.0, -4.0], [-4.0, 15.0]])
STIFFNESS = np.array([[450.0, 80.0], [80.0, 250.0]])


@dataclass(frozen=True, kw_only=True)
class Case:
    """Recordings of which the truth is known: seed to recording, frequency to admittance, and the model that fits."""

    name: str
    record: Callable[[int], xr.Dataset]
    truth: Callable[[Any], Any]
    model: str | None = None


def load_admittance(frequency):
    s = 2j * np.pi * np.asarray(frequency)[:, None, None]
    return np.linalg.inv(MASS * s**2 + DAMPING * s + STIFFNESS)


def load_recording(seed: int, *, noise: float, n_trials: int = 2, rate: float = 200.0) -> xr.Dataset:
    """A mass-spring-damper in the place of the arm, whose own force noise is low-passed at 2 Hz.

    Args:
      seed: of everything random.
      noise: RMS of that force [N]; if there is any, gauge and encoders are noisy, too.
      n_trials: of 32 s.
      rate: of the recording [Hz]; the system is simulated at five times that.
    """
    rng = np.random.default_rng(seed)
    n, step = round(32.0 * rate), 1.0 / (5 * rate)
    n_padded = fft.next_fast_len(10 * n)
    frequency = np.maximum(fft.rfftfreq(n_padded, step), 1e-6)
    s = 2j * np.pi * frequency[:, None, None]
    environment = Environment()
    held = (environment.m_env * s**2 + environment.b_env * s + environment.k_env) * np.eye(2)
    loop = np.linalg.inv(MASS * s**2 + DAMPING * s + STIFFNESS + held)
    signals = []
    for _ in range(n_trials):
        d = Multisine.draw(seed=rng, rms=5.4, crested=False).sample(5 * rate, 5 * n)
        own = fft.rfft(rng.normal(size=(n_padded, 2)), axis=0) / (1.0 + frequency[:, None] / 2.0j)
        own *= noise / np.sqrt(np.pi * 2.0 * step)
        drive = fft.rfft(d, n_padded, axis=0)
        x = np.einsum("fij,fj->fi", loop, drive + own)
        f = drive - np.einsum("fij,fj->fi", held, x)
        f, x = (fft.irfft(values, n_padded, axis=0)[: 5 * n : 5] for values in (f, x))
        if noise:
            f, x = f + 0.02 * rng.normal(size=f.shape), x + 1e-5 * rng.normal(size=x.shape)
        signals.append((d[::5], f, x))
    labels: dict[str, Any] = dict.fromkeys(TRIAL_COORDINATES, 0.0)
    labels |= {"subject": "load", "task": "PT", "condition": "load", "pulse_onset": np.nan, "limit_time": np.nan}
    return make_recording(
        dict(zip(("perturbation", "force", "displacement"), map(np.array, zip(*signals, strict=True)), strict=True)),
        {name: np.full(n_trials, value) for name, value in labels.items()},
        rate,
    )


def arm_case(name: str, **settings: Any) -> Case:
    asked = ValidateSettings(**settings)
    arm = asked.truth()
    return Case(
        name=name,
        record=lambda seed: simulate_group(asked, seed),
        truth=lambda frequency: arm_admittance(arm, frequency),
        model=asked.model,
    )


def ending_early(recording: xr.Dataset) -> xr.Dataset:
    """The same trials with pulses after 12 to 32 s, none of which is used beyond that."""
    onsets = np.linspace(12.0, 32.0, recording.sizes["trial"])
    return recording.assign_coords(pulse_onset=("trial", onsets, recording["pulse_onset"].attrs))


def unequal(case: Case) -> Case:
    return Case(
        name=f"{case.name} of 12 to 32 s",
        record=lambda seed: ending_early(case.record(seed)),
        truth=case.truth,
        model=None,
    )


CASES = (
    Case(name="load", record=lambda seed: load_recording(seed, noise=0.0), truth=load_admittance),
    Case(name="load, noise of 2 N", record=lambda seed: load_recording(seed, noise=2.0), truth=load_admittance),
    arm_case("PT, 2 trials, instruments", trials=2, noise=0.0),
    arm_case("PT, 2 trials", trials=2),
    arm_case("PT, 8 trials", trials=8),
    unequal(arm_case("PT, 8 trials", trials=8)),
    arm_case("RT, 2 trials, instruments", task="RT", model="1", trials=2, noise=0.0),
    arm_case("RT, 2 trials", task="RT", model="1", trials=2),
    arm_case("RT, 8 trials", task="RT", model="1", trials=8),
)


def direct(recording: xr.Dataset, frequency: Any) -> Any:
    records = joint_records(recording)
    straight = [TrialRecord(record.response[:, :2], record.response[:, 2:], record.rate) for record in records]
    return Regression(straight, HIGHEST_ORDER).model(HIGHEST_ORDER).response(frequency)[0]


def run(case: Case, method: str, recording: xr.Dataset, frequency: Any) -> dict[str, float]:
    """Error, order, largest pole, error over standard deviation and processor time [s]."""
    truth = case.truth(frequency)
    start = time.process_time()
    order = pole = ratio = np.nan
    if method == "parametric":
        values = arm_admittance(identify(recording, case.model).fit.arm, frequency)
    elif method == "direct":
        values = direct(recording, frequency)
    else:
        result = response(recording, method, frequency)
        values = result.response
        if result.covariance is not None:
            ratio = float(np.mean(np.abs(values - truth) ** 2 / result.covariance))
    took = time.process_time() - start
    if method in ("arx", "subspace"):
        fit: Any = {"arx": fit_arx, "subspace": fit_subspace}[method]
        model = fit(joint_records(recording), frequency)
        order, pole = model.order, model.largest_pole
    error = np.linalg.norm(values - truth, axis=(1, 2)) / np.linalg.norm(truth, axis=(1, 2))
    return {"error": float(np.sqrt(np.mean(error**2))), "order": order, "pole": pole, "ratio": ratio, "took": took}


def orders(recording: xr.Dataset, truth: Any, frequency: Any) -> dict[str, tuple[float, float]]:
    """Way of choosing an order to order and error."""
    records = joint_records(recording)
    regression = Regression(records, HIGHEST_ORDER)
    models = [regression.model(order) for order in range(1, HIGHEST_ORDER + 1)]
    error = []
    criterion = []
    for model in models:
        values = admittance_of("arm", model.response(frequency)[0])
        off = np.linalg.norm(values - truth, axis=(1, 2)) / np.linalg.norm(truth, axis=(1, 2))
        error.append(np.sqrt(np.mean(off**2)))
        n, width = regression.n_rows, regression.width(model.order)
        likely = n * np.linalg.slogdet(model.noise)[1]
        criterion.append(likely + regression.n_outputs * width * np.log(n))
    chosen = {
        "chosen": fit_arx(records, frequency).order,
        "BIC": 1 + int(np.argmin(criterion)),
        "best": 1 + int(np.argmin(error)),
    }
    return {way: (order, error[order - 1]) for way, order in chosen.items()}


def main(names: Sequence[str] = ()) -> None:
    cases = [case for case in CASES if case.name.startswith(tuple(names) or "")]
    compare_methods(cases)
    print(f"\n{'case':28}" + "".join(f"{way:>20}" for way in ("chosen", "BIC", "best")) + "   error [%] (order)")
    for case in cases:
        if case.model is None:
            continue
        result = []
        for seed in range(SEEDS):
            recording = case.record(seed)
            frequency = estimate_spectra(line_spectra(recording)).frequency
            frequency = frequency[frequency <= TOP]
            result.append(orders(recording, case.truth(frequency), frequency))
        cells = [np.array([entry[way] for entry in result]) for way in result[0]]
        line = "".join(f"{100 * cell[:, 1].mean():>14.2f} ({np.median(cell[:, 0]):3.0f})" for cell in cells)
        print(f"{case.name:28}{line}", flush=True)


def compare_methods(cases: Sequence[Case]) -> None:
    columns = ("error [%]", "largest", "order", "pole", "|e|/sd", "CPU [ms]")
    print(f"{'case':28} {'method':12}" + "".join(f"{column:>10}" for column in columns))
    for case in cases:
        recordings = [case.record(seed) for seed in range(SEEDS)]
        whole = [entry.assign_coords(pulse_onset=entry["pulse_onset"] * np.nan) for entry in recordings[:1]]
        frequency = estimate_spectra(line_spectra(whole[0])).frequency
        frequency = frequency[frequency <= TOP]
        periodic = np.isnan(recordings[0]["pulse_onset"]).all()
        methods = ("spectral", "multisine", "welch", "multitaper") * bool(periodic)
        methods += ("noise", "arx", "subspace", "direct") + ("parametric",) * bool(case.model)
        for method in methods:
            rows = [run(case, method, recording, frequency) for recording in recordings]
            result = {key: np.array([row[key] for row in rows]) for key in rows[0]}
            cells = (
                f"{100 * result['error'].mean():.2f}",
                f"{100 * result['error'].max():.2f}",
                f"{np.median(result['order']):.0f}",
                f"{result['pole'].max():.4f}",
                f"{np.sqrt(result['ratio'].mean()):.2f}",
                f"{1e3 * np.median(result['took']):.0f}",
            )
            line = "".join(f"{'' if cell == 'nan' else cell:>10}" for cell in cells)
            print(f"{case.name:28} {method:12}{line}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
