"""Structures of one's own: files, options and choices against structures made by hand, and every refusal."""

from dataclasses import replace

import numpy as np
import pytest
from foreign_arms import Arm
from foreign_recordings import Setup

from armperturb.analysis.arm.geometry import mass_matrix
from armperturb.analysis.arm.parameters import PARAMETERS
from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.analysis.fit.group import Group
from armperturb.analysis.fit.maximum_likelihood import estimate
from armperturb.analysis.fit.own_structures import (
    composed,
    edited,
    inertia_prior,
    load_structure,
    save_structure,
    with_options,
)
from armperturb.analysis.fit.structures import STRUCTURES, Structure, is_published, wide_bounds
from armperturb.anthropometry import anthropometric_body
from armperturb.environment import Environment
from armperturb.subject import POSITION, RELAX

MODEL_3 = STRUCTURES["3"].widened()
CHOICES = [
    dict(inertia=inertia, grip=grip, reflex=reflex)
    for inertia in ("tied", "points", "free")
    for grip in ("rigid", "spring")
    for reflex in ("none", "velocity", "position")
]


def assert_alike(one: Structure, other: Structure) -> None:
    for field in ("bounds", "initial", "fixed", "tied", "prior"):
        assert getattr(one, field) == getattr(other, field), field
    np.testing.assert_array_equal(one.mixing, other.mixing)


def written(tmp_path, text: str) -> Structure:
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    return load_structure(tmp_path / "mine.toml")


def test_options_and_a_file_make_the_structure_that_is_made_by_hand(tmp_path):
    by_options = with_options(
        MODEL_3,
        free=["zeta_act", "k_se=-50:10:300"],
        fix=["k_h=rigid", "kp=0"],
        bounds=["fact=1:6"],
        tie=["Td_e=Td_s"],
        prior=["m_f=1.8+-0.3"],
    )
    by_file = written(
        tmp_path,
        """
        base = "3"
        [free]
        zeta_act = "wide"
        k_se = [-50, 10, 300]
        fact_s = [1, 6]
        fact_e = [1, 6]
        [fixed]
        k_h = "rigid"
        kp_s = 0
        kp_se = 0
        kp_e = 0
        [tied]
        Td_e = { Td_s = 1 }
        [prior]
        m_f = [1.8, 0.3]
        """,
    )
    by_hand = (
        MODEL_3.fixing(k_h=np.inf, b_h=0.0, kp_s=0.0, kp_se=0.0, kp_e=0.0)
        .tying(Td_e={"Td_s": 1.0})
        .freeing(zeta_act=(0.3, 0.75, 2.0), k_se=(-50.0, 10.0, 300.0))
        .freeing(fact_s=(1.0, 2.8, 6.0), fact_e=(1.0, 2.74, 6.0))
        .knowing(m_f=(1.8, 0.3))
    )
    for structure in (by_options, by_file):
        for field in ("bounds", "initial", "fixed", "tied", "prior"):
            assert dict(getattr(structure, field)) == dict(getattr(by_hand, field)), field
    assert by_options.name.startswith("3 with free zeta_act, free k_se=-50:10:300, fix k_h=rigid, fix kp=0, bounds")
    assert by_file.name == "mine"


def test_total_mass_is_made_free_together_with_what_follows_it():
    tied = with_options(STRUCTURES["1"], free=["m_tot=0.5:8"], tie=["m_h=0.49*m_tot", "m_f=0.51*m_tot"])
    assert tied.tied == STRUCTURES["3b"].tied
    assert "m_h" not in tied.free
    assert with_options(STRUCTURES["3b"], fix=["m_tot=4"]).fixed["PT"]["m_h"] == pytest.approx(0.49 * 4)
    both = with_options(MODEL_3, tie=["k_se=0.2*k_s+0.3*k_e"])
    values = both.parameters("PT", list(both.initial.values()))
    assert values[PARAMETERS.index("k_se")] == pytest.approx(0.2 * 181.4 + 0.3 * 158.46)


