"""What the joint model makes of recordings of real people: `python -m benchmarks.real_people ../shared/real`.

Writes docs/real_people.md and its figures from the recordings of a folder, which are no part of the package; without
the folder it says so and ends. Each ankle trial is fitted on its first half and predicted on its second; parameters
of both halves stand side by side.
"""

import itertools
import math
import sys
from pathlib import Path

import numpy as np

from armperturb.analysis.joint.identify import JointIdentification, identify_joint
from armperturb.analysis.joint.model import JointModel, JointStructure
from armperturb.analysis.joint.prediction import explained, fit_free_model
from armperturb.analysis.joint.signals import JointSignals, joint_signals, mean_angle
from armperturb.analysis.results import plain
from armperturb.plots.style import new_figure, save_svg
from armperturb.recording import make_recording

ROOT = Path(__file__).parents[1]
TRIALS = {
    "ankle_z_pf": ("ankle, plantarflexors active", 91.6),
    "ankle_z_df": ("ankle, dorsiflexors active", 96.1),
    "ankle_z_df2": ("ankle, dorsiflexors active, second trial", 96.1),
    "ankle_moving_2022": ("ankle on a large imposed movement", 82.1),
}
"""File to what it holds, and the held-out VAF of a least-squares prototype [%]."""

GRID = {
    "reflex_delay": (0.03, 0.04, 0.05, 0.065),
    "reflex_frequency": (1.0, 1.7, 3.0, 5.0),
    "reflex_threshold": (0.0, 0.3),
    "short_range_limit": (0.1, 0.4),
}
"""Parameters of the least-squares cascade that are not linear; threshold and limit over RMS velocity and angle."""

SPEEDS = (10, 20, 30, 40, 50, 60, 70, 80, 90)
HEAD = (
    "# Real people\n\n"
    "What the [joint model](joint.md) makes of recordings of real people: four trials of ankles on a position servo "
    "(McGill, REKLAB, GPL-2) and nine stretches of one elbow (myo-manipulation, Apache-2.0). They are **single "
    "people**: nothing here says how people in general are. No recording of a planar arm could be had, so that the "
    "two-axis analysis is not judged here. The recordings are no part of the package; "
    "`python -m benchmarks.real_people FOLDER` makes this page from a folder that holds them.\n\n"
)


def recording(path: Path, *, scheduled: bool = False):
    """A trial of an ankle as a recording of one axis."""
    with np.load(path) as file:
        arrays = {"displacement": file["angle_rad"], "force": -file["torque_Nm"]}
        if scheduled:
            arrays["scheduling"] = file["scheduling_rad"]
        rate = float(file["rate_hz"])
    return one_axis(arrays, rate, "ankle")


def one_axis(arrays: dict[str, np.ndarray], rate: float, joint: str):
    """Arrays over time as a recording of one trial."""
    labels = {"subject": ["A"], "task": ["PT"], "condition": ["PT"], "repetition": [0], "pulse_level": [0.0]}
    empty = ("pulse_direction", "pulse_onset", "l_h", "l_f", "theta_s_deg", "theta_e_deg", "limit_time")
    signals = {name: np.asarray(values, dtype=float)[None, :, None] for name, values in arrays.items()}
    labels |= {name: [math.nan] for name in empty}
    return make_recording(signals, labels, rate, servo="position", joint=joint, angular=True)


