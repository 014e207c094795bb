"""Figure of pulses that a fit has left out: as recorded, and as models predict them."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from armperturb.analysis.nonlinear.prediction import PulsePrediction
from armperturb.plots.style import COLOURS, FITTED, RECORDED, SKELETAL, in_style, new_figure

LOOKS: dict[str, dict[str, Any]] = {
    "nonlinear": {"color": COLOURS["RT"], "linewidth": 1.3},
    "linear": FITTED,
    "skeletal": SKELETAL,
}
"""Model to its line."""

ROW = 1.5
"""Height of a row [inch]."""


@in_style()
def pulses_figure(pulses: Mapping[str, Sequence[PulsePrediction]]) -> Figure:
    """Displacement along x and y after the first left-out pulse of each condition and direction.

    Args:
      pulses: model to its predictions of the same pulses.
    """
    models = [model for model in LOOKS if model in pulses]
    first: dict[tuple[str, float], int] = {}
    for i, one in enumerate(pulses[models[0]]):
        first.setdefault((one.condition, one.direction_deg), i)
    figure = new_figure(0.7 + ROW * len(first))
    axes = figure.subplots(len(first), 2, squeeze=False, sharex="row", sharey="row")
    for row, ((condition, direction), i) in zip(axes, first.items(), strict=True):
        for axis, (ax, name) in enumerate(zip(row, "xy", strict=True)):
            recorded = pulses[models[0]][i]
            ax.plot(recorded.time, 1e3 * recorded.recorded[:, axis], **RECORDED, label="recorded")
            for model in models:
                ax.plot(recorded.time, 1e3 * pulses[model][i].predicted[:, axis], **LOOKS[model], label=model)
            ax.set_title(f"{condition}, pulse at {direction:g} deg: {name}", loc="left")
            ax.set_ylabel("displacement [mm]" if axis == 0 else "")
    for ax in axes[-1]:
        ax.set_xlabel("time from the onset [s]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
    return figure
