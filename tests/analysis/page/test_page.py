"""The page of an identification: whole, self-contained, and true to the numbers that it comes from."""

import math
import re
import tomllib
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from foreign_arms import Arm
from foreign_recordings import Setup, recording_of
from invented_emg import noise, recorded

import armperturb
from armperturb.analysis.emg.envelope import envelopes
from armperturb.analysis.fit.diagnosis import diagnose
from armperturb.analysis.fit.frequency_bands import BandOfLack
from armperturb.analysis.fit.group import parts_by_condition
from armperturb.analysis.fit.identification import Identifications
from armperturb.analysis.fit.identify import identify_conditions
from armperturb.analysis.fit.whittle import LackOfFit
from armperturb.analysis.imbalance import Imbalance
from armperturb.analysis.page.data_check import check_data
from armperturb.analysis.page.page import WORDS, Origin, write_page
from armperturb.analysis.page.verdict import likely_causes, nonlinearity, unknowns, verdict
from armperturb.analysis.response.best_linear import best_linear
from armperturb.analysis.results import Description, Table, plain
from armperturb.joined_recordings import stack_trials
from armperturb.plots.traces import COLUMNS, outline
from tests.browser import BROKEN_IMAGES, CHROMIUM, DEAD_LINKS, SMALL_PRINT, TOO_WIDE, Browser, complaints, requests

NAME = "<b>S & 1</b>"
ROOT = Path(armperturb.__file__).parents[1]
LEAST_CONTRAST = 4.5  # of small text, WCAG 2 level AA


AS_MODEL_1 = Arm(centre=(0.5, 0.5), gyration=(0.0, 0.0), grip=(5000.0, 50.0))
"""An arm that model 1 can be. One that it cannot takes a long search where two conditions share parameters."""


def multisines(arm):
    still = Setup(arm=arm, seed=3, n_trials=3, duration=20.0, linear=True)
    return recording_of(still, *still.record())


def session():
    """Two conditions of one person: three multisines, and the same with a pulse at the end."""
    first = multisines(AS_MODEL_1)
    second = first.assign_coords(
        condition=("trial", ["pulsed"] * 3),
        pulse_onset=("trial", [17.0] * 3),
        pulse_direction=("trial", [20.0, 200.0, 20.0]),
        pulse_level=("trial", [1.0] * 3),
    )
    both = stack_trials([first, second])
    return both.assign_coords(subject=("trial", [NAME] * 6))


def silent_muscles():
    """EMG of the same trials, of muscles that answer to nothing, beside a trial of maximal contraction."""
    volts = np.append(np.full(6, 0.1), 1.0)[:, None, None] * noise((7, 2, 40_000))
    volts[-1, :, :2000] *= 0.01
    conditions = ["multisine"] * 3 + ["pulsed"] * 3 + ["MVC"]
    pulses = {
        "repetition": [*range(3), *range(3), 0],
        "pulse_level": [0.0] * 3 + [1.0] * 3 + [0.0],
        "pulse_onset": [math.nan] * 3 + [17.0] * 3 + [math.nan],
        "pulse_direction": [math.nan] * 3 + [20.0, 200.0, 20.0] + [math.nan],
    }
    return recorded(volts, conditions, subject=[NAME] * 7, **pulses)


@pytest.fixture(scope="module")
def identified():
    trials = parts_by_condition(session())
    return identify_conditions(trials, "1"), trials


@pytest.fixture(scope="module")
def drawn_page(identified, tmp_path_factory):
    return written(identified, tmp_path_factory.mktemp("drawn") / "identify.html")


