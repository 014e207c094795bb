"""`plot`: recordings and results alike."""

import matplotlib
import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot

import armperturb
from armperturb.analysis.nonlinear.prediction import PulsePrediction
from armperturb.analysis.results import PARAMETER_COLUMNS
from armperturb.plots.parameters import plot_parameters
from armperturb.plots.scores import FARTHEST, plot_scores
from armperturb.plots.style import colours_for, new_figure

matplotlib.use("agg")


def test_a_recording_is_drawn_signal_by_signal(relax_recording):
    axes = armperturb.plot(relax_recording, figure=new_figure(1.0))
    assert axes.shape == (4, 2)
    assert [ax.get_title(loc="left") for ax in axes[:, 0]] == [
        "perturbation, x", "hand force, x", "displacement, x", "joint angle, shoulder",
    ]  # fmt: skip
    lines = axes[2, 1].get_lines()[: relax_recording.sizes["trial"]]
    for line, values in zip(lines, relax_recording["displacement"].values, strict=True):
        np.testing.assert_array_equal(line.get_xdata(), relax_recording["time"])
        np.testing.assert_allclose(line.get_ydata(), 1e3 * values[:, 1])
    assert axes[3, 1].get_lines()[0].get_ydata()[0] == pytest.approx(relax_recording.theta_e_deg.values[0], abs=0.01)


def test_single_trials_and_conditions(noisy_relax_recording):
    without = noisy_relax_recording.drop_vars("joint_angle")
    axes = armperturb.plot(without, trial=4, figure=new_figure(1.0))
    assert axes.shape == (3, 2)
    force = axes[1, 0].get_lines()[0].get_ydata()
    np.testing.assert_array_equal(force, without["force"].values[4, :, 0])
    assert "trial 4, RT22.5" in axes[0, 0].figure.get_suptitle()
    both = armperturb.plot(without, trial=[0, 5], figure=new_figure(1.0))
    colours = {line.get_color() for line in both[0, 0].get_lines()[:2]}
    assert len(colours) == 2
    assert [text.get_text() for text in both[0, 0].figure.legends[0].get_texts()] == ["RT7.5", "RT22.5"]
    with pytest.raises(ValueError, match="trial = 6; expected 0 to 5"):
        armperturb.plot(without, trial=6)
    with pytest.raises(ValueError, match="trial = -1; expected 0 to 5"):
        armperturb.plot(without, trial=-1)
    mask = without["condition"] == "RT22.5"
    with pytest.raises(TypeError, match=r"trial = False; expected the number of a trial \(plot\(recording\.isel"):
        armperturb.plot(without, trial=mask)
    with pytest.raises(TypeError, match=r"trial = 1\.9; expected the number of a trial"):
        armperturb.plot(without, trial=1.9)
    with pytest.raises(ValueError, match="trial is empty; expected at least one of 0 to 5"):
        armperturb.plot(without, trial=[])
    numbered = without.isel(trial=mask).assign_coords(subject=("trial", [7, 7, 7]))
    assert armperturb.plot(numbered, figure=new_figure(1.0))[0, 0].figure.get_suptitle() == "7, 3 trials, RT22.5"


@pytest.mark.parametrize("n", [1, 6, 7, 24])
def test_no_two_conditions_of_a_figure_have_a_colour(n):
    assert len(set(colours_for(n))) == n


@pytest.mark.slow(reason="imports pyplot")
def test_figures_of_pyplot_are_made_where_none_is_given(relax_recording):
    axes = armperturb.plot(relax_recording, trial=0)
    assert pyplot.gcf() is axes[0, 0].figure
    pyplot.close(axes[0, 0].figure)


def test_what_cannot_be_drawn_is_refused(relax_recording):
    with pytest.raises(TypeError, match="item of type dict; expected a recording or a result"):
        armperturb.plot({})
    with pytest.raises(ValueError, match="variable 'force' is missing"):
        armperturb.plot(relax_recording.drop_vars("force"))


def test_parameters_of_several_fits_stand_side_by_side():
    rows = [
        ("k_s", 100.0, 5.0, 90.0, 110.0, "Nm/rad", False, "", "A"),
        ("Td_s", 0.03, np.inf, -np.inf, np.inf, "s", True, "", "A"),
    ]
    frame = pd.DataFrame(rows, columns=PARAMETER_COLUMNS)
    axes = plot_parameters({"first": frame, "second": frame}, new_figure(1.0))
    assert [ax.get_xlabel() for ax in axes] == ["[Nm/rad]", "[s]"]
    assert len(axes[0].collections) == 2
    assert not axes[1].collections  # no limits, but a line across
    hollow = [line for line in axes[1].get_lines() if line.get_marker() == "o"]
    assert {line.get_markerfacecolor() for line in hollow} == {"white"}
    assert [text.get_text() for text in axes[0].figure.legends[0].get_texts()] == ["first", "second"]


def test_scores_keep_what_is_far_at_the_edge():
    cells = pd.DataFrame({"table": [*4 * ["F.2"], "C.3"], "z": [0.3, np.nan, 20.0, -7.0, np.nan]})
    ax = plot_scores(cells, (0.5, 1.0), new_figure(1.0))
    drawn = np.concatenate([line.get_xdata() for line in ax.get_lines() if line.get_marker() in "o<>"])
    assert sorted(drawn.tolist()) == [-FARTHEST, 0.3, FARTHEST]
    assert [label.get_text() for label in ax.get_yticklabels()] == ["F.2", "C.3"]


def test_a_predicted_pulse_reads_as_a_line_and_plots():
    time = np.arange(60) / 200.0
    recorded = np.stack([np.sin(9.0 * time), 0.5 * np.cos(9.0 * time)], axis=1)
    pulse = PulsePrediction(
        condition="PT7.5", direction_deg=20.0, time=time, recorded=recorded, predicted=0.9 * recorded
    )
    assert repr(pulse) == "Pulse at 20 deg in PT7.5: predicted over recorded peak 90 %, VAF 99.0 %"
    frame = pulse.to_frame()
    assert list(frame.columns) == ["time_s", "recorded_x_m", "recorded_y_m", "predicted_x_m", "predicted_y_m"]
    np.testing.assert_array_equal(frame["predicted_y_m"], pulse.predicted[:, 1])
    axes = armperturb.plot(pulse, figure=new_figure(1.0))
    assert axes.shape == (1, 2)
    for ax, column in zip(axes[0], range(2), strict=True):
        shown = {line.get_label(): line.get_ydata() for line in ax.get_lines()}
        np.testing.assert_allclose(shown["recorded"], 1e3 * recorded[:, column])
        np.testing.assert_allclose(shown["predicted"], 1e3 * pulse.predicted[:, column])
