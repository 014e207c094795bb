"""The thesis's estimator on simulated recordings: procedures, averages, starts and refusals."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from armperturb.analysis.fit.admittance_problem import penalty_factor
from armperturb.analysis.fit.structures import STRUCTURES
from armperturb.analysis.fit.thesis import (
    MODEL_3_WIDE,
    THETA,
    VARTHETA,
    fit_starts,
    fit_trials,
    join_estimates,
)
from armperturb.analysis.trials import ConditionTrials
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine
from armperturb.plots.style import new_figure
from armperturb.study.published import tables as published
from armperturb.study.report.tables import true_value
from armperturb.subject import POSITION


@pytest.fixture(scope="module")
def first(position_recording):
    """Three trials of one person."""
    return position_recording.isel(trial=slice(3)).assign_coords(subject=("trial", ["first"] * 3))


@pytest.fixture(scope="module")
def other(position_recording):
    """One of another, who is the same but for the name."""
    return position_recording.isel(trial=[3]).assign_coords(subject=("trial", ["other"]))


@pytest.fixture(scope="module")
def estimate(first, other, once):
    return once("estimate of the thesis", lambda _: join_estimates([fit_trials(part, "3b") for part in (first, other)]))


def test_ideal_trials_give_the_person_back_and_are_predicted(estimate):
    truth = [true_value(POSITION, name) for name in estimate.parameters]
    for name, found, true in zip(estimate.parameters, estimate.values.mean(axis=0), truth, strict=True):
        if name.startswith(("m", "b", "kv")) or name in ("k_s", "k_se", "k_e"):
            assert found == pytest.approx(true, rel=0.25), name
    assert (estimate.vaf > 95).all()
    assert estimate.n_positive == estimate.n_stable == 4
    assert estimate.environment.m_env == pytest.approx(Environment().m_env, rel=0.01)
    assert sum(estimate.status.values()) == 4
    assert all(word.startswith(("converged", "not converged")) for word in estimate.status)


def test_criterion_is_the_printed_sum(estimate):
    assert estimate.fits[0].n_errors == 72
    np.testing.assert_allclose(estimate.criterion, [72 * fit.criterion for fit in estimate.fits])


def test_averages_are_over_trials_and_then_over_subjects(estimate):
    mean, sd = estimate.over_subjects(estimate.values)
    of_first, of_other = estimate.values[:3].mean(axis=0), estimate.values[3]
    np.testing.assert_allclose(mean, (of_first + of_other) / 2)
    np.testing.assert_allclose(sd, np.abs(of_first - of_other) / np.sqrt(2))
    data = estimate.to_xarray()
    of_people = data["value"].groupby("subject").mean("trial").sel(parameter="k_s")
    assert float(of_people.mean()) == pytest.approx(mean[estimate.parameters.index("k_s")])
    assert data["vaf"].sizes == {"trial": 4, "axis": 2}
    panels = estimate.plot(new_figure(1.0))
    assert len(panels) == len(set(data["unit"].values.tolist()))
    drawn = {float(line.get_xdata()[0]) for ax in panels for line in ax.get_lines() if line.get_marker() == "o"}
    assert {float(value) for value in of_people} <= drawn
    rows = {row["parameter"]: row for row in estimate.to_frame().to_dict("records")}
    assert rows["k_s"]["value"] == pytest.approx(mean[estimate.parameters.index("k_s")])
    assert rows["k_s"]["sem_over_value"] == pytest.approx(rows["k_s"]["sem"] / rows["k_s"]["value"])
    assert estimate.means() == pytest.approx(dict(zip(estimate.parameters, mean, strict=True)))


def test_only_positive_vaf_counts(estimate):
    kept = estimate.vaf.copy()
    try:
        estimate.vaf[0, 1] = -20.0
        estimate.vaf[2] = -np.inf
        assert estimate.n_positive == 2
        np.testing.assert_allclose(estimate.mean_vaf()[0], kept[[1, 3]].mean(axis=0))
        estimate.vaf[:] = -1.0
        assert np.isnan(estimate.mean_vaf()[0]).all()
    finally:
        estimate.vaf[:] = kept


@pytest.mark.slow(reason="fits trials in two steps")
def test_a_second_step_from_the_means_of_the_first_is_penalised_where_it_is_unstable(first):
    one = first.isel(trial=[0, 2])
    step_1 = fit_trials(one, "3", use_penalty=False)
    assert all(fit.penalty == 1.0 for fit in step_1.fits)
    step_2 = fit_trials(one, "3", initial=step_1.means())
    assert step_2.n_stable == 2
    assert step_2.fits[0].penalty == pytest.approx(penalty_factor(step_2.fits[0].largest_real_pole))


@pytest.mark.slow(reason="fits trials")
def test_fits_are_kept_with_their_trials(first):
    one = ConditionTrials.prepare(first.isel(trial=[1, 2]))
    one = replace(one, given=(Environment(m_env=3.0), one.noise))
    found = fit_trials(one, "3b", initial=VARTHETA["vartheta_i4"])
    assert (found.structure, found.subjects, found.environment.m_env) == ("3b", ("first", "first"), 3.0)
    assert fit_trials(one, "3b", initial=VARTHETA["vartheta_i4"]) is found
    assert fit_trials(one, "3b") is not found
    assert fit_trials(one, "3b", initial=VARTHETA["vartheta_i4"], use_penalty=False) is not found
    with pytest.warns(RuntimeWarning, match="as many averages as inputs"):
        of_pairs = fit_trials(one, "3b", lines_per_average=2)
    assert of_pairs.fits[0].n_errors == 2 * fit_trials(one, "3b").fits[0].n_errors


@pytest.mark.slow(reason="fits from every published start")
def test_appendix_d_and_e_take_every_published_start(other):
    one = ConditionTrials.prepare(other)
    d, e = fit_starts(one, THETA), fit_starts(one, VARTHETA)
    assert list(d) == [f"theta_i{i}" for i in range(1, 7)]
    assert {estimate.structure for estimate in d.values()} == {"3 (D.2)"}
    assert [e[f"vartheta_i{i}"].structure for i in range(1, 7)] == ["3a", *["3b"] * 5]


@pytest.mark.slow(reason="fits from every published start")
def test_the_published_optimisation_stops_on_the_way_to_a_minimum_that_all_starts_share():
    trial = Trial(
        subject=POSITION,
        perturbation=Multisine.draw(seed=3, rms=4.0, crested=False, duration=30.0),
        seed=4,
        noise=HUMAN_NOISE["PT"].scaled(0.5),  # of one trial with all of it, the criterion has several minima
    )
    noisy = run_experiment([trial])
    spread = {}
    for as_published in (True, False):
        found = [
            fit_trials(noisy, "3b", initial=VARTHETA[f"vartheta_i{i}"], as_published=as_published).values[0]
            for i in (2, 3, 5)
        ]
        spread[as_published] = (np.std(found, axis=0) / np.max(found, axis=0).clip(1e-3)).max()
    assert spread[False] < 1e-3
    assert spread[True] > 0.1


@pytest.mark.parametrize(("table", "model", "starts"), [("D.3", "3", THETA), ("E.3", "3b", VARTHETA)])
def test_starts_are_the_published_ones(table, model, starts):
    for start, values in starts.items():
        of_model = "3a" if start == "vartheta_i1" else model
        for name, value in values.items():
            printed = published.estimate(name, table, model=of_model, start=start, quantity="initial").mean
            if (start, name) == ("theta_i6", "k_h"):
                assert (printed, value) == (32.6e3, MODEL_3_WIDE.bounds["k_h"][1])
            else:
                assert value == pytest.approx(printed, rel=1e-12), (start, name)
        structure = MODEL_3_WIDE if table == "D.3" else STRUCTURES[of_model]
        assert all(structure.bounds[name][0] <= value <= structure.bounds[name][1] for name, value in values.items())


def test_bounds_are_the_published_ones():
    for table, structures in (
        ("C.2", [STRUCTURES[n] for n in "23456"]),
        ("D.2", [MODEL_3_WIDE]),
        ("E.2", [STRUCTURES["3b"]]),
    ):
        for structure in structures:
            for name, pair in structure.bounds.items():
                printed = published.bounds(name, table)
                assert printed == ((0.035, 0.045) if (table, name) == ("C.2", "Td_e") else pytest.approx(pair)), name


def test_bad_input_is_named(first, other):
    with pytest.raises(ValueError, match=r"subject has several values \(first, other\)"):
        fit_trials(xr.concat([first, other], "trial", combine_attrs="override"), "3b")
    with pytest.raises(ValueError, match=r"initial: k_s = 5000.0; expected 0 to 1000 Nm/rad"):
        fit_trials(first, "3b", initial={"k_s": 5000.0})
    broken = first.assign(force=first["force"] * np.nan)
    with pytest.raises(ValueError, match="force"):
        fit_trials(broken, "3b")
    flipped = first.assign(force=-first["force"])
    with pytest.raises(ValueError, match="force must be the reaction force that the handle exerts"):
        fit_trials(flipped, "3b")
