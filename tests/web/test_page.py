"""The live page in a real browser: values shown equal values sent, old looks old, and it comes back."""

from __future__ import annotations

import http.client
import json
import os
import shutil
import socket
import time
from typing import TYPE_CHECKING, Any, Literal

import pytest

import contract
from local.pubnub_standin import PubNubStandIn
from station.page import BUILT, PageServer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from playwright.sync_api import Browser, Page

playwright_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

PUBLISH_KEY, SUBSCRIBE_KEY = "pub-local", "sub-local"
GAIN = 4614.0
FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
SAMPLE: dict[str, contract.Value] = {
    "voltage_input": 11.65,
    "temperature_pcb": 29.9,
    "current_motor": 3.96,
    "current_input": -5.27,
    "speed": -12_020,
    "duty_cycle": -0.127,
    "charge_drawn": 19,
    "energy_drawn": 222,
    "displacement": -4044,
    "fault_code": 0,
}


class Car:
    """Publishes live updates as Lambda 1 does, over plain HTTP."""

    def __init__(self, pubnub: PubNubStandIn, name: str = "car-1", boot: str = "0a1b2c3d") -> None:
        self.pubnub, self.name, self.boot, self.seq = pubnub, name, boot, 0

    def update(self, sample: Mapping[str, contract.Value] = SAMPLE, **change: Any) -> dict[str, Any]:
        now_us = time.time_ns() // 1000
        live = contract.LiveSample(self.boot, self.seq, now_us - 12_000, now_us - 10_000, dict(sample))
        self.seq += 1
        stream = change.pop("stream", contract.VESC_STREAM)
        return {**contract.live_update(self.name, stream, live, now_us // 1000 - 6, now_us - 2_000), **change}

    def send(self, sample: Mapping[str, contract.Value] = SAMPLE, **change: Any) -> dict[str, Any]:
        update = self.update(sample, **change)
        self.publish(update)
        return update

    def publish(self, message: Any, channel: str | None = None) -> None:
        host, port = self.pubnub.origin.split(":")
        connection = http.client.HTTPConnection(host, int(port), timeout=5)
        path = f"/publish/{PUBLISH_KEY}/{SUBSCRIBE_KEY}/0/{channel or contract.channel(self.name)}/0"
        connection.request("POST", path, json.dumps(message), {"Content-Type": "application/json"})
        assert connection.getresponse().status == 200
        connection.close()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    chromium = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    if not chromium:
        pytest.skip("there is no chromium on this machine: apt-get install chromium, or name it in CHROMIUM")
    if not (BUILT / "index.html").is_file():
        pytest.skip("the live page is not built: npm run build")
    with playwright_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=list(FLAGS))
        yield browser
        browser.close()


@pytest.fixture
def pubnub() -> Iterator[PubNubStandIn]:
    with PubNubStandIn(publish_key=PUBLISH_KEY, subscribe_key=SUBSCRIBE_KEY) as pubnub:
        yield pubnub


@pytest.fixture
def car(pubnub: PubNubStandIn) -> Car:
    return Car(pubnub)


@pytest.fixture
def url(pubnub: PubNubStandIn) -> Iterator[str]:
    with PageServer(
        namespace="iort",
        subscribe_key=SUBSCRIBE_KEY,
        origin=pubnub.origin,
        tls=False,
        vehicles={"car-1": {"speed_to_erpm_gain": GAIN}},
    ) as server:
        yield server.url


@pytest.fixture
def page(browser: Browser, url: str) -> Iterator[Page]:
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(url)
    until(lambda: page.evaluate("window.iort?.link") == "live", "the page to connect")
    yield page
    page.close()
    assert not errors


def until(true: Callable[[], bool], what: str, seconds: float = 10) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, f"waited {seconds} s for {what}"
        time.sleep(0.02)


def shown(page: Page, name: str) -> str:
    """The text of a value on the page, its minus sign and thin spaces as a computer writes them."""
    text = page.locator(f"[data-value='{name}']").inner_text()
    return text.replace("\u2212", "-").replace("\u202f", "")


def show(page: Page, update: Mapping[str, Any]) -> None:
    """Wait until the page has drawn the update."""
    robot, stream, seq = update["robot"], update["stream"], update["seq"]
    script = "([robot, stream]) => iort.robots[robot]?.streams[stream]?.seq"
    until(lambda: page.evaluate(script, [robot, stream]) == seq, f"message {seq} to arrive")
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def test_it_says_what_it_waits_for(page: Page, pubnub: PubNubStandIn) -> None:
    text = page.inner_text("#empty")
    assert "Waiting for a car" in text
    assert "iort.*" in text
    assert pubnub.origin in text
    assert page.inner_text("#link") == "Connected"


def test_values_shown_are_values_sent(page: Page, car: Car) -> None:
    update = car.send()
    show(page, update)
    assert page.evaluate("iort.robots['car-1'].streams.vesc.sample") == update["sample"]
    assert page.evaluate("iort.robots['car-1'].streams.vesc.hops") == update["hops"]
    expected = {
        "speed": "-12020",
        "speed_mps": f"{-12_020 / GAIN:.2f}",
        "voltage_input": "11.65",
        "current_motor": "3.96",
        "current_input": "-5.27",
        "duty_cycle": "-12.7",
        "power_w": f"{11.65 * -5.27:.1f}",
        "temperature_pcb": "29.9",
        "charge_drawn": "0.0019",
        "energy_drawn": "0.022",
        "displacement": "-4044",
        "fault_code": "none",
    }
    assert {name: shown(page, name) for name in expected} == expected


def test_every_newer_message_is_shown(page: Page, car: Car) -> None:
    for i in range(30):
        update = car.send({**SAMPLE, "voltage_input": 10 + i / 20})
        time.sleep(0.02)
    show(page, update)
    assert shown(page, "voltage_input") == "11.45"
    assert page.evaluate("iort.received") == 30
    assert page.evaluate("iort.outOfOrder") == 0


def test_any_field_of_any_stream_is_shown(page: Page, car: Car) -> None:
    sample: dict[str, contract.Value] = {
        "pose.x": -1.25,
        "armed": True,
        "frame": "map",
        "nothing": None,
        "n": 1234567,
    }
    show(page, car.send(sample, stream="odom"))
    texts = {name: shown(page, name) for name in sample}
    assert texts == {"pose.x": "-1.25", "armed": "true", "frame": "map", "nothing": "\u2013", "n": "1234567"}
    assert not page.locator(".charts").is_visible()


def test_text_from_a_robot_is_never_html(page: Page, car: Car) -> None:
    text = '<img src=x onerror="window.hacked=1"><script>window.hacked=1</script>'
    show(page, car.send({"frame": text}, stream="odom"))
    assert shown(page, "frame") == text
    assert page.locator("#car img, #car script").count() == 0
    assert page.evaluate("window.hacked") is None


def test_the_delay_is_that_measured_outside(page: Page, car: Car) -> None:
    update = {}
    delays = []
    for _ in range(12):
        update = car.send()
        show(page, update)
        delays.append((time.time_ns() // 1000 - update["hops"]["sent_us"]) / 1000)
        time.sleep(0.05)
    seen = page.evaluate("iort.delays('car-1')")
    assert len(seen) == 12
    # Sent says 10 ms ago; we look a little later than the page does.
    for inside, outside in zip(seen, delays, strict=True):
        assert 10 - 2 <= inside <= outside + 2
    delay = page.evaluate("iort.robots['car-1'].delay_ms")
    assert delay["newest"]["total"] == pytest.approx(seen[-1])
    assert delay["median"]["total"] == pytest.approx(sorted(seen)[5] / 2 + sorted(seen)[6] / 2)
    hops = delay["newest"]
    assert hops["toCloud"] + hops["toLambda"] + hops["toPage"] == pytest.approx(hops["total"])
    assert hops["toCloud"] == pytest.approx(4, abs=1.1)
    assert float(shown(page, "delay")) == pytest.approx(seen[-1], abs=0.51)


def test_a_message_out_of_order_is_not_the_newest(page: Page, car: Car) -> None:
    first = car.update({**SAMPLE, "voltage_input": 1})
    second = car.send({**SAMPLE, "voltage_input": 2})
    show(page, second)
    car.publish(first)
    car.publish(second)
    until(lambda: page.evaluate("iort.outOfOrder") == 2, "the late messages")
    assert shown(page, "voltage_input") == "2.00"
    # A new run of the agent starts from 0, and a message of the run before it is late for ever.
    again = Car(car.pubnub, boot="ffffffff").send({**SAMPLE, "voltage_input": 3})
    show(page, again)
    assert shown(page, "voltage_input") == "3.00"
    car.send({**SAMPLE, "voltage_input": 4})
    until(lambda: page.evaluate("iort.outOfOrder") == 3, "the message of the old run")
    assert shown(page, "voltage_input") == "3.00"


def test_malformed_messages_are_counted_and_do_no_harm(page: Page, car: Car) -> None:
    good = car.update()
    bad: list[Any] = [
        7,
        "text",
        [],
        {},
        {**good, "v": 2},
        {**good, "robot": "car-2"},
        {**good, "stream": "<b>"},
        {**good, "boot": None},
        {**good, "seq": -1},
        {**good, "seq": 0.5},
        {**good, "hops": {}},
        {**good, "hops": {**good["hops"], "sent_us": "1"}},
        {**good, "sample": []},
        {**good, "sample": {"__proto__": 1}},
        {**good, "sample": {"a b": 1}},
        {**good, "sample": {"nested": {"x": 1}}},
        {**good, "sample": {f"f{i}": 0 for i in range(513)}},
    ]
    for message in bad:
        car.publish(message)
    car.publish(good, "iort.not.a.robot")
    until(lambda: page.evaluate("iort.malformed") == len(bad) + 1, "the malformed messages")
    assert page.evaluate("Object.keys(iort.robots).length") == 0
    show(page, car.send())
    until(lambda: page.inner_text("#malformed") == str(len(bad) + 1), "the footer")
    assert shown(page, "voltage_input") == "11.65"


def test_a_fault_stands_out_with_its_name(page: Page, car: Car) -> None:
    show(page, car.send({**SAMPLE, "fault_code": 5}))
    assert page.inner_text(".fault") == "Fault: MOSFET over-temperature (5)"
    until(lambda: page.get_attribute("[data-robot=car-1]", "data-fault") == "true", "the card")
    show(page, car.send())
    assert not page.locator(".fault").is_visible()
    show(page, car.send({**SAMPLE, "fault_code": 99}))
    assert page.inner_text(".fault") == "Fault: unknown fault (99)"


def test_old_values_look_stale_and_a_silent_car_is_gone(page: Page, car: Car) -> None:
    def state() -> str | None:
        return page.get_attribute("[data-robot=car-1]", "data-state")

    show(page, car.send())
    start = time.monotonic()
    until(lambda: state() == "live", "live")
    until(lambda: state() == "stale", "stale")
    assert 1.3 < time.monotonic() - start < 2.5
    assert page.get_attribute("#car", "data-state") == "stale"
    until(lambda: state() == "gone", "gone")
    assert 4.5 < time.monotonic() - start < 6
    assert "last heard" in page.inner_text(".car-state")
    assert shown(page, "voltage_input") == "11.65"
    car.send()
    until(lambda: state() == "live", "live again")


def test_a_sample_that_was_long_under_way_is_stale(page: Page, car: Car) -> None:
    show(page, car.send())
    old = car.update()
    old["t"] += 1000
    time.sleep(1.8)
    car.publish(old)
    show(page, old)
    assert page.evaluate("iort.robots['car-1'].state") == "stale"


def test_it_connects_again_by_itself_and_says_so(page: Page, car: Car) -> None:
    show(page, car.send())
    car.pubnub.stop()
    until(lambda: page.inner_text("#link") == "Connection lost", "the page to notice")
    assert "Connection lost" in page.inner_text("#banner")
    time.sleep(1.2)
    car.pubnub.start()
    until(lambda: page.evaluate("iort.link") == "live", "the page to connect again")
    until(lambda: "Connected again" in page.inner_text("#banner"), "the good news")
    show(page, car.send({**SAMPLE, "voltage_input": 12}))
    assert shown(page, "voltage_input") == "12.00"


def test_a_pubnub_that_hangs_is_noticed(browser: Browser) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with PageServer(
            namespace="iort", subscribe_key=SUBSCRIBE_KEY, origin=f"127.0.0.1:{port}", tls=False
        ) as server:
            page = browser.new_page()
            page.goto(server.url)
            until(lambda: page.inner_text("#link") == "Connection lost", "the page to notice")
            assert "does not answer" in page.inner_text("#banner")
            page.close()


def test_arrow_keys_and_the_address_choose_the_car(page: Page, car: Car, url: str) -> None:
    for name in ("car-10", "car-2", "car-1"):
        show(page, Car(car.pubnub, name).send({**SAMPLE, "voltage_input": int(name[4:])}))
    cards = page.locator("[data-robot]")
    assert [cards.nth(i).get_attribute("data-robot") for i in range(3)] == ["car-1", "car-2", "car-10"]
    assert page.inner_text(".car-name") == "car-10"
    page.click("[data-robot=car-1]")
    assert page.inner_text(".car-name") == "car-1"
    page.keyboard.press("ArrowRight")
    assert page.inner_text(".car-name") == "car-2"
    assert page.evaluate("document.activeElement.dataset.robot") == "car-2"
    page.keyboard.press("End")
    assert page.url == f"{url}#car-10"
    until(lambda: shown(page, "voltage_input") == "10.00", "the car's own values")


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_a_phone_needs_no_sideways_scrolling(
    browser: Browser, url: str, car: Car, theme: Literal["dark", "light"]
) -> None:
    page = browser.new_page(viewport={"width": 375, "height": 700}, color_scheme=theme)
    page.goto(url)
    until(lambda: page.evaluate("window.iort?.link") == "live", "the page to connect")
    for name in ("car-1", "a-car-with-a-name-as-long-as-names-may-be-" + "x" * 21):
        car = Car(car.pubnub, name)
        show(page, car.send({**SAMPLE, "fault_code": 5}))
        show(page, car.send({"text": "y" * 4000, "number": -1.2345e-300}, stream="odom"))
        page.click(f"[data-robot={name}]")
        assert page.evaluate("document.documentElement.scrollWidth") == 375
    page.close()


def test_nothing_can_be_changed_through_what_tests_read(page: Page, car: Car) -> None:
    show(page, car.send())
    page.evaluate(
        "() => { try { iort.robots['car-1'].streams.vesc.sample.speed = 1; iort.received = 9 } catch {} }"
    )
    assert page.evaluate("iort.received") == 1
    assert page.evaluate("iort.robots['car-1'].streams.vesc.sample.speed") == SAMPLE["speed"]
