"""The live page in a real browser: it shows the sent values, marks old values, and recovers from faults."""

from __future__ import annotations

import math
import socket
import time

import pytest

from iort_contract.catalog.vesc import TEMPERATURES
from testkit.waiting import until
from tests.browser import drawn, plain, show, shown
from tests.web.cars import GAIN, SAMPLE, Car


def test_the_empty_page_says_that_it_waits_for_a_car(page, pubnub):
    text = page.inner_text("#empty")
    assert "Waiting for car-1" in text
    assert "iort.*" in text
    assert pubnub.origin in text
    until(lambda: page.inner_text("#link") == "Connected", "the word of the connection")


def test_the_page_shows_the_sent_values(page, car):
    update = car.send()
    show(page, update)
    assert page.evaluate("iort.robots['car-1'].streams.vesc.sample") == update["sample"]
    hops = page.evaluate("iort.robots['car-1'].streams.vesc.hops")
    assert hops == {**update["hops"], "offset_us": 0, "offset_known": False}
    expected = {
        "speed": "-12020",
        "speed_mps": f"{-12_020 / GAIN:.2f}",
        "voltage_input": "11.65",
        "current_motor": "3.96",
        "current_input": "-5.27",
        "duty_cycle": "-12.7",
        "power_w": f"{11.65 * -5.27:.1f}",
        "temperature": "29.9",
        "temperature_pcb": "29.9",
        "charge_drawn": "0.0019",
        "energy_drawn": "0.022",
        "displacement": "-4044",
        "fault_code": "none",
    }
    assert {name: shown(page, name) for name in expected} == expected
    readings = {"speed": expected["speed_mps"], "current_input": "-5.27", "duty_cycle": "-12.7"}
    for name, text in readings.items():
        assert plain(page.inner_text(f"[data-reading='{name}']")) == text


def test_the_hottest_value_covers_every_temperature_of_the_alarm(page, car):
    for hot in TEMPERATURES:
        show(page, car.send({**dict.fromkeys(TEMPERATURES, 0), "temperature_pcb": -4.5, hot: 81.5}))
        assert shown(page, "temperature") == "81.5"
    show(page, car.send({**dict.fromkeys(TEMPERATURES, 0), "temperature_pcb": -4.5}))
    assert shown(page, "temperature") == "-4.5"


def test_charge_and_energy_have_the_unit_of_their_driver(page, car):
    show(page, car.send({**SAMPLE, "charge_drawn": 0, "energy_drawn": 0}))
    page.click("[data-stream='vesc'] .tile:has([data-value='charge_drawn'])")
    show(page, car.send({**SAMPLE, "charge_drawn": 0.0019, "energy_drawn": 1}))
    texts = {"charge_drawn": "0.0019", "energy_drawn": "1.000"}
    assert {name: shown(page, name) for name in texts} == texts
    assert plain(page.inner_text("[data-reading='vesc/charge_drawn']")) == "0.0019"


def test_every_newer_message_is_shown(page, car):
    for i in range(30):
        update = car.send({**SAMPLE, "voltage_input": 10 + i / 20})
    show(page, update)
    assert shown(page, "voltage_input") == "11.45"
    assert page.evaluate("iort.received") == 30
    assert page.evaluate("iort.outOfOrder") == 0


# For each new text, how many frames after its message was heard it is drawn.
FRAMES = """() => {
  const text = () => document.querySelector("[data-value=voltage_input]").textContent;
  let [frame, received, drawn, heard] = [0, iort.received, text(), undefined];
  window.late = [];
  const look = () => {
    frame += 1;
    if (iort.received !== received) [received, heard] = [iort.received, heard ?? frame];
    if (text() !== drawn) {
      late.push(frame - (heard ?? frame));
      [drawn, heard] = [text(), undefined];
    }
    requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
}"""


def test_a_message_after_a_pause_is_drawn_with_the_next_frame(page, car):
    show(page, car.send())
    page.evaluate(FRAMES)
    for i in range(12):
        show(page, car.send({**SAMPLE, "voltage_input": 10 + i / 10}))
    late = page.evaluate("late")
    assert len(late) == 12
    assert max(late) <= 1


def test_the_page_shows_any_field_of_any_stream(page, car):
    sample = {"pose.x": -1.25, "armed": True, "frame": "map", "nothing": None, "n": 1234567}
    show(page, car.send(sample, stream="odom"))
    texts = {name: shown(page, name) for name in sample}
    assert texts == {"pose.x": "-1.25", "armed": "true", "frame": "map", "nothing": "\u2013", "n": "1234567"}
    assert not page.locator("section[aria-label='Battery voltage']").is_visible()


