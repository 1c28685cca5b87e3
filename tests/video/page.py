"""The page in a browser on the viewers' machine: what its video shows, and a person at its stick."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, Playwright, sync_playwright
from playwright.sync_api import Error as PlaywrightError
from typing_extensions import Self

from iort_contract.counter import CHECK_BITS, COLUMNS, HEIGHTS, NUMBER_BITS, ROWS
from testkit.chromium import Tabs
from testkit.proxy import Proxy
from testkit.waiting import GUARD_S, InstrumentError, until
from tests.video.account import Said, Shown
from tests.video.scene import Scene, port_of

_START_MS = GUARD_S * 1000
# Reads every picture that the page's video shows from the picture itself, and not by what the page thinks.
READER = """
(() => {
  const [columns, rows, heights, numberBits, checkBits] = LAYOUT;
  [window.shownPictures, window.panelSays] = [[], []];
  window.peers = [];
  const Peer = window.RTCPeerConnection;
  window.RTCPeerConnection = class extends Peer {
    constructor(...options) { super(...options); window.peers.push(this); }
  };
  const checksum = (bytes) => bytes.reduce((sum, byte) => {
    sum ^= byte << 8;
    for (let i = 0; i < 8; i++) sum = ((sum & 0x8000 ? sum << 1 ^ 0x1021 : sum << 1) & 0xffff);
    return sum;
  }, 0xffff);
  const canvas = document.createElement("canvas");
  const pen = canvas.getContext("2d", { willReadFrequently: true });
  const number = (picture, width, height) => {
    const strip = Math.round(rows * height / heights);
    if (!strip) return null;
    [canvas.width, canvas.height] = [width, strip];
    pen.drawImage(picture, 0, height - strip, width, strip, 0, 0, width, strip);
    const { data } = pen.getImageData(0, 0, width, strip);
    let bits = "";
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        let sum = 0;
        for (const x of [0.35, 0.5, 0.65]) for (const y of [0.35, 0.5, 0.65]) {
          const line = Math.floor((row + y) * strip / rows);
          sum += data[4 * (line * width + Math.floor((column + x) * width / columns)) + 1];
        }
        bits += sum / 9 > 127 ? 1 : 0;
      }
    }
    const found = parseInt(bits.slice(0, numberBits), 2);
    const bytes = [24, 16, 8, 0].map((shift) => (found >>> shift) & 0xff);
    return checksum(bytes) === parseInt(bits.slice(numberBits, numberBits + checkBits), 2) ? found : null;
  };
  const followed = new WeakSet();
  const follow = (video) => {
    followed.add(video);
    const look = (now, about) => {
      // The picture is on the screen at that time, which is soon.
      const soon = Math.max(0, about.expectedDisplayTime - performance.now());
      const received = about.receiveTime === undefined ? null : now - about.receiveTime;
      const at = Math.round((Date.now() + soon) * 1000);
      const read = number(video, video.videoWidth, video.videoHeight);
      window.shownPictures.push([at, read, received === null ? null : received + soon, soon]);
      video.requestVideoFrameCallback(look);
    };
    video.requestVideoFrameCallback(look);
  };
  setInterval(() => {
    for (const video of document.querySelectorAll("video")) if (!followed.has(video)) follow(video);
    const panel = document.querySelector(".sight");
    const age = panel?.querySelector(".sight-age")?.textContent.replace(/[^0-9]/g, "");
    if (age) window.panelSays.push([Date.now() * 1000, panel.dataset.state, +panel.dataset.frame, +age]);
  }, 50);
  // Pictures over the broker tell nobody when they are there.
  let newest = null;
  const compare = () => {
    requestAnimationFrame(compare);
    const drawn = document.querySelector(".sight[data-way=broker] canvas");
    const read = drawn && number(drawn, drawn.width, drawn.height);
    if (read && read !== newest) window.shownPictures.push([Date.now() * 1000, newest = read, null]);
  };
  requestAnimationFrame(compare);
})();
""".replace("LAYOUT", str([COLUMNS, ROWS, HEIGHTS, NUMBER_BITS, CHECK_BITS]))
STATS = """async () => Promise.all(window.peers.filter((one) => one.connectionState === "connected")
  .map(async (one) => Object.fromEntries((await one.getStats()).entries())))"""


class Viewer:
    """The page of one car, and its video, from `__enter__` to `__exit__`."""

    def __init__(self, scene: Scene, folder: Path) -> None:
        self._scene, self._folder = scene, folder
        self._exit = ExitStack()
        self._play: Playwright
        self._browser: Browser
        self._shown: list[Shown] = []
        self.said: list[Said] = []
        self._page: Page
        self.tabs: Tabs

    def __enter__(self) -> Self:
        scene = self._scene
        with ExitStack() as stack:
            self._play = stack.enter_context(sync_playwright())
            self.tabs = stack.enter_context(Tabs(self._folder, within=scene.there()))
            if scene.wire is not None:
                tools = Proxy("127.0.0.1", port_of(self.tabs.url), dial=scene.wire.other.socket)
                self.tabs.url = f"http://127.0.0.1:{stack.enter_context(tools).port}"
            self.connect()
            context = self._browser.contexts[0]
            context.add_init_script(READER)
            self._page = context.new_page()
            # Without a graphics card, smooth charts take a core.
            self._page.emulate_media(reduced_motion="reduce")
            self._page.goto(scene.server.invitation(f"#/car/{scene.robot}"))
            self._page.get_by_role("button", name="Look", exact=True).click()
            self._exit = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(PlaywrightError):
            self._browser.close()
        self._exit.close()

    def connect(self) -> None:
        """Have the browser in hand, again, with the car's page if it is open."""
        self._browser = self._play.chromium.connect_over_cdp(self.tabs.url, timeout=_START_MS)
        self._browser.contexts[0].set_default_timeout(_START_MS)
        found = [page for page in self._browser.contexts[0].pages if self._scene.robot in page.url]
        if found:
            self._page = found[0]

    def disconnect(self) -> None:
        """Leave the browser to itself: while it is in hand, each page believes that it is in front."""
        self._look()
        self._browser.close()

    @property
    def page(self) -> Page:
        return self._page

    def _look(self) -> None:
        news = self._page.evaluate("[shownPictures.splice(0), panelSays.splice(0)]")
        self._shown += [Shown(*one) for one in news[0]]
        self.said += [Said(*one) for one in news[1]]

    @property
    def shown(self) -> list[Shown]:
        """The pictures that were on the screen so far."""
        self._look()
        return self._shown

    def stats(self) -> list[dict[str, Any]]:
        """What `getStats()` says of each connection."""
        found: list[dict[str, Any]] = self._page.evaluate(STATS)
        return found

    def begun(self) -> Self:
        """Wait for the first picture that can be read."""
        until(lambda: any(one.number for one in self.shown), "the first picture on the page")
        return self

    @contextmanager
    def hidden(self) -> Iterator[None]:
        """Another tab is in front, until the end of the block."""
        self.disconnect()
        tab = self.tabs.cover()
        try:
            yield
        finally:
            self.tabs.uncover(tab)
            self.connect()

    @property
    def way(self) -> str | None:
        """How the newest picture came: ``webrtc`` or ``broker``."""
        return self._page.locator(".sight").get_attribute("data-way")

    def live(self) -> None:
        """Wait until pictures come, and the page calls them live."""
        now_us = time.time_ns() // 1000
        until(lambda: any(one.number for one in self.shown if one.shown_us > now_us), "pictures on the page")
        self._page.locator(".sight[data-state=live]").wait_for()

    def sit(self) -> None:
        """Take the wheel."""
        self._page.get_by_role("button", name="Take the wheel").click()

    @property
    def drives(self) -> bool:
        """Whether the page drives the car."""
        return self._page.locator(".drive").get_attribute("data-phase") == "driving"

    def release(self) -> None:
        """Let go."""
        for key in ("ArrowUp", "Space"):
            self._page.keyboard.up(key)

    def drive(self) -> None:
        """Hold the car, and drive ahead. A hold that a slow machine ends is begun anew."""
        page, end = self._page, time.monotonic() + GUARD_S
        while time.monotonic() < end:
            self.release()
            page.locator(".drive[data-phase=free], .drive[data-phase=holding]").wait_for()
            page.keyboard.down("Space")
            done = page.locator(".drive[data-phase=driving], .drive[data-phase=over]")
            with suppress(PlaywrightError):
                done.wait_for(timeout=5_000)
                if done.get_attribute("data-phase") == "driving":
                    page.keyboard.down("ArrowUp")
                    return
        said = page.locator(".drive-said").inner_text()
        raise InstrumentError(f"the car is not driven: {said}")
