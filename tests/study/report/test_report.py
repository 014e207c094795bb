"""The report of a study: whole, self-contained, and true to the tables."""

import base64
import csv
import math
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from markupsafe import escape
from scipy import stats

from armperturb.environment import Strap
from armperturb.envs.render.camera import simplify
from armperturb.files import checksum
from armperturb.pages.formats import MISSING, chance, digits, mean_sd, signed, symbol, words
from armperturb.plots.style import COLOURS, TRUE, save_svg, shades
from armperturb.study.comparison.effects import effects
from armperturb.study.comparison.score import score
from armperturb.study.experiments.mechanisms import ONE_LEVEL, WHOLE, Response, Yielding
from armperturb.study.protocol import THESIS, Condition, Protocol
from armperturb.study.recording.settings import StudySettings
from armperturb.study.report.figures import fit as fit_figures
from armperturb.study.report.figures import rig as rig_figures
from armperturb.study.report.figures.catalogue import drawings
from armperturb.study.report.findings import findings, geometric_mean, law_alone
from armperturb.study.report.provenance import digest_of
from armperturb.study.report.report import _simulations
from armperturb.study.report.sections import _agreement, left_out, remarks
from armperturb.study.report.tables import condition_rows, fit_rows, pulse_units
from armperturb.study.results.analyse import _Study
from tests.studies import FEW_FITS, coarse_study, sketch

HEADERS = {
    "summary": "condition,subjects,identified,trials,trials_used,model,median_abs_error_percent",
    "parameters": "parameter,value,standard_error,lower_95,upper_95,unit,at_bound,condition,subject",
    "estimates": "condition,subject,parameter,unit,true,estimated,standard_error,lower_95,upper_95,error_percent,"
    "at_bound,thesis_estimated,thesis_sem,thesis_error_percent",
    "parameters_summary": "condition,parameter,unit,published_mean,published_sd,true_mean,true_sd,estimated_mean",
    "correlations": "condition,subject,parameter,other,correlation",
    "fits": "condition,subject,model,estimator,status,converged",
    "conditions": "condition,task,trials,pulse_levels,published_force_N_mean,published_force_N_sd,force_N_mean",
    "statistics": "quantity,task,conditions,people,test,statistic",
    "statistics_pairs": "quantity,task,first,second,difference,t,dof,p_bonferroni",
    "joints": "table,condition,quantity,published_mean,published_sd,path_mean,path_sd,simulated_mean,simulated_sd",
    "findings": "finding,above,below,subject,value,lower_95,upper_95",
    "emg_levels": "subject,unit,condition,part,muscle,amplitude,lower_95,trials,p,is_active",
    "emg_cocontraction": "subject,unit,condition,part,joint,index,ratio",
    "emg_reflexes": "subject,condition,muscle,delay_s,lower_95_s,upper_95_s,coherence,p",
    "emg_tests": "question,joint,conditions,n,test,statistic,p,ratio",
    "moving_shoulder": "condition,joint,quantity,strap,true,fixed_shoulder,with_shoulder",
}
FIGURES = {
    **{"2.3": "pulse_signal", "2.4": "pulse_directions", "2.5": "perturbation"},
    **{"3.1": "admittance_PT", "3.2": "admittance_by_task", "3.3": "admittance_by_amplitude_PT"},
    **{"3.4": "admittance_by_amplitude_RT", "3.5": "gain_linear_scale", "3.6": "coherence", "3.7": "fit_PT"},
    **{"3.8": "fit_RT", "3.9": "prediction_PT", "3.10": "prediction_RT", "3.11": "vaf"},
    **{"3.12": "joint_parameters_PT", "3.13": "joint_parameters_RT", "3.14": "muscle_parameters"},
    **{"3.15": "peak_displacement", "3.16": "pulse_admittance", "3.17": "trajectories_PT", "3.18": "trajectories_RT"},
    **{"3.19": "pulse_prediction", "C.1": "penalty", "F.1": "joint_rotations"},
}
"""Figure of the thesis to ours."""

DRAWN = {*FIGURES.values(), "rig", "stills", "admittance_RT", "parameters_PT", "parameters_RT"}
DRAWN |= {"findings", "estimates", "emg_cocontraction", "emg_envelopes", "emg_pulses", "emg_reflexes"}
MULTISINE = ("PT2.5", "PT7.5", "PT22.5", "RT2.5", "RT7.5", "RT22.5")
SECTIONS = [
    *(
        "summary",
        "admittance",
        "pulses",
        "emg",
        "parameters",
        "explorer",
        "fits",
        "statistics",
        "kinematics",
        "conditions",
        "method",
    ),
    *("stills", "left_out", "published"),
]
TABLES = ["2.1", *(f"C.{n}" for n in range(3, 23)), "D.3", "D.4", "D.5", "E.3", "E.4", "E.5"] + [
    f"F.{n}" for n in range(2, 7)
]


