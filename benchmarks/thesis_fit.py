"""Time of the thesis's fit against scipy's `least_squares` with numerical derivatives on a plain loop over frequencies.

Run by `python -m benchmarks.thesis_fit`; about 1 min. All minimise the criterion of eq. 2.19 (with penalty and Pade
delay), model 3b from vartheta_i5, on the same noisy admittances of linear people. "plain" and "published" do it on the
modulus with the tolerances of appendix C; "fit" is `fit_admittance` as it comes, which goes on to the minimum. Time is
that of the processor, as others may use the machine.
"""

import time
import timeit
from collections.abc import Callable

import numpy as np
from scipy import optimize

from armperturb.analysis.arm.geometry import hand_jacobian, mass_matrix
from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.analysis.fit.admittance_fit import fit_admittance
from armperturb.analysis.fit.admittance_problem import Target, checked_problem, penalty_factor
from armperturb.analysis.fit.structures import STRUCTURES
from armperturb.analysis.fit.thesis import VARTHETA
from armperturb.cohort import draw_cohort
from armperturb.environment import Environment
from armperturb.subject import Subject

N_PEOPLE = 6
FREQUENCY = np.array([0.3, 0.7, 1.1, 1.4, 1.9, 2.2, 2.6, 3.1, 3.7, 4.3, 5.1, 6.1, 7.2, 10.1, 14.2, 20.0, 28.3, 39.9])
NOISE = 0.35
"""SD of real and imaginary part of the log error, which gives the criterion that drawn people's trials have."""

STRUCTURE, ENVIRONMENT = STRUCTURES["3b"], Environment()
START = np.array(list(VARTHETA["vartheta_i5"].values()))


def admittance_in_a_loop(arm: Subject) -> np.ndarray:
    """The arm's admittance as one would write it down, frequency by frequency."""
    jacobian, mass = hand_jacobian(arm), mass_matrix(arm)
    out = np.empty((len(FREQUENCY), 2, 2), complex)
    for k, f in enumerate(FREQUENCY):
        s = 2j * np.pi * f
        reflex = np.zeros((2, 2), complex)
        for joint, (delay, cutoff) in enumerate(((arm.Td_s, arm.fact_s), (arm.Td_e, arm.fact_e))):
            u, omega = s * delay, 2 * np.pi * cutoff
            pade = (120 - 60 * u + 12 * u**2 - u**3) / (120 + 60 * u + 12 * u**2 + u**3)
            reflex[joint, joint] = pade * omega**2 / (s**2 + 2 * arm.zeta_act * omega * s + omega**2)
        feedback = arm.joint_matrix("kv") * s + arm.joint_matrix("kp")
        impedance = mass * s**2 + arm.joint_matrix("b") * s + arm.joint_matrix("k") + reflex @ feedback
        out[k] = jacobian @ np.linalg.inv(impedance) @ jacobian.T + np.eye(2) / (arm.b_h * s + arm.k_h)
    return out


def error_in_a_loop(admittance: np.ndarray, body: Subject) -> Callable[[np.ndarray], np.ndarray]:
    """Error of eq. 2.18 times penalty, as a function of the parameters over their start."""

    def error(v: np.ndarray) -> np.ndarray:
        arm = STRUCTURE.arm(body, v * START)
        penalty = penalty_factor(largest_real_pole(arm, ENVIRONMENT))
        return np.abs(np.log(admittance / admittance_in_a_loop(arm))).ravel() * penalty

    return error


def plain_fit(admittance: np.ndarray, body: Subject) -> float:
    """Criterion."""
    error = error_in_a_loop(admittance, body)
    bounds = tuple(np.array(list(STRUCTURE.bounds.values())).T / START)
    result = optimize.least_squares(
        error, np.ones(13), bounds=bounds, diff_step=1e-4, ftol=1e-5, xtol=1e-6, gtol=None, max_nfev=428
    )
    return float(np.mean(result.fun**2))


def our_fit(admittance: np.ndarray, body: Subject, *, as_published: bool) -> float:
    """Criterion."""
    start = VARTHETA["vartheta_i5"]
    return fit_admittance(
        FREQUENCY, admittance, body, STRUCTURE, ENVIRONMENT, initial=start, as_published=as_published, delay="pade"
    ).criterion


def main() -> None:
    rng = np.random.default_rng(0)
    spent = {"plain": 0.0, "published": 0.0, "fit": 0.0}
    print(f"{'person':8}" + "".join(f"{name + ': V':>14} {'time':>9} {'ratio':>6}" for name in spent))
    for person in draw_cohort(N_PEOPLE, 0, muscles="linear"):
        arm = person.subjects["PT"]
        noise = rng.normal(size=(2, len(FREQUENCY), 2, 2))
        admittance = arm_admittance(arm, FREQUENCY, "pade") * np.exp(NOISE * (noise[0] + 1j * noise[1]))
        methods = {
            "plain": lambda h=admittance, arm=arm: plain_fit(h, arm),
            "published": lambda h=admittance, arm=arm: our_fit(h, arm, as_published=True),
            "fit": lambda h=admittance, arm=arm: our_fit(h, arm, as_published=False),
        }
        line, own = f"{person.name:8}", {}
        for name, method in methods.items():
            begin = time.process_time()
            criterion = method()
            own[name] = time.process_time() - begin
            spent[name] += own[name]
            line += f"{criterion:14.4f} {1e3 * own[name]:6.0f} ms {own['plain'] / own[name]:6.1f}"
        print(line)
    for name in ("published", "fit"):
        print(f"{name}: {spent['plain'] / spent[name]:.0f} times faster than plain")

    arm = draw_cohort(1, 0, muscles="linear")[0].subjects["PT"]
    admittance = arm_admittance(arm, FREQUENCY)
    target = Target(frequency=FREQUENCY, admittance=admittance, body=arm, environment=ENVIRONMENT)
    problem = checked_problem(target, STRUCTURE, "pade")
    plain_error = error_in_a_loop(admittance, arm)
    ours = seconds(lambda: (problem.residual(START, True), problem.jacobian(START, True)))
    plain = seconds(lambda: optimize.approx_fprime(np.ones(13), plain_error, 1e-4))
    print(
        f"errors and their derivatives once: {1e3 * plain:.1f} ms plain, {1e3 * ours:.2f} ms ours: {plain / ours:.0f}"
    )


def seconds(function: Callable[[], object]) -> float:
    """Best of five means."""
    return min(timeit.repeat(function, timer=time.process_time, number=20, repeat=5)) / 20


if __name__ == "__main__":
    main()
