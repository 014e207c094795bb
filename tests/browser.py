"""A headless browser, and what to ask it about a page."""

import fcntl
import json
import os
import select
import shutil
import subprocess
import time
from itertools import count
from pathlib import Path

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--hide-scrollbars=false"),
    *("--host-resolver-rules=MAP * ~NOTFOUND", "--remote-debugging-pipe"),
)
PATIENCE = 60.0  # [s]; far more than anything here takes
HEIGHT = 900


class Browser:
    """A headless browser that is spoken to in Chrome's DevTools protocol, through two pipes."""

    def __init__(self, profile):
        from_us, self._out = os.pipe()
        self._in, to_us = os.pipe()
        # The browser reads from descriptor 3 and writes to 4, which these must not be themselves.
        theirs = [fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (from_us, to_us)]
        redirected = 'exec "$0" "$@" 3<&{} 4>&{}'.format(*theirs)
        command = ["bash", "-c", redirected, CHROMIUM, *FLAGS, f"--user-data-dir={profile}"]
        self._process = subprocess.Popen(command, pass_fds=theirs, stderr=subprocess.DEVNULL)
        for end in (from_us, to_us, *theirs):
            os.close(end)
        self._numbers, self._rest, self._session = count(1), b"", {}
        self.events = []

    def open_page(self):
        """An empty one."""
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self._session = {"sessionId": self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]}
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")

    def stop(self):
        self._process.kill()
        self._process.wait()
        os.close(self._out)
        os.close(self._in)

    def ask(self, method, **parameters):
        """The answer to a command; events that come before are kept."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters, **self._session}
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while (found := self._next()).get("id") != number:
            self.events.append(found)
        assert "error" not in found, found
        return found["result"]

    def wait_for(self, method):
        while not any(event["method"] == method for event in self.events):
            self.events.append(self._next())

    def evaluate(self, expression):
        """The value of an expression of JavaScript, or of what it promises."""
        found = self.ask("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def show(self, path, width):
        """Load a page in a window of that width."""
        self.ask("Emulation.setDeviceMetricsOverride", width=width, height=HEIGHT, deviceScaleFactor=1, mobile=False)
        self.events.clear()
        self.ask("Page.navigate", url=path.as_uri())
        self.wait_for("Page.loadEventFired")

    def press_escape(self):
        for kind in ("keyDown", "keyUp"):
            self.ask("Input.dispatchKeyEvent", type=kind, key="Escape", code="Escape", windowsVirtualKeyCode=27)

    def _next(self):
        end = time.monotonic() + PATIENCE
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._in], [], [], end - time.monotonic())
            assert ready, "the browser does not answer"
            part = os.read(self._in, 1 << 20)
            assert part, "the browser has ended"
            self._rest += part
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)


COMPLAINTS = {
    "Runtime.exceptionThrown": lambda it: it["exceptionDetails"]["text"],
    "Log.entryAdded": lambda it: it["entry"]["text"] if it["entry"]["level"] in ("error", "warning") else "",
    "Runtime.consoleAPICalled": lambda it: str(it["args"]) if it["type"] in ("error", "warning", "assert") else "",
}


def complaints(browser):
    """What the browser has against the page."""
    said = [COMPLAINTS[event["method"]](event["params"]) for event in browser.events if event["method"] in COMPLAINTS]
    return [line for line in said if line]


def requests(browser):
    """Addresses that the page has asked for, its own and what it holds aside."""
    asked = [
        event["params"]["request"]["url"] for event in browser.events if event["method"] == "Network.requestWillBeSent"
    ]
    return [url for url in asked[1:] if not url.startswith("data:")]


BROKEN_IMAGES = """
Promise.all([...document.images].map(image => image.decode().then(
  () => image.naturalWidth > 0 && image.getBoundingClientRect().width > 100 ? "" : image.alt, () => image.alt)))
.then(found => found.filter(name => name))
"""

DEAD_LINKS = """
(async () => {
  document.documentElement.style.scrollBehavior = "auto";
  const dead = [];
  for (const link of document.querySelectorAll("nav a")) {
    scrollTo(0, link.getAttribute("href") === "#summary" ? document.body.scrollHeight : 0);
    link.click();
    await new Promise(resolve => setTimeout(resolve, 30));
    const target = document.querySelector(link.getAttribute("href"));
    const top = target ? target.getBoundingClientRect().top : NaN;
    // The last section may be too short to reach the top.
    const ended = Math.abs(scrollY + innerHeight - document.documentElement.scrollHeight) < 2;
    if (!(Math.abs(top) < 2 || (ended && top > 0 && top < innerHeight))) dead.push(link.textContent);
  }
  return dead;
})()
"""

TOO_WIDE = """
(() => {
  const wide = [...document.querySelectorAll("h1, h2, h3, p, li, dd, summary, figcaption, img, nav a, .table")].filter(
    one => one.offsetParent && !one.parentElement.closest(".table, .frame")
      && (one.getBoundingClientRect().right > innerWidth + 0.5 || one.getBoundingClientRect().left < 0));
  const found = wide.map(one => one.outerHTML.slice(0, 80));
  const page = document.documentElement.scrollWidth;
  return page > innerWidth ? [...found, `the page is ${page} wide`] : found;
})()
"""

SMALL_PRINT = """
[...document.querySelectorAll("p, li, dd, td, th, summary, figcaption")]
  .filter(one => one.offsetParent && one.textContent.trim() && parseFloat(getComputedStyle(one).fontSize) < 12)
  .map(one => one.outerHTML.slice(0, 80))
