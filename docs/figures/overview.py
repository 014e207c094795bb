"""The picture at the head of the documentation: the simulated laboratory, and the admittance of one simulated person.

Run `python docs/figures/overview.py PICTURE.png`. It perturbs a person with linear muscles in both tasks, with noise,
identifies the person, and writes the picture of README.md and docs/index.md.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

import armperturb as ap
from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.envs.render.camera import render
from armperturb.models.rig import build_model
from armperturb.perturbations.multisine import PERIOD
from armperturb.plots.panels import AXES, FREQUENCY, label_frequency
from armperturb.plots.style import COLOURS, in_style, new_figure, save_png

PEOPLE = {"PT": (ap.POSITION, "3b", 5.4, "hold position"), "RT": (ap.RELAX, "1", 0.9, "relax")}
"""Task to the person, the model, the RMS force [N] and the name of the task."""

N_TRIALS = 8


def main(picture: Path) -> None:
    save_png(overview(), picture)


@in_style()
def overview() -> Figure:
    """The rig, and the admittance of one person in both tasks: without a model, and of the fitted arm, with 95 % bands.

    Raises:
      RuntimeError: this machine cannot draw the rig; the message names what to install.
    """
    figure = new_figure(4.6, 10.7)
    beside = 0.46
    figure.set_layout_engine("constrained", rect=(beside, 0, 1 - beside, 1))
    ax = figure.add_axes((0, 0, beside - 0.02, 1))
    ax.set_axis_off()
    model = build_model(ap.POSITION, ap.Environment())
    picture = ax.imshow(render(model, camera="oblique", width=1412, height=1380), aspect="auto")
    corners = FancyBboxPatch((0.03, 0.03), 0.94, 0.94, boxstyle="round,pad=0.03", transform=ax.transAxes)
    picture.set_clip_path(corners)

    panels = figure.subplots(2, 1, sharex=True, sharey=True)
    for task, (person, structure, rms, name) in PEOPLE.items():
        trials = [
            ap.Trial(
                subject=person,
                perturbation=ap.Multisine.draw(seed=seed, rms=rms, crested=False),
                noise=HUMAN_NOISE[task],
                seed=seed,
            )
            for seed in range(N_TRIALS)
        ]
        recording = ap.run_experiment(trials, instruments=ap.Instruments(emg=None), engine="compiled")
        fit, colour = ap.identify(recording, model=structure).fit, COLOURS[task]
        fitted, (fit_low, fit_high, *_) = np.abs(arm_admittance(fit.arm, FREQUENCY)), fit.admittance_bands(FREQUENCY)
        estimate = ap.response(recording, "multisine", period=PERIOD)
        low, high, *_ = estimate.bands()
        for element, panel in enumerate(panels):
            at = (slice(None), element, element)
            panel.fill_between(FREQUENCY, fit_low[at], fit_high[at], color=colour, alpha=0.25, linewidth=0)
            panel.loglog(FREQUENCY, fitted[at], color=colour, linewidth=1.5)
            gain = np.abs(estimate.response[at])
            error = [gain - np.maximum(low[at], 0.01 * gain), high[at] - gain]
            panel.errorbar(estimate.frequency, gain, error, fmt="o", color=colour, markersize=4.5, elinewidth=1.1)
        panels[0].text(0.17, 0.6 * fitted[0, 0, 0], name, color=colour, fontsize=12, weight="bold", va="top")
    for axis, panel in zip(AXES, panels, strict=True):
        panel.set_ylabel(f"$|H_{{{2 * axis}}}|$  [m/N]", fontsize=11)
        panel.tick_params(labelsize=10)
    label_frequency(panels[-1], fontsize=11)
    panels[0].set_title("Admittance of one arm: estimated (points), fitted (lines)", fontsize=11)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "overview.png"))
