"""Results that describe themselves: text of few lines, HTML, tables of one schema, and axes that hold the data."""

import json
from dataclasses import dataclass, replace
from types import SimpleNamespace

import matplotlib
import numpy as np
import pandas as pd
import pytest

from armperturb.analysis.arm.geometry import hand_jacobian
from armperturb.analysis.arm.linear_arm import LinearArm, arm_admittance
from armperturb.analysis.arm.parameters import parameter_vector
from armperturb.analysis.fit.export import write_identification
from armperturb.analysis.fit.identification import Identifications
from armperturb.analysis.fit.identify import identify_conditions
from armperturb.analysis.results import (
    LINES,
    PARAMETER_COLUMNS,
    WIDTH,
    Description,
    FitResult,
    Result,
    Table,
    inseparable,
    limits_of,
    parameter_table,
    plain,
    plain_limits,
    quantile,
)
from armperturb.files import write_csv
from armperturb.plots.style import new_figure

matplotlib.use("agg")

ESTIMATORS = ("record", "frequency", "thesis")


def require_readable(result):
    """What a person reads: `repr` fits a terminal, and summary and HTML hold all of the title and the table."""
    said = result.describe()
    lines = repr(result).splitlines()
    assert len(lines) <= LINES
    assert max(map(len, lines)) <= WIDTH
    assert "array(" not in repr(result)
    summary, html = result.summary(), result._repr_html_()
    for text in (said.title, *said.facts, *said.remarks):
        assert text in summary
    for row in said.table.rows:
        assert all(cell.strip() in summary for cell in row)
    assert html.count("<tr>") == len(said.table.rows) + bool(said.table.rows)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Many(Result):
    """Of many conditions with long names."""

    n: int

    def describe(self):
        names = [f"condition {i} of a study" for i in range(self.n)]
        return Description(
            title=f"{self.n} conditions",
            facts=tuple(f"{name}: {12 * 'facts of a condition, '}" for name in names),
            table=Table(("parameter", "unit", *names), tuple((f"p{i}", "N/m", *names) for i in range(13))),
            remarks=tuple(f"{name}: {12 * 'remark '}" for name in names),
        )


@pytest.mark.parametrize("n", [1, 3, 6, 12, 24])
def test_many_conditions_are_shortened(n):
    require_readable(Many(n=n))
    assert "Remarks:" in repr(Many(n=n))


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class MadeUp(FitResult):
    def unit_of(self, name):
        return "Nm/rad"

    def describe(self):
        return Description(title="Made <up>", table=parameter_table(self.to_frame()), remarks=self.remarks)


def made_up(n, n_remarks=0):
    names = [f"k_{i}" for i in range(n)]
    error = dict.fromkeys(names, 2.0) | {"k_1": np.inf}
    return MadeUp(
        values={name: 10.0 * i for i, name in enumerate(names)},
        standard_error=error,
        correlation=np.eye(n),
        at_bound=("k_0",),
        converged=True,
        message="settled",
        remarks=tuple(
            f"remark {i} is a sentence of some length, which may need more than a line " * 2 for i in range(n_remarks)
        ),
    )


@pytest.mark.parametrize(("n", "n_remarks"), [(2, 0), (13, 2), (26, 0), (26, 30), (90, 3)])
def test_any_number_of_parameters_and_remarks_fits_a_terminal(n, n_remarks):
    result = made_up(n, n_remarks)
    require_readable(result)
    if n <= 26 and not n_remarks:
        assert all(name in repr(result).split() for name in result.values)
    elif n_remarks > 20:
        assert "summary() has the rest" in repr(result)
    assert "Made &lt;up&gt;" in result._repr_html_()


def test_intervals_and_their_table():
    result = made_up(3)
    assert result.interval("k_2") == pytest.approx((20.0 - 1.959964 * 2.0, 20.0 + 1.959964 * 2.0))
    assert result.interval("k_2", 0.5) == pytest.approx((20.0 - 0.67449 * 2.0, 20.0 + 0.67449 * 2.0), rel=1e-5)
    frame = result.to_frame()
    assert tuple(frame.columns) == PARAMETER_COLUMNS
    assert frame["at_bound"].tolist() == [True, False, False]
    assert frame["lower_95"].tolist()[1] == -np.inf
    assert frame["upper_95"].tolist()[1] == np.inf
    assert "not identifiable" in result.summary()
    assert list(result.correlation_frame().columns) == ["k_0", "k_1", "k_2"]
    for level in (0.0, 1.0, 95):
        with pytest.raises(ValueError, match=r"level = .*; expected a probability"):
            quantile(level)


