"""Tests of co-contraction within people, against formulae of textbooks."""

import numpy as np
import pytest
from scipy import stats

from armperturb.study.comparison.cocontraction import cocontraction_tests, index_of, left_out_of_tests
from armperturb.study.protocol import THESIS
from armperturb.study.results.emg import Cocontraction, Level, PersonEmg

CONDITIONS = [c for c in THESIS.conditions if c.name in ("PT0", "PT2.5", "PT7.5", "PT22.5", "RT7.5")]


def people(n=6, seed=0, relaxed=0.02):
    """Co-contraction that grows with amplitude in the elbow and not in the shoulder."""
    rng = np.random.default_rng(seed)
    everyone = []
    for number in range(n):
        level = rng.uniform(0.1, 0.2)
        rows = []
        for joint, growth in (("shoulder", 0.0), ("elbow", 0.03)):
            for place, name in enumerate(("PT0", "PT2.5", "PT7.5", "PT22.5")):
                noisy = level + growth * place + 0.004 * rng.standard_normal()
                rows.append(Cocontraction(name, "before" if name == "PT0" else "during", joint, noisy, 0.5))
            rows.append(Cocontraction("RT7.5", "during", joint, relaxed * rng.uniform(0.5, 1.5), 0.5))
        levels = (Level("RT7.5", "during", "biceps", 0.01, 0.0, 4, 0.9, False),)
        everyone.append(
            PersonEmg(
                name=f"S{number}", unit="% of maximal contraction", limit=0.02, levels=levels, cocontraction=tuple(rows)
            )
        )
    return everyone


def rows_of(everyone):
    return {(row.question, row.joint, row.conditions): row for row in cocontraction_tests(everyone, CONDITIONS)}


def test_growth_with_amplitude_is_found_where_there_is_some():
    tests = rows_of(people())
    names = "PT2.5, PT7.5, PT22.5"
    assert tests["amplitude", "elbow", names].p < 1e-3 < tests["amplitude", "shoulder", names].p
    assert tests["amplitude", "shoulder", names].ratio == pytest.approx(1.0, abs=0.05)
    assert tests["amplitude", "elbow", names].ratio > 1.2


def test_task_is_a_dependent_t_test_on_means():
    everyone = people()
    row = rows_of(everyone)["task", "elbow", "PT, RT"]
    table = [index_of(person, "elbow") for person in everyone]
    held = np.array([np.mean([of[name] for name in ("PT2.5", "PT7.5", "PT22.5")]) for of in table])
    change = np.array([of["RT7.5"] for of in table]) - held
    t = change.mean() / (change.std(ddof=1) / np.sqrt(len(change)))
    assert row.statistic == pytest.approx(t)
    assert row.p == pytest.approx(2.0 * stats.t.sf(abs(t), len(change) - 1))
    assert row.n == len(everyone)


def test_index_is_that_during_the_perturbation_where_there_is_one():
    both = (Cocontraction("PT7.5", "before", "elbow", 0.1, 0.5), Cocontraction("PT7.5", "during", "elbow", 0.2, 0.5))
    for rows in (both, both[::-1]):
        assert index_of(PersonEmg(name="A", cocontraction=rows), "elbow") == {"PT7.5": 0.2}


def test_who_lacks_a_condition_is_left_out_and_nobody_is_no_test():
    everyone = people()
    everyone[0] = PersonEmg(name="S0", cocontraction=everyone[0].cocontraction[:2])
    assert {row.n for row in cocontraction_tests(everyone, CONDITIONS)} == {5}
    said = left_out_of_tests(everyone, CONDITIONS)
    assert said[0].startswith("co-contraction of the shoulder: S0 has no index in PT7.5, PT22.5, RT7.5, and no part in")
    assert said[1].startswith("co-contraction of the elbow: S0 has no index in PT0, PT2.5, PT7.5, PT22.5, RT7.5, and")
    assert len(said) == 2
    assert cocontraction_tests(everyone[:2], CONDITIONS) == []
    assert left_out_of_tests(everyone[:2], CONDITIONS) == []
    silent = [row for row in cocontraction_tests(people(relaxed=0.0), CONDITIONS) if row.question == "task"]
    assert np.isnan([row.ratio for row in silent]).all()
