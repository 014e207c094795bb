"""Bodies from tables: lengths, masses and mass distribution of the arm by sex, height and body mass."""

from typing import Literal, get_args

import numpy as np

from armperturb.files import packaged_table
from armperturb.validation import require_number, require_one_of

Sex = Literal["male", "female"]
Source = Literal["de Leva", "Winter"]

_TABLES = packaged_table(__package__, "anthropometry.toml")


def anthropometric_body(
    sex: Sex, height: float, mass: float, source: Source = "de Leva", *, attached: float = 0.0
) -> dict[str, float]:
    """Segment lengths, masses, centres of mass and radii of gyration as fields of a `Subject`.

        replace(RELAX, **anthropometric_body("female", 1.68, 61.0))

    Forearm and hand are one rigid segment that ends at the middle of the grip. The fist is assumed to close about the
    handle so that the hand's centre of mass is there; a cuff that keeps the wrist straight, and the part of the handle
    that the force sensor does not see, are a point there.

    Args:
      sex: "male" or "female"; the tables of Winter have the same values for both.
      height: [m].
      mass: of the whole body [kg].
      source: "de Leva" (1996) or "Winter" (2009); `anthropometry.toml` has the values, and the axis that they are for.
      attached: mass of cuff and handle that moves with the hand [kg].

    Raises:
      TypeError: height, mass or attached is no number.
      ValueError: sex or source is unknown, or a number is out of its range.
    """
    require_one_of("anthropometric_body", "sex", sex, get_args(Sex))
    require_one_of("anthropometric_body", "source", source, get_args(Source))
    # Beyond these a number is a slip of the unit.
    require_number("anthropometric_body", "height", height, at_least=0.5, at_most=2.5)
    require_number("anthropometric_body", "mass", mass, at_least=5.0, at_most=300.0)
    require_number("anthropometric_body", "attached", attached, at_least=0.0)
    humerus, forearm, hand = (_TABLES[source][sex][segment] for segment in ("humerus", "forearm", "hand"))
    l_f = (forearm["length"] + hand["centre"] * hand["length"]) * height
    masses = np.array([forearm["mass"] * mass, hand["mass"] * mass, attached])
    places = np.array([forearm["centre"] * forearm["length"] * height, l_f, l_f])
    radii = np.array([part["radius"] * part["length"] * height for part in (forearm, hand)] + [0.0])
    m_f = float(masses.sum())
    centre = float(masses @ places) / m_f
    inertia = float(masses @ (radii**2 + (places - centre) ** 2))
    return {
        "l_h": humerus["length"] * height,
        "l_f": l_f,
        "m_h": humerus["mass"] * mass,
        "m_f": m_f,
        "c_h": humerus["centre"],
        "c_f": centre / l_f,
        "r_h": humerus["radius"],
        "r_f": float(np.sqrt(inertia / m_f)) / l_f,
    }
