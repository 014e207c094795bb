"""mujoco.sysid as a judge: one least-squares problem, solved by it on the MJCF arm and by us on the compiled arm.

Run by `python -m benchmarks.sysid`; about half a minute. It needs more than the package: pip install "mujoco[sysid]".

A relaxed person without a muscle law (model 1: stiffness and damping of the three muscle groups, masses, grip) is held
by a handle that a multisine moves for some seconds. The laboratory simulates the truth; white noise is added to the
displacement of the handle. Both sides minimise the same sum of squares: displacement of the handle, x and
y each over its own norm, without weights, from the same start 30 % off:

- sysid compiles an MJCF model per parameter change, rolls it out and takes finite differences of parameters;
- ours steps lanes of compiled equations of motion and takes finite differences of their logarithms (`least_squares` of
  scipy).

Both step by 0.5 ms on one core. An evaluation is one simulation of the record by one set of parameters, time is that of
the processor, and both costs are ours, so that they may be compared.
"""

import io
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from armperturb.analysis.nonlinear.model import BOUNDS, Model, person, true_values
from armperturb.cohort import draw_person
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.trial import Trial
from armperturb.models.rig import ANGLE_SENSORS, BIARTICULAR, GRIP, KNOWN, REFLEXES, SLIDES, STRAIN_GAUGE, build_spec
from armperturb.perturbations import Multisine
from armperturb.planar_arm.lanes import lane_table
from armperturb.planar_arm.simulation import Disturbances
from armperturb.subject import Subject

Array = NDArray[np.float64]

FORCE, SECONDS, RATE = 5.0, 8.0, 200.0
STEP = 5e-4
"""Of both simulations [s]: short, as sysid holds the force over each."""
NOISE = 1e-4
"""SD of white noise on the displacement of the handle [m]."""

OFF = 1.3
"""Start over truth, and truth over start, in turns."""

ENVIRONMENT, BODIES = Environment(), ("humerus", "forearm")
NAMES = Model(law="linear").names("RT", ["RT"])
LOWER, UPPER = np.array([BOUNDS[name.partition(".")[0]] for name in NAMES]).T
LOWER = np.maximum(LOWER, 0.02)  # nothing is negative here


class Found(NamedTuple):
    """An optimum; `values` in the order of `NAMES`."""

    values: Array
    evaluations: int
    seconds: float


class Data(NamedTuple):
    """Truth, disturbance and what was recorded."""

    subject: Subject
    multisine: Multisine
    displacement: Array
    truth: Array


def recorded() -> Data:
    subject = replace(draw_person(0, 0, muscles="linear").subjects["RT"], muscle=None)
    multisine = Multisine.draw(seed=0, rms=FORCE, duration=SECONDS)
    recording = run_experiment([Trial(subject=subject, perturbation=multisine)], ENVIRONMENT, rate=RATE, n_threads=1)
    clean = recording["displacement"].values[0]
    noise = np.random.default_rng(0).normal(scale=NOISE, size=clean.shape)
    noise[0] = 0.0  # at rest, as both sides know
    truth = true_values(subject, {})
    return Data(
        subject=subject,
        multisine=multisine,
        displacement=clean + noise,
        truth=np.array([truth[name] for name in NAMES]),
    )


def norm(data: Data) -> Array:
    """What sysid divides residuals by, (axis,)."""
    return np.linalg.norm(data.displacement[1:], axis=0) / np.sqrt(2.0)


def stepwise(data: Data) -> tuple[int, Array]:
    """Steps per sample, and the disturbance at each step [N], (step, axis)."""
    every = round(1.0 / (RATE * STEP))
    return every, data.multisine.sample(1.0 / STEP, (len(data.displacement) - 1) * every + 1, 0.0)


def our_residual(data: Data) -> Callable[[Array], Array]:
    """Residuals of any number of parameter vectors (vector, parameter), (vector, number)."""
    every, force = stepwise(data)
    disturbances = Disturbances(force[None], 1.0 / STEP)

    def residual(vectors: Array) -> Array:
        people = [person(data.subject, "linear", dict(zip(NAMES, row, strict=True)), "", {}) for row in vectors]
        lanes = lane_table(people, [ENVIRONMENT] * len(people), disturbances.timestep)
        predicted = disturbances.responses(lanes, np.zeros(len(people), np.intp))
        return ((data.displacement - predicted[:, ::every])[:, 1:] / norm(data)).reshape(len(people), -1)

    return residual


