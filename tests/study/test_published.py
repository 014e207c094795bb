"""The thesis's numbers in SI units."""

import math

import pytest

from armperturb.study.published import tables as published


def test_units_are_si():
    assert published.joint_motion("PT7.5", "s", "rms_rotation").mean == pytest.approx(math.radians(1.7))
    assert published.joint_motion("RT22.5", "e", "rms_velocity").sd == pytest.approx(math.radians(8.5))
    assert published.joint_motion("PT0", "e", "peak_rotation", pulse="max").mean == pytest.approx(math.radians(17.2))
    assert published.rms_displacement("RT2.5") == pytest.approx((4.3e-3, 1.5e-3))
    assert published.applied_force("PT22.5") == pytest.approx((16.6, 4.8))
    assert published.pulse_unit() == pytest.approx((53.9, 13.0))
    assert published.parameter("RT22.5", "k_h").mean > 1e3


@pytest.mark.parametrize(
    "call",
    [
        lambda: published.applied_force("PT0"),
        lambda: published.rms_displacement("PT5"),
        lambda: published.joint_motion("PT0", "s", "rms_rotation"),
        lambda: published.parameter("PT2.5", "k_s"),
        lambda: published.parameter("PT7.5", "kf_s"),
        lambda: published.peak_displacement("RT0", "max"),
        lambda: published.headline_text("no such number"),
    ],
)
def test_what_is_not_printed_is_a_key_error(call):
    with pytest.raises(KeyError, match=r"no "):
        call()


def test_conditions_are_those_of_table_2_1():
    assert published.conditions() == ("PT0", "PT2.5", "PT7.5", "PT22.5", "RT0", "RT2.5", "RT7.5", "RT22.5")
    assert [name for name in published.conditions() if not published.has_multisine(name)] == ["PT0", "RT0"]
    assert published.pulse_levels("PT7.5") == ("min", "max")
    assert published.pulse_levels("RT22.5") == ("min",)
    assert published.pulse_levels("PT5") == ()
    assert published.peak_displacement("PT7.5", "max") == pytest.approx((0.0914, 0.0118))


def test_entries_are_all_there():
    assert len(published.joint_motions()) == len(set(published.joint_motions())) == 104
    entries = published.fit_entries()
    tables = list(dict.fromkeys(entry.table for entry in entries))
    assert tables == [*(f"C.{n}" for n in range(3, 23)), "D.3", "D.4", "D.5", "E.3", "E.4", "E.5"]
    # Of each start: parameters and their errors, criterion, VAF of both axes, and how many are positive.
    expected = {"C": 2108, "D": 6 * (2 * 20 + 4), "E": 6 * (2 * 13 + 4)}
    assert {name: sum(entry.table[0] == name for entry in entries) for name in "CDE"} == expected
    for entry in entries[::50]:
        if entry.parameter:
            name, where = entry.parameter, {"model": entry.model, "start": entry.start}
            assert entry.value == published.estimate(name, entry.table, quantity=entry.quantity, **where)
    shares = [entry.value for entry in entries if entry.quantity.startswith("N_")]
    assert len(shares) == 60 + 6 + 6
    assert all(0.0 < value.mean <= 1.0 and math.isnan(value.sd) for value in shares)


def test_headlines_stand_as_printed():
    assert published.headline_text("p_pulse_admittance_anova_rt") == "0.000"
    assert published.headline_text("p_pulse_admittance_pt0_pt2.5") == "ns"
    assert published.headline("pulse_underprediction_factor") == 1.7