"""

ZOOMS = """
(() => {
  const zooms = [...document.querySelectorAll("figure .zoom")];
  const failed = [];
  window.widths = zooms.map(zoom => zoom.querySelector("img").getBoundingClientRect().width);
  zooms.forEach((zoom, k) => {
    zoom.click();
    const box = zoom.getBoundingClientRect(), image = zoom.querySelector("img").getBoundingClientRect();
    const fills = box.left <= 0 && box.top <= 0 && box.right >= document.documentElement.clientWidth
      && box.bottom >= innerHeight;
    if (!fills || image.width <= widths[k]) failed.push(zoom.querySelector("img").alt);
    if (k < zooms.length - 1) zoom.click();  // closes it; the last one is left to Escape
  });
  return {n: zooms.length, failed, open: document.querySelectorAll(".zoom input:checked").length};
})()
"""

BARRIERS = """
(() => {
  const shown = one => one.getClientRects().length > 0 && getComputedStyle(one).visibility !== "hidden";
  const told = one => one.getAttribute("aria-label")
    || document.getElementById(one.getAttribute("aria-labelledby"))?.textContent
    || [...(one.labels || [])].map(label => label.textContent).join("") || one.getAttribute("alt") || one.textContent;
  const find = (selector, wrong) =>
    [...document.querySelectorAll(selector)].filter(wrong).map(one => one.outerHTML.slice(0, 100));
  const numbers = colour => colour.match(/[\\d.]+/g).map(Number);
  const light = ([r, g, b]) => [r, g, b].map(c => c / 255)
    .map(c => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4)
    .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
  const behind = one => {
    for (let at = one; at; at = at.parentElement) {
      const back = numbers(getComputedStyle(at).backgroundColor);
      if (back.length === 3 || back[3] === 1) return back;
    }
    return [255, 255, 255];
  };
  const faint = one => {
    const own = [...one.childNodes].some(node => node.nodeType === 3 && node.textContent.trim());
    if (!own || !shown(one) || one.closest("svg, [disabled], option, script, style")) return false;
    const style = getComputedStyle(one), size = parseFloat(style.fontSize);
    const pair = [light(numbers(style.color)), light(behind(one))].sort((a, b) => b - a);
    const large = size >= 24 || (size >= 18.66 && parseInt(style.fontWeight) >= 700);
    return (pair[0] + 0.05) / (pair[1] + 0.05) < (large ? 3 : 4.5);
  };
  const ids = [...document.querySelectorAll("[id]")].map(one => one.id);
  const levels = [...document.querySelectorAll("h1, h2, h3, h4, h5, h6")].map(one => +one.tagName[1]);
  return {
    language: document.documentElement.lang ? [] : ["html"],
    title: document.title ? [] : ["title"],
    main: document.querySelectorAll("main").length === 1 ? [] : ["main"],
    twice: ids.filter((id, k) => ids.indexOf(id) !== k),
    headings: levels.filter((level, k) => level > (k ? levels[k - 1] : 0) + 1),
    unnamed: find("button, input, select, a[href], canvas, video, img, summary, [role=region], [role=img]",
      one => shown(one) && !told(one).trim()),
    headless: find("table", one => !one.querySelector("th")),
    unreachable: find(".table", one => one.scrollWidth > one.clientWidth + 1 && one.tabIndex < 0),
    missing: find("[aria-labelledby], [for]",
      one => !document.getElementById(one.getAttribute("aria-labelledby") || one.getAttribute("for"))),
    faint: find("body *", faint),
  };
})()
"""
"""What keeps somebody from reading a page: the kind of barrier to what has it."""

AXE = Path(__file__).resolve().parent.parent / "node_modules" / "axe-core" / "axe.min.js"
"""Where `npm install axe-core` puts the checker, which is no part of this package."""

SERIOUS = """
axe.run(document, { resultTypes: ["violations"] }).then(found => found.violations
  .filter(one => ["serious", "critical"].includes(one.impact))
  .map(one => `${one.id}: ${one.nodes[0].html.slice(0, 100)}`))
"""


def barriers(browser):
    """What keeps somebody from reading the page that is shown, by our rules, and by axe-core where it is installed."""
    found = {kind: those for kind, those in browser.evaluate(BARRIERS).items() if those}
    if AXE.exists():
        browser.ask("Runtime.evaluate", expression=AXE.read_text(encoding="utf-8"))
        found |= {"axe": serious} if (serious := browser.evaluate(SERIOUS)) else {}
    return found


LEFT_OPEN = """
[...document.querySelectorAll("figure .zoom")].filter((zoom, k) => zoom.querySelector("input").checked
  || Math.abs(zoom.querySelector("img").getBoundingClientRect().width - widths[k]) > 0.5).length
"""
