"""Arms with which JavaScript and Python are compared, and what Python makes of them."""

import json
import math
from dataclasses import asdict, replace

import numpy as np

from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.arm.state_space import fastest_pole, largest_real_pole
from armperturb.cohort import average_person
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.trial import RK4_LIMIT, Trial
from armperturb.live.page import arm_values
from armperturb.perturbations.multisine import Multisine
from armperturb.perturbations.pulse import Pulse
from armperturb.subject import POSITION, RELAX, at_level

FREQUENCY = np.geomspace(0.15, 45.0, 40)
TIMESTEP, DURATION, PEAK, DIRECTION, ONSET = 2.5e-3, 1.2, 54.0, 200.0, 0.1
FORCES = ("pulse", "multisine")
MOST_PARTS = 16
PARTS = (1, 2, 4, 8, MOST_PARTS)
LOAD = Environment(m_env=4.0, b_env=3.0, k_env=60.0)
MULTISINE = Multisine.draw(seed=0, rms=3.0, crested=False)


def compared():
    """Linear and lawful muscles, with and without reflexes, uneven delays, other segments and postures."""
    average = average_person().subjects
    odd = replace(POSITION, Td_s=0.0413, Td_e=0.033, fact_e=2.5, zeta_act=1.2, theta_e_deg=60.0, r_f=0.3, c_f=0.45)
    one_way = replace(average["PT"].muscle, spindle_direction=0.5, spindle_threshold=0.05, elastic_limit_slope=0.01)
    arms = (POSITION, RELAX, *average.values(), at_level(average["PT"], 1.6), odd)
    return [*arms, replace(average["PT"], muscle=one_way)]


def values_of(subject):
    """What the page has of it, and the load; None where a value is infinite."""
    return {**arm_values(subject), **asdict(LOAD)}


def too_fast():
    """Arms that the page's sliders make: too fast for whole steps, up to where the page refuses them."""
    average = average_person()
    person, held = average.subjects["PT"], at_level(average.subjects["PT"], average.levels["PT22.5"])
    return [damped(at_level(person, 3.0), 2.0), damped(held, 4.0), damped(POSITION, 8.0), damped(POSITION, 200.0)]


def damped(subject, factor):
    return replace(subject, **{f"b_{place}": factor * getattr(subject, f"b_{place}") for place in ("s", "se", "e")})


GIVEN = {
    "pulse": [PEAK, DIRECTION, ONSET, DURATION],
    "multisine": [
        *(values.tolist() for values in (MULTISINE.frequencies, MULTISINE.amplitudes, MULTISINE.phases)),
        DURATION,
    ],
    "frequency": FREQUENCY.tolist(),
}

REVIVE = (
    f"const given = {json.dumps(GIVEN)};"
    + """
const revive = arm => ({...arm, muscle: arm.muscle && Object.fromEntries(Object.entries(arm.muscle).map(
  ([name, value]) => [name, Array.isArray(value) ? value.map(each => each === null ? Infinity : each) : value]))});
const path = moved => moved.log.x.map((x, i) => [x, moved.log.y[i]]);
const pulse = arm => ArmModel.move(arm, timestep => ArmModel.pulse(...given.pulse, timestep));
const multisine = arm => ArmModel.move(arm, timestep => ArmModel.multisine(...given.multisine, timestep));
const answer = (arm, pulsed) => ({
  admittance: given.frequency.map(frequency => ArmModel.admittance(arm, frequency)),
  pole: ArmModel.largestRealPole(arm),
  fastest: ArmModel.fastestPole(arm),
  parts: pulsed.parts,
  ended: pulsed.log.ended,
  torn: ArmModel.move(arm, timestep => ArmModel.pulse(1e15, 0, 0.1, 0.2, timestep)).log.ended,
  pulse: path(pulsed),
  multisine: path(multisine(arm)),
});
const answers = arms => arms.map(revive).map(arm => answer(arm, pulse(arm)));
"""
)
"""JavaScript that answers for arms as `values_of` gives them."""


def simulated(subject, parts=1):
    """Displacement in the laboratory by a pulse and a multisine, (force, time, axis), in parts of a step."""
    pulse = Pulse(peak=PEAK, direction_deg=DIRECTION, onset=ONSET, duration=DURATION)
    perturbations = (pulse, replace(MULTISINE, duration=DURATION))
    recording = run_experiment(
        [Trial(subject=subject, perturbation=perturbation) for perturbation in perturbations],
        LOAD,
        timestep=TIMESTEP / parts,
        rate=1.0 / TIMESTEP,
        engine="compiled",
    )
    return recording["displacement"].values[:, :-1]  # the last one is where the multisine is cut off


def require_agreement(subjects, answers):
    """Admittance within 1e-6, poles too, and movements within 1e-9 of the largest; in finer steps, within 0.5 %."""
    for subject, answer in zip(subjects, answers, strict=True):
        admittance = np.array(answer["admittance"]).reshape(-1, 2, 2, 2)
        expected = arm_admittance(subject, FREQUENCY)
        off = np.abs(admittance[..., 0] + 1j * admittance[..., 1] - expected)
        assert (off <= 1e-6 * np.abs(expected)).all()
        assert math.isclose(answer["pole"], largest_real_pole(subject, LOAD), rel_tol=1e-6)
        assert math.isclose(answer["fastest"], fastest_pole(subject, LOAD), rel_tol=1e-6)
        # As the laboratory cuts the step of a trial.
        needed = fastest_pole(subject, LOAD) * TIMESTEP / RK4_LIMIT
        if needed > MOST_PARTS:
            assert (answer["ended"], answer["pulse"]) == ("fast", [[0.0, 0.0]])
            continue
        assert answer["torn"] == "diverged"
        assert (answer["ended"], answer["parts"]) == ("", next(parts for parts in PARTS if parts >= needed))
        expected, finer = (simulated(subject, parts) for parts in (answer["parts"], 4 * answer["parts"]))
        for name, path, same, right in zip(FORCES, (answer[name] for name in FORCES), expected, finer, strict=True):
            path = np.array(path)[: len(same)]
            assert path.shape == same.shape, name
            assert np.abs(path - same).max() <= 1e-9 * np.abs(same).max(), name
            assert np.abs(path - right).max() <= 5e-3 * np.abs(right).max(), name
