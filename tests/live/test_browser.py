"""The live laboratory as a browser runs it: the numbers of Python, quick, and without a network."""

import json

import pytest

from armperturb.live.page import write_live
from tests.browser import CHROMIUM, TOO_WIDE, Browser, barriers, complaints, requests
from tests.live.arms import REVIVE, compared, require_agreement, values_of

pytestmark = [
    pytest.mark.slow(reason="starts a browser"),
    pytest.mark.skipif(
        CHROMIUM is None, reason="no chromium, chromium-browser or google-chrome on PATH: the page is not seen"
    ),
]

REDRAW = 50.0
"""Most time from a slider to curves [ms], the median of several."""

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
    write_live(path)
    return path


def test_has_the_numbers_of_python(browser, page):
    browser.show(page, 1280)
    subjects = compared()
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


def test_links_carry_settings(browser, page):
    browser.show(page, 1280)
    browser.evaluate("location.hash = 'preset=linear+muscle%2C+relaxing&kind=multisine&mass=6'")
    browser.evaluate("new Promise(resolve => setTimeout(resolve, 100))")
    assert browser.evaluate("[Lab.state.preset, Lab.state.kind, Lab.armOf().m_env]") == [
        "linear muscle, relaxing",
        "multisine",
        6,
    ]
