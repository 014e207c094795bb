"""Makes the data sets of the examples: synthetic people, dressed as laboratories hand their recordings over.

Run `python examples/data/make.py [FOLDER]`. By default it writes where it lies; README.md there describes the files.
"""

import json
import sys
from pathlib import Path
from typing import Any

import ezc3d
import h5py
import numpy as np
import xarray as xr
from scipy.io import savemat

from armperturb import Instruments, Multisine, MultisineThenPulse, Pulse, Trial, run_experiment, save_recording
from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.cohort import draw_person
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Environment
from armperturb.envs.lab.trial import subject_in
from armperturb.perturbations import CLUSTERS
from armperturb.perturbations.multisine import PERIOD
from armperturb.recording import TRIAL_COORDINATES
from armperturb.study.protocol import PULSE_UNIT, PULSE_WIDTH, THESIS
from armperturb.subject import Subject

COHORT_SEED, NUMBER = 8, 0
FORCES = THESIS.given_forces()
INSTRUMENTS = Instruments(marker_noise=None, emg=None)
DIGITS = {"perturbation": 3, "force": 3, "displacement": 6}
"""That are kept after the point: mN and um, the size of the instruments' own noise."""

START = (112.4, 438.9)
"""Where the C3D files have the handle at the start of a trial, from the laboratory's origin [mm]."""

PARAMETERS = ("b", "k", "kv", "kp")


def keep_position() -> tuple[xr.Dataset, dict[str, Any]]:
    """Two trials of a person with linear muscles, whose parameters are therefore numbers that a fit can be held to."""
    person = draw_person(COHORT_SEED, NUMBER, muscles="linear").subjects["PT"]
    trials = [
        Trial(
            subject=person,
            perturbation=Multisine.draw(seed=seed, rms=FORCES["PT7.5"]),
            condition="PT7.5",
            repetition=seed,
            seed=seed,
            noise=HUMAN_NOISE["PT"],
        )
        for seed in range(2)
    ]
    recording = rounded(run_experiment(trials, instruments=INSTRUMENTS))
    # Nobody is quite the same in every trial: a fit to both is held to their mean.
    own = [subject_in(trial, Environment()) for trial in trials]
    truth = {
        "person": f"draw_person({COHORT_SEED}, {NUMBER}, muscles='linear').subjects['PT']",
        "m_tot": person.m_h + person.m_f,
        **{
            f"{quantity}_{joint}": float(np.mean([getattr(one, f"{quantity}_{joint}") for one in own]))
            for quantity in PARAMETERS
            for joint in ("s", "se", "e")
        },
        "not fitted": {name: getattr(person, name) for name in ("Td_s", "Td_e", "fact_s", "k_h", "b_h")},
        "admittance": admittances(own),
    }
    return recording, truth


def relax() -> tuple[xr.Dataset, dict[str, Any]]:
    """Four trials of a person of the default cohort, whose muscles yield: multisines, each with a pulse at its end."""
    person = draw_person(COHORT_SEED, NUMBER).subjects["RT"]
    trials = [
        Trial(
            subject=person,
            perturbation=MultisineThenPulse(
                multisine=Multisine.draw(seed=10 + number, rms=FORCES["RT7.5"], duration=32.0),
                pulse=Pulse(
                    peak=FORCES[PULSE_UNIT],
                    direction_deg=(20.0, 200.0)[number % 2],
                    onset=32.0,
                    duration=33.5,
                    width=PULSE_WIDTH,
                ),
            ),
            condition="RT7.5",
            repetition=number,
            pulse_level=1.0,
            seed=10 + number,
            noise=HUMAN_NOISE["RT"],
        )
        for number in range(4)
    ]
    recording = rounded(run_experiment(trials, instruments=INSTRUMENTS))
    truth = {
        "person": f"draw_person({COHORT_SEED}, {NUMBER}).subjects['RT']",
        "distortion share": distortion_share(person).tolist(),
    }
    return recording, truth


