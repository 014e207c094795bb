"""Whether an arm is told from people, and people from nobody."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy import signal

import armperturb as ap
from armperturb.analysis.trials import prepared_condition
from armperturb.study.comparison.likeness import _under_the_same_forces, impedance_matrices


def linear_trial(subject, rms=3.0):
    perturbation = ap.Multisine.draw(rms=rms, seed=0, crested=False)
    return ap.run_experiment([ap.Trial(subject=subject, perturbation=perturbation)], linear=True)


def test_the_matrices_of_a_mass_spring_and_damper_are_found():
    frequency = np.array([0.5, 1.0, 2.0, 4.0, 9.0])
    s = 2j * np.pi * frequency[:, None, None]
    truth = {"stiffness": [[300.0, 40.0], [60.0, 200.0]], "damping": [[9.0, 1.0], [1.0, 7.0]]}
    truth["inertia"] = [[1.5, 0.2], [0.2, 1.0]]
    stiffness, damping, inertia = map(np.array, truth.values())
    impedance = stiffness + s * damping + s**2 * inertia
    impedance[-1] *= 3.0  # above the frequencies that count
    fitted = impedance_matrices(frequency, np.linalg.inv(impedance))
    for name, matrix in truth.items():
        np.testing.assert_allclose(fitted[name], matrix, rtol=1e-9)


@pytest.mark.slow(reason="draws people and simulates a trial of each")
def test_a_person_is_human_and_an_arm_of_iron_is_not():
    human = ap.compare(linear_trial(ap.POSITION), "thesis", ideal=True)
    assert all(human.is_human(group) for group in human.distance), human.distance
    iron = linear_trial(replace(ap.POSITION, k_s=3000.0, k_e=3000.0, b_s=90.0, b_e=90.0, m_f=8.0))
    for reference in ("thesis", "people"):
        told_apart = ap.compare(iron, reference, ideal=True)
        assert not any(told_apart.is_human(group) for group in told_apart.distance), told_apart.distance
        assert "not as people's" in repr(told_apart)
        assert set(told_apart.to_frame()["group"]) == {"admittance", "ellipses", "parameters"}
        assert [set(told_apart.to_frame()[name]) for name in ("condition", "subject")] == [{"PT"}, {"position"}]
        assert len(told_apart.plot()) == 2
    data = human.to_xarray()
    assert data["reference_gains"].dims == ("person", "frequency", "gain")
    np.testing.assert_array_equal(data["gains"].sel(gain="larger"), human.gains[:, 0])
    assert (data["gains"].sel(gain="larger") >= data["gains"].sel(gain="smaller")).all()


@pytest.mark.slow(reason="draws people and simulates a trial of each")
def test_noise_tells_a_person_from_an_arm_of_iron():
    white = np.random.default_rng(3).standard_normal((round(30.0 * 200.0), 2))
    force = ap.Sampled(
        force=6.0 * signal.sosfilt(signal.butter(2, 12.0, fs=200.0, output="sos"), white, axis=0), rate=200.0
    )
    for k, is_human in ((1.0, True), (15.0, False)):
        arm = replace(ap.POSITION, k_s=k * ap.POSITION.k_s, k_e=k * ap.POSITION.k_e, m_f=k**0.5 * ap.POSITION.m_f)
        recording = ap.run_experiment([ap.Trial(subject=arm, perturbation=force)], linear=True)
        likeness = ap.compare(recording, "thesis", ideal=True)
        assert len(likeness.frequency) > 20
        assert {likeness.is_human(group) for group in likeness.distance} == {is_human}, likeness.distance


@pytest.mark.slow(reason="analyses several studies")
def test_signs_that_no_handle_has_are_remarked_on():
    recording = linear_trial(ap.POSITION)
    likeness = ap.compare(recording, "thesis", ideal=True)
    assert likeness.remarks == ()
    assert [ax.get_title() for ax in ap.plot(likeness, figure=Figure())] == ["largest gain", "smallest gain"]
    turned = ap.compare(recording.assign(force=-recording["force"]), "thesis", ideal=True)
    assert "as it would if the sign of force were turned" in turned.summary()


@pytest.mark.slow(reason="draws people and simulates trials of each")
@pytest.mark.parametrize(("task", "n_trials"), [("PT", 1), ("RT", 2)])
def test_noise_pulses_and_few_trials_make_nobody_inhuman(task, n_trials):
    person, force = ap.draw_person(764, 0).subjects[task], {"PT": 5.4, "RT": 0.9}[task]
    multisines = [ap.Multisine.draw(rms=force, seed=seed, crested=False) for seed in range(1, 1 + n_trials)]
    trials = [
        ap.Trial(
            subject=person,
            perturbation=ap.MultisineThenPulse.join(multisine, peak=50.0, direction_deg=20.0),
            seed=seed,
            noise=ap.HUMAN_NOISE[task],
        )
        for seed, multisine in enumerate(multisines)
    ]
    recording = ap.run_experiment(trials, engine="compiled", instruments=ap.Instruments(emg=None))
    likeness = ap.compare(recording, "people", seed=5)
    assert all(likeness.is_human(group) for group in likeness.distance), likeness.distance


@pytest.mark.slow(reason="simulates trials")
@pytest.mark.slow(reason="simulates people")
def test_people_hold_what_the_recorded_hand_held():
    """On a stiff manipulator people move less, and are stiffer, than the same force would make them on the thesis's."""
    stiff = ap.Environment(m_env=1.0, b_env=20.0, k_env=300.0)
    person = ap.draw_person(77, 0).subjects["RT"]
    trials = [
        ap.Trial(subject=person, perturbation=ap.Multisine.draw(rms=2.5, seed=seed, crested=False)) for seed in range(2)
    ]
    likeness = ap.compare(ap.run_experiment(trials, stiff, engine="compiled"), ideal=True)
    assert {likeness.is_human(group) for group in likeness.distance} == {True}, likeness.distance
    assert not any("workspace" in remark for remark in likeness.remarks)