def test_text_from_a_robot_is_never_html(page, car, url):
    text = '<img src=x onerror="window.hacked=1"><script>window.hacked=1</script>'
    hostile = {"frame": text, "fault_code": text, "constructor": 1, "toString": "x"}
    show(page, car.send(hostile, stream="odom"))
    assert shown(page, "frame") == text
    assert shown(page, "constructor") == "1"
    assert shown(page, "toString") == "x"
    page.goto(f"{url}#/car/{'%3Cimg%20src=x%20onerror=alert(1)%3E'}")
    page.goto(f"{url}#/history/..%2F..%2Fetc")
    drawn(page)
    assert page.locator("main img, main script").count() == 0
    assert page.evaluate("window.hacked") is None


def test_a_foreign_script_does_not_run(page, open_page):
    page.evaluate(
        """() => {
          const script = document.createElement("script");
          script.textContent = "window.hacked = 1";
          document.body.append(script);
        }"""
    )
    assert page.evaluate("window.hacked") is None
    assert page.evaluate("fetch('https://example.com').then(() => 'went', () => 'refused')") == "refused"
    until(lambda: len(open_page.errors) == 3, "the policy's words")
    assert all("Content Security Policy" in error for error in open_page.errors)
    open_page.errors.clear()


def test_the_delay_equals_the_delay_measured_outside(page, car):
    bounds = []
    for _ in range(12):
        update = car.update()
        before_us = time.time_ns() // 1000
        car.publish(update)
        show(page, update)
        # Bounds for the same message: it arrived after it was published, and before the test saw it.
        sent_us = update["hops"]["sent_us"]
        bounds.append(((before_us - sent_us) / 1000, (time.time_ns() // 1000 - sent_us) / 1000))
    seen = page.evaluate("iort.delays('car-1')")
    assert len(seen) == len(bounds)
    # The browser's wall clock has a resolution of 1 ms.
    for inside, (least, most) in zip(seen, bounds, strict=True):
        assert least - 1 <= inside <= most + 1
    delay = page.evaluate("iort.robots['car-1'].delay_ms")
    assert delay["newest"]["total"] == pytest.approx(seen[-1])
    legs = delay["newest"]
    way = legs["toCloud"] + legs["toLambda"] + legs["toPubNub"] + legs["toPage"]
    assert way == pytest.approx(legs["total"], abs=0.01)
    assert legs["car"] == pytest.approx(2)
    assert legs["toCloud"] == pytest.approx(4, abs=1.1)
    assert float(shown(page, "delay")) == pytest.approx(seen[-1], abs=0.51)
    until(lambda: page.locator("[data-value=leg_car]").inner_text() == "2.0", "the delay by hop")


def test_the_delay_uses_the_clouds_clock(page, car):
    update = car.update()
    hour_us = 3_600_000_000
    for hop, key in ((update, "t"), (update["hops"], "sent_us")):
        hop[key] -= hour_us
    update["hops"]["offset_us"] = hour_us
    car.publish(update)
    show(page, update)
    legs = page.evaluate("iort.robots['car-1'].delay_ms.newest")
    assert legs["car"] == pytest.approx(2)
    assert legs["toCloud"] == pytest.approx(4, abs=1.1)
    assert legs["total"] < hour_us / 1000
    # With an hour of delay it would be gone; on a slow machine it may be late.
    assert page.evaluate("iort.robots['car-1'].state") != "gone"
    until(lambda: "corrected by the offset" in page.inner_text(".warning"), "the warning about the offset")


def test_a_message_out_of_order_is_not_the_newest(page, car):
    first = car.update({**SAMPLE, "voltage_input": 1})
    second = car.send({**SAMPLE, "voltage_input": 2})
    show(page, second)
    car.publish(first)
    car.publish(second)
    until(lambda: page.evaluate("iort.outOfOrder") == 2, "the late messages")
    assert shown(page, "voltage_input") == "2.00"
    # A new run of the agent starts from 0, and a message of the previous run stays out of order.
    again = Car(car.pubnub, boot="ffffffff").send({**SAMPLE, "voltage_input": 3})
    show(page, again)
    assert shown(page, "voltage_input") == "3.00"
    car.send({**SAMPLE, "voltage_input": 4})
    until(lambda: page.evaluate("iort.outOfOrder") == 3, "the message of the old run")
    assert shown(page, "voltage_input") == "3.00"


def test_malformed_messages_are_counted_and_ignored(page, car):
    good = car.update()
    bad = [
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
        {**good, "hops": {**good["hops"], "offset_us": None}},
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
    told = f"{len(bad)} live messages came and could not be read; the last: too many fields."
    until(lambda: page.inner_text("#empty-text") == told, "the word of a car that is only garbled")
    show(page, car.send())
    told = f"{len(bad)} live messages of this car could not be read; the last: too many fields."
    page.get_by_text(told).wait_for()
    until(lambda: page.inner_text("#malformed") == str(len(bad) + 1), "the footer")
    assert shown(page, "voltage_input") == "11.65"


def test_a_fault_is_highlighted_by_name_and_logged(page, car, url):
    rows = page.locator(".faults tbody tr[data-state]:not([data-state=none])")
    show(page, car.send({**SAMPLE, "fault_code": 5}))
    assert page.inner_text(".fault") == "Fault: MOSFET over-temperature (5)"
    until(lambda: rows.count() == 1, "the log")
    assert rows.first.get_attribute("data-state") == "on"
    show(page, car.send())
    assert not page.locator(".fault").is_visible()
    until(lambda: rows.first.get_attribute("data-state") == "over", "the end of the fault in the log")
    show(page, car.send({**SAMPLE, "fault_code": 99}))
    assert page.inner_text(".fault") == "Fault: unknown fault (99)"
    until(lambda: rows.count() == 2, "the second fault")
    assert "unknown fault (99)" in rows.first.inner_text()
    page.goto(f"{url}#/")
    card = page.locator("[data-robot=car-1]")
    until(lambda: card.get_attribute("data-fault") == "true", "the card")
    assert "unknown fault (99)" in card.inner_text()


def test_old_values_look_stale_and_a_silent_car_disappears(page, car):
    show(page, car.send())
    # The states shown, and how old the values were then, or how long the car had been silent.
    page.evaluate(
        """() => {
          const car = document.querySelector("#car");
          window.states = [];
          const note = () => {
            const { state } = car.dataset, { silent_s, streams } = iort.robots["car-1"];
            states.push([state, state === "stale" ? streams.vesc.age_s : silent_s]);
          };
          new MutationObserver(note).observe(car, { attributeFilter: ["data-state"] });
        }"""
    )

    def shown_in_turn():
        # A busy machine may not look at the car while it is stale.
        sends_until_live(page, car)
        page.evaluate("states.length = 0")
        until(lambda: page.get_attribute("#car", "data-state") == "gone", "gone")
        told = page.evaluate("states")
        return told if [state for state, _ in told] == ["stale", "gone"] else None

    states = until(shown_in_turn, "a car that is stale, and then gone")
    bounds = page.evaluate("iort.bounds")
    assert bounds["gone_s"] + bounds["tick_s"] <= 5
    for state, after_s in states:
        least_s = {"stale": bounds["stale_s"] - 0.1, "gone": bounds["gone_s"]}[state]
        assert after_s >= least_s
    assert "last heard" in page.inner_text(".car-state")
    assert shown(page, "voltage_input") == "11.65"
    sends_until_live(page, car)


def sends_until_live(page, car):
    """The car sends, until one of its messages is shown in time."""

    def live():
        show(page, car.send())
        return page.get_attribute("#car", "data-state") == "live"

    until(live, "the car to be live")


def test_a_sample_with_a_long_delay_is_stale(page, car):
    first = car.send()
    show(page, first)
    until(lambda: page.evaluate("iort.robots['car-1'].state") in {"stale", "gone"}, "silence")
    late = car.update()
    late["t"] = first["t"] + 1000
    car.publish(late)
    show(page, late)
    # The page has just received a message of the car, but its sample is old.
    assert page.evaluate("iort.robots['car-1'].state") != "live"
    sends_until_live(page, car)


def test_the_page_reconnects_and_reports_it(page, car):
    show(page, car.send())
    car.pubnub.stop()
    until(lambda: page.inner_text("#link") == "Connection lost", "the page to notice")
    assert "Connection lost" in page.inner_text("#banner")
    car.pubnub.start()
    until(lambda: page.evaluate("iort.link") == "live", "the page to connect again")
    until(lambda: "Connected again" in page.inner_text("#banner"), "the success message")
    show(page, car.send({**SAMPLE, "voltage_input": 12}))
    assert shown(page, "voltage_input") == "12.00"


def test_the_page_detects_a_hanging_pubnub(open_page, serve):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        server = serve(origin=f"127.0.0.1:{silent.getsockname()[1]}")
        page = open_page(server.url, listening=False)
        until(lambda: page.inner_text("#link") == "Connection lost", "the page to notice")
        until(lambda: "does not answer" in page.inner_text("#banner"), "the reason")


def test_any_number_can_be_charted(page, car):
    show(page, car.send())
    tile = page.locator("button.tile", has_text="Displacement")
    tile.click()
    panel = page.locator("section.panel[aria-label=Displacement]")
    show(page, car.send({**SAMPLE, "displacement": 77}))
    assert "77" in panel.inner_text()
    until(lambda: tile.get_attribute("aria-pressed") == "true", "the tile to be selected")
    panel.get_by_label("Close Displacement").click()
    assert panel.count() == 0


def test_xy_charts_appear_with_their_data(page, car):
    plane = page.locator("section.panel[aria-label=Trajectory]")
    show(page, car.send())
    assert page.locator("section.panel[aria-label='Speed and motor current']").is_visible()
    assert not plane.is_visible()
    show(page, car.send({"pose.pose.position.x": 1, "pose.pose.position.y": 2}, stream="odom"))
    assert plane.is_visible()
    show(page, car.send({"linear_acceleration.x": 1, "linear_acceleration.y": 2}, stream="imu"))
    assert page.locator("section.panel[aria-label='Accelerations, G-G']").is_visible()


def test_updates_do_not_move_the_layout(page, car):
    show(page, car.send())
    page.evaluate(
        """() => {
          window.shifts = [];
          const moved = (e) => [e.value, e.sources.map(({ node }) => node?.outerHTML?.slice(0, 80))];
          const seen = (list) => list.getEntries().forEach((entry) => shifts.push(moved(entry)));
          new PerformanceObserver(seen).observe({ type: "layout-shift" });
        }"""
    )
    for value in (0, 123.456, -9999, 5, None):
        sample = {name: value for name in SAMPLE if name != "fault_code"}
        show(page, car.send({**sample, "fault_code": 5 if value == 5 else 0}))
    shifts = page.evaluate("shifts")
    # Bars and figures move a little with each message, at most 0.011 where a slow browser draws two at once.
    # A line that appears above everything moves 0.03.
    assert max((value for value, _ in shifts), default=0) < 0.02, "\n".join(map(str, shifts))


def test_memory_stays_bounded(page, car, url):
    page.goto(f"{url}#/")
    bounds = page.evaluate("iort.bounds")
    many = {f"f{i}": i for i in range(500)}
    full = math.ceil(bounds["columns"] / len(many))
    for i in range(full):
        show(page, car.send(many, stream=f"full{i}"))
    columns = page.evaluate("Object.values(iort.robots['car-1'].streams).map(({ kept }) => kept.columns - 1)")
    assert sum(columns) == bounds["columns"]
    for i in range(bounds["streams"] - full + 1):
        update = car.send({"x": 1}, stream=f"s{i}")
    until(lambda: page.evaluate("iort.malformed") == 1, "the extra stream")
    assert update["stream"] not in page.evaluate("Object.keys(iort.robots['car-1'].streams)")


def test_a_phone_needs_no_sideways_scrolling(open_page, url, car):
    page = open_page(url, viewport={"width": 375, "height": 700}, has_touch=True)
    for name in ("car-1", "a-car-with-a-name-as-long-as-names-may-be-" + "x" * 21):
        car = Car(car.pubnub, name)
        show(page, car.send({**SAMPLE, "fault_code": 5}))
        show(page, car.send({"text": "y" * 4000, "number": -1.2345e-300, "w" * 99: 1}, stream="s" * 64))
        page.goto(f"{url}#/")
        assert page.evaluate("document.documentElement.scrollWidth") == 375
        page.tap(f"[data-robot={name}]")
        until(lambda name=name: page.inner_text(".car-name") == name, "the car")
        drawn(page)
        assert page.evaluate("document.documentElement.scrollWidth") == 375


def test_the_test_interface_is_read_only(page, car):
    show(page, car.send())
    change = "iort.robots['car-1'].streams.vesc.sample.speed = 1; iort.received = 9"
    page.evaluate(f"() => {{ try {{ {change} }} catch {{}} }}")
    assert page.evaluate("iort.received") == 1
    assert page.evaluate("iort.robots['car-1'].streams.vesc.sample.speed") == SAMPLE["speed"]