def distortion_share(person: Subject, n_trials: int = 8) -> np.ndarray:
    """Share of the displacement's power that no linear response to the force explains, without any noise, (axis,).

    Trials of two periods, of which the last has forgotten the start; one 2 x 2 response for each cluster of lines.
    """
    signals = [Multisine.draw(seed=100 + i, rms=FORCES["RT7.5"], duration=2 * PERIOD) for i in range(n_trials)]
    ideal = run_experiment([Trial(subject=person, perturbation=signal, seed=0) for signal in signals])
    last = ideal.isel(time=slice(-round(PERIOD * 200.0), None))
    force, moved = (np.fft.rfft(last[name].values, axis=1)[:, CLUSTERS] for name in ("force", "displacement"))
    left = np.zeros(2)
    for cluster in range(len(CLUSTERS)):
        f, x = force[:, cluster].reshape(-1, 2), moved[:, cluster].reshape(-1, 2)
        response = np.linalg.lstsq(f, x, rcond=None)[0]
        # Two complex unknowns of each output are not free to be distortion.
        left += np.sum(np.abs(x - f @ response) ** 2, axis=0) * len(f) / (len(f) - 2)
    return left / np.sum(np.abs(moved) ** 2, axis=(0, 1, 2))


def rounded(recording: xr.Dataset) -> xr.Dataset:
    """The three signals that a laboratory has, with the digits that mean something."""
    kept = recording.drop_vars([name for name in recording.data_vars if name not in DIGITS])
    return kept.assign({name: kept[name].round(digits) for name, digits in DIGITS.items()})


def admittances(arms: list[Subject]) -> dict[str, list[float]]:
    """Mean gain of the arms [m/N] at some frequencies [Hz]."""
    frequency = np.array([0.5, 1.0, 2.0, 4.0, 8.0, 16.0])
    gain = np.abs(np.mean([arm_admittance(arm, frequency) for arm in arms], axis=0))
    return {
        "frequency": frequency.tolist(),
        **{name: gain[:, i, j].tolist() for name, i, j in (("xx", 0, 0), ("xy", 0, 1), ("yx", 1, 0), ("yy", 1, 1))},
    }


def labels(recording: xr.Dataset) -> dict[str, Any]:
    """Of all trials, as somebody would type them."""
    one = {name: recording[name].values[0].item() for name in TRIAL_COORDINATES if name in recording.coords}
    return {
        **{name: one[name] for name in ("subject", "task", "condition")},
        "l_h": f"{100.0 * one['l_h']:.9g} cm",
        "l_f": f"{100.0 * one['l_f']:.9g} cm",
        "theta_s_deg": one["theta_s_deg"],
        "theta_e_deg": one["theta_e_deg"],
    }


def write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def sidecar(recording: xr.Dataset, **content: Any) -> dict[str, Any]:
    pairs = {
        name: dict(zip("xy", content.pop(name), strict=True)) for name in ("perturbation", "force", "displacement")
    }
    force_by, unit, start = content.pop("exerted_by"), content.pop("unit"), content.pop("start", None)
    of_force = {"channels": pairs["force"], "unit": "N", "exerted_by": force_by}
    of_displacement = {"channels": pairs["displacement"], "unit": unit, **({"start": start} if start else {})}
    return {
        **content,
        "signals": {
            "perturbation": {"channels": pairs["perturbation"], "unit": "N"},
            "force": of_force,
            "displacement": of_displacement,
        },
        "labels": labels(recording),
        "environment": {"m_env": f"{Environment().m_env:g} kg"},
    }


def write_csv(recording: xr.Dataset, path: Path) -> None:
    """Times in ms, mm, x to the left, and the gauge's sign: force of the hand on the handle."""
    lines = ["trial,t_ms,motor_x_N,motor_y_N,gauge_x_N,gauge_y_N,pos_x_mm,pos_y_mm"]
    time = np.rint(1e3 * recording["time"].values).astype(int)
    for trial in range(recording.sizes["trial"]):
        d, f, x = (recording[name].values[trial] * (-1.0, 1.0) for name in DIGITS)
        for at, row in zip(time, np.concatenate([d, -f, 1e3 * x], axis=1) + 0.0, strict=True):
            lines.append(f"{trial + 1},{at}," + ",".join(f"{value:.3f}" for value in row))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    meaning = sidecar(
        recording,
        rate=200,
        time={"channel": "t_ms", "unit": "ms"},
        trial="trial",
        axes={"x": "left", "y": "forward"},
        perturbation=("motor_x_N", "motor_y_N"),
        force=("gauge_x_N", "gauge_y_N"),
        exerted_by="hand",
        displacement=("pos_x_mm", "pos_y_mm"),
        unit="mm",
    )
    write_json(path.with_suffix(".json"), meaning)


