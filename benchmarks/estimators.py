"""Errors, intervals, convergence and speed of the estimators against what they must reach.

Run by `python -m benchmarks.estimators`; about 6 min on four idle cores. `--groups 20` takes half as long, `--cases
"PT, 1 trial"` one case, `--workers 1` one core. All cases but one perturb the linear arm, for which the structure is
exactly right, so that what is left is the estimators' own; MuJoCo's moves in a circle besides. Judged is maximum
likelihood over whole records; the other estimators stand beside it.

A percentage that is below the Cramer-Rao bound, which no unbiased estimator can beat, is no target, and the line says
so: of most in the position task, whose people are noisy, and of the mass of the upper arm in the relax task, which
hardly moves the handle.
"""

import argparse
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from armperturb.analysis.fit.group import Group
from armperturb.analysis.fit.linear_start import linear_start
from armperturb.analysis.fit.maximum_likelihood import estimate
from armperturb.analysis.response.spectra import estimate_spectra, line_spectra
from armperturb.analysis.trials import ConditionTrials
from armperturb.study.validation.settings import ESTIMATORS
from armperturb.study.validation.validate import ValidateSettings, Validation, simulate_group, validate

GROUPS = 40
LIKELY = ("frequency", "record")
JUDGED = "record"

RIGHT = {
    "PT, 8 trials": ValidateSettings(groups=GROUPS),
    "PT, MuJoCo's arm": ValidateSettings(groups=GROUPS, multibody=True),
    "PT, 20 free": ValidateSettings(groups=GROUPS, model="3", estimators=LIKELY),
    "PT, 1 trial": ValidateSettings(groups=GROUPS, trials=1),
    "RT, 8 trials": ValidateSettings(groups=GROUPS, task="RT", model="1"),
}
"""Cases in which the structure is right."""

WRONG = {
    "delay 10 ms off": ValidateSettings(groups=GROUPS, wrong="delay", estimators=LIKELY),
    "force feedback left out": ValidateSettings(groups=GROUPS, wrong="force-feedback", estimators=LIKELY),
    "grip 20 % too soft": ValidateSettings(groups=GROUPS, wrong="grip", estimators=LIKELY),
}


class Target(NamedTuple):
    """What the largest error of some parameters must stay below."""

    words: str
    limit: float
    parameters: tuple[str, ...]
    quantity: str = "rms_error_percent"


def triple(quantity: str) -> tuple[str, ...]:
    return tuple(f"{quantity}_{joint}" for joint in ("s", "se", "e"))


MAIN = (
    Target(
        "error / bound [-]",
        1.35,
        ("m_tot", *(f"{q}_{j}" for q in ("b", "k", "kv", "kp") for j in ("s", "se", "e"))),
        "rms_error_over_bound",
    ),
    Target("m [%]", 0.3, ("m_tot",)),
    Target("b [%]", 2.0, triple("b")),
    Target("k [%]", 4.5, triple("k")),
    Target("kv [%]", 3.5, triple("kv")),
    Target("kp_se, kp_e [%]", 10.0, ("kp_se", "kp_e")),
    Target("kp_s [Nm/rad]", 5.0, ("kp_s",), "rms_error"),
)
TARGETS = {
    "PT, 8 trials": MAIN,
    "PT, MuJoCo's arm": MAIN,
    "PT, 20 free": (
        *(Target(f"{name} [%]", 5.0, triple(name)) for name in ("b", "k", "kv")),
        *(Target(f"{name} [%]", 5.0, (f"{name}_s", f"{name}_e")) for name in ("Td", "fact")),
    ),
    "PT, 1 trial": tuple(
        Target(f"{name} [%]", limit, triple(name)) for name, limit in (("b", 5), ("k", 12), ("kv", 10))
    ),
    "RT, 8 trials": (
        Target("m_h [%]", 6.0, ("m_h",)),
        Target("k_se [%]", 13.0, ("k_se",)),
        Target("all others [%]", 6.0, ("m_f", *triple("b"), "k_s", "k_e", "b_h", "k_h")),
    ),
}
"""Case to what it must reach."""

SPEEDS = {"linear start": 5.0, "frequency fit": 20.0, "whole records": 1000.0}
"""Most time [ms]."""


def report_head() -> None:
    estimators = " ".join(f"{name:>10}" for name in reversed(ESTIMATORS))
    print(f"{'case':24} {'largest RMS error, or':26} {'target':>9} {estimators} {'bound':>7}")


def report(case: str, what: str, limit: str, values: dict[str, float], bound: float, met: bool | None) -> None:
    cells = " ".join(
        f"{'' if math.isnan(values.get(name, math.nan)) else format(values[name], '.2f'):>10}"
        for name in reversed(ESTIMATORS)
    )
    verdict = {True: "met", False: "NOT MET", None: ""}[met]
    if met is False and limit.startswith("<= ") and bound > float(limit[3:]):
        verdict = "below the bound"
    print(f"{case:24} {what:26} {limit:>9} {cells} {'' if math.isnan(bound) else format(bound, '.2f'):>7}  {verdict}")