def test_parametric_fits_have_their_estimates_on_an_axis():
    result = made_up(3)
    data = result.to_xarray()
    frame = result.to_frame().set_index("parameter")
    for name in ("value", "standard_error", "lower_95", "upper_95", "at_bound", "unit"):
        assert data[name].sel(parameter="k_2").item() == frame.loc["k_2", name]
    assert data["correlation"].dims == ("parameter", "other")
    np.testing.assert_array_equal(data["correlation"], result.correlation)


def test_numbers_that_do_not_exist_are_written_by_name(tmp_path):
    frame = made_up(2).to_frame().assign(extra=[np.nan, 1.0])
    write_csv(frame, tmp_path / "parameters.csv")
    lines = (tmp_path / "parameters.csv").read_text().splitlines()
    assert lines[0] == ",".join((*PARAMETER_COLUMNS, "extra"))
    assert lines[2] == "k_1,10.0,inf,-inf,inf,Nm/rad,false,,,1.0"
    assert lines[1].endswith(",true,,,nan")
    write_csv(frame.iloc[:0], tmp_path / "empty.csv")
    assert (tmp_path / "empty.csv").read_text() == lines[0] + "\n"


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0"), (161.4159, "161.4"), (22412.3, "22412"), (1e-5, "1.000e-05"), (np.inf, "inf")]
)
def test_numbers_are_plain(value, text):
    assert plain(value) == text


@pytest.mark.parametrize(
    ("limits", "text"),
    [
        ((12.04, 12.24), "12.04 to 12.24"),
        ((0.30821, 0.30842), "0.30821 to 0.30842"),
        ((22375.6, 22384.8), "22375.6 to 22384.8"),
        ((-1.488, 13.76), "-1.488 to 13.76"),
        ((5.0, 5.0), "5.000 to 5.000"),
    ],
)
def test_limits_of_an_interval_differ_as_far_as_it_is_wide(limits, text):
    assert plain_limits(*limits) == text


@pytest.fixture(scope="module", params=ESTIMATORS)
def identified(request, noisy_relax_recording):
    return identify_conditions(noisy_relax_recording, "1", estimator=request.param)


@pytest.fixture(scope="module")
def written(identified, tmp_path_factory):
    """Files of that identification by name."""
    return {path.name: path for path in write_identification(identified, tmp_path_factory.mktemp("identification"))}


def test_an_identification_reads_as_a_table(identified):
    assert isinstance(identified, Identifications)
    assert list(identified) == ["RT7.5", "RT22.5"]
    require_readable(identified)
    for condition, result in identified.items():
        require_readable(result)
        require_readable(result.fit)
        require_readable(result.spectra)
        assert result.spectra.to_frame().iloc[0, -2:].to_dict() == {"condition": condition, "subject": "relax"}
        text = result.summary()
        assert f"relax in {condition} (RT), 3 trials: model 1" in text
        assert f"VAF x {result.vaf[0]:.1f} %" in text
        for name, value in result.fit.values.items():
            assert [name, plain(value)] in [line.split()[:2] for line in text.splitlines()]
    detail = identified["RT7.5"].fit.detail
    require_readable(detail)
    if identified["RT7.5"].fit.estimator == "thesis":
        assert "3 trials of relax" in repr(detail)
        require_readable(detail.fits[0])


def test_structures_and_remarks_that_conditions_do_not_share_are_said_of_each(identified):
    first, second = identified.values()
    other = replace(second.fit, structure="3b", remarks=("of both", "of one"))
    results = [replace(first, fit=replace(first.fit, remarks=("of both",))), replace(second, fit=other)]
    said = Identifications(dict(zip(identified, results, strict=True))).describe()
    assert "model" not in said.title
    assert [fact.split(", ")[0] for fact in said.facts] == ["RT7.5: model 1", "RT22.5: model 3b"]
    assert said.remarks == ("of both", "RT22.5: of one")
    assert "model 1, " in identified.describe().title