@pytest.fixture(scope="module")
def page(identified, tmp_path_factory):
    """With nothing in the pictures, as most of the time would pass with drawing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("armperturb.pages.page.svg", lambda _: b"<svg/>")
        return written(identified, tmp_path_factory.mktemp("page") / "identify.html")


def written(identified, path):
    """The path of a page with everything that there may be."""
    results, trials = identified
    choice = SimpleNamespace(
        group=SimpleNamespace(parts=trials["multisine"]),
        sentence="the trials choose <this>",
        undecided=("grip: rigid or spring",),
        remarks=lambda parts: (),
        describe=lambda: Description(title="Structures tried", table=Table(("structure", "p"), (("1", "0.3"),))),
    )
    first, second = results.values()
    chosen = replace(first, fit=replace(first.fit, choice=choice))
    results = Identifications({"multisine": chosen, "pulsed": second})
    origin = Origin(
        command="armperturb identify <a>.nc --model 1",
        files={"<a>.nc": "0" * 64},
        notes=("a gap & a <repair>",),
    )
    write_page(results, trials, path, origin, envelopes(silent_muscles()))
    return path


class Content(HTMLParser):
    """Text, tags and headings of a page, without what its figures hold."""

    def __init__(self, page):
        super().__init__()
        self.text, self.tags, self.headings, self._open = [], [], [], []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self._open.append(tag)

    def handle_endtag(self, tag):
        while self._open and self._open.pop() != tag:
            pass

    def handle_data(self, data):
        if not {"style", "script"} & set(self._open):
            self.text.append(data)
        if self._open and self._open[-1] in ("h1", "h2"):
            self.headings.append(data)


@pytest.fixture(scope="module")
def content(page):
    return Content(page.read_text(encoding="utf-8"))


@pytest.mark.slow(reason="draws fourteen pictures")
def test_the_page_is_one_small_file(drawn_page):
    assert drawn_page.stat().st_size < 3e6
    text = drawn_page.read_text(encoding="utf-8")
    content = Content(text)
    sources = [value for _, attrs in content.tags for name, value in attrs.items() if name in ("src", "href")]
    assert sources
    assert all(source.startswith(("data:image/svg+xml;base64,", "#")) for source in sources)
    assert not re.search(r"url\(|@import", text)


def test_all_sections_are_there_in_order(content):
    sections = [title for name, title in WORDS["sections"].items() if not name.startswith("joint_")]
    assert content.headings == [f"Arm of {NAME}", *sections]
    levels = [tag for tag, _ in content.tags if tag in ("h1", "h2", "h3")]
    assert levels[0] == "h1"
    assert levels.count("h1") == 1
    figures = [attrs for tag, attrs in content.tags if tag == "img"]
    assert len(figures) == 14
    assert all(len(attrs["alt"]) > 20 for attrs in figures)
    n_tables = sum(tag == "table" for tag, _ in content.tags)
    assert n_tables == sum(tag == "thead" for tag, _ in content.tags) > 4
    assert all("scope" in attrs for tag, attrs in content.tags if tag == "th")


def test_names_are_text_and_numbers_are_numbers(page, content):
    source, text = page.read_text(encoding="utf-8"), " ".join(content.text)
    assert NAME not in source
    assert not {"b>s", "a", "this", "repair"} & {tag for tag, attrs in content.tags if not attrs}
    for shown in (NAME, "<a>.nc", "a gap & a <repair>", "The trials choose <this>.", "grip: rigid or spring"):
        assert shown in text
    assert not re.search(r"\bnan\b|\binf\b|None", text)


def test_numbers_are_those_of_the_results(identified, content):
    results, trials = identified
    text = " ".join(content.text)
    for label, result in results.items():
        assert f"{result.vaf[0]:.1f} % of the movement's variance along x" in text
        for value in result.fit.values.values():
            assert plain(value) in text
        assert verdict(result, diagnose(result, trials[label]).bands).text.rpartition(":")[0] in text
        check = check_data(trials[label], 8.0)
        assert (check.n_trials, check.period, check.from_rest) == (3, 10.0, False)
        assert "amid the movement" in text
        assert f"{check.environment.m_env:.3f} kg" in text
        assert check.n_pulses == (3 if label == "pulsed" else 0)
        assert (check.clipped, check.held) == ({}, 0.0)


@pytest.mark.slow(reason="fits and draws a page")
@pytest.mark.usefixtures("blank_pictures")
def test_a_fit_to_pulses_alone_has_a_page(tmp_path):
    pulsed = Setup(arm=AS_MODEL_1, kind="pulses", seed=1, n_trials=6, duration=6.0, linear=True)
    labels = {"pulse_onset": [1.0] * 6, "pulse_direction": [0.0, 90.0] * 3, "pulse_level": [1.0] * 6}
    recording = pulsed.recording().assign_coords({name: ("trial", values) for name, values in labels.items()})
    trials = parts_by_condition(recording)
    write_page(identify_conditions(trials, "1"), trials, tmp_path / "identify.html", Origin())
    text = " ".join(Content((tmp_path / "identify.html").read_text(encoding="utf-8")).text)
    assert "as the model, which is fitted to these pulses too, predicts it" in text
    assert "from what precedes the pulses" not in text


@pytest.mark.slow(reason="draws a page")
@pytest.mark.usefixtures("blank_pictures")
def test_conditions_of_both_tasks_are_told_by_task(identified, tmp_path):
    results, trials = identified
    first, other = results.values()
    tasks = {"PT": "keeps the position", "RT": "relaxes"}
    task = next(each for each in tasks if each != first.fit.arm.task)
    arm = replace(other.fit.arm, task=task)
    of_both = Identifications({"multisine": first, "pulsed": replace(other, fit=replace(other.fit, arm=arm))})
    write_page(of_both, trials, tmp_path / "identify.html", Origin())
    text = " ".join(" ".join(Content((tmp_path / "identify.html").read_text(encoding="utf-8")).text).split())
    assert f"{tasks[first.fit.arm.task]}: multisine, 3 trials" in text
    assert f"{tasks[task]}: pulsed, 3 trials" in text


def test_clipped_and_constant_samples_are_counted(identified):
    _, trials = identified
    recording = trials["multisine"][0].recording.copy(deep=True)
    force = recording["force"].values
    top = 0.6 * force[1, :, 0].max()
    n_clipped = int((force[1, :, 0] > top).sum())
    force[1, :, 0] = np.minimum(force[1, :, 0], top)
    for name in ("force", "displacement"):
        recording[name].values[2, 1000:1100] = recording[name].values[2, 1000]
    check = check_data(parts_by_condition(recording)["multisine"], 8.0)
    assert set(check.clipped) == {"force x"}
    assert 0.5 * n_clipped < check.clipped["force x"] <= n_clipped
    assert check.held == pytest.approx(100 / check.rate)


def test_lack_of_fit_by_band_adds_up_and_spectra_have_their_power(identified):
    results, trials = identified
    result, part = results["multisine"], trials["multisine"][0]
    diagnosis = diagnose(result, [part])
    estimate = result.fit.detail
    assert len(diagnosis.bands) * 8 > estimate.dof / 2
    widths = np.diff(diagnosis.frequency, append=2 * diagnosis.frequency[-1] - diagnosis.frequency[-2])
    power = np.sum(diagnosis.moved * widths[:, None], axis=0)
    np.testing.assert_allclose(power, np.mean(part.displacement**2, axis=(0, 1)), rtol=0.25)
    # The model follows the noise that is left, and both are far below the movement.
    ratio = np.mean(diagnosis.left / diagnosis.noise, axis=0)
    assert ((ratio > 0.8) & (ratio < 1.2)).all()


def test_verdicts_in_words(identified):
    results, _ = identified
    fine = results["multisine"]

    def with_fit(**changes):
        return replace(fine, fit=replace(fine.fit, **changes))

    def with_chi2(chi2, dof=100):
        return with_fit(detail=replace(fine.fit.detail, chi2=chi2, dof=dof, dispersion=chi2 / dof))

    assert verdict(with_chi2(100.0), ()).level == "trust"
    care = verdict(with_chi2(150.0), ())
    assert care.level == "care"
    assert f"{math.sqrt(1.5):.2f}" in care.text
    assert verdict(with_chi2(1000.0), ()).level == "reject"
    # Of several conditions together, each is judged by its own lack of fit.
    right = [BandOfLack(1.0, 2.0, 8.0)] * 20
    arms = {condition: result.fit.arm for condition, result in results.items()}
    together = with_fit(detail=replace(fine.fit.detail, arms=arms))
    assert verdict(together, right).level == "trust"
    assert verdict(together, [*right, BandOfLack(2.0, 3.0, 500.0)]).level == "reject"
    assert verdict(with_fit(converged=False), ()).level == verdict(with_fit(stable=False), ()).level == "reject"


def test_emg_that_does_not_fit_is_not_blamed_on_the_movement(identified):
    results, trials = identified
    (_, found), part = next(iter(results.items())), trials["multisine"]
    lacking = replace(found.fit.detail, chi2=600.0, dof=200, lack_of_emg=LackOfFit(500.0, 100))
    lacking = replace(lacking, arms={"multisine": found.fit.arm})
    wrong = replace(found, fit=replace(found.fit, detail=lacking))
    said = verdict(wrong, ())
    assert said.level == "reject"
    assert said.text.startswith("EMG does not follow from the reflexes that the movement shows")
    assert "Rely on a fit without --emg" in said.text
    cause = likely_causes(wrong, check_data(part, 8.0), diagnose(found, part), None)[0]
    assert (cause.name, cause.supported) == ("EMG", True)
    moved = replace(lacking, lack_of_emg=LackOfFit(100.0, 100))
    assert not moved.doubts_emg
    assert "of the movement than" in verdict(replace(found, fit=replace(found.fit, detail=moved)), ()).text


def test_what_is_wrong_with_the_balance_caps_the_verdict(identified):
    results, trials = identified
    (_, found), part = next(iter(results.items())), trials["multisine"]
    fits = replace(found.fit.detail, chi2=100.0, dof=100, arms={"multisine": found.fit.arm})
    known = {name: 0.01 * abs(value) for name, value in found.fit.values.items()}
    fine = replace(found, fit=replace(found.fit, detail=fits, standard_error=known))
    gain, bands = Imbalance("gain", "force appears to be too large", 0.99, 0.15), ()
    assert verdict(fine, bands, None).level == "trust"
    assert verdict(fine, bands, gain).level == "reject"
    assert verdict(fine, bands, gain).text.startswith("Force appears to be too large, ")
    assert verdict(fine, bands, gain._replace(bias=0.04)).level == "care"  # however well parameters are known
    unsure = {name: 0.1 * abs(value) for name, value in fine.fit.values.items()}
    unknown = replace(fine, fit=replace(fine.fit, standard_error=unsure))
    assert verdict(unknown, bands, gain).level == "trust"  # within the intervals
    late = Imbalance("force", "force is recorded 1.00 ms later", 0.99, 0.001, 1e-3, 1e-5)
    assert verdict(unknown, bands, late).level == "care"
    assert verdict(fine, bands, late._replace(delay=1e-2, bias=gain.bias)).level == "reject"
    unstable = replace(fine, fit=replace(fine.fit, stable=False))
    assert verdict(unstable, bands, late).level == "reject"
    assert verdict(unstable, bands, late).text.startswith("Force is recorded 1.00 ms later, ")
    check, diagnosis = check_data(part, 8.0), diagnose(found, part)
    assert check.imbalance is None
    for wrong, name in ((gain, "force balance"), (late, "clocks")):
        cause = likely_causes(fine, check._replace(imbalance=wrong), diagnosis, None)[0]
        assert (cause.name, cause.supported) == (name, True)
        assert cause.evidence.startswith("Force ")
    early = Imbalance("perturbation", "perturbation is recorded 0.50 ms earlier", 0.99, 0.02, -5e-4, 1e-5)
    cause = likely_causes(fine, check._replace(imbalance=early), diagnosis, None)[0]
    assert cause.name == "clocks"
    assert "held between its samples acts later: delay it by 0.50 ms in the file" in cause.remedy


def test_a_force_that_is_late_or_too_large_is_found_in_the_trials(identified):
    _, trials = identified
    recording = trials["multisine"][0].recording
    force = recording["force"]
    for changed, kind in ((1.15 * force.values, "gain"), (np.roll(force.values, 1, axis=1), "force")):
        part = parts_by_condition(recording.assign(force=force.copy(data=changed)))["multisine"]
        check = check_data(part, 8.0)
        assert check.imbalance.kind == kind
        assert check.imbalance.bias > 0.05
        assert math.isfinite(check.skew.standard_error) == (kind == "force")
        assert check.skew.time == pytest.approx(0.0 if kind == "gain" else 1 / check.rate, abs=1e-5)


@pytest.mark.slow(reason="identifies an arm that the model does not fit")
def test_causes_come_in_order_with_what_the_data_say():
    trials = parts_by_condition(multisines(Arm()))
    results, part = identify_conditions(trials, "1"), trials["multisine"]
    check = check_data(part, 8.0)
    distortion = best_linear(part)
    causes = likely_causes(results["multisine"], check, diagnose(results["multisine"], part), distortion)
    assert [cause.name for cause in causes] == ["inertia", "grip", "wrong geometry", "delay", "nonlinearity"]
    assert [cause.supported for cause in causes][1] is False  # as model 1 has it free
    late = check._replace(skew=check.skew._replace(time=2e-3))
    assert likely_causes(results["multisine"], late, diagnose(results["multisine"], part), None)[0].name == "clocks"
    # The simulated arm is linear.
    assert nonlinearity(distortion).supported is False
    assert nonlinearity(None).supported is None
    strong = replace(distortion, statistic=9.0, distortion=0.1 * distortion.linear)
    assert nonlinearity(strong).supported is True
    causes = likely_causes(results["multisine"], check, diagnose(results["multisine"], part), strong)
    assert causes[0].name == "nonlinearity"
    assert re.search(r"9.1% .* Hz in x", nonlinearity(strong).evidence)


def test_what_the_data_cannot_tell(identified):
    results, trials = identified
    check = check_data(trials["multisine"], 8.0)
    said = unknowns(results["multisine"], check._replace(n_trials=1), ("grip: rigid or spring",))
    assert any("grip: rigid or spring" in line for line in said)
    assert any("1 trial does not tell" in line for line in said)
    assert not any("trial to trial" in line for line in unknowns(results["multisine"], check))


def test_the_citation_is_that_of_the_project(content):
    cited = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    text = " ".join(" ".join(content.text).split())
    for field in (r"^version", r"^license", r"^  - name", r"^    title", r"^        name", r"^      name"):
        for value in re.findall(rf"{field}: (.*)$", cited, re.MULTILINE):
            assert value in text
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["license"] in cited
    assert project["description"].removesuffix(".") in text


def test_an_outline_keeps_the_extremes():
    values = np.random.default_rng(0).normal(size=10_000)
    places, shown = outline(values)
    assert len(shown) == 2 * COLUMNS
    assert (np.diff(places) >= 0).all()
    np.testing.assert_array_equal(values[places], shown)
    assert (shown.min(), shown.max()) == (values.min(), values.max())
    short = values[:COLUMNS]
    np.testing.assert_array_equal(outline(short)[1], short)


CONTRAST = """
(() => {
  const light = colour => {
    const [r, g, b] = colour.match(/[\\d.]+/g).map(Number).map(v => v / 255)
      .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const behind = one => {
    const colour = getComputedStyle(one).backgroundColor;
    if (colour !== "rgba(0, 0, 0, 0)") return colour;
    return one.parentElement ? behind(one.parentElement) : "rgb(255, 255, 255)";
  };
  return Math.min(...[...document.querySelectorAll("p, li, td, th, a, h1, h2, figcaption, pre")].map(one => {
    const [dark, bright] = [light(getComputedStyle(one).color), light(behind(one))].sort((a, b) => a - b);
    return (bright + 0.05) / (dark + 0.05);
  }));
})()
"""


@pytest.mark.slow(reason="starts a browser")
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium, chromium-browser or google-chrome on PATH")
def test_a_browser_shows_it_whole_at_both_widths(drawn_page, tmp_path):
    browser = Browser(tmp_path / "profile")
    try:
        browser.open_page()
        for width in (1280, 400):
            browser.show(drawn_page, width)
            assert browser.evaluate("document.images.length") == 14
            for wrong in (BROKEN_IMAGES, TOO_WIDE, SMALL_PRINT, DEAD_LINKS):
                assert browser.evaluate(wrong) == []
            assert browser.evaluate(CONTRAST) > LEAST_CONTRAST
            assert complaints(browser) == requests(browser) == []
    finally:
        browser.stop()
