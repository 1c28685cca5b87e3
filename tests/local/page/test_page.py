"""The page in a real browser, on the embedded cloud: it shows the car's values, live and later."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from pathlib import Path

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import LIVE_MAX_AGE_MS
from iort_station.cloud import EMBEDDED
from iort_station.page.answers import actions, answers
from iort_station.page.pubnub import Listener
from iort_station.page.server import PageServer
from local.deployment import ROOT
from testkit.waiting import until
from tests.browser import plain, shown
from tests.images import TOPIC, jpeg, write_bag
from tests.local.conftest import run_agent

RATE_HZ, DRIVE_S = 50, 4


@contextmanager
def watching(embedded):
    """`iort watch --json`, once it listens."""
    command = [Path(sys.executable).parent / "iort", "--local", "--embedded", embedded.folder / EMBEDDED.name]
    process = subprocess.Popen(
        [*command, "watch", "--json"], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    with process:
        try:
            assert "listening to iort.*" in process.stderr.readline()
            yield process
        finally:
            process.kill()


def served(embedded):
    return PageServer(
        namespace=embedded.namespace,
        **embedded.keys.reading(),
        answers=answers(embedded.cloud),
        open_actions=actions(embedded.cloud),
    )


def test_the_page_shows_the_cars_values_live_and_later(embedded, bundle, open_page):
    source = {"type": "sim", "stream": VESC_STREAM, "rate_hz": RATE_HZ, "duration_s": DRIVE_S}
    car = bundle(sources=[source], live={"when": "always"})
    listener = Listener(
        robot=car.robot,
        namespace=embedded.namespace,
        **embedded.keys.reading(),
    )
    with served(embedded) as server, watching(embedded) as watched, listener:
        page = open_page(f"{server.url}#/car/{car.robot}")
        report = run_agent(car)
        until(lambda: listener.heard, "a live message outside")
        # Then Lambda 1 lets none pass any more.
        time.sleep(LIVE_MAX_AGE_MS / 1000 + 1)
        script = f"iort.robots['{car.robot}']?.streams.{VESC_STREAM}?.seq"
        until(lambda: page.evaluate(script) == _newest(listener).seq, "the last message on the page")
        newest = _newest(listener)
        sample = page.evaluate(f"iort.robots['{car.robot}'].streams.{VESC_STREAM}.sample")

        # The terminal shows the same values.
        lines = (line for line in map(json.loads, watched.stdout) if line["stream"] == VESC_STREAM)
        line = next(line for line in lines if line["t"] == newest.t_us)
        assert (line["robot"], line["sample"]) == (car.robot, sample)
        until(lambda: shown(page, "voltage_input") == f"{sample['voltage_input']:.2f}", "the voltage")

        # Both sides of the comparison wait for a processor; whenever both had one at once, they must agree.
        def compared():
            taken, delays = _in_order(list(listener.heard)), page.evaluate(f"iort.delays('{car.robot}')")
            return list(zip(delays, taken, strict=True)) if len(delays) == len(taken) else []

        until(compared, "every message on the page")
        apart_ms = [
            abs(delay_ms - each.delay_ms + each.hops.get("offset_us", 0) / 1000)
            for delay_ms, each in compared()
        ]
        assert min(apart_ms) <= 20

        _look_back(page, server.url, car.robot, report["streams"][VESC_STREAM]["samples"], sample)


def _newest(listener):
    return max(
        (each for each in list(listener.heard) if each.stream == VESC_STREAM), key=lambda each: each.seq
    )


def _in_order(heard):
    """Remove messages that a later one has overtaken in the cloud; the page skips them, too."""
    newest, taken = {}, []
    for each in heard:
        if each.seq > newest.get(each.stream, -1):
            newest[each.stream] = each.seq
            taken.append(each)
    return taken


def _look_back(page, url, robot, samples, newest):
    page.goto(f"{url}#/history/{robot}")
    note = page.locator(".history-note")

    def loaded():
        if f"{samples} samples" in plain(note.inner_text()):
            return True
        if "Loading" not in note.inner_text():
            page.get_by_role("button", name="Last 5 min").click()
        return False

    until(loaded, "the samples in the table")
    assert page.locator("section.panel[aria-label='Battery voltage'] .plot canvas").count() == 1
    row = page.locator("tr[data-field=voltage_input] td")
    until(lambda: plain(row.nth(1).inner_text()) == f"{newest['voltage_input']:.2f}", "the value now")
    counted = page.locator("tr[data-field=displacement] td")
    page.locator(".scrub").focus()
    page.keyboard.press("Home")
    until(lambda: plain(counted.nth(0).inner_text()) == "0", "the value at the start")
    assert plain(counted.nth(1).inner_text()) == f"{newest['displacement']:.0f}"
    assert plain(counted.nth(2).inner_text()) == f"+{newest['displacement']:.0f}"


def test_a_cameras_thumbnails_reach_the_page(embedded, bundle, open_page, tmp_path):
    recording = write_bag(tmp_path / "camera.bag", [jpeg(seed) for seed in range(4)])
    source = {"type": "bag", "path": str(recording), "topics": {TOPIC: "camera"}, "large": "upload"}
    car = bundle(sources=[source], files={"large_folder": "large", "rate_kb_s": 0}, live={"when": "always"})
    with served(embedded) as server:
        page = open_page(f"{server.url}#/car/{car.robot}")
        run_agent(car)
        picture = page.locator("[data-picture=data]")
        canvas = picture.locator("canvas")
        until(canvas.is_visible, "a picture")
        assert page.evaluate("(c) => [c.width, c.height]", canvas.element_handle()) == [96, 72]
        # A visitor who comes later reads it from the table.
        page.goto(f"{server.url}#/history/{car.robot}")
        until(lambda: "camera" in page.locator("#stream option").all_inner_texts(), "the streams")
        page.select_option("#stream", "camera")

        def loaded():
            if picture.count() and picture.locator(".picture-taken").inner_text().endswith(" before"):
                return True
            if "Loading" not in page.locator(".history-note").inner_text():
                page.get_by_role("button", name="Last 5 min").click()
            return False

        until(loaded, "the past")
        until(canvas.is_visible, "its picture")


def logged(cloud, group, *lines):
    """Write lines into a CloudWatch log group, a millisecond apart."""
    client, stream = cloud.client("logs"), str(time.time_ns())
    with suppress(client.exceptions.ResourceAlreadyExistsException):
        client.create_log_group(logGroupName=group)
    client.create_log_stream(logGroupName=group, logStreamName=stream)
    now_ms = time.time_ns() // 1_000_000 - 1000
    events = [{"timestamp": now_ms + i, "message": line} for i, line in enumerate(lines)]
    client.put_log_events(logGroupName=group, logStreamName=stream, logEvents=events)


def test_the_page_draws_cloudwatch_dashboards_from_their_metrics(embedded, open_page):
    cloudwatch = embedded.cloud.client("cloudwatch")
    rows = [
        ["Test/Page", "Laps", "Car", "a", {"stat": "Sum", "period": 60, "label": "laps of a"}],
        ["...", "b"],
    ]
    query = "SOURCE 'page-test' | fields @timestamp, @log, @message | filter @message like /WARN/"
    lines = {
        "title": "What went wrong",
        "query": f"{query} | sort @timestamp desc | limit 2",
        "view": "table",
    }
    laps = {"title": "Laps driven", "metrics": rows, "view": "timeSeries"}
    widgets = [
        {"type": kind, "x": 0, "y": 6 * i, "width": 12, "height": 6, "properties": properties}
        for i, (kind, properties) in enumerate(
            [
                ("text", {"markdown": "# <b>Laps</b>"}),
                ("metric", {**laps, "region": "eu-west-1"}),
                ("log", {**lines, "region": "eu-west-1"}),
            ]
        )
    ]
    logged(embedded.cloud, "page-test", "[WARN] first", "[INFO] fine", "[WARN] <b>bold</b>", "[WARN] last")
    cloudwatch.put_dashboard(
        DashboardName=f"{embedded.namespace}-test", DashboardBody=json.dumps({"widgets": widgets})
    )
    now = datetime.now(timezone.utc)
    for value in (2, 3):
        datum = {"MetricName": "Laps", "Dimensions": [{"Name": "Car", "Value": "a"}], "Timestamp": now}
        cloudwatch.put_metric_data(Namespace="Test/Page", MetricData=[{**datum, "Value": value}])
    with served(embedded) as server:
        page = open_page(f"{server.url}#/cloudwatch")
        names = page.locator("#dashboard option")
        until(lambda: f"{embedded.namespace}-test" in names.all_inner_texts(), "the dashboards")
        # Our own deployment comes first, and is drawn.
        assert names.first.inner_text().lower().startswith(embedded.namespace)
        alarms = page.locator("[data-widget='Alarms'] li")
        deployed = cloudwatch.describe_alarms(AlarmNamePrefix=embedded.namespace)["MetricAlarms"]
        until(lambda: alarms.count() == len(deployed) > 0, "the alarms")
        page.select_option("#dashboard", f"{embedded.namespace}-test")
        widget = page.locator("[data-widget='Laps driven']")
        until(lambda: "laps of a 5" in plain(widget.inner_text()), "the metric's value")
        assert widget.locator(".plot canvas").count() == 1
        assert page.locator(".words h3").inner_text() == "<b>Laps</b>"
        log = page.locator("[data-widget='What went wrong']")
        until(lambda: log.locator("tbody tr").count() == 2, "the lines of the log")
        assert log.locator("th").all_inner_texts() == ["timestamp", "log", "message"]
        assert log.locator("td.words").all_inner_texts() == ["[WARN] last", "[WARN] <b>bold</b>"]
        # A repeated query draws over the old result, which stays visible meanwhile.
        logged(embedded.cloud, "page-test", "[WARN] newest")
        page.select_option("#minutes", "15")
        until(lambda: "newest" in log.locator("td.words").first.inner_text(), "the newest line")