class Page(HTMLParser):
    """What a page links to, and the text of its tables' cells."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.links, self.anchors, self.tables, self.ids = set(), [], [], {}, []
        self.marks = {}
        self._table, self._cell = None, None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.tags.add(tag)
        if "id" in attrs:
            self.ids.append(attrs["id"])
            if attrs["id"].startswith("table-"):
                self._table = self.tables.setdefault(attrs["id"].removeprefix("table-"), [])
        for name in ("src", "href", "srcset", "data", "action", "poster"):
            if name in attrs:
                (self.anchors if attrs[name].startswith("#") else self.links).append(attrs[name])
        if tag == "tr" and self._table is not None:
            self._table.append([])
        if tag in ("td", "th"):
            self._cell, self._mark = "", attrs.get("class")

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self._table[-1].append(" ".join(self._cell.split()))
            self.marks.setdefault(id(self._table), []).append(self._mark)
            self._cell = None

    def handle_data(self, data):
        if self._cell is not None:
            self._cell += data


@pytest.fixture(scope="module")
def out(thesis_report):
    return thesis_report


@pytest.fixture(scope="module")
def written(out):
    return out / "report.html"


@pytest.fixture(scope="module")
def page(written):
    return Page(written.read_text(encoding="utf-8"))


def possible_figures(study):
    return set(drawings(study, effects(study))) - {"rig", "stills"}


def shown_figures(page):
    return {name.removeprefix("figure-") for name in page.ids if name.startswith("figure-")}


def rows(out, name):
    with (out / "tables" / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def number(text):
    return float(text.replace("−", "-"))


def test_report_lies_in_the_folder(written, out):
    assert written.is_file()
    assert written.stat().st_size < 15e6
    assert not list(out.rglob("*.part"))


def test_asks_for_nothing_outside_itself(written, page):
    assert page.links
    assert all(link.startswith("data:") for link in page.links)
    assert not page.tags & {"link", "iframe", "object", "embed", "base"}
    text = written.read_text(encoding="utf-8")
    assert "@import" not in text
    assert "url(" not in text


def test_contents_lead_to_the_sections(written, page):
    assert [name for name in page.ids if name in SECTIONS] == SECTIONS
    assert page.anchors[: len(SECTIONS)] == [f"#{name}" for name in SECTIONS]
    assert {anchor.removeprefix("#") for anchor in page.anchors} <= set(page.ids)
    assert len(page.ids) == len(set(page.ids))


def test_every_figure_is_embedded_once(page, out):
    files = {path.stem: path for path in (out / "figures").glob("*.svg")}
    assert files.keys() == shown_figures(page) == DRAWN
    pictures = [link for link in page.links if link.startswith("data:image/svg+xml")]
    embedded = [base64.b64decode(link.partition(",")[2]) for link in pictures]
    assert len(embedded) == len(files)
    assert set(embedded) == {path.read_bytes() for path in files.values()}


def test_captions_name_the_figures_of_the_thesis(written):
    text = written.read_text(encoding="utf-8")
    named = {}
    for figure in re.findall(r'<figure id="figure-(\w+)">(.*?)</figure>', text, flags=re.S):
        for number in re.findall(r"Thesis: figure ([\w.]+?)\.<", figure[1]):
            named[number] = figure[0]
    assert named == FIGURES


def test_truth_is_drawn_of_linear_people(written, out):
    for name in ("admittance_PT", "admittance_RT", "fit_PT", "fit_RT", "parameters_PT"):
        assert TRUE["color"].lower() in (out / "figures" / f"{name}.svg").read_text(encoding="utf-8")


def test_figures_ask_for_nothing_outside_themselves(out):
    for path in (out / "figures").glob("*.svg"):
        targets = re.findall(r'(?:href|src)="([^"]*)"', path.read_text(encoding="utf-8"))
        assert all(target.startswith(("#", "data:")) for target in targets)


@pytest.mark.parametrize(("name", "header"), HEADERS.items())
def test_tables_are_there(written, out, name, header):
    first, *rest = (out / "tables" / f"{name}.csv").read_text(encoding="utf-8").splitlines()
    assert first.startswith(header)
    assert rest


def test_summary_shows_its_table(page, out):
    cells = page.tables["summary"][1:]
    assert [shown[0] for shown in cells] == [row["condition"] for row in rows(out, "summary")]
    for shown, row in zip(cells, rows(out, "summary"), strict=True):
        assert shown[8] == "3 of 3"
        assert shown[9] == f"{row['trials_used']} of {row['trials']}"
        for place, name, off in (
            (2, "median_abs_error_percent", {"rel": 0.06}),  # two digits
            (3, "VAF_x_mean", {"abs": 0.051}),
            (4, "VAF_y_mean", {"abs": 0.051}),
        ):
            mine, of_thesis = (number(part) for part in shown[place].rstrip(")").split(" ("))
            assert mine == pytest.approx(float(row[name]), **off)
            assert of_thesis == pytest.approx(float(row[f"thesis_{name}"]), **off)
        assert shown[5] == f"{row['at_bound']} ({row['thesis_at_bound']})"
        assert number(shown[6]) == pytest.approx(float(row["coverage_95_percent"]), abs=0.51)
        assert shown[7] == row["suspicious"]


def test_first_screen_tells_what_was_found_and_how_sure(written, page, out):
    text = re.sub(
        r"\s+", " ", re.sub(r"<[^>]+>", "", written.read_text(encoding="utf-8").split('<section id="summary">')[1])
    )
    told = text.split("What these people are and are not")[0]
    means = {row["finding"]: row for row in rows(out, "findings") if row["subject"] == "geometric mean"}
    assert means.keys() == {"tasks", "amplitude_PT", "amplitude_RT", "excess"}
    for row in means.values():
        mean = float(row["value"])
        ends = [digits(float(row[name]), 2 if mean >= 10.0 or mean < 1.0 else 3) for name in ("lower_95", "upper_95")]
        assert f"({ends[0]} to {ends[1]})" in told
    fits = rows(out, "fits")
    suspicious = sum(float(row["p_value"]) < 0.01 for row in fits)
    assert f"of {len(fits)} fits are flagged" in told
    assert not suspicious or f"{suspicious} rejected by the lack-of-fit test" in told
    assert page.ids.index("figure-findings") < page.ids.index("admittance")


def test_findings_are_geometric_means_over_people(thesis_study):
    told = findings(thesis_study)["tasks"]
    gains = {
        name: {
            case.name: math.prod(abs(case.identified.spectra.arm[k, i, i]) for k in range(2) for i in range(2)) ** 0.25
            for case in thesis_study.of(name)
        }
        for name in (told.above, told.below)
    }
    logs = [math.log(gains[told.above][name] / gains[told.below][name]) for name in gains[told.below]]
    interval = stats.t.interval(0.95, len(logs) - 1, np.mean(logs), stats.sem(logs))
    assert (told.mean, told.lower, told.upper) == pytest.approx(np.exp([np.mean(logs), *interval]))
    alone = geometric_mean([2.0])
    assert alone[0] == pytest.approx(2.0)
    assert all(map(math.isnan, alone[1:]))


@pytest.mark.parametrize(("lasting", "above"), [(3, "PT22.5"), (2, "PT7.5")])
def test_law_alone_is_told_of_movements_in_which_an_arm_with_one_level_lasts(lasting, above):
    gains = {WHOLE: (1.0, 0.9, 0.6), ONE_LEVEL: (1.0, 1.2, 1.5)}
    responses = {
        (arm, condition): Response(subject=None, gain=np.full((3, 2, 2), gain))
        for arm, of_arm in gains.items()
        for condition, gain in zip(("PT2.5", "PT7.5", "PT22.5"), of_arm[: 3 if arm == WHOLE else lasting], strict=False)
    }
    unstable = {} if lasting == 3 else {(ONE_LEVEL, "PT22.5"): "leaves the workspace at 21.9 s"}
    told = law_alone(Yielding(person=None, variants=(WHOLE, ONE_LEVEL), responses=responses, unstable=unstable))
    assert (told.below, told.above, told.unstable) == ("PT2.5", above, lasting == 2)
    assert (told.with_levels, told.alone) == pytest.approx((0.6, 1.5) if lasting == 3 else (0.9, 1.2))
    assert law_alone(Yielding(person=None, variants=(WHOLE,), responses=responses, unstable={})) is None


def test_foot_has_command_digest_and_how_to_cite(thesis_study, written):
    foot = written.read_text(encoding="utf-8").split("<footer>")[1]
    assert "armperturb study --out DIR --subjects 3 --seed" in foot
    assert "--muscles linear" in foot
    assert re.search(r"SHA-256 over the checksums of all recordings: <span class=\"file\">[0-9a-f]{64}<", foot)
    assert "How to cite" in foot

    sums = {path.name: checksum(path) for path in thesis_study.recordings.values()}
    assert digest_of(sums) in foot
    assert digest_of(sums) != digest_of(dict(reversed(sums.items())))


def scored(out, name="score"):
    with (out / "score" / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_summary_has_score_and_headline_numbers(page, out):
    cells = scored(out)
    groups = [
        ("movements", "2F"),
        ("six structures", "C"),
        ("six starts", "D"),
        ("final structure", "E"),
        ("all", "2CDEF"),
    ]
    assert len(page.tables["shares"]) == 1 + len(groups)
    for shown, (label, of) in zip(page.tables["shares"][1:], groups, strict=True):
        assert shown[0].startswith(label)
        judged = [float(row["z"]) for row in cells if row["table"][0] in of and row["published_sd"] != "nan"]
        assert shown[1] == f"{sum(map(math.isfinite, judged))} of {len(judged)}"
        for text, limit in zip(shown[2:], (1.0, 2.0), strict=True):
            near = sum(abs(z) <= limit for z in judged) / len(judged)
            assert number(text.removesuffix(" %")) == pytest.approx(100.0 * near, abs=0.51)
    by_name = {row["name"]: row for row in scored(out, "headlines")}
    factors = page.tables["factors"][1:]
    assert len(factors) >= 5
    for name, printed in (("admittance_ratio_rt7.5_pt7.5", "18"), ("pulse_underprediction_factor", "1.7")):
        [shown] = [row for row in factors if row[1] == printed]
        assert number(shown[2]) == pytest.approx(float(by_name[name]["ours"]), rel=0.006)
    reach = {row[0].partition(":")[0]: row[0].partition("printed arms: ")[2] for row in page.tables["shares"][1:]}
    assert {name for name, share in reach.items() if share} == {"six structures", "six starts", "final structure"}
    contradicted = [row[0] for row in factors if row[0].endswith("(contradicted)")]
    assert len(contradicted) == sum(bool(row["contradiction"]) for row in by_name.values()) == 4


def test_summary_tells_what_differs(thesis_study, written, out):
    text = written.read_text(encoding="utf-8")
    missing = [row for row in scored(out) if row["reason"]]
    assert f"{len(missing)} of {len(scored(out))} cells could not be computed and count as not reproduced" in text
    [named] = re.findall(r"<li>movements beyond 2 SD: (.*?)</li>", text)
    # Where the experiment is another, differences are not told to be the people's.
    assert "</b>, so that cells differ for its sake." in text
    assert "trial_duration is 36.0 there and 30.0 now" in text
    assert "<li>fitted cells beyond 1 SD:" not in text
    repeated = " ".join(_agreement(replace(score(thesis_study), differences=()))["differs"])
    [causes] = re.findall(r"fitted cells beyond 1 SD: (.*?); in brackets", repeated)
    assert [part.split()[0] for part in causes.split(", ")] == ["C", "D", "E"]
    off = [
        abs(float(row["z"])) > 1.0 for row in scored(out) if row["table"][0] in "2F" and math.isfinite(float(row["z"]))
    ]
    assert f"movements beyond 1 SD: {100 * sum(off) / len(off):.0f} % of computed cells" in repeated
    first = next(row for row in scored(out) if row["table"][0] in "2F" and abs(float(row["z"])) > 2.0)
    assert named.startswith(f"{first['quantity'].replace('_', ' ')} in {first['condition']}")


def test_published_tables_mark_every_cell(page, out):
    assert [name for name in page.tables if name in TABLES] == TABLES
    for table in TABLES:
        cells = [row for row in scored(out) if row["table"] == table]
        z = [abs(float(row["z"])) for row in cells]
        marks = page.marks[id(page.tables[table])]
        assert marks.count("missing") == sum(bool(row["reason"]) for row in cells), table
        assert marks.count("beyond-1") == sum(1.0 < value <= 2.0 for value in z), table
        assert marks.count("beyond-2") == sum(value > 2.0 for value in z), table
        assert sum(mark is not None and mark != "" for mark in marks) <= len(cells)
    head, *body = page.tables["2.1"]
    place, row = head.index("RMS force [N]"), {row[0]: row for row in body}["PT7.5"]
    [cell] = [row for row in scored(out) if (row["condition"], row["quantity"]) == ("PT7.5", "rms_force")]
    published, ours, z = re.fullmatch(r"(\S+) \(\S+\) (\S+) \(\S+\) (\S+)(?: \*+)?", row[place]).groups()
    assert number(published) == float(cell["published_mean"])
    assert number(ours) == pytest.approx(float(cell["ours"]), rel=0.006)
    assert number(z) == pytest.approx(float(cell["z"]), abs=0.051)


def test_statistics_show_their_tables(page, out):
    for name, place, column, task in (("statistics", 5, "statistic", 1), ("statistics_pairs", 5, "t", 7)):
        shown, table = page.tables[name][1:], rows(out, name)
        assert len(shown) == len(table) > 5
        for line, row in zip(shown, table, strict=True):
            assert line[0].replace(",", "") == row["quantity"].replace("_", "").replace(",", "")
            assert line[task] == row["task"]
            if math.isfinite(float(row[column])):
                assert number(line[place]) == pytest.approx(float(row[column]), rel=0.006, abs=0.0051)
            else:
                assert line[place] == MISSING


def test_kinematics_shows_its_tables(page, out):
    shown, table = page.tables["joints"][1:], rows(out, "joints")
    assert len(shown) == len(table) > 50
    for line, row in zip(shown, table, strict=True):
        assert line[:2] == [row["quantity"].replace("_", " "), row["condition"]]
        path, simulated = float(row["path_mean"]), float(row["simulated_mean"])
        assert number(line[5]) == pytest.approx(100.0 * (path / simulated - 1.0), abs=0.051)
        # A third digit at most is lost beside the SD.
        mean = number(line[2].split(" ± ")[0])
        assert mean == pytest.approx(math.degrees(path), abs=0.06 * math.degrees(float(row["path_sd"])) + 0.5)
    assert page.tables["moving_shoulder"][1:]
    assert page.tables["elastic_limits"][1:]


def test_fits_and_remarks_are_shown(thesis_study, written, page, out):
    table = rows(out, "fits")
    cells = page.tables["fits"][1:]
    assert len(cells) == len(table) == 18
    for shown, row in zip(cells, table, strict=True):
        assert shown[:2] == [row["condition"], row["subject"]]
        assert number(shown[6]) == pytest.approx(float(row["chi2"]) / float(row["dof"]), abs=0.0051)
        assert shown[7] == chance(float(row["p_value"]))
        assert shown[9] == row["status"]
    text = written.read_text(encoding="utf-8")
    assert any(row["remarks"] or row["thesis_remarks"] for row in table)
    for condition, people in remarks(thesis_study).items():
        assert f"{condition}: remarks on {len(people)} of 3 people" in text
        for lines in people.values():
            assert all(str(escape(line)) in text for line in lines)


def test_parameters_show_their_table(page, out):
    cells, table = page.tables["parameters_summary"][1:], rows(out, "parameters_summary")
    assert len(cells) == len(table) == 3 * (13 + 10)
    for shown, row in zip(cells, table, strict=True):
        assert shown[0] == row["condition"]
        assert shown[9] == row["unit"]
        if row["condition"] == "PT2.5":
            assert shown[4] == MISSING
        assert number(shown[6]) == pytest.approx(float(row["median_abs_error_percent"]), rel=0.06)
        assert number(shown[7]) == pytest.approx(float(row["thesis_median_abs_error_percent"]), rel=0.06)
        assert shown[8] == f"{float(row['coverage_95_percent']):.0f}"
        for text, name in zip(shown[2:6], ("estimated", "thesis", "published", "true"), strict=True):
            if text != MISSING and float(row[f"{name}_sd"]) > 1e-9 * float(row[f"{name}_mean"]):
                mean, sd = (number(part) for part in text.split(" ± "))
                assert mean == pytest.approx(float(row[f"{name}_mean"]), abs=0.06 * float(row[f"{name}_sd"]) + 0.5)
                assert sd == pytest.approx(float(row[f"{name}_sd"]), rel=0.06, abs=0.5)


def test_conditions_show_their_table(page, out):
    cells, table = page.tables["conditions"][1:], rows(out, "conditions")
    assert [shown[0] for shown in cells] == ["PT0", *MULTISINE[:3], "RT0", *MULTISINE[3:]]
    for shown, row in zip(cells, table, strict=True):
        assert shown[6] == row["trials"]
        if shown[0] in ("PT0", "RT0"):
            assert set(shown[1:6]) == {MISSING}
            continue
        assert number(shown[4].split(" ± ")[0]) == pytest.approx(float(row["force_N_mean"]), rel=0.006)
        assert number(shown[2]) == pytest.approx(1e3 * float(row["intended_displacement_m"]), rel=0.006)
        mean = number(shown[1].split(" ± ")[0])
        assert mean == pytest.approx(
            1e3 * float(row["displacement_m_mean"]), abs=0.06e3 * float(row["displacement_m_sd"])
        )


def test_pulse_levels_are_told_in_newtons(written, study, thesis_study, tmp_path):
    assert "multiples of a peak force of 53.9&nbsp;N, the same for all people." in written.read_text(encoding="utf-8")
    practised = replace(thesis_study.protocol, forces="practice", pulse_unit_condition="PT7.5", pulse_unit_factor=8.0)
    units = [8.0 * case.force for case in thesis_study.of("PT7.5")]
    [_, _, row, *_] = condition_rows(replace(thesis_study, protocol=practised))
    assert (row["condition"], row["pulse_unit_N_mean"]) == ("PT7.5", pytest.approx(np.mean(units)))
    assert row["pulse_unit_N_sd"] == pytest.approx(np.std(units, ddof=1))
    # Of a laboratory's pulses nobody knows it.
    assert pulse_units(replace(thesis_study, made=None)) == []
    brief = replace(study.protocol, forces="practice", pulse_unit_condition="PT7.5", multisine_duration=20.0)
    text = sketch(replace(study, protocol=brief, people=()), tmp_path)
    assert "which is 10 times the RMS force in PT7.5: 5" in text
    assert "Force and displacement in PT7.5, RT7.5 are of all of the multisine" in text


def test_admittance_of_the_tasks_is_the_ratio_of_the_gains(thesis_study, out):
    def gain(name, k, i):
        gains = [abs(case.identified.spectra.arm[k, i, i]) for case in thesis_study.of(name)]
        return math.prod(gains) ** (1 / 3)  # three people

    gains = [gain("RT7.5", k, i) / gain("PT7.5", k, i) for k in range(2) for i in range(2)]
    with (out / "score" / "headlines.csv").open(encoding="utf-8", newline="") as file:
        ours = {row["name"]: float(row["ours"]) for row in csv.DictReader(file)}
    assert ours["admittance_ratio_rt7.5_pt7.5"] == pytest.approx(sum(gains) / 4)


def test_rig_is_drawn(study, monkeypatch):
    draw = rig_figures.render

    def small(model, *, camera, width, height):
        limits = model.vis.global_
        assert width <= limits.offwidth
        assert height <= limits.offheight
        simplify(model, 48)
        return draw(model, camera=camera, width=48, height=48)

    monkeypatch.setattr(rig_figures, "render", small)
    top, oblique = (ax.images[0].get_array() for ax in rig_figures.rig(study).axes)
    for picture in (top, oblique):
        assert np.std(picture) > 5.0  # something is seen
    assert not np.array_equal(top, oblique)


def test_the_prediction_of_a_short_trial_shows_its_end(study, monkeypatch):
    case = study.of("RT7.5")[0]
    short = case.trials().isel(time=slice(2400))
    monkeypatch.setattr(type(case), "trials", lambda _: short)
    for ax in fit_figures.prediction(case).axes:
        assert ax.get_xlim() == pytest.approx((7.0, 12.0), abs=0.01)
        assert all(len(line.get_xdata()) == 1001 for line in ax.lines)


def test_users_settings_neither_matter_nor_change(study, tmp_path):
    import matplotlib

    save_svg(fit_figures.prediction(study.of("RT7.5")[0]), tmp_path / "plain.svg")
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "black"}):
        save_svg(fit_figures.prediction(study.of("RT7.5")[0]), tmp_path / "odd.svg")
        assert matplotlib.rcParams["font.size"] == 30
    assert (tmp_path / "plain.svg").read_bytes() == (tmp_path / "odd.svg").read_bytes()


def test_leaves_no_open_figures(written):
    if "matplotlib.pyplot" in sys.modules:  # another test's doing
        assert sys.modules["matplotlib.pyplot"].get_fignums() == []


def test_reports_what_went_badly(study, tmp_path):
    position = study.of("PT7.5")[0]
    fit = replace(
        position.identified.fit,
        stable=False,
        at_bound=("k_s",),
        converged=False,
        message="gave up",
        remarks=("k_s <sits>",),
        detail=replace(position.estimate, chi2=3.0 * position.estimate.dof),
    )
    unstable = replace(position.identified, fit=fit, vaf=position.identified.vaf * -math.inf)
    bad = replace(position, identification=unstable, thesis=None)
    relax = study.of("RT7.5")[0]
    reason = "trial 0 of S01 in RT7.5 reached the <limit> at 9.000 s"
    gone = replace(relax, identification=None, left_out=(reason,), single_trials=())
    badly = replace(study, made=replace(study.made, subjects=1), cases=(bad, gone), people=())
    lists = left_out(badly, fit_rows(badly), ["a <remark>"])
    assert lists["Maximum likelihood fits with a parameter at its bound"] == ["S01 in PT7.5: k_s"]
    assert [line.split(",")[0] for line in lists["Fits with residuals larger than the noise explains"]] == [
        "S01 in PT7.5: chi2 / dof 3.00"
    ]
    assert lists["Maximum likelihood fits that did not converge"] == ["S01 in PT7.5: gave up"]
    assert lists["Trials and people left out"] == [reason]
    assert [line.split(":")[0] for line in lists["Maximum likelihood fits that are unstable on the manipulator"]] == [
        "S01 in PT7.5"
    ]
    text = sketch(badly, tmp_path)
    # One task and one amplitude are left.
    assert possible_figures(badly) == {
        *("pulse_directions", "perturbation", "admittance_by_task", "gain_linear_scale", "coherence"),
        *("findings", "estimates"),
        *(f"{name}_PT" for name in ("admittance", "fit", "prediction", "parameters")),
        *("pulse_signal", "joint_rotations", "trajectories_PT"),  # of the recording alone
    }
    assert "reached the &lt;limit&gt; at 9.000 s" in text
    assert "SD over people" not in text  # there is only one person
    shown = Page(text).tables["summary"][1:]
    assert [row[0] for row in shown] == ["PT7.5"]
    assert shown[0][3] == f"{MISSING} ({MISSING})"
    assert shown[0][7] == "1"
    assert "<dd>k_s &lt;sits&gt;</dd>" in text


YIELDING = """
forces = "published"
trial_duration = 28.6
multisine_duration = 28.5

