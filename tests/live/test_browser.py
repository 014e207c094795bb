"""The live laboratory as a browser runs it: the numbers of Python, quick, and without a network."""

import json
from dataclasses import replace

import pytest

from armperturb.cohort import average_person
from armperturb.live.page import arm_values, write_live
from armperturb.subject import at_level
from tests.browser import CHROMIUM, TOO_WIDE, Browser, barriers, complaints, requests
from tests.live.arms import REVIVE, compared, require_agreement, too_fast, values_of

pytestmark = [
    pytest.mark.slow(reason="starts a browser"),
    pytest.mark.skipif(
        CHROMIUM is None, reason="no chromium, chromium-browser or google-chrome on PATH: the page is not seen"
    ),
]

REDRAW = 50.0
"""Most time from a slider to curves [ms], the median of several."""

PERSON = average_person().subjects["PT"]
SLOPED = replace(
    PERSON, muscle=replace(PERSON.muscle, spindle_threshold=0.1, spindle_threshold_slope=(-0.1, -0.2, 0.0))
)
"""A person whose active spindles respond earlier."""

SLIDE = """
(() => {
  const took = [];
  const slider = document.getElementById("s-k");
  for (let k = 0; k < 40; k += 1) {
    slider.value = 0.3 + 0.01 * k;
    slider.dispatchEvent(new Event("input"));
    took.push(Lab.took);
  }
  return took.sort((a, b) => a - b)[took.length / 2];
})()
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    shown = Browser(tmp_path_factory.mktemp("profile"))
    try:
        shown.open_page()
        yield shown
    finally:
        shown.stop()


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    path = tmp_path_factory.mktemp("live") / "live.html"
    write_live(path, {"sloped": SLOPED})
    return path


def test_has_the_numbers_of_python(browser, page):
    browser.show(page, 1280)
    subjects = [*compared(), *too_fast()]
    given = json.dumps([values_of(subject) for subject in subjects])
    require_agreement(subjects, browser.evaluate(f"(() => {{ {REVIVE} return answers({given}); }})()"))


@pytest.mark.parametrize("width", [1280, 400])
def test_slides_quickly_and_is_whole(browser, page, width):
    browser.show(page, width)
    assert browser.evaluate(SLIDE) < REDRAW
    assert "k=" in browser.evaluate("location.hash")
    assert browser.evaluate("document.getElementById('o-k').textContent").endswith("×")
    assert browser.evaluate(TOO_WIDE) == []
    assert barriers(browser) == {}
    assert complaints(browser) == []
    assert requests(browser) == []


def set_up(browser, page, settings):
    browser.show(page, 1280)
    browser.evaluate(f"location.hash = '{settings}'")
    browser.evaluate("new Promise(resolve => setTimeout(resolve, 100))")


@pytest.mark.parametrize("kind", ["pulse", "multisine"])
def test_cuts_the_step_of_a_fast_arm_and_says_where_it_cannot(browser, page, kind):
    said = "document.getElementById('numbers').textContent"
    set_up(browser, page, f"kind={kind}&preset=average+person%2C+holding&level=2&b=4")
    assert "limit of the workspace" not in browser.evaluate(said)
    set_up(browser, page, f"kind={kind}&preset=linear+muscle%2C+holding&level=4&b=4&elbow=20&mass=0.5")
    text = browser.evaluate(said)
    assert "not computed: fastest pole of arm and load = 28587 1/s; expected at most 16000 1/s" in text
    assert "distance" not in text
    assert complaints(browser) == []


def test_co_contraction_is_that_of_at_level(browser, page):
    set_up(browser, page, "preset=sloped&level=2")
    arm, expected = browser.evaluate("Lab.armOf()"), arm_values(at_level(SLOPED, 2.0))
    for name in ("k_s", "b_se", "kv_e", "kp_s"):
        assert arm[name] == pytest.approx(expected[name])
    for name in ("short_range_stiffness", "spindle_threshold"):
        assert arm["muscle"][name] == pytest.approx(expected["muscle"][name])


def test_links_carry_settings(browser, page):
    set_up(browser, page, "preset=linear+muscle%2C+relaxing&kind=multisine&mass=6")
    assert browser.evaluate("[Lab.state.preset, Lab.state.kind, Lab.armOf().m_env]") == [
        "linear muscle, relaxing",
        "multisine",
        6,
    ]