@pytest.mark.parametrize(
    "structure", [*STRUCTURES.values(), *(composed(**choice) for choice in CHOICES)], ids=lambda s: s.name
)
def test_a_saved_structure_is_read_back_whole(tmp_path, structure):
    known = structure.knowing(**{structure.free[0]: (structure.initial[structure.free[0]], 0.1)}).named(structure.name)
    save_structure(known, tmp_path / "saved.toml")
    again = load_structure(tmp_path / "saved.toml")
    assert_alike(again, known)
    assert again.name == known.name


def test_a_structure_is_published_for_what_it_says_whatever_it_is_called(tmp_path):
    assert all(is_published(structure) and is_published(structure.widened()) for structure in STRUCTURES.values())
    assert is_published(STRUCTURES["3b"].named("mine"))
    (tmp_path / "3b.toml").write_text('base = "3b"\n[fixed]\nTd_s = 0.04\n')
    changed = load_structure(tmp_path / "3b.toml")
    assert changed.name == "3b"
    assert not is_published(changed)


@pytest.mark.parametrize("structure", STRUCTURES.values(), ids=lambda structure: structure.name)
def test_wide_bounds_hold_the_published_ones_and_change_nothing_else(structure):
    wide = structure.widened()
    assert (wide.name, wide.initial, wide.fixed, wide.tied) == (
        structure.name, structure.initial, structure.fixed, structure.tied,
    )  # fmt: skip
    for name, (lower, upper) in structure.bounds.items():
        assert wide.bounds[name][0] <= lower < upper <= wide.bounds[name][1]
    # Model 3b is the one without negative gains.
    assert (wide.bounds.get("kv_s", (-1.0,))[0] == 0.0) == (structure.name == "3b")


def test_every_parameter_has_wide_bounds_around_people():
    for name in PARAMETERS:
        lower, usual, upper = wide_bounds(name)
        assert lower < usual < upper, name
        if not name.startswith("i_"):
            assert lower <= getattr(RELAX, name) <= upper, name
            assert lower <= getattr(POSITION, name) <= upper, name
    assert wide_bounds("m_x") is None


