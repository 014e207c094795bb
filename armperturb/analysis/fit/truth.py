"""What a structure makes of an arm whose parameters are known."""

import math
from collections.abc import Mapping

import numpy as np

from armperturb.analysis.arm.parameters import ACTIVE_DAMPING, CUTOFFS, DELAYS, GROUPS, PARAMETERS, parameter_vector
from armperturb.analysis.fit.structures import STRUCTURES, Structure, unit
from armperturb.arrays import Array
from armperturb.subject import Subject

ALIKE = 1e-3
"""Share of a parameter by which an arm may be off a structure and still count as held by it [-]: how files round."""

NOTHING = 1e-9
"""Size below which a parameter is zero but for rounding, SI; the least that matter, delays, are above 1e-3."""

BIASED = "estimates will be biased by more than their standard errors say"


def at_truth(structure: Structure, truth: Subject) -> Structure:
    """The structure with all that it fixes as it is in an arm."""
    return structure.fixing(**{name: getattr(truth, name) for name in structure.fixed[truth.task]})


def true_values(truth: Subject, structure: Structure) -> Array:
    """Values of a structure's free parameters that are nearest to an arm, (parameter,), SI."""
    free = structure.mixing.any(axis=1)
    others = parameter_vector(truth)[free] - structure.constant(truth.task)[free]
    return np.asarray(np.linalg.lstsq(structure.mixing[free], others, rcond=None)[0])


def departures(structure: Structure, truth: Subject) -> tuple[str, ...]:
    """How estimates will miss an arm, a sentence each: by what is not in the structure, and by what `identify` fixes.

    Args:
      structure: that is fitted, with what it fixes at the truth or on purpose elsewhere; named as one of `STRUCTURES`.
      truth: the arm.
    """
    nearest = structure.parameters(truth.task, true_values(truth, structure))
    lacking, other = [], {}
    for name, value in _different(dict(zip(PARAMETERS, nearest.tolist(), strict=True)), nearest, truth).items():
        if abs(value) > NOTHING:
            other[name] = value
        elif (quantity := name.partition("_")[0]) not in lacking:
            lacking.append(quantity)
    remarks = []
    if lacking:
        remarks.append(f"model {structure.name} leaves out {', '.join(lacking)} of {truth.name!r}: {BIASED}")
    if other:
        remarks.append(f"model {structure.name} is not exact for {truth.name!r}: {_beside(other, truth)}; {BIASED}")
    published = _different(STRUCTURES[structure.name].fixed[truth.task], nearest, truth)
    if published:
        fixes = " ".join(f"{name}={_fixable(getattr(truth, name))}" for name in published)
        remarks.append(
            f"identify --model {structure.name} fixes {_beside(published, truth)}: what is said here holds with "
            f"--fix {fixes} only"
        )
    if "i_s" not in structure.free and (rigid := _mass_beside_points(truth)):
        remarks.append(
            f"identify --model {structure.name} takes segments for point masses in their middle, which those of "
            f"{truth.name!r} are not ({rigid}): what is said here holds where that is known alone; without --model, "
            "inertia is free"
        )
    if truth.muscle is not None:
        remarks.append(
            f"no model has the [muscle] of {truth.name!r}: values and errors are those of the linear arm that the "
            "other parameters make"
        )
    return tuple(remarks)


def _mass_beside_points(truth: Subject) -> str:
    """What an arm has in place of point masses in the middle of segments; "" if it has these."""
    point = {name: default for name, default in truth.LEFT_OUT.items() if name != "muscle"}
    values = {name: getattr(truth, name) for name in point}
    return ", ".join(f"{name} = {value:.3g}" for name, value in values.items() if not np.isclose(value, point[name]))


def _different(values: Mapping[str, float], nearest: Array, truth: Subject) -> dict[str, float]:
    """Those of some parameters that differ from an arm's and change its movement, SI.

    Args:
      values: name to the value that a structure has.
      nearest: all parameters of the arm in the structure that is nearest, (parameter,), SI.
      truth: the arm.
    """
    of_reflexes = {*PARAMETERS[DELAYS], *PARAMETERS[CUTOFFS], PARAMETERS[ACTIVE_DAMPING]}
    has_reflexes = any((np.abs(nearest[GROUPS[gain]]) > NOTHING).any() for gain in ("kv", "kp", "ka", "kf"))
    return {
        name: value
        for name, value in values.items()
        if not np.isclose(value, getattr(truth, name), rtol=ALIKE, atol=NOTHING)
        and (has_reflexes or name not in of_reflexes)
    }


def _beside(values: Mapping[str, float], truth: Subject) -> str:
    """Values of parameters, and what the arm has."""
    return ", ".join(
        f"{name} = {value:.4g} instead of {getattr(truth, name):.4g} {unit(name)}" for name, value in values.items()
    )


def _fixable(value: float) -> str:
    """A value as the option --fix of `identify` reads it."""
    return "rigid" if math.isinf(value) else f"{value:.6g}"
