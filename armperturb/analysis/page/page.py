"""Writes the page of an identification: findings first, then the data, then how it was made."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from armperturb.analysis.defaults import WINDOW_START
from armperturb.analysis.emg.envelope import Envelopes
from armperturb.analysis.fit.diagnosis import diagnose
from armperturb.analysis.fit.identification import ESTIMATOR_NAMES, Identification, Identifications
from armperturb.analysis.fit.maximum_likelihood import Estimate
from armperturb.analysis.fit.structures import unit
from armperturb.analysis.measures.endpoint import EndpointImpedance, is_straight
from armperturb.analysis.page import figures
from armperturb.analysis.page.data_check import DataCheck, check_data
from armperturb.analysis.page.emg import EmgSection, emg_section
from armperturb.analysis.page.verdict import likely_causes, nonlinearity, unknowns, verdict
from armperturb.analysis.pulses_alone import PULSES_ALONE, used_whole
from armperturb.analysis.response.best_linear import BestLinear, best_linear
from armperturb.analysis.response.estimate import response
from armperturb.analysis.response.frequency_response import FrequencyResponse
from armperturb.analysis.results import FitResult, limits_of, plain, plain_limits
from armperturb.analysis.trials import ConditionTrials
from armperturb.files import packaged_table, write_whole
from armperturb.pages.page import rendered, versions

WORDS: dict[str, dict[str, str]] = packaged_table(__package__, "words.toml")
"""Kind and name to words."""


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Where an identification comes from.

    Attributes:
      command: that made it; empty if none did.
      files: name of each file that was read to its checksum (SHA-256).
      notes: what reading them gave rise to, a sentence each.
      window_start: from when on whole periods were used [s].
      period: of the perturbation, as it was given [s]; None if it was found.
    """

    command: str = ""
    files: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    window_start: float = WINDOW_START
    period: float | None = None


def write_page(
    results: Identifications,
    trials: Mapping[str, Sequence[ConditionTrials]],
    path: str | Path,
    origin: Origin,
    emg: Envelopes | None = None,
) -> None:
    """Write the page, one HTML file that needs no other and no network.

    Args:
      results: of `identify_conditions`.
      trials: condition to its trials, those of one length together.
      path: of the page.
      origin: where the results come from.
      emg: of the person, which has a section then; None without.

    Raises:
      OSError: the folder cannot be written to.
    """
    arms = {label: result.fit.arm for label, result in results.items()}
    content = _content(results, trials, origin, emg_section(emg, trials, arms) if emg else None)
    write_whole(path, content)


def _content(
    results: Identifications,
    trials: Mapping[str, Sequence[ConditionTrials]],
    origin: Origin,
    emg: EmgSection | None,
) -> str:
    choices = {label: result.fit.choice for label, result in results.items() if result.fit.choice is not None}
    checks = {label: check_data(trials[label], origin.window_start, origin.period) for label in results}
    # What a fit to trials in the start geometry leaves is left of those, and pulses alone are part of a fit.
    fitted = {label: result.fit.trials or tuple(used_whole(trials[label])) for label, result in results.items()}
    diagnoses = {label: diagnose(result, fitted[label]) for label, result in results.items()}
    verdicts = {
        label: verdict(result, diagnoses[label].bands, checks[label].imbalance) for label, result in results.items()
    }
    distortions = {label: _distortion(fitted[label], check) for label, check in checks.items()}
    endpoints = {
        label: result.endpoint() for label, result in results.items() if not is_straight(result.fit.arm.theta_e_deg)
    }
    responses = {label: _response(result, trials[label], checks[label].period) for label, result in results.items()}
    pictures = {
        "parameters": figures.parameters(results),
        "admittance": figures.admittance(results, responses),
        "quality": figures.quality(results, diagnoses),
        **{f"traces_{k}": figures.traces(trials[label][0]) for k, label in enumerate(results)},
        **{f"residual_{k}": figures.residual(diagnosis) for k, diagnosis in enumerate(diagnoses.values())},
    }
    if endpoints:
        pictures["endpoint"] = figures.endpoint(endpoints)
    of_pulses = figures.pulses(results, trials)
    if of_pulses is not None:
        pictures["pulses"] = of_pulses
    if emg is not None:
        pictures |= emg.pictures
    causes = {
        label: likely_causes(result, checks[label], diagnoses[label], distortions[label])
        for label, result in results.items()
        if verdicts[label].level != "trust"
    }
    nonlinear = {label: nonlinearity(each).evidence for label, each in distortions.items() if label not in causes}
    sections: dict[str, dict[str, Any]] = {
        "parameters": {
            "rows": parameter_rows({label: result.fit for label, result in results.items()}, unit),
            "triples": True,
        },
        "endpoint": {"rows": _endpoint_rows(endpoints)},
        "admittance": {},
        "pulses": {"are_fitted": any(PULSES_ALONE in result.fit.remarks for result in results.values())},
        "emg": {"emg": emg},
        "data": {"checks": checks, "notes": origin.notes},
        "traces": {},
        "residual": {},
        "remarks": {"remarks": _remarks(results, trials), "causes": causes, "nonlinear": nonlinear},
        "unknown": {"unknowns": _unknowns(results, checks)},
        "structures": {"choices": {label: choice.describe() for label, choice in choices.items()}},
        "method": {"origin": origin, "licence": metadata.metadata("armperturb")["License-Expression"]},
    }
    absent = {
        "endpoint": not endpoints,
        "pulses": of_pulses is None,
        "emg": emg is None,
        "structures": not choices,
    }
    return rendered(
        __package__,
        "identification.html",
        {name: values for name, values in sections.items() if not absent.get(name)},
        WORDS["sections"],
        pictures,
        conditions=list(results),
        results=results,
        verdicts=verdicts,
        words=WORDS,
        plain=plain,
        estimator=ESTIMATOR_NAMES[next(iter(results.values())).fit.estimator],
        choices=choices,
        versions=versions("armperturb", "numpy", "scipy", "matplotlib"),
    )