def halves(path: Path) -> tuple[JointIdentification, JointIdentification]:
    """The first half, with its prediction of the second, and the second half alone."""
    whole = recording(path, scheduled="moving" in path.stem)
    n = whole.sizes["time"]
    first = identify_joint(whole, fit_until=n / 2 / float(whole.attrs["rate"]))
    later = whole.isel(time=slice(n // 2, n))
    later = later.assign_coords(time=later["time"] - later["time"][0])
    return first, identify_joint(later, reflex=first.structure.reflex)


def cell(result: JointIdentification, name: str) -> str:
    """Estimate and 95 % interval of a parameter."""
    if name not in result.values:
        return "-"
    lower, upper = result.interval(name)
    known = f"{plain(lower, 3)} to {plain(upper, 3)}" if math.isfinite(upper) else "at bound"
    return f"{plain(result.values[name], 3)} ({known})"


def difference(first: JointIdentification, second: JointIdentification, name: str) -> float:
    """Of the estimates from both halves, over its standard error [-]; NaN where there is none."""
    error = math.hypot(first.standard_error[name], second.standard_error.get(name, math.nan))
    return (second.values.get(name, math.nan) - first.values[name]) / error if error else math.nan


def elbow_table(path: Path) -> list[str]:
    """Least squares of the elbow's torque on angle and velocity in each stretch: too few movements for a cascade."""
    lines = ["| speed [deg/s] | stiffness [Nm/rad] | damping [Nms/rad] | VAF [%] |", "|---|---|---|---|"]
    with np.load(path) as file:
        for speed in SPEEDS:
            time, angle, torque = (np.asarray(file[f"v{speed}_{name}"], float) for name in ("time", "angle", "torque"))
            angle = np.radians(angle)
            velocity = np.gradient(angle, time)
            columns = np.column_stack([angle - angle.mean(), velocity, np.ones_like(angle)])
            weights, *_ = np.linalg.lstsq(columns, torque, rcond=None)
            vaf = 100.0 * (1.0 - np.var(torque - columns @ weights) / np.var(torque))
            lines.append(f"| {speed} | {plain(weights[0], 3)} | {plain(weights[1], 3)} | {vaf:.1f} |")
    return lines


def prototype(train: JointSignals, test: JointSignals) -> float:
    """VAF [%] of a test by least squares with a half-wave reflex and short-range stiffness, the best of a grid."""
    best, share = math.inf, math.nan
    target, judged = train.torque[:, train.used].ravel(), test.torque[:, test.used]
    for side in (1, -1):
        structure = JointStructure(reflex="half-wave", side=side, short_range=True)
        models = JointModel(structure, train), JointModel(structure, test)
        linear = [name for name in structure.parameters if name not in GRID and name != "reflex_damping_ratio"]
        for point in itertools.product(*GRID.values()):
            given = dict(zip(GRID, point, strict=True))
            given["reflex_threshold"] *= train.velocity_scale
            given["short_range_limit"] *= train.angle_scale
            values = [given.get(name, 1.0) for name in structure.parameters]
            columns = []
            for model, signals in zip(models, (train, test), strict=True):
                of_name = model.derivatives(values)
                parts = [of_name[name][:, signals.used].ravel() for name in linear]
                columns.append(np.stack([np.ones_like(parts[0]), *parts], axis=1))
            weights = np.linalg.lstsq(columns[0], target, rcond=None)[0]
            if (cost := float(np.var(target - columns[0] @ weights))) < best:
                best, share = cost, explained(judged, (columns[1] @ weights).reshape(judged.shape))
    return share


def turned_round(path: Path) -> str:
    """Row of a table: both models fitted on the second half, and judged on the first."""
    whole = recording(path, scheduled="moving" in path.stem)
    n = whole.sizes["time"]
    first, second = (whole.isel(time=part) for part in (slice(0, n // 2), slice(n // 2, n)))
    second = second.assign_coords(time=second["time"] - second["time"][0])
    train, test = (joint_signals(half, reference=mean_angle(second)) for half in (second, first))
    share = explained(test.torque[:, test.used], fit_free_model(train).torque(test)[:, test.used])
    return f"| {TRIALS[path.stem][0]} | {prototype(train, test):.1f} | {share:.1f} |"


def page(folder: Path) -> str:
    """The page, and its figures beside it."""
    results = {name: halves(folder / f"{name}.npz") for name in TRIALS if (folder / f"{name}.npz").is_file()}
    lines = ["## Held-out prediction", ""]
    lines += [
        "Fitted on the first half of each trial; the torque of the second half is simulated from the angle alone, "
        "below 60 Hz and without its mean and drift. The prototype, an earlier least-squares fit with a rectified "
        "reflex that is no part of the package, has the figures to beat.",
        "",
    ]
    lines += ["| trial | prototype [%] | parallel cascade [%] | free model [%] | what `identify` reports [%] |"]
    lines += ["|---|---|---|---|---|"]
    for name, (first, _) in results.items():
        what, target = TRIALS[name]
        cascade, free = first.held_out["cascade"], first.held_out["free"]
        lines.append(f"| {what} | {target} | {cascade:.1f} | {free:.1f} | **{first.held_out_vaf:.1f}** |")
    lines += ["", "The model of the moving ankle has the imposed position as its scheduling signal.", ""]
    lines += [
        "The free model was developed with these second halves in view, so that unseen trials may be predicted less "
    ]
    lines[-1] += (
        "well. As a check the halves change places: it is fitted on the second and judged on the first, beside a "
    )
    lines[-1] += "least-squares cascade with half-wave reflex and short-range stiffness, the best of a grid."
    lines += ["", "| trial, second half fitted | least-squares cascade [%] | free model [%] |", "|---|---|---|"]
    lines += [turned_round(folder / f"{name}.npz") for name in results]
    lines += [""]
    lines += ["## Parameters, first and second half", "", "Estimates with 95 % intervals."]
    for name, (first, second) in results.items():
        lines += ["", f"### {TRIALS[name][0][0].upper()}{TRIALS[name][0][1:]}", "", f"{first.sentence}.", ""]
        lines += [
            "| parameter | unit | first half | second half | difference [standard errors] |",
            "|---|---|---|---|---|",
        ]
        for each in first.values:
            z = difference(first, second, each)
            cells = cell(first, each), cell(second, each), f"{z:+.1f}" if math.isfinite(z) else "-"
            lines.append(f"| {each.replace('_', ' ')} | {first.unit_of(each)} | {' | '.join(cells)} |")
        shares = ", ".join(f"{path} {share:.1f} %" for path, share in first.vaf.items())
        check = first.intrinsic
        lines += ["", f"VAF of the first half: {shares}. Of the torque that the reflex path leaves, left-out blocks: "]
        lines[-1] += (
            f"{check.structured_vaf:.1f} % by inertia, damping and stiffness, {check.left_out_vaf:.1f} % by an "
        )
        lines[-1] += "impulse response without structure."
        lines += ["", f"![Torque and paths](figures/real_{name}.svg)"]
        figure = new_figure(1.0)
        first.plot(figure)
        save_svg(figure, ROOT / "docs" / "figures" / f"real_{name}.svg")
    lines += ["", "## Elbow stretches", ""]
    lines += [
        "Each stretch moves once at constant speed. That is too little for a parallel cascade, and stiffness and "
        "damping by least squares explain little of the torque.",
        "",
    ]
    lines += elbow_table(folder / "elbow_stretches.npz")
    lines += ["", "## Where the models lose", ""]
    for name, (first, second) in results.items():
        free, total = first.free_model, first.vaf["total"]
        far = [each.replace("_", " ") for each in first.values if abs(difference(first, second, each)) > 3.0]
        lost = f"the cascade accounts for {total:.1f} % of the first half, a free model for {free.left_out_vaf:.1f} %"
        moved = f"; halves differ by more than three standard errors in {', '.join(far)}" if far else ""
        names = ", ".join(each.replace("_", " ") for each in first.at_bound)
        at_bound = f"; at a bound: {names}" if names else ""
        lines.append(f"- {TRIALS[name][0][0].upper()}{TRIALS[name][0][1:]}: {lost}{moved}{at_bound}.")
    lines += ["", "Where the cascade loses, its intervals are too short: they assume that the structure is right.", ""]
    return HEAD + "\n".join(lines)


def main(folder: Path) -> None:
    """Write the page, if there are recordings."""
    if not (folder / "ankle_z_pf.npz").is_file():
        print(f"{folder}: no recordings of real people; nothing is written")
        return
    (ROOT / "docs" / "real_people.md").write_text(page(folder), encoding="utf-8")
    print(f"written: {ROOT / 'docs' / 'real_people.md'}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/real"))
