"""Synthetic people: draws around the thesis's mean arms."""

from dataclasses import replace
from typing import Any

import numpy as np

from armperturb.analysis.arm_model import largest_real_pole
from armperturb.environment import Environment
from armperturb.subject import HUMERUS_MASS_SHARE, PRESETS, Subject

SPREAD = {
    # Table C.18, model 1.
    "relax": {
        "m_h": 0.39,
        "m_f": 0.42,
        "b_s": 0.25,
        "b_se": 0.19,
        "b_e": 0.23,
        "k_s": 2.6,
        "k_se": 0.9,
        "k_e": 2.0,
        "b_h": 16.6,
        "k_h": 1.77e3,
    },
    # Table E.3, start vartheta_i5; grip, delay and cut-off were fixed. m_tot is shared out as in eqs 2.14, 2.15.
    "position": {
        "m_tot": 0.53,
        "b_s": 1.70,
        "b_se": 3.14,
        "b_e": 6.56,
        "k_s": 42.2,
        "k_se": 61.1,
        "k_e": 120.2,
        "kv_s": 1.8,
        "kv_se": 2.2,
        "kv_e": 8.0,
        "kp_s": 11.8,
        "kp_se": 19.9,
        "kp_e": 47.7,
    },
}
"""Standard deviation over the thesis's subjects of each parameter of a preset, SI."""

STABILITY_MARGIN = 0.5
"""Poles of arm and environment lie left of minus this [1/s]: the shift of the thesis's penalty (eq. 2.21), with which
the published parameters were estimated because arms closer to instability rang on."""

MAX_REDRAWS = 1000


def draw(
    preset: str, seed: int | np.random.Generator, *, name: str | None = None, environment: Environment | None = None
) -> Subject:
    """A person drawn around a preset, each parameter from a normal distribution with the published mean and SD.

    Parameters are independent, as only their means and SDs are published. The person is redrawn as a whole until every
    parameter is in its range, no feedback gain is negative (as in model 3b) and arm and environment are stable together
    with a margin; this narrows the spread a little and shifts the means of wide distributions.

    Args:
      preset: "relax" or "position".
      seed: of the draw, or a generator to draw from.
      name: of the person; the preset's if not given.
      environment: on which the person has to be stable; the thesis's manipulator if not given.

    Raises:
      ValueError: the preset is unknown.
      RuntimeError: no stable person was found, which only an odd environment can cause.
    """
    if preset not in PRESETS:
        raise ValueError(f"preset = {preset!r}; expected one of {', '.join(PRESETS)}")
    rng = np.random.default_rng(seed)
    environment = environment or Environment()
    mean, spread = PRESETS[preset], SPREAD[preset]
    for _ in range(MAX_REDRAWS):
        drawn: dict[str, Any] = {key: rng.normal(_mean(mean, key), sd) for key, sd in spread.items()}
        total = drawn.pop("m_tot", None)
        if total is not None:
            drawn.update(m_h=HUMERUS_MASS_SHARE * total, m_f=(1 - HUMERUS_MASS_SHARE) * total)
        if min(drawn.values()) <= 0:
            continue
        subject = replace(mean, name=name or mean.name, **drawn)
        if largest_real_pole(subject, environment) < -STABILITY_MARGIN:
            return subject
    raise RuntimeError(f"no stable {preset!r} subject in {MAX_REDRAWS} draws on {environment}")


def _mean(preset: Subject, parameter: str) -> float:
    return preset.m_h + preset.m_f if parameter == "m_tot" else getattr(preset, parameter)