def _distortion(parts: Sequence[ConditionTrials], check: DataCheck) -> BestLinear | None:
    """Best linear approximation, where there are multisines in two or more trials."""
    if check.period is None or check.n_trials < 2:
        return None
    try:
        return best_linear(parts, period=check.period)
    except ValueError:
        return None


def _response(result: Identification, parts: Sequence[ConditionTrials], period: float | None) -> FrequencyResponse:
    """The admittance without a model, with limits where trials allow any."""
    try:
        return response(parts, "noise") if period is None else response(parts, "multisine", period=period)
    except ValueError:
        spectra = result.spectra
        return FrequencyResponse(frequency=spectra.frequency, response=spectra.arm, covariance=None, what="arm")


def parameter_rows(fits: Mapping[str, FitResult], unit_of: Callable[[str], str]) -> list[dict[str, Any]]:
    """Parameter to what the fit of each condition says of it."""
    names = dict.fromkeys(name for fit in fits.values() for name in fit.values)
    rows = []
    for name in names:
        cells = []
        for fit in fits.values():
            if name not in fit.values:
                cells.append(("–", "–"))
                continue
            lower, upper = fit.interval(name)
            interval = plain_limits(lower, upper, 3) if abs(upper) < float("inf") else "not identifiable"
            mark = " (at bound)" if name in fit.at_bound else ""
            cells.append((plain(fit.values[name], 4), ("not known" if lower != lower else interval) + mark))
        rows.append({"name": name, "unit": unit_of(name), "cells": cells})
    return rows


def _endpoint_rows(endpoints: Mapping[str, EndpointImpedance]) -> list[tuple[str, ...]]:
    rows = []
    for label, each in endpoints.items():
        rows += [(label, *(cell.replace("nan", "–") for cell in row)) for row in each.describe().table.rows]
    return rows


def _remarks(results: Identifications, trials: Mapping[str, Sequence[ConditionTrials]]) -> list[str]:
    """What the fits say of themselves, but for what they say of single parameters."""
    said: dict[str, None] = {}
    for label, result in results.items():
        detail = result.fit.detail
        apart = set(limits_of(detail)) if isinstance(detail, Estimate) else set()
        if result.fit.choice is not None:  # the page says it elsewhere
            apart |= set(result.fit.choice.remarks(trials[label]))
        said |= dict.fromkeys(remark for remark in result.fit.remarks if remark not in apart)
        if isinstance(detail, Estimate):
            said |= {
                f"{WORDS['quantities'][name]} differ from trial to trial by {spread:.1%} (standard deviation); "
                "intervals are of the mean over trials": None
                for name, spread in detail.trial_spread.items()
            }
    return list(said)


def _unknowns(results: Identifications, checks: Mapping[str, DataCheck]) -> dict[str, list[str]]:
    undecided = {label: result.fit.choice.undecided if result.fit.choice else () for label, result in results.items()}
    return {label: unknowns(result, checks[label], undecided[label]) for label, result in results.items()}
