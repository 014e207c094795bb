"""The report of a study: whole, self-contained, and true to the tables."""

import base64
import csv
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from armperturb.study import figures, report
from armperturb.study.protocol import CONDITIONS
from armperturb.study.report import digits, left_out, mean_sd, symbol, write_report
from armperturb.study.runner import StudySettings, run_study
from armperturb.study.style import save_svg
from armperturb.study.tables import fit_rows

HEADERS = {
    "summary": "condition,subjects,identified,trials,trials_left_out,model,median_abs_error_percent",
    "task_effect": "quantity,study,published",
    "parameters": "condition,subject,parameter,unit,true,estimated,sem,error_percent,at_bound",
    "parameters_summary": "condition,parameter,unit,published_mean,published_sd,true_mean,true_sd,estimated_mean",
    "fits": "condition,subject,model,status,converged",
    "conditions": "condition,published_force_N_mean,published_force_N_sd,force_N_mean",
}
DRAWN = {"perturbation", "admittance_by_task", "coherence"} | {
    f"{name}_{condition.name}" for name in ("admittance", "fit", "prediction", "parameters") for condition in CONDITIONS
}


class Page(HTMLParser):
    """What a page links to, and the text of its tables' cells."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.links, self.anchors, self.tables, self.ids = set(), [], [], {}, []
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
            self._cell = ""

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self._table[-1].append(" ".join(self._cell.split()))
            self._cell = None

    def handle_data(self, data):
        if self._cell is not None:
            self._cell += data


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return tmp_path_factory.mktemp("study")


@pytest.fixture(scope="module")
def study(out):
    return run_study(StudySettings(subjects=1, seed=3), out, show_progress=False)


@pytest.fixture(scope="module")
def written(study, out):
    return write_report(study, out)


@pytest.fixture(scope="module")
def page(written):
    return Page(written.read_text(encoding="utf-8"))


def rows(out, name):
    with (out / "tables" / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def number(text):
    return float(text.replace("−", "-"))


def test_report_lies_in_the_folder(written, out):
    assert written == out / "report.html"
    assert written.stat().st_size < 8e6
    assert not list(out.rglob("*.part"))


def test_asks_for_nothing_outside_itself(written, page):
    assert page.links
    assert all(link.startswith("data:") for link in page.links)
    assert not page.tags & {"link", "iframe", "object", "embed", "base"}
    text = written.read_text(encoding="utf-8")
    assert "@import" not in text
    assert "url(" not in text


def test_contents_lead_to_the_sections(page):
    assert len(page.anchors) == 7
    assert {anchor.removeprefix("#") for anchor in page.anchors} <= set(page.ids)
    assert len(page.ids) == len(set(page.ids))


def test_every_figure_is_embedded(page, out):
    files = {path.stem: path for path in (out / "figures").glob("*.svg")}
    assert files.keys() - {"rig"} == DRAWN  # the rig needs a GL library
    embedded = {base64.b64decode(link.partition(",")[2]) for link in page.links}
    assert embedded == {path.read_bytes() for path in files.values()}


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
    for shown, row in zip(cells, rows(out, "summary"), strict=True):
        assert shown[0] == row["condition"]
        assert shown[3] == f"{row['trials']} of {row['trials']}"
        assert number(shown[4]) == pytest.approx(float(row["median_abs_error_percent"]), rel=0.06)  # two digits
        assert number(shown[5]) == pytest.approx(float(row["VAF_x_mean"]), abs=0.0051)
        assert number(shown[6]) == pytest.approx(float(row["VAF_y_mean"]), abs=0.0051)


def test_parameters_show_their_table(page, out):
    cells, table = page.tables["parameters_summary"][1:], rows(out, "parameters_summary")
    assert len(cells) == len(table) == 23
    for shown, row in zip(cells, table, strict=True):
        assert shown[0] == row["condition"]
        assert shown[2] == row["unit"]
        mean, sd = (number(part) for part in shown[3].split(" ± "))
        assert mean == pytest.approx(float(row["published_mean"]), abs=0.06 * float(row["published_sd"]))
        assert sd == pytest.approx(float(row["published_sd"]), rel=0.06)
        for text, name in ((shown[4], "true_mean"), (shown[5], "estimated_mean")):
            assert number(text) == pytest.approx(float(row[name]), rel=0.006)  # one person: three digits, no SD


def test_task_effect_is_the_ratio_of_the_gains(study, written, out):
    relax, position = (study.of(name)[0].identification.spectra.arm for name in ("RT7.5", "PT7.5"))
    gains = [abs(relax[k, i, i]) / abs(position[k, i, i]) for k in range(2) for i in range(2)]
    effect = float(rows(out, "task_effect")[0]["study"])
    assert effect == pytest.approx(sum(gains) / 4)
    assert f'id="task-effect">{digits(effect)}<' in written.read_text(encoding="utf-8")


def test_same_study_same_bytes(study, tmp_path):
    case = study.of("PT7.5")[0]
    for draw in (
        lambda: figures.perturbation(case),
        lambda: figures.coherence(study),
        lambda: figures.parameters(study, CONDITIONS[1]),
    ):
        for name in ("first.svg", "second.svg"):
            save_svg(draw(), tmp_path / name)
        assert (tmp_path / "first.svg").read_bytes() == (tmp_path / "second.svg").read_bytes()


def test_users_settings_neither_matter_nor_change(study, tmp_path):
    import matplotlib

    save_svg(figures.prediction(study.of("RT7.5")[0]), tmp_path / "plain.svg")
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "black"}):
        save_svg(figures.prediction(study.of("RT7.5")[0]), tmp_path / "odd.svg")
        assert matplotlib.rcParams["font.size"] == 30
    assert (tmp_path / "plain.svg").read_bytes() == (tmp_path / "odd.svg").read_bytes()


def test_leaves_no_open_figures(written):
    if "matplotlib.pyplot" in sys.modules:  # another test's doing
        assert sys.modules["matplotlib.pyplot"].get_fignums() == []


def without_pictures(model, *args, **options):
    raise RuntimeError("render: no OpenGL context; install <libegl1>")


def test_reports_what_went_badly(study, tmp_path, monkeypatch):
    position, relax = study.cases
    fit = replace(position.identification.fit, stable=False, at_bound=("k_s",), converged=False, status="gave up")
    bad = replace(
        position,
        identification=replace(position.identification, fit=fit, vaf=position.identification.vaf * -float("inf")),
    )
    gone = replace(relax, identification=None, left_out=("trial 0 of S01 in RT7.5 reached the <limit> at 9.000 s",))
    badly = replace(study, cases=(bad, gone))
    lists = left_out(badly, fit_rows(badly))
    assert lists["Fits with a parameter at its bound"] == ["S01 in PT7.5: k_s"]
    assert lists["Fits that did not converge"] == ["S01 in PT7.5: gave up"]
    assert lists["People without any trial left"] == ["S01 in RT7.5"]
    monkeypatch.setattr(figures, "render", without_pictures)
    text = write_report(badly, tmp_path).read_text(encoding="utf-8")
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == {name for name in DRAWN if "RT7.5" not in name}
    assert "reached the &lt;limit&gt; at 9.000 s" in text
    shown = Page(text).tables["summary"][1:]
    assert [row[0] for row in shown] == ["PT7.5"]
    assert shown[0][5] == report.MISSING
    assert shown[0][7] == "0 of 1"
    assert not (tmp_path / "tables" / "task_effect.csv").exists()


def test_reports_a_study_without_anybody_and_without_a_rig(study, tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "render", without_pictures)
    nobody = replace(study, cases=tuple(replace(case, identification=None) for case in study.cases))
    text = write_report(nobody, tmp_path).read_text(encoding="utf-8")
    assert "Nobody was identified" in text
    assert "render: no OpenGL context; install &lt;libegl1&gt;" in text
    assert "<libegl1>" not in text
    assert Page(text).links == []


def test_a_failure_leaves_no_report(study, tmp_path, monkeypatch):
    monkeypatch.setattr(report, "_draw", lambda *_: ({}, {}))
    monkeypatch.setattr(report, "_page", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_report(study, tmp_path)
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


def test_symbol_is_escaped_markup():
    assert symbol("kv_se") == "<i>k</i><sub>v,se</sub>"
    assert symbol("m_<tot>") == "<i>m</i><sub>&lt;tot&gt;</sub>"
