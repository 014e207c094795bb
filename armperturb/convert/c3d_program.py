"""Run as a program: unpacks a C3D file to NumPy's format on standard output.

A process of its own, and one that needs nothing of this package: on damaged files the library crashes, and would take
the caller with it.
"""

import io
import sys
from typing import Any

import numpy as np


def unpack(path: str) -> dict[str, Any]:
    """Rates, labels, units and values of a C3D file; values of markers are NaN where they are not seen.

    Raises:
      Exception: of any kind, if the file is damaged.
    """
    import ezc3d

    content = ezc3d.c3d(path)
    data, parts = content["data"], {}
    values = {"POINT": np.asarray(data["points"][:3]), "ANALOG": np.asarray(data["analogs"][0])}
    seen = np.asarray(data["meta_points"]["residuals"][0]) >= 0.0
    values["POINT"] = np.where(seen[None], values["POINT"], np.nan)
    for group, of_group in values.items():
        parameters = content["parameters"][group]
        parts[f"{group}.values"] = of_group
        for name, kind in (("RATE", float), ("LABELS", str), ("UNITS", str)):
            parts[f"{group}.{name}"] = np.array(parameters[name]["value"] if name in parameters else [], dtype=kind)
    return parts


if __name__ == "__main__":
    out = io.BytesIO()
    try:
        np.savez(out, **unpack(sys.argv[1]))
    except Exception as error:
        sys.exit(f"{error}")
    sys.stdout.buffer.write(out.getvalue())
