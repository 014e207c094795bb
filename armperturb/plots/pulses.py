"""Figure of pulses: displacement as recorded, and as models predict it."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from armperturb.arrays import Array
from armperturb.plots.style import COLOURS, FITTED, RECORDED, SKELETAL, figure_for, in_style

LOOKS: dict[str, dict[str, Any]] = {
    "nonlinear": {"color": COLOURS["RT"], "linewidth": 1.3},
    "linear": FITTED,
    "skeletal": SKELETAL,
    "predicted": FITTED,
}
"""Model to its line; "predicted" is that of a single model."""

ROW = 1.5
"""Height of a row [inch]."""


class PredictedPulse(NamedTuple):
    """The response to one pulse.

    Attributes:
      title: condition and direction.
      time: from the onset [s], (time,).
      recorded: displacement [m], (time, axis).
      predicted: model (one of `LOOKS`) to the displacement that it predicts [m], (time, axis).
    """

    title: str
    time: Array
    recorded: Array
    predicted: Mapping[str, Array]


@in_style()
def plot_pulses(pulses: Sequence[PredictedPulse], figure: Figure | None = None) -> Any:
    """Displacement along x and y after each pulse.

    Args:
      pulses: at least one.
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Axes, (pulse, axis).
    """
    figure = figure_for(figure, 0.7 + ROW * len(pulses))
    axes = figure.subplots(len(pulses), 2, squeeze=False, sharex="row", sharey="row")
    for row, pulse in zip(axes, pulses, strict=True):
        for axis, (ax, name) in enumerate(zip(row, "xy", strict=True)):
            ax.plot(pulse.time, 1e3 * pulse.recorded[:, axis], **RECORDED, label="recorded")
            for model, look in LOOKS.items():
                if model in pulse.predicted:
                    ax.plot(pulse.time, 1e3 * pulse.predicted[model][:, axis], **look, label=model)
            ax.set_title(f"{pulse.title}: {name}", loc="left", parse_math=False)
            ax.set_ylabel("displacement [mm]" if axis == 0 else "")
    for ax in axes[-1]:
        ax.set_xlabel("time from the onset [s]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
    return axes