def report_errors(case: str, validation: Validation) -> None:
    rows = validation.to_frame().to_dict("records")
    for target in TARGETS[case]:
        mine = [row for row in rows if row["parameter"] in target.parameters]
        values = {
            name: max(row[target.quantity] for row in mine if row["estimator"] == name) for name in validation.judged
        }
        at_bound = {
            "rms_error_percent": max(100.0 * row["bound"] / abs(row["true"]) for row in mine),
            "rms_error": max(row["bound"] for row in mine),
            "rms_error_over_bound": 1.0,
        }[target.quantity]
        report(case, target.words, f"<= {target.limit:g}", values, at_bound, values[JUDGED] <= target.limit)


def report_trust(result: dict[str, Validation]) -> None:
    """Intervals and convergence, over all cases in which the structure is right."""
    for case, validation in result.items():
        rows = validation.to_frame().to_dict("records")
        pooled = {row["estimator"]: row["coverage_percent"] for row in validation.estimators_frame().to_dict("records")}
        least = {
            name: min(row["coverage_percent"] for row in rows if row["estimator"] == name) for name in validation.judged
        }
        report(case, "95 % intervals, pooled [%]", "92 to 98", pooled, math.nan, 92.0 <= pooled[JUDGED] <= 98.0)
        report(case, "least of a parameter [%]", ">= 85", least, math.nan, least[JUDGED] >= 85.0)
    rows = [row for validation in result.values() for row in validation.estimators_frame().to_dict("records")]
    for name in ("converged", "stable", "global"):
        shares = {
            estimator: float(np.mean([row[f"{name}_percent"] for row in rows if row["estimator"] == estimator]))
            for estimator in {row["estimator"] for row in rows}
        }
        report("all of these", f"{name} [%]", "100", shares, math.nan, shares[JUDGED] == 100.0)


def report_suspicion(case: str, validation: Validation, *, is_wrong: bool) -> None:
    summary = {
        row["estimator"]: row for row in validation.estimators_frame().to_dict("records") if row["estimator"] in LIKELY
    }
    if is_wrong:
        biased = {name: row["biased_percent"] for name, row in summary.items()}
        flagged = {name: row["flagged_of_biased_percent"] for name, row in summary.items()}
        report(case, "biased by 2 errors [%]", "", biased, math.nan, None)
        report(case, "flagged of these [%]", ">= 90", flagged, math.nan, flagged[JUDGED] >= 90.0)
    else:
        flagged = {name: row["flagged_percent"] for name, row in summary.items()}
        report(case, "flagged though right [%]", "about 1", flagged, math.nan, None)


def milliseconds(function: Callable[[], object], repeats: int) -> float:
    """Median processor time of a call: with one thread, what the clock says on an idle core."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return 1e3 * float(np.median(times))


def speed() -> None:
    """Times of the parts, from eight trials of PT7.5, in this process."""
    settings = ValidateSettings()
    recording, structure = simulate_group(settings, 0), settings.structure()
    body = ConditionTrials.prepare(recording).body
    spectra = estimate_spectra(line_spectra(recording))
    group = Group.prepare(recording, structure)
    took = {
        "linear start": milliseconds(lambda: linear_start(spectra.frequency, spectra.arm, body, structure), 50),
        "frequency fit": milliseconds(lambda: estimate([group], "frequency"), 50),
        "whole records": milliseconds(lambda: estimate([Group.prepare(recording, structure)], "record"), 10),
    }
    report_head()
    for name, value in took.items():
        report("one core", f"{name} [ms]", f"<= {SPEEDS[name]:g}", {JUDGED: value}, math.nan, value <= SPEEDS[name])
    print("(whole records: from the recording on, with preparation, start and frequency fit)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", choices=["speed", "all"], default="all")
    parser.add_argument("--groups", type=int, default=GROUPS)
    parser.add_argument("--cases", nargs="+", choices=[*RIGHT, *WRONG], default=[*RIGHT, *WRONG])
    parser.add_argument("--workers", type=int)
    options = parser.parse_args()
    if options.what == "speed":
        speed()
        return
    start = time.monotonic()
    # A process of its own: how many threads BLAS has is settled when it is loaded.
    single = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    sys.stdout.flush()
    subprocess.run([sys.executable, "-m", "benchmarks.estimators", "speed"], env={**os.environ, **single}, check=True)
    right = {}
    for case, settings in RIGHT.items():
        if case not in options.cases:
            continue
        right[case] = validate(replace(settings, groups=options.groups), workers=options.workers)
        print(f"\n{right[case].summary()}\n")
        report_head()
        report_errors(case, right[case])
        report_suspicion(case, right[case], is_wrong=False)
    print()
    report_head()
    if right:
        report_trust(right)
    for case, settings in WRONG.items():
        if case in options.cases:
            result = validate(replace(settings, groups=options.groups), workers=options.workers)
            report_suspicion(case, result, is_wrong=True)
    print(f"{time.monotonic() - start:.0f} s in all")


if __name__ == "__main__":
    main()