def write_matlab_5(recording: xr.Dataset, path: Path) -> None:
    """An array of structures, one per trial, in single precision."""
    trials = np.zeros((1, recording.sizes["trial"]), dtype=[(name, object) for name in ("motor", "hand", "handle")])
    for trial in range(recording.sizes["trial"]):
        d, f, x = (recording[name].values[trial].astype(np.float32) for name in DIGITS)
        trials[0, trial] = d, f, x
    savemat(path, {"trials": trials}, do_compression=True)
    with path.open("r+b") as file:  # whose text names the day
        file.write(b"MATLAB 5.0 MAT-file, simulated by armperturb".ljust(116))
    meaning = sidecar(
        recording,
        rate="0.2 kHz",
        axes={"x": "right", "y": "forward"},
        perturbation=("trials(trial).motor(time,1)", "trials(trial).motor(time,2)"),
        force=("trials(trial).hand(time,1)", "trials(trial).hand(time,2)"),
        exerted_by="handle",
        displacement=("trials(trial).handle(time,1)", "trials(trial).handle(time,2)"),
        unit="m",
    )
    write_json(path.with_suffix(".json"), meaning)


def write_matlab_73(recording: xr.Dataset, path: Path) -> None:
    """One matrix per channel, a column per trial, in cm; HDF5 below a header, with dimensions turned round."""
    matrices = {}
    for name, letter, factor in (("perturbation", "D", 1.0), ("force", "F", 1.0), ("displacement", "P", 100.0)):
        for axis in range(2):
            matrices[f"{letter}{'xy'[axis]}"] = (factor * recording[name].values[:, :, axis]).astype(np.float32)
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in matrices.items():
            stored = file.create_dataset(name, data=values, compression="gzip", compression_opts=9, shuffle=True)
            stored.attrs["MATLAB_class"] = np.bytes_("single")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, simulated by armperturb".ljust(124) + b"\x00\x02IM")
    meaning = sidecar(
        recording,
        rate=200,
        axes={"x": "right", "y": "forward"},
        perturbation=("Dx(time,trial)", "Dy(time,trial)"),
        force=("Fx(time,trial)", "Fy(time,trial)"),
        exerted_by="handle",
        displacement=("Px(time,trial)", "Py(time,trial)"),
        unit="cm",
    )
    write_json(path.with_suffix(".json"), meaning)


def write_c3d(recording: xr.Dataset, folder: Path) -> None:
    """One file per trial: a marker on the handle, from the laboratory's origin, and four analogue channels."""
    for trial in range(recording.sizes["trial"]):
        d, f, x = (recording[name].values[trial].T for name in DIGITS)
        file, points = ezc3d.c3d(), np.zeros((4, 1, recording.sizes["time"]))
        points[:2, 0] = 1e3 * x + np.array(START)[:, None]
        for group, labelled, unit in (("POINT", ["HANDLE"], "mm"), ("ANALOG", ["MX", "MY", "FX", "FY"], "N")):
            for name, value in (("RATE", [200.0]), ("LABELS", labelled), ("UNITS", [unit] * len(labelled))):
                file["parameters"][group][name]["value"] = value
        file["data"]["points"], file["data"]["analogs"] = points, np.concatenate([d, f])[None]
        file.write(str(folder / f"position_{trial + 1}.c3d"))
    meaning = sidecar(
        recording,
        axes={"x": "right", "y": "forward"},
        perturbation=("MX", "MY"),
        force=("FX", "FY"),
        exerted_by="handle",
        displacement=("HANDLE.X", "HANDLE.Y"),
        unit="mm",
        start=list(START),
    )
    write_json(folder / "position_c3d.json", meaning)


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    position, of_position = keep_position()
    relaxed, of_relaxed = relax()
    write_csv(position, folder / "position.csv")
    write_matlab_5(position, folder / "position_v5.mat")
    write_matlab_73(position, folder / "position_v73.mat")
    write_c3d(position, folder)
    save_recording(relaxed.astype(np.float32), folder / "relax.nc")
    write_json(folder / "truth.json", {"position": of_position, "relax": of_relaxed})


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
