"""The picture at the head of the documentation: the simulated laboratory, and the admittance of one simulated person.

Run `python docs/figures/overview.py FOLDER`. It simulates two people with linear muscles into FOLDER/study, identifies
them, and writes the picture of README.md and docs/index.md, which shows the second.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.envs.render.camera import render
from armperturb.models.rig import build_model
from armperturb.plots.panels import AXES, FREQUENCY, label_frequency
from armperturb.plots.style import COLOURS, in_style, new_figure, save_png
from armperturb.study.recording.settings import StudySettings
from armperturb.study.results.analyse import run_study
from armperturb.study.results.study_result import StudyResult


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    study = run_study(StudySettings(subjects=2, seed=0, muscles="linear"), folder / "study")
    save_png(overview(study, subject=1), folder / "overview.png")


@in_style()
def overview(study: StudyResult, *, subject: int = 0) -> Figure:
    """The rig, and the admittance of one person in both tasks with the fitted models; for the head of a page.

    Args:
      study: of known people, in which the person was identified in PT7.5 and RT7.5.
      subject: number of the person, from 0.

    Raises:
      RuntimeError: this machine cannot draw the rig; the message names what to install.
    """
    figure = new_figure(4.6, 10.7)
    beside = 0.46
    figure.set_layout_engine("constrained", rect=(beside, 0, 1 - beside, 1))
    ax = figure.add_axes((0, 0, beside - 0.02, 1))
    ax.set_axis_off()
    model = build_model(study.cohort[subject].subjects["PT"], study.environment)
    picture = ax.imshow(render(model, camera="oblique", width=1412, height=1380), aspect="auto")
    corners = FancyBboxPatch((0.03, 0.03), 0.94, 0.94, boxstyle="round,pad=0.03", transform=ax.transAxes)
    picture.set_clip_path(corners)

    panels = figure.subplots(2, 1, sharex=True, sharey=True)
    for condition in (study.protocol.condition(name) for name in ("PT7.5", "RT7.5")):
        identification = study.of(condition.name)[subject].identified
        spectra, colour = identification.spectra, COLOURS[condition.task]
        fitted = np.abs(arm_admittance(identification.fit.arm, FREQUENCY))
        for element, panel in enumerate(panels):
            panel.loglog(FREQUENCY, fitted[:, element, element], color=colour, linewidth=1.8)
            gain = np.abs(spectra.arm[:, element, element])
            panel.plot(spectra.frequency, gain, "o", color=colour, markersize=6, markeredgecolor="white")
        task = {"PT": "hold position", "RT": "relax"}[condition.task]
        panels[0].text(0.17, 0.6 * fitted[0, 0, 0], task, color=colour, fontsize=12, weight="bold", va="top")
    for axis, panel in zip(AXES, panels, strict=True):
        panel.set_ylabel(f"$|H_{{{2 * axis}}}|$  [m/N]", fontsize=11)
        panel.tick_params(labelsize=10)
    label_frequency(panels[-1], fontsize=11)
    panels[0].set_title("Admittance of one arm: estimated (points), fitted (lines)", fontsize=11)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "overview"))