def test_every_estimator_has_the_same_table(identified, written):
    read = pd.read_csv(written["parameters.csv"])
    frame = identified.to_frame()
    assert tuple(read.columns) == tuple(frame.columns) == PARAMETER_COLUMNS
    pd.testing.assert_frame_equal(read, frame)
    for condition, result in identified.items():
        part = frame[frame["condition"] == condition].set_index("parameter")
        assert part["value"].to_dict() == dict(result.fit.values)
        assert part["standard_error"].to_dict() == dict(result.fit.standard_error)
        for name in result.fit.values:
            assert tuple(part.loc[name, ["lower_95", "upper_95"]]) == result.fit.interval(name)
        assert part.loc["m_h", "unit"] == "kg"


def test_every_table_says_of_whom_it_is(written):
    for name in ("parameters.csv", "admittance.csv", "endpoint.csv"):
        read = pd.read_csv(written[name])
        assert tuple(read.columns[-2:]) == ("condition", "subject")
        assert set(read["subject"]) == {"relax"}
    assert [of["subject"] for of in json.loads(written["fit.json"].read_text()).values()] == ["relax", "relax"]


def test_impedance_at_the_hand_is_written(identified, written):
    read = pd.read_csv(written["endpoint.csv"])
    frame = pd.concat([result.endpoint().to_frame() for result in identified.values()], ignore_index=True)
    pd.testing.assert_frame_equal(read, frame)
    result = identified["RT7.5"]
    stiffness, arm = result.endpoint()["stiffness"], result.fit.arm
    jacobian = hand_jacobian(arm)
    recorded = jacobian.T @ stiffness.values @ jacobian
    np.testing.assert_allclose(recorded, arm.joint_matrix("k"), rtol=1e-9)
    known = result.fit.estimator != "thesis"
    assert np.isfinite(stiffness.area_interval()).all() == known
    assert b"<svg" in written["endpoint.svg"].read_bytes()
    require_readable(result.endpoint())


def test_axes_are_labelled(identified):
    data = identified.to_xarray()
    assert data["arm"].dims == ("condition", "frequency", "output", "input")
    assert data["frequency"].attrs == {"units": "Hz"}
    assert data["model"].attrs["units"] == "m/N"
    result = identified["RT22.5"]
    assert data.attrs == result.fit.labels
    assert result.to_xarray().attrs == {**result.fit.labels, "condition": "RT22.5"}
    for each in (result.spectra, result.endpoint()):
        assert {"condition": "RT22.5", "subject": "relax"}.items() <= each.to_xarray().attrs.items()
    part = data.sel(condition="RT22.5")
    np.testing.assert_array_equal(part["arm"], result.spectra.arm)
    np.testing.assert_array_equal(part["arm"].sel(output="x", input="y"), result.spectra.arm[:, 0, 1])
    np.testing.assert_array_equal(part["model"], arm_admittance(result.fit.arm, result.spectra.frequency))


@pytest.mark.slow(reason="draws figures")
def test_the_plot_draws_estimate_model_and_bands(identified):
    result = identified["RT7.5"]
    axes = result.plot(figure=new_figure(1.0))
    assert axes.shape == (2, 2, 2)
    gain, phase = axes[1, 0]
    points, model = gain.get_lines()
    np.testing.assert_array_equal(points.get_xdata(), result.spectra.frequency)
    np.testing.assert_allclose(points.get_ydata(), np.abs(result.spectra.arm[:, 1, 0]))
    np.testing.assert_allclose(model.get_ydata(), np.abs(arm_admittance(result.fit.arm, model.get_xdata())[:, 1, 0]))
    assert len(phase.get_lines()) == 2
    # The thesis's estimator gives no correlations, and so no band.
    assert len(gain.collections) == (result.fit.estimator != "thesis")
    both = identified.plot(figure=new_figure(1.0))
    assert len(both[0, 0, 0].get_lines()) == 4