[[conditions]]
name = "PT2.5"
task = "PT"
rms_displacement = 0.0025
published_force = 1.2

[[conditions]]
name = "PT7.5"
task = "PT"
rms_displacement = 0.0075
published_force = 5.4
"""


@pytest.fixture(scope="module")
def yielding(tmp_path_factory):
    """A person whose muscles yield, in two trials."""
    out = tmp_path_factory.mktemp("yielding")
    (out / "p.toml").write_text(YIELDING)
    return coarse_study(StudySettings(subjects=1, protocol=out / "p.toml"), out / "s")


@pytest.mark.slow(reason="simulates and analyses a small study")
def test_no_truth_is_told_of_people_whose_muscles_yield(yielding, tmp_path):
    assert all(case.identification is not None and case.truth.muscle is not None for case in yielding.cases)
    page = sketch(yielding, tmp_path, figures=("admittance_PT", "fit_PT"))
    text = re.sub(r'"data:[^"]*"', "", page)
    assert not re.search(
        r"\b(nan|truth|true|error of a parameter)\b", re.sub(r"<(style|script)\b.*?</\1>", "", text, flags=re.S), re.I
    )
    assert "of arms that are linear around each\ncondition's movement" in text
    assert "figure-parameters_PT" not in text
    assert shown_figures(Page(text)) == {"admittance_PT", "fit_PT"}
    names = possible_figures(yielding)
    assert {"admittance_PT", "fit_PT", "prediction_PT", "admittance_by_amplitude_PT"} <= names
    assert not {name for name in names if "RT" in name} - {"joint_parameters_RT"}
    assert "parameters_PT" not in names
    for name in ("admittance_PT", "fit_PT"):
        assert TRUE["color"].lower() not in (tmp_path / "figures" / f"{name}.svg").read_text(encoding="utf-8")

    tables = Page(page).tables
    for name, n_columns in (("summary", 8), ("parameters_summary", 6)):
        assert {len(row) for row in tables[name][-2:]} == {n_columns}
    for shown, row in zip(tables["parameters_summary"][1:], rows(tmp_path, "parameters_summary"), strict=True):
        assert number(shown[2]) == pytest.approx(float(row["estimated_mean"]), rel=0.006, abs=1e-6)
        assert number(shown[3]) == pytest.approx(float(row["thesis_mean"]), rel=0.006, abs=1e-6)
    of_parameters = rows(tmp_path, "estimates")
    assert list(of_parameters[0]) == HEADERS["estimates"].split(",")
    for row in of_parameters:
        for name in ("true", "error_percent", "thesis_error_percent"):
            assert math.isnan(float(row[name]))
        assert float(row["lower_95"]) <= float(row["estimated"]) <= float(row["upper_95"])
    assert all(math.isnan(float(row["coverage_95_percent"])) for row in rows(tmp_path, "summary"))


def test_a_strap_is_told_and_nothing_is_called_true(study, tmp_path):
    strap = Strap(stiffness=3000.0, damping=120.0, mass=6.0)
    protocol = replace(study.protocol, strap=strap)
    found = _Study(
        root=tmp_path,
        settings=FEW_FITS,
        paths={},
        made=study.made,
        protocol=protocol,
        environment=study.environment,
        cohort=study.cohort,
        recorded={},
    )
    case = found.with_truth(study.of("PT7.5")[0])
    assert study.has_truth
    assert case.truth is None
    strapped = replace(study, protocol=protocol, cases=(case,))
    assert strapped.is_linear
    assert "parameters_PT" not in possible_figures(strapped)
    text = " ".join(re.sub(r"<[^>]+>", "", sketch(strapped, tmp_path)).replace("&nbsp;", " ").split())
    assert "stiffness 3000 N/m, damping 120 Ns/m, and a mass of 6.00 kg that moves with the shoulder" in text
    assert text.count("of arm and moving shoulder together") == 2  # among the findings, and under Method
    assert "have linear muscles and reflexes and do not tire." in text
    assert "What is between them is the movement of the shoulder, the grip's deflection, and instruments." in text
    assert "cases the joints, as the handle's path about a fixed shoulder has them, rotate beyond" in text
    for untrue in ("the same structure as the simulated people", "only the geometry", "truth in 95 %", "person's own"):
        assert untrue not in text
    assert all(math.isnan(float(row["true"])) for row in rows(tmp_path, "estimates"))

    unit = _simulations(strapped, tmp_path)["moving-shoulder"]
    assert unit.cached.settings["strap"] == repr(unit.run.keywords["strap"]) == repr(strap)
    unit = _simulations(study, tmp_path)["moving-shoulder"]
    assert unit.run.keywords["strap"] is None
    assert "strap" not in unit.cached.settings


def test_tells_how_far_people_change_after_practice(study, tmp_path):
    steady, changing = (
        replace(THESIS, conditions=tuple(replace(c, reached=reached, reached_spread=0.0) for c in THESIS.conditions))
        for reached in (1.0, 1.25)
    )
    for protocol, told in ((steady, False), (changing, True)):
        text = sketch(replace(study, protocol=protocol, cases=(), people=()), tmp_path)
        assert "until the displacement is as intended" in text
        assert ("as people change before the experiment" in text) == told
        assert ("1.2 in PT2.5" in text) == told
    assert not re.search(r"\d in PT0,", text)


def test_reports_a_study_without_anybody_and_without_a_rig(study, tmp_path, monkeypatch):
    def without_pictures(*args, **options):
        raise RuntimeError("render: no OpenGL context; install <libegl1>")

    monkeypatch.setattr(rig_figures, "render", without_pictures)
    nobody = replace(study, cases=tuple(replace(case, identification=None) for case in study.cases), people=())
    text = sketch(nobody, tmp_path, figures=("rig", "stills"))
    assert 'Nobody was identified: the section <a href="#left_out">What was left out</a> gives the reasons' in text
    assert not {"admittance", "parameters", "fits"} & set(Page(text).ids)
    assert "render: no OpenGL context; install &lt;libegl1&gt;" in text
    assert "<libegl1>" not in text
    assert possible_figures(nobody) == {"pulse_signal", "joint_rotations", "trajectories_PT"}


def test_reports_a_protocol_of_pulses_alone(study, tmp_path):
    pulses = Protocol(conditions=(Condition(name="only <pulses>/1", task="RT", pulse_levels=(1,)),))
    of_an_earlier_report = [tmp_path / "tables" / f"{name}.csv" for name in ("estimates", "fits", "nonlinear_fits")]
    (tmp_path / "tables").mkdir()
    for path in of_an_earlier_report:
        path.write_text("not of this study\n")
    text = sketch(replace(study, protocol=pulses, cases=()), tmp_path)
    assert not any(path.exists() for path in of_an_earlier_report)
    assert "as no condition\nhas a multisine" in text
    shown = [[row[0], *row[6:]] for row in Page(text).tables["conditions"][1:]]
    assert shown == [["only <pulses>/1", "4", "1"]]


def test_reports_conditions_of_any_name_and_pulses_or_none(study, tmp_path, monkeypatch):
    odd = replace(study.protocol.condition("PT2.5"), name="a/b <odd> one")
    cases = tuple(replace(case, condition=odd) for case in study.of("PT2.5"))
    # The recordings say PT2.5; what is drawn from them is the trial without a pulse.
    recording = study.of("PT2.5")[0].trials()
    monkeypatch.setattr(type(cases[0]), "trials", lambda _: recording)
    renamed = replace(study, protocol=replace(study.protocol, conditions=(odd,)), cases=cases, people=())
    people = tuple(
        replace(
            each,
            trials=(),
            estimates={},
            **{
                name: {
                    cell._replace(condition=odd.name): value
                    for cell, value in getattr(each, name).items()
                    if cell.condition == "PT2.5"
                }
                for name in ("cells", "true_cells")
            },
        )
        for each in study.people
    )
    text = sketch(replace(renamed, people=people), tmp_path, figures=("perturbation", "prediction_PT"))
    page = Page(text)
    assert {"fits", "table-joints"} <= set(page.ids)
    # Nothing is printed of such a condition: there are no tables of the thesis to lead to.
    assert "published" not in page.ids
    assert {anchor.removeprefix("#") for anchor in page.anchors} <= set(page.ids)
    assert "Tables C.3 to E.5" not in text
    assert shown_figures(Page(text)) == {"perturbation", "prediction_PT"}
    assert possible_figures(renamed) == {
        *("perturbation", "admittance_by_task", "gain_linear_scale", "coherence"),
        *("findings", "estimates"),
        *(f"{name}_PT" for name in ("admittance", "fit", "prediction", "parameters")),
    }
    assert "a/b &lt;odd&gt; one" in text
    assert "<odd>" not in text
    assert [row[0] for row in Page(text).tables["summary"][1:]] == ["a/b <odd> one"]


def test_amplitudes_are_shades_of_the_tasks_colour():
    for colour in COLOURS.values():
        assert shades(colour, 1) == [colour.lower()]
        assert shades(colour, 3)[1] != shades(colour, 3)[0]
        brightness = [sum(int(shade[k : k + 2], 16) for k in (1, 3, 5)) for shade in shades(colour, 5)]
        assert brightness == sorted(brightness, reverse=True)


def test_a_failure_leaves_no_report(study, tmp_path):
    class Unprintable:
        def __html__(self):
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        sketch(replace(study, missing=(Unprintable(),), cases=(), people=()), tmp_path)
    assert not (tmp_path / "report.html").exists()


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0012345, "0.00123"), (99.96, "100"), (22400.0, "22400"), (-3.5, "−3.50"), (0.0, "0.00"), (None, "–")],
)
def test_digits(value, text):
    assert digits(value) == text


@pytest.mark.parametrize(
    ("mean", "sd", "text"),
    [
        (161.4, 42.2, "161 ± 42"),
        (3.38, 0.53, "3.38 ± 0.53"),
        (8200.0, 1770.0, "8200 ± 1770"),
        (5.4, 0.0, "5.40"),
        (5.4, float("nan"), "5.40"),
    ],
)
def test_mean_sd(mean, sd, text):
    assert mean_sd(mean, sd) == text


def test_small_chances_are_called_small():
    assert [chance(value) for value in (0.5, 0.0123, 1e-9)] == ["0.500", "0.012", "< 0.001"]


def test_symbol_is_escaped_markup():
    assert symbol("kv_se") == "<i>k</i><sub>v,se</sub>"
    assert symbol("zeta_act") == "<i>ζ</i><sub>act</sub>"
    assert symbol("m_<tot>") == "<i>m</i><sub>&lt;tot&gt;</sub>"


def test_differences_have_their_sign():
    assert [signed(value) for value in (1.26, -0.5, 0.0, math.nan)] == ["+1.3", "−0.5", "0.0", MISSING]


def test_conditions_are_written_as_such_in_words():
    assert words("pulse_admittance_ratio_max_min_pt7.5") == "pulse admittance ratio max min PT7.5"
    assert words("peak_displacement_ratio_rt_pt_min_level") == "peak displacement ratio RT PT min level"
    assert words("pulse_prediction_RT2.5_min") == "pulse prediction RT2.5 min"