@pytest.mark.parametrize("choice", CHOICES, ids=str)
def test_a_structure_of_three_choices_starts_from_a_stable_arm_within_its_bounds(choice):
    structure = composed(**choice)
    arm = structure.arm(POSITION, list(structure.initial.values()))
    assert largest_real_pole(arm, Environment()) < 0.0
    assert arm.has_extra_inertia == (choice["inertia"] == "free")
    assert arm.has_rigid_grip == (choice["grip"] == "rigid")
    assert any(arm.joint_triple("kp")) == (choice["reflex"] == "position")
    assert any(arm.joint_triple("kv")) == (choice["reflex"] != "none")
    assert ("zeta_act" in structure.free) == ("Td_s" in structure.free) == (choice["reflex"] != "none")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"free": ["k_x=1:2"]}, "free parameter 'k_x' is unknown; expected one of m_h"),
        (
            {"free": ["k_x"]},
            "free parameter 'k_x' is unknown; expected one of m_h, .*, zeta_act, or bounds of a new one",
        ),
        ({"free": ["k_s=5"]}, "free 'k_s=5'; expected NAME, NAME=LOWER:UPPER or NAME=LOWER:INITIAL:UPPER"),
        ({"free": ["k_s=1:x"]}, "free k_s = 'x'; expected a number"),
        ({"free": ["k_s=9:9"]}, r"bounds of k_s = 9\.0 to 9\.0; expected a lower and a higher finite number"),
        ({"free": ["k_s=1:20:9"]}, r"initial value of k_s = 20\.0; expected 1 to 9"),
        ({"fix": ["k_x=1"]}, "fixed parameter 'k_x' is unknown; expected one of m_h"),
        ({"fix": ["k_s"]}, "fix 'k_s'; expected NAME=VALUE, or k_h=rigid"),
        ({"fix": ["k_s=rigid"]}, "fix k_s = 'rigid'; expected a number"),
        ({"fix": ["k_s=inf"]}, r"k_s = inf is fixed \(PT\); expected a finite number"),
        ({"fix": ["k_s=3"], "free": ["k_s"]}, "k_s is both free and fixed; expected one of them"),
        ({"fix": ["Td_e=0.03"], "tie": ["Td_e=Td_s"]}, "Td_e is both tied and fixed; expected one of them"),
        ({"fix": ["k_h=rigid"], "free": ["b_h"]}, "b_h is both free and fixed; expected one of them"),
        ({"bounds": ["fact=6:1"]}, r"bounds of fact_s = 6\.0 to 1\.0; expected a lower and a higher finite number"),
        ({"bounds": ["fact=6"]}, "bounds 'fact=6'; expected NAME=LOWER:UPPER"),
        ({"bounds": ["zeta_act=0.5:1"]}, "bounds 'zeta_act=0.5:1', but zeta_act is not free; expected one of m_h"),
        ({"bounds": ["k=-5:100"]}, r"bounds of k_s = -5\.0 to 100\.0; expected a lower bound at least 0"),
        (
            {"tie": ["Td_e=Td_s", "Td_s=Td_e"]},
            "ties in a circle: Td_e to Td_s to Td_e; expected one of them free or fixed",
        ),
        ({"tie": ["Td_e=Td_e"]}, "ties in a circle: Td_e to Td_e; expected one of them free or fixed"),
        ({"tie": ["Td_e=Td_x"]}, "Td_e is tied to 'Td_x', which is not free; expected m_h"),
        ({"tie": ["T=Td_s"]}, "tied parameter 'T' is unknown; expected one of m_h"),
        ({"tie": ["Td_e"]}, r"tie 'Td_e'; expected NAME=NAME or NAME=WEIGHT\*NAME, with \+ between several"),
        ({"tie": ["Td_e=half*Td_s"]}, "tie Td_e: weight of Td_s = 'half'; expected a number"),
        ({"tie": ["Td_e=*Td_s"]}, r"tie 'Td_e=\*Td_s'; expected NAME=NAME or"),
        ({"prior": ["m_f=1.8"]}, r"prior 'm_f=1\.8'; expected NAME=MEAN\+-SD"),
        ({"prior": ["m_f=1.8+-0"]}, r"prior of m_f = 1\.8 \+- 0\.0; expected a width above 0"),
        ({"prior": ["m_f=1.8±-1"]}, r"prior of m_f = 1\.8 \+- -1\.0; expected a width above 0"),
        ({"prior": ["m_f=18+-1"]}, r"prior of m_f = 18\.0 \+- 1\.0; expected a mean of 0\.05 to 15"),
        ({"prior": ["zeta_act=1+-0.1"]}, "prior of 'zeta_act', which is not free; expected one of m_h"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(ValueError, match=message) as caught:
        with_options(MODEL_3, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("base = '7'", r"base = '7'; expected one of 1, 2"),
        ("model = '3'", "unknown key 'model'; expected keys are base, name, free, fixed, tied, prior"),
        (
            "base = '3'\n[free]\nk_s = 5",
            r'free: k_s = 5; expected \[lower, upper\], \[lower, initial, upper\] or "wide"',
        ),
        ("base = '3'\n[free]\nk_s = [1, '2']", "free: k_s = '2'; expected a number"),
        ("base = '3'\n[free]\nk_x = [1, 2]", "free parameter 'k_x' is unknown; expected one of m_h"),
        ("base = '3'\nfixed = 3", "fixed = 3; expected a table"),
        ("base = '3'\n[fixed]\nPT = 3", r"fixed\.PT = 3; expected a table"),
        ("base = '3'\n[fixed]\nk_s = 'rigid'", "fixed: k_s = 'rigid'; expected a number"),
        ("base = '3'\n[fixed.PT]\nk_s = 5", r"k_s is neither free nor tied nor fixed \(RT\); expected one of them"),
        ("base = '3'\n[tied]\nTd_e = 'Td_s'", "tied: Td_e = 'Td_s'; expected a table"),
        ("base = '3'\n[tied]\nTd_e = { Td_s = true }", "tied: Td_e: Td_s = True; expected a number"),
        ("base = '3'\n[prior]\nm_f = 2", r"prior: m_f = 2; expected \[mean, standard deviation\]"),
        ("base = '3'\n[prior]\nm_f = [2, 0]", r"prior of m_f = 2\.0 \+- 0\.0; expected a width above 0"),
        ("[free]\nk_s = 'wide'", r"m_h is neither free nor tied nor fixed \(PT\)"),
        ("base = 3 = 4", "not a TOML file"),
    ],
)
def test_bad_files_are_named(tmp_path, text, message):
    with pytest.raises(ValueError, match=message) as caught:
        written(tmp_path, text)
    assert str(caught.value).startswith(str(tmp_path / "mine.toml"))
    assert "\n" not in str(caught.value)