def our_fit(data: Data, start: Array) -> Found:
    residual, evaluations = our_residual(data), 0

    def error(point: Array) -> Array:
        nonlocal evaluations
        evaluations += 1
        return residual(np.exp(point)[None])[0]

    def slopes(point: Array) -> Array:
        nonlocal evaluations
        step = 1e-5
        moved = np.vstack([point, point + step * np.eye(len(point))])
        evaluations += len(moved)
        answers = residual(np.exp(moved))
        return (answers[1:] - answers[0]).T / step

    residual(start[None])  # compiles
    begin = time.process_time()
    bounds = (np.log(LOWER), np.log(UPPER))
    result = optimize.least_squares(error, np.log(start), slopes, bounds=bounds, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    return Found(np.exp(result.x), evaluations, time.process_time() - begin)


def write(spec: mujoco.MjSpec, name: str, value: float) -> None:
    """Set a parameter, by its name in `Model`, where the MJCF model has it."""
    quantity, _, element = name.partition(".")
    if quantity in ("m_h", "m_f"):
        spec.body(BODIES[("m_h", "m_f").index(quantity)]).mass = value
    elif quantity in ("k_h", "b_h"):
        for tendon in GRIP:
            (spec.tendon(tendon).stiffness if quantity == "k_h" else spec.tendon(tendon).damping)[0] = value / 2.0
    else:
        muscle = spec.tendon(BIARTICULAR) if element == "two-joint" else spec.joint(element)
        (muscle.stiffness if quantity == "k" else muscle.damping)[0] = value


def handle_spec(subject: Subject) -> mujoco.MjSpec:
    """The rig whose motors push the handle at once and do nothing else, and with no sensor but the handle's."""
    spec = build_spec(subject, ENVIRONMENT, timestep=STEP, rope="ideal", strap=None, visual=False)
    for element in (*map(spec.actuator, (*REFLEXES, *KNOWN)), *map(spec.sensor, (*ANGLE_SENSORS, STRAIN_GAUGE))):
        spec.delete(element)
    for name in SLIDES:
        motor = spec.add_actuator(name=f"push_{name}", target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
    return spec


def sysid_fit(data: Data, start: Array, sysid: Any, **options: Any) -> Found:
    def modifier(name: str) -> Callable[[mujoco.MjSpec, Any], None]:
        return lambda spec, parameter: write(spec, name, float(parameter.value[0]))

    parameters = sysid.ParameterDict(
        {
            name: sysid.Parameter(name, value, low, high, modifier=modifier(name))
            for name, value, low, high in zip(NAMES, start, LOWER, UPPER, strict=True)
        }
    )
    spec = handle_spec(data.subject)
    model = spec.compile()
    every, force = stepwise(data)
    # It holds the force over each step: that of the middle. What sysid is given last only ends the record.
    held = np.vstack([Disturbances(force[None], 1.0 / STEP).force[0, 1::2], force[-1:]])
    control = sysid.TimeSeries.from_control_names(STEP * np.arange(len(held)), held, model)
    sensed = sysid.TimeSeries.from_names(np.arange(len(data.displacement)) / RATE, data.displacement, model)
    initial = sysid.create_initial_state(model, mujoco.MjData(model).qpos)
    sequence = sysid.ModelSequences("arm", spec, "multisine", initial, control, sensed)
    evaluations = 0

    def residual(x: Array, parameters: Any, **more: Any) -> Any:
        nonlocal evaluations
        evaluations += 1 if np.ndim(x) == 1 else np.shape(x)[1]
        return built(x, parameters, **more)

    def left(
        parameters: Any, predicted: Any, measured: Any, model: Any, return_all: bool, *, state: Array, **_: Any
    ) -> Any:
        places = [1 + int(model.joint(name).qposadr[0]) for name in SLIDES]
        moved = state[every - 1 :: every, places]
        return (data.displacement[1:] - moved) / norm(data), sensed, sensed

    built = sysid.build_residual_fn(models_sequences=[sequence], modify_residual=left, n_threads=1, resample_true=False)
    begin = time.process_time()
    result, _ = sysid.optimize(parameters, residual, optimizer="mujoco", verbose=False, output=io.StringIO(), **options)
    return Found(result.as_vector(), evaluations, time.process_time() - begin)


def main() -> None:
    try:
        from mujoco import sysid

        sysid.optimize  # noqa: B018 - the package imports without its extra, but is empty then
    except (ImportError, AttributeError):
        sys.exit('mujoco.sysid is not complete: pip install "mujoco[sysid]" -c constraints.txt')
    data = recorded()
    start = data.truth * OFF ** np.where(np.arange(len(NAMES)) % 2, 1.0, -1.0)
    cost = our_residual(data)
    result = {
        "ours": our_fit(data, start),
        "sysid": sysid_fit(data, start, sysid, x_scale="jac"),
    }
    print(
        f"{'parameter':14}{'true':>10}{'start':>10}" + "".join(f"{name:>12}" for name in result) + f"{'ratio - 1':>12}"
    )
    for i, name in enumerate(NAMES):
        ours, theirs = (entry.values[i] for entry in result.values())
        print(f"{name:14}{data.truth[i]:10.4g}{start[i]:10.4g}{ours:12.6g}{theirs:12.6g}{theirs / ours - 1.0:12.1e}")
    for name, entry in result.items():
        error = np.abs(np.log(entry.values / data.truth)).max()
        print(
            f"{name}: cost {np.sum(cost(entry.values[None]) ** 2):.9g}, {entry.evaluations} evaluations in "
            f"{entry.seconds:.2f} s ({1e3 * entry.seconds / entry.evaluations:.2f} ms each), largest error of a "
            f"parameter {100.0 * error:.1f} %"
        )


if __name__ == "__main__":
    main()