@pytest.mark.slow(reason="identifies trials and draws bands")
def test_bands_are_those_of_the_parameters(noisy_relax_recording):
    fit = identify_conditions(noisy_relax_recording, "1", estimator="frequency")["RT7.5"].fit
    frequency = np.array([0.5, 2.0, 8.0])
    bands = fit.admittance_bands(frequency)
    rng = np.random.default_rng(0)
    error = np.array(list(fit.standard_error.values()))
    drawn = rng.multivariate_normal(np.zeros(len(error)), fit.correlation * np.outer(error, error), 800)
    # Far smaller errors, so that what is drawn is as linear as the bands.
    shift = 1e-3 * drawn @ fit.mixing.T
    arm, middle = LinearArm(fit.arm, frequency), parameter_vector(fit.arm)
    log = np.log([arm.admittance(middle + step) for step in shift]) - np.log(arm.admittance(middle))
    spread = 1.96e3 * log.real.std(axis=0, ddof=1)
    np.testing.assert_allclose(np.log(bands.gain_high / bands.gain_low) / 2, spread, rtol=0.1)
    np.testing.assert_allclose(
        (bands.phase_high - bands.phase_low) / 2, 1.96e3 * log.imag.std(axis=0, ddof=1), rtol=0.1
    )


def test_the_forest_draws_estimates_and_intervals(identified):
    fit = identified["RT7.5"].fit
    axes = fit.plot(figure=new_figure(1.0))
    assert [ax.get_xlabel() for ax in axes] == [f"[{unit}]" for unit in dict.fromkeys(fit.to_frame()["unit"])]
    masses = axes[0]
    assert [label.get_text() for label in masses.get_yticklabels()] == ["m_h", "m_f"]
    drawn = {float(line.get_xdata()[0]) for line in masses.get_lines() if len(line.get_xdata()) == 1}
    assert drawn >= {fit.values["m_h"], fit.values["m_f"]}
    for name, bar in zip(("m_h", "m_f"), masses.collections, strict=True):
        assert tuple(bar.get_segments()[0][:, 0]) == pytest.approx(fit.interval(name))


def test_a_relative_error_is_that_of_an_estimate_which_is_not_zero_but_for_rounding():
    fit = SimpleNamespace(
        at_bound=("kp_e",),
        values={"kp_s": 6.0, "kp_e": 2.8e-17},
        standard_error={"kp_s": 4.0, "kp_e": 5.3},
        correlation=np.eye(2),
    )
    assert limits_of(fit) == (
        "kp_e sits on a bound",
        "2 parameters are poorly determined: kp_s (6 +/- 4, relative s.e. 67%), kp_e (0 +/- 5.3)",
    )


def test_parameters_that_share_a_limit_are_named_together_condition_by_condition():
    fit = SimpleNamespace(
        at_bound=("k_s", "k_e"),
        values={"k_s": 0.0, "k_e": 0.0, "b_s [PT]": 1.0, "b_s [RT]": 2.0, "b_e [RT]": 4.0, "Td": 0.03},
        standard_error={"k_s": np.inf, "k_e": np.inf, "b_s [PT]": 0.8, "b_s [RT]": 4.0, "b_e [RT]": 3.0, "Td": 1e-3},
        correlation=np.eye(6),
    )
    assert limits_of(fit) == (
        "k_s and k_e sit on a bound",
        "k_s and k_e are not identifiable from these trials",
        "b_s [PT] is poorly determined (1 +/- 0.8, relative s.e. 80%)",
        "2 parameters are poorly determined: b_s [RT] (2 +/- 4, relative s.e. 200%), "
        "b_e [RT] (4 +/- 3, relative s.e. 75%)",
    )


def test_parameters_that_correlations_connect_are_named_together():
    correlation = np.eye(6)
    for i, j, r in ((0, 2, 0.96), (2, 3, -0.99), (1, 4, 0.97), (0, 3, -0.9)):
        correlation[i, j] = correlation[j, i] = r
    correlation[5, :5] = correlation[:5, 5] = np.nan
    assert inseparable(list("abcdef"), correlation) == [
        "a, c and d are not separately identifiable (largest error correlation r = -0.99)",
        "b and e are not separately identifiable (error correlation r = 0.97)",
    ]
