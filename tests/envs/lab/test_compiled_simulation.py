"""The compiled engine against MuJoCo: noisy, yielding people with all instruments, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from armperturb.cohort import average_person, draw_person
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Environment, Strap
from armperturb.envs.lab.compiled_simulation import CompiledSimulation
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine, MultisineThenPulse, Pulse
from armperturb.subject import POSITION, RELAX

PULSE = Pulse(peak=20.0, direction_deg=20.0, onset=0.2, duration=1.5)
FEEDBACK = replace(POSITION, name="feedback", kf_s=-0.5, kf_e=-0.3, ka_e=0.3, c_h=0.58, c_f=0.62, r_h=0.27, r_f=0.36)
OPPOSED = replace(RELAX, name="opposed", k_s=80.0, k_se=-30.0, k_e=70.0, b_s=3.0, b_se=-0.8, b_e=2.5)
QUIET = Instruments(force_noise=0.0, encoder_bits=32, marker_noise=None)


def trials(duration=1.0):
    people = [draw_person(0, 1).subjects["PT"], average_person().subjects["RT"], FEEDBACK, OPPOSED]
    return [
        Trial(
            subject=person,
            perturbation=MultisineThenPulse.join(
                Multisine.draw(seed=seed, rms=4.0 if person.task == "PT" else 0.6, duration=duration, crested=False),
                peak=60.0 if person.task == "PT" else 15.0,
                direction_deg=200.0,
                tail=0.5,
            ),
            noise=HUMAN_NOISE[person.task],
            seed=seed,
        )
        for seed, person in enumerate(people)
    ]


def test_recordings_are_those_of_mujoco():
    everyone = trials()
    ours, mujocos = (run_experiment(everyone, engine=engine, instruments=QUIET) for engine in ("compiled", "mujoco"))
    for name in ("displacement", "force", "joint_angle", "emg"):
        for one, other in zip(ours[name].values, mujocos[name].values, strict=True):
            moved = np.abs(other - other[0]).max()
            rounding = 1.01 * QUIET.emg.adc_step if name == "emg" else 0.0
            assert np.abs(one - other).max() < 2e-4 * moved + rounding, name
    for name in ("perturbation", "limit_time", "pulse_onset"):
        np.testing.assert_array_equal(ours[name].values, mujocos[name].values)


def test_a_trial_is_the_same_to_the_last_bit_alone_and_at_any_number_of_threads():
    everyone = trials(0.4) * 3
    together = run_experiment(everyone, engine="compiled", n_threads=1)
    assert run_experiment(everyone, engine="compiled", n_threads=3).identical(together)
    for i in (0, 5, 11):
        alone = run_experiment(everyone[i : i + 1], engine="compiled")
        for name in ("force", "displacement", "joint_angle"):
            np.testing.assert_array_equal(alone[name].values[0], together[name].values[i])


def test_the_workspace_limit_is_reported_when_mujoco_reports_it():
    hard = Trial(subject=RELAX, perturbation=replace(PULSE, peak=600.0))
    ours, mujocos = (run_experiment([hard], engine=engine)["limit_time"].item() for engine in ("compiled", "mujoco"))
    assert ours == pytest.approx(mujocos, abs=1e-9)


def test_what_cannot_be_integrated_is_refused():
    with pytest.raises(RuntimeError, match="trial 0 of subject 'relax' could not be integrated"):
        run_experiment([Trial(subject=RELAX, perturbation=replace(PULSE, peak=1e300))], engine="compiled")


def test_a_delay_beyond_what_is_remembered_is_refused():
    simulation = CompiledSimulation([RELAX], Environment(), timestep=2.5e-3)
    with pytest.raises(ValueError, match=r"delay = 0\.5 s; expected at most 0\.3125 s"):
        simulation.replace(np.zeros(1, dtype=int), [replace(RELAX, Td_s=0.5)])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rope": "pendulum"}, "rope = 'pendulum' with engine = 'compiled'; expected engine = 'mujoco'"),
        ({"strap": Strap()}, r"strap = Strap\(.*\) with engine = 'compiled'; expected engine = 'mujoco'"),
        ({"engine": "fast"}, "engine = 'fast'; expected one of mujoco, compiled"),
    ],
)
def test_what_the_engine_has_not_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        run_experiment([Trial(subject=RELAX, perturbation=PULSE)], Environment(), **{"engine": "compiled", **options})


def test_an_arm_that_diverges_beyond_the_workspace_leaves_a_whole_recording():
    pulse = Pulse(peak=5000.0, direction_deg=20.0, onset=0.3, duration=1.0)
    trial = Trial(subject=POSITION, perturbation=pulse)
    recording = run_experiment([trial], engine="compiled", instruments=Instruments())
    assert 0.3 < float(recording["limit_time"][0]) < 0.5
    for name in ("displacement", "joint_angle", "force", "emg"):
        assert np.isfinite(recording[name].values).all(), name
