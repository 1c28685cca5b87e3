"""One Chromium for each module with page tests: meanwhile playwright holds the thread's event loop."""

from __future__ import annotations

import pytest

from testkit import chromium
from testkit.waiting import GUARD_S, until


@pytest.fixture(scope="module")
def browser():
    # Imported here: every test loads this file, and on the robot's Python 3.8 the station does not run.
    from iort_station.page.page import BUILT

    playwright_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    program = chromium.found()
    if program is None:
        pytest.skip("Chromium is not installed: apt-get install chromium, or name it in CHROMIUM")
    if not (BUILT / "index.html").is_file():
        pytest.skip("the live page is not built: npm run build")
    with playwright_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=program, args=list(chromium.FLAGS))
        yield browser
        browser.close()


@pytest.fixture
def open_page(browser):
    """Open an address in a new window and wait until the page is connected.

    A script's error fails the test, and so does what the page's policy forbids, unless the test takes it
    from `open_page.errors`.
    """
    contexts, errors = [], []

    def open_(url, *, listening=True, **options):
        context = browser.new_context(**{"viewport": {"width": 1280, "height": 900}, **options})
        contexts.append(context)
        context.set_default_timeout(GUARD_S * 1000)
        page = context.new_page()
        # A page that is left stops what its worker loads. One that cannot load it otherwise never connects.
        page.on("pageerror", lambda error: "'importScripts'" in str(error) or errors.append(str(error)))
        page.on("console", lambda line: "Content Security Policy" in line.text and errors.append(line.text))
        page.goto(url)
        if listening:
            until(lambda: page.evaluate("window.iort?.link") == "live", "the page to connect")
        return page

    open_.errors = errors
    yield open_
    for context in contexts:
        context.close()
    assert not errors, errors


def plain(text):
    """Convert a text with minus signs and thin spaces to plain characters."""
    return text.replace("\u2212", "-").replace("\u202f", "")


def shown(page, name):
    """Return the text of a value on the page."""
    return plain(page.locator(f"[data-value='{name}']").inner_text())


def show(page, update):
    """Wait until the page has drawn the update."""
    robot, stream, seq = update["robot"], update["stream"], update["seq"]
    script = "([robot, stream]) => iort.robots[robot]?.streams[stream]?.seq"
    until(lambda: page.evaluate(script, [robot, stream]) == seq, f"message {seq} to arrive")
    drawn(page)


def drawn(page):
    """Wait until the page has drawn its values again: it does so at most 25 times a second."""
    frames = "requestAnimationFrame(() => requestAnimationFrame(done))"
    page.evaluate(f"() => new Promise((done) => setTimeout(() => {frames}, 50))")
