"""Where the fits of appendix C start."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from armperturb.analysis.fit.structures import STRUCTURES, neutral_start
from armperturb.study.published import tables as published
from armperturb.study.results import appendix_fits
from armperturb.study.results.appendix_fits import SCATTER, first_start, fit_person, fit_second_step
from armperturb.study.results.settings import AnalysisSettings

MODELS = "123456"


@pytest.mark.parametrize(("task", "table"), [("PT", "C.3"), ("RT", "C.13")])
def test_published_starts_are_the_printed_means_of_the_task(task, table):
    for model in MODELS:
        start = first_start(model, task, "published")
        assert list(start) == list(STRUCTURES[model].free)
        assert start == {name: published.estimate(name, table, model=model).mean for name in start}
    assert first_start("3", "RT", "published")["k_s"] == 8.3


def test_scattered_starts_are_published_ones_times_factors_within_the_bounds():
    factors = []
    for task in ("PT", "RT"):
        for model in MODELS:
            start, scattered = (first_start(model, task, kind) for kind in ("published", "scattered"))
            assert scattered == first_start(model, task, "scattered")
            for name, (lower, upper) in STRUCTURES[model].bounds.items():
                assert lower <= scattered[name] <= upper
                if lower < scattered[name] < upper and start[name]:
                    factors.append(math.log(scattered[name] / start[name]))
    assert len(factors) > 180
    # Those that a bound cut short are missing, so the rest spreads a little less.
    assert 0.8 * SCATTER < np.std(factors) < 1.1 * SCATTER


def test_the_first_step_starts_where_the_settings_say(monkeypatch):
    wanted = []

    def fitted(_, model, *, initial, use_penalty):
        wanted.append((model, initial, use_penalty))

    trials = SimpleNamespace(name="S01")
    monkeypatch.setattr(appendix_fits, "_fittable", lambda *_: {"PT7.5": trials, "RT7.5": trials})
    monkeypatch.setattr(appendix_fits.thesis, "fit_trials", fitted)
    for start in ("neutral", "published"):
        wanted.clear()
        fit_person({"PT7.5": trials}, AnalysisSettings(structures=("3",), starts_of=None, start=start))
        assert wanted == [("3", first_start("3", task, start), False) for task in ("PT", "RT")]
    assert first_start("3", "RT", "neutral") == neutral_start(STRUCTURES["3"], "RT")
    with pytest.raises(ValueError, match="start = 'PT'"):
        AnalysisSettings(start="PT")


def test_multisines_that_are_known_to_be_too_short_are_not_told_again():
    trials = SimpleNamespace(name="S01")
    first = fit_person({"PT7.5": trials}, AnalysisSettings(), ["PT7.5"])
    second = fit_second_step({"PT7.5": trials}, {("PT", "3"): {}}, ["PT7.5"])
    assert (first.first, first.starts, second.estimates) == ({}, {}, {})
    assert first.left_out == second.left_out == ()