@pytest.mark.slow(reason="simulates and fits two arms that the package did not make")
@pytest.mark.parametrize("grip", [None, (12e3, 60.0)], ids=["rigid", "spring"])
def test_free_inertia_gives_arms_of_distributed_mass_back(grip):
    reflexes = dict(kv=(4.0, 1.0, 3.0), kp=(12.0, 4.0, 9.0), delay=(0.035, 0.03), cutoff=(2.6, 3.2), zeta=0.9)
    world = dict(load=(1.6, 12.0, 60.0), remnant=0.02, linear=True, seed=5)
    quick = dict(rate=100.0, duration=15.0, period=5.0, rms=0.001)  # so small that other geometries fit as well
    setup = Setup(arm=Arm(grip=grip, **reflexes), **world, **quick)
    structure = composed(inertia="free", grip="rigid" if grip is None else "spring", reflex="position")
    fit = estimate([Group.prepare(setup.recording(), structure)])
    truth = {name.replace("inertia", "i"): value for name, value in setup.truth.items()}
    assert fit.converged
    assert not fit.is_suspicious
    for name in (name for name in structure.free if name in truth):
        assert abs(fit.values[name] - truth[name]) < 3.5 * fit.standard_error[name], name
    for name in ("i_s", "i_se", "i_e", "k_s", "k_se", "k_e"):
        assert fit.standard_error[name] < 0.25 * truth[name], name


def test_tables_tell_the_inertia_of_a_body_of_their_own_mass_distribution():
    segments = anthropometric_body("female", 1.68, 61.0, attached=0.2)
    body = replace(POSITION, l_h=segments["l_h"], l_f=segments["l_f"])
    prior = inertia_prior(body, "female", 1.68, 61.0, attached=0.2, share=0.1)
    inertia = mass_matrix(replace(body, **segments))
    assert [mean for mean, _ in prior.values()] == pytest.approx([inertia[0, 0], inertia[0, 1], inertia[1, 1]])
    assert prior["i_s"][1] == pytest.approx(0.1 * inertia[0, 0])
    structure = composed(inertia="free").knowing(**prior)
    assert structure.prior == prior
    with pytest.raises(ValueError, match="prior of 'i_s', which is not free; expected one of m_tot"):
        composed(inertia="tied").knowing(**prior)


def test_unknown_choices_are_named():
    with pytest.raises(ValueError, match="composed: grip = 'soft'; expected one of rigid, spring"):
        composed(grip="soft")


def test_priors_stay_where_only_bounds_change():
    known = MODEL_3.knowing(m_f=(1.8, 0.3))
    assert with_options(known, bounds=["m_f=1:3"]).prior == {"m_f": (1.8, 0.3)}
    assert edited(known, name="fixed", fixed={"PT": {"m_f": 1.8}, "RT": {"m_f": 1.8}}).prior == {}


@pytest.mark.slow(reason="fits trials")
@pytest.mark.parametrize(("free", "estimator"), [(("m_h",), "record"), (("b_h",), "frequency")])
def test_what_alone_is_free_is_estimated(free, estimator, relax_recording):
    known = {name: getattr(RELAX, name) for name in MODEL_3.free if name not in free}
    structure = MODEL_3.fixing(**known).named("the rest is known")
    fit = estimate([Group.prepare(relax_recording.isel(trial=[0, 1, 2]), structure)], estimator)
    assert fit.converged
    for name in free:
        assert fit.values[name] == pytest.approx(getattr(RELAX, name), rel=0.03)