def test_people_have_the_same_noise_in_whatever_order_trials_come():
    multisines = [ap.Multisine.draw(rms=3.0, seed=seed, crested=False) for seed in (0, 1)]
    trials = ap.run_experiment(
        [ap.Trial(subject=ap.RELAX, perturbation=each) for each in multisines], engine="compiled"
    )
    people, options = [ap.RELAX] * 2, {"linear": True, "ideal": False}
    before, after = (
        _under_the_same_forces(people, prepared_condition(each), 7, **options)
        for each in (trials, [trials.isel(trial=[1]), trials.isel(trial=[0])])
    )
    forces = [[part["force"].values for part in person] for person in before]
    np.testing.assert_array_equal([[part["force"].values for part in person] for person in after], forces)
    assert not np.array_equal(*forces)  # of two people, the noise differs


@pytest.mark.slow(reason="draws people and simulates a trial of each")
def test_people_who_leave_the_workspace_are_left_out():
    likeness = ap.compare(linear_trial(ap.RELAX, rms=4.2), "people")
    (remark,) = [line for line in likeness.remarks if "leave the workspace" in line]
    n_gone = int(remark.split()[0])
    assert 0 < n_gone <= 8
    assert len(likeness.reference_gains) == 16 - n_gone
    with pytest.raises(ValueError, match=r"of the 16 people .* expected forces that at least 8 bear"):
        ap.compare(linear_trial(ap.POSITION, rms=30.0).assign_coords(task=("trial", ["RT"])), "people")


def test_an_unknown_reference_is_refused():
    with pytest.raises(ValueError, match="reference = 'apes'; expected one of thesis, people"):
        ap.compare(None, "apes")


def test_a_posture_that_nobody_has_is_refused_with_the_option_that_mends_it():
    turned = linear_trial(ap.POSITION).assign_coords(theta_s_deg=("trial", [-130.0]))
    with pytest.raises(ValueError, match=r"theta_s_deg = -130\.0; expected .* at least -90 .*--turn-deg"):
        ap.compare(turned, "thesis")


def test_a_seed_that_is_none_is_refused_as_such():
    for seed, message in ((-1, "seed = -1; expected .* at least 0"), (1.5, "seed = 1.5; expected a whole number")):
        with pytest.raises((TypeError, ValueError), match=f"compare: {message}"):
            ap.compare(None, "thesis", seed=seed)
