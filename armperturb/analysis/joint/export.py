"""Results of the identification of a joint as files that any other program reads."""

import json
import math
from pathlib import Path
from typing import Any

from armperturb.analysis.joint.identify import JointIdentification
from armperturb.files import write_csv, written_together


def joint_summary(result: JointIdentification) -> dict[str, Any]:
    """How the identification went, ready for JSON; a number that does not exist is None."""
    free = result.free_model
    return {
        "model": "joint",
        **result.labels,
        "structure": result.structure.name,
        "reflex": result.structure.reflex,
        "servo": result.servo,
        "status": result.message,
        "converged": result.converged,
        "VAF": dict(result.vaf),
        "fit_until_s": result.fit_until,
        "held_out_vaf": result.held_out_vaf,
        "held_out_vaf_by_model": dict(result.held_out),
        "predicted_by": result.predicted_by,
        "free_model_left_out_vaf": None if free is None else free.left_out_vaf,
        "lack_of_fit": {**result.lack_of_fit._asdict(), "p": result.lack_of_fit.p_value},
        "intrinsic_check": None
        if result.intrinsic is None
        else {
            "lag_s": result.intrinsic.lag.tolist(),
            "response": result.intrinsic.response.tolist(),
            "left_out_vaf": result.intrinsic.left_out_vaf,
            "structured_vaf": result.intrinsic.structured_vaf,
        },
        "trial_spread": dict(result.trial_spread),
        "band_Hz": list(result.band),
        "at_bound": list(result.at_bound),
        "remarks": [result.sentence, *result.remarks],
        "structures_tried": [
            {"structure": each.estimate.structure.name, "score": each.score, "loss": each.estimate.loss}
            for each in result.tried
        ],
        "profiles": {
            name: {"value": profile.values.tolist(), "rise": profile.rise.tolist()}
            for name, profile in result.profiles.items()
        },
        "correlation": {
            "parameters": list(result.values),
            "matrix": [
                [value if math.isfinite(value) else None for value in row] for row in result.correlation.tolist()
            ],
        },
        "environment": None if result.environment is None else result.environment._asdict(),
    }


def write_joint(result: JointIdentification, folder: str | Path) -> list[Path]:
    """Write `parameters.csv`, `fit.json` and `joint.svg` into a folder, which is made if needed.

    Returns:
      The paths written.

    Raises:
      OSError: the folder cannot be made or written to.
    """
    from armperturb.plots.style import new_figure, svg

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    figure = new_figure(1.0)
    result.plot(figure)
    paths = [folder / name for name in ("parameters.csv", "fit.json", "joint.svg")]
    with written_together(paths) as (parameters, fit, drawn):
        write_csv(result.to_frame(), parameters)
        fit.write_text(json.dumps(joint_summary(result), indent=2, allow_nan=False) + "\n", encoding="utf-8")
        drawn.write_bytes(svg(figure))
    return paths
