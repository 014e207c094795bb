"""How well `identify` does on arms that the package did not make: truth in its intervals, fit, error over the bound.

Run by `python -m benchmarks.foreign_arms --n 40`, with `--mujoco` on MuJoCo's rigid bodies. Each arm is drawn by
`tests/foreign_recordings.py` (rigid segments, reflexes, grips, manipulators, excitations) and identified with the
structure that its trials choose, with the right one (`--model right`), or with a given `--model`. A line of JSON for
each arm goes to `--out` as soon as it is there; a second run with the same file continues.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np

from armperturb.analysis.fit.identify import identify
from armperturb.analysis.fit.own_structures import composed
from armperturb.analysis.fit.structures import Structure
from benchmarks.kept_rows import Row, with_kept_rows

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

JUDGED = ("k_s", "k_se", "k_e", "b_s", "b_se", "b_e")


def right_structure(truth: dict) -> Structure:
    """The structure of an arm, within wide bounds."""
    return composed(inertia="free", grip=truth["grip"], reflex=truth["reflex"])


def hand_ellipse(arm: Any) -> tuple[float, float]:
    """Area [(N/m)^2] and orientation [deg] of the true stiffness at the hand."""
    inverse = np.linalg.inv(arm.jacobian())
    k_s, k_se, k_e = arm.k
    turned = inverse.T @ np.array([[k_s, k_se], [k_se, k_e]]) @ inverse
    axes, directions = np.linalg.eigh(turned)
    return float(np.pi * axes.prod()), float(np.degrees(np.arctan2(*directions[::-1, 1])))


def judge(seed: int, with_mujoco: bool, model: str | None, given: dict) -> dict:
    """Draw, record and identify one arm."""
    import foreign_arms
    import foreign_mujoco
    from foreign_recordings import draw_foreign

    setup = draw_foreign(seed, **given)
    truth = setup.truth
    row = {"seed": seed, "kind": setup.kind, "period": setup.period, "lines": setup.lines, "amid": setup.amid}
    row |= {name: getattr(setup, name) for name in ("n_trials", "duration", "rate", "load", "remnant", "spread")}
    row |= {"reflex": truth["reflex"], "grip": truth["grip"]}
    recording = setup.recording(foreign_mujoco.simulate if with_mujoco else foreign_arms.simulate)
    start = time.process_time()
    try:
        result = identify(recording, right_structure(truth) if model == "right" else model)
    except ValueError as error:
        return row | {"refused": str(error)}
    fit, detail = result.fit, result.fit.detail
    bound = np.sqrt(detail.dispersion)
    for name in set(JUDGED) & fit.values.keys():
        error = fit.values[name] - truth[name]
        low, high = fit.interval(name)
        inside = bool(low <= truth[name] <= high)
        row[name] = [truth[name], fit.values[name], inside, fit.standard_error[name] / bound, error]
    if fit.choice is not None:
        row["right"] = fit.choice.chosen[:3] == ("free", truth["grip"], truth["reflex"])
    area, orientation = hand_ellipse(setup.arm)
    stiffness = fit.endpoint()["stiffness"]
    low, high = stiffness.orientation_interval()
    off = abs((orientation - (low + high) / 2.0 + 90.0) % 180.0 - 90.0)
    row["ellipse"] = [bool(np.prod(np.subtract(area, stiffness.area_interval())) <= 0.0), bool(2.0 * off <= high - low)]
    row |= {"chi2": detail.chi2, "dof": detail.dof, "converged": fit.converged, "suspicious": detail.is_suspicious}
    return row | {"seconds": time.process_time() - start, "remarks": list(fit.remarks)}


def report(rows: list[dict]) -> None:
    """Print what the arms of each kind, and all of them, gave."""
    columns = ("n", "refused", "right %", "flagged", "chi2/dof", "inside %", "worst %", "e/bound")
    print(f"{'arms':28}" + "".join(f"{column:>10}" for column in columns))
    splits = {"all": lambda row: "all"}
    splits |= {key: (lambda row, key=key: f"{key} {row[key]}") for key in ("kind", "reflex", "grip", "amid", "lines")}
    splits["load"] = lambda row: f"load {row['load'][0]:g} kg {row['load'][2]:g} N/m"
    for split in splits.values():
        for label in sorted({split(row) for row in rows}):
            of_label = [row for row in rows if split(row) == label]
            fitted = [row for row in of_label if "refused" not in row]
            cells = [f"{len(of_label)}", f"{len(of_label) - len(fitted)}"]
            if fitted:
                each = {name: np.array([row[name] for row in fitted if name in row]) for name in JUDGED}
                inside = [100.0 * np.mean(v[:, 2]) for v in each.values() if len(v)]
                ratio = np.concatenate([v[:, 4] / v[:, 3] for v in each.values() if len(v)])
                right = [row["right"] for row in fitted if "right" in row]
                cells += [f"{100.0 * np.mean(right):.0f}" if right else "-"]
                cells += [f"{sum(row['suspicious'] for row in fitted)}"]
                cells += [f"{np.median([row['chi2'] / row['dof'] for row in fitted]):.2f}"]
                cells += [f"{np.mean(inside):.1f}", f"{min(inside):.1f}", f"{np.sqrt(np.mean(ratio**2)):.2f}"]
            print(f"{label:28}" + "".join(f"{cell:>10}" for cell in cells))
    ellipses = 100.0 * np.mean([row["ellipse"] for row in rows if "ellipse" in row], axis=0)
    print(f"ellipse of stiffness: true area inside {ellipses[0]:.1f} %, true orientation inside {ellipses[1]:.1f} %")
    for reason in sorted({row["refused"] for row in rows if "refused" in row}):
        print(f"refused: {reason}")


def main() -> None:
    """Identify the arms that are not in the file yet, and report on all that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=40, help="arms")
    parser.add_argument("--seed", type=int, default=0, help="of the first arm; the others follow")
    parser.add_argument("--mujoco", action="store_true", help="MuJoCo as the engine")
    parser.add_argument("--model", help="for all arms, or right: each one's own; by default the trials choose")
    parser.add_argument("--given", type=json.loads, default={}, help='of every arm, e.g. \'{"kind": "multisine"}\'')
    parser.add_argument("--out", type=Path, help="file of JSON lines")
    asked = parser.parse_args()

    def judged(left: list[int]) -> Iterator[Row]:
        with ProcessPoolExecutor(2) as pool:
            waiting = [pool.submit(judge, seed, asked.mujoco, asked.model, asked.given) for seed in left]
            for future in as_completed(waiting):
                yield future.result()

    of_all = {"mujoco": asked.mujoco, "model": asked.model, "given": asked.given}
    report(with_kept_rows(asked.out, range(asked.seed, asked.seed + asked.n), judged, **of_all))


if __name__ == "__main__":
    main()
