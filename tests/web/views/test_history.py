"""A car's past in a real browser, with the server's own answers from a table in memory."""

from __future__ import annotations

import csv
import math
import re

import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import Batch
from iort_contract.topics import RECORD, build_topic
from iort_station.page.answers import answers
from iort_station.page.history import downloads
from testkit.dynamodb import TELEMETRY, item_of
from testkit.waiting import reached, until
from tests.archived import FakeS3, archive, expire
from tests.browser import plain
from tests.unit.station.data.test_queries import START, cloud_of
from tests.web.cars import GAIN
from tests.web.lab import VIEWS

SECOND = 1_000_000
FIRST_S, SECOND_S = 60, 30
LATER_US = START + 3600 * SECOND
# 14 November 2023, 22:13:20 UTC.
FIRST = "from=2023-11-14T22:13:20.000Z&to=2023-11-14T22:14:19.981Z"
NEWEST = "from=2023-11-14T23:13:20.000Z&to=2023-11-14T23:13:49.981Z"


def drive(boot, start_us, seconds):
    """A run of 50 samples a second, which gets faster by 0.1 m/s a second."""
    for second in range(seconds):
        times = [start_us + second * SECOND + i * 20_000 for i in range(50)]
        at = [(t - start_us) / SECOND for t in times]
        columns = {
            "voltage_input": [12 - each / 100 for each in at],
            "current_motor": [20 * math.sin(each) for each in at],
            "speed": [4614 * each / 10 for each in at],
            # The way of that speed: t² / 20 m, in counts.
            # The counter begins anew once, as after a restart of the VESC.
            "displacement": [float(int(each**2 / 20 * 461.4) % 15_000) for each in at],
        }
        yield Batch(boot, second, times, columns)


class Past:
    """A car's two runs, and the requests for its history; `expire` archives them, and deletes them."""

    def __init__(self):
        self.asked = []
        cloud = cloud_of(
            *drive("00000001", START, FIRST_S), *drive("00000002", LATER_US, SECOND_S), page_items=100
        )
        agent = Batch("00000001", 0, [START, START + SECOND // 2], {"cpu_percent": [3.5, 4.5]})
        self.cloud = cloud
        cloud.table.put(TELEMETRY, item_of(agent, build_topic(RECORD, "car", "agent")))
        served = answers(cloud)
        self.answers = {name: served[name] for name in ("streams", "runs", "history", "vehicles")}
        self.downloads = downloads(cloud)
        history = self.answers["history"]

        def watched(asked):
            self.asked.append(dict(asked))
            return history(asked)

        self.answers["history"] = watched

    def expire(self):
        self.cloud.bucket = FakeS3()
        archive(self.cloud.table, self.cloud.bucket)
        expire(self.cloud.table)


@pytest.fixture
def past():
    return Past()


@pytest.fixture
def server(serve, past):
    vehicles = {"car": {"speed_to_erpm_gain": GAIN}}
    return serve(vehicles=vehicles, answers=past.answers, downloads=past.downloads)


@pytest.fixture
def page(open_page, server):
    page = open_page(f"{server.url}#/history/car", timezone_id="UTC")
    loaded(page, "1500 samples")
    return page


def loaded(page, text):
    note = page.locator(".history-note")
    until(lambda: text in plain(note.inner_text()), f"{text}, not {note.inner_text()}")


def address(page):
    return re.sub(r".*#", "#", page.url)


def chart(page, label):
    return page.locator(f"section.panel[aria-label='{label}'] .u-over")


def drag(page, label, start, end):
    box = chart(page, label).bounding_box()
    assert box is not None
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + box["width"] * start, y)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * end, y, steps=4)
    page.mouse.up()


def shown(page):
    """The seconds of the address' range, from the start of the first run."""
    return page.evaluate(
        """(first) => {
          const query = new URLSearchParams(location.hash.split("?")[1]);
          return ["from", "to"].map((end) => Date.parse(query.get(end)) / 1000 - first);
        }""",
        START / 1e6,
    )


def test_the_history_of_an_offline_car_opens_at_its_newest_run(page):
    assert address(page) == f"#/history/car?stream=vesc&{NEWEST}"
    runs = page.locator(".runs")
    about = "Runs: vesc is stored from Tue 14 Nov 22:13:20 UTC to Tue 14 Nov 23:13:49 UTC"
    assert runs.locator("summary").inner_text() == about
    runs.locator("summary").click()
    assert runs.locator("tbody tr").count() == 2
    runs.get_by_role("link", name="22:13:20").click()
    loaded(page, "3000 samples")
    assert address(page) == f"#/history/car?stream=vesc&{FIRST}"
    page.get_by_role("button", name="Last 1 min").click()
    loaded(page, "Nothing was stored in this range. vesc is stored from Tue 14 Nov 22:13:20")


def test_what_has_expired_is_shown_from_the_archive(page, past):
    past.expire()
    page.reload()
    loaded(page, "From the archive.")
    loaded(page, "1500 samples")
    assert page.locator("section.panel .u-over").count() > 0


def test_dragging_zooms_all_charts_into_finer_data_and_a_link_shows_the_same(page, server, past, open_page):
    page.goto(f"{server.url}#/history/car?{FIRST}")
    loaded(page, "averaged per 40 ms")
    drag(page, "Motor current", 0.25, 0.5)
    until(lambda: shown(page)[1] < 40, "the zoom")
    assert shown(page) == pytest.approx([15, 30], abs=0.3)
    until(lambda: re.search(r"samples in [\d.]+ m?s\.", page.inner_text(".history-note")), "single samples")
    # Ten times the speed is the time since the start: every chart shows the same range.
    low, high = plain(page.locator("section[aria-label=Speed] .note").inner_text()).split(" to ")
    assert [float(low) * 10, float(high) * 10] == pytest.approx([15, 30], abs=0.3)
    chart(page, "Speed").click(position={"x": 40, "y": 40})
    page.get_by_role("button", name="Battery voltage", exact=True).click()
    link = page.url
    other = open_page(link, timezone_id="UTC")
    cursor = page.locator(".scrub-at").inner_text()
    until(lambda: other.locator(".scrub-at").inner_text() == cursor, "the cursor")
    labels = "[...document.querySelectorAll('.charts .panel')].map((panel) => panel.ariaLabel)"
    assert other.evaluate(labels) == page.evaluate(labels) == ["Speed", "Motor current"]
    assert other.url == link
    chart(page, "Speed").dblclick()
    loaded(page, "averaged per 40 ms")
    assert shown(page) == pytest.approx([0, 59.981])
    page.go_back()
    until(lambda: shown(page)[0] > 14, "the browser's Back")
    until(lambda: int(past.asked[-1]["from_us"]) > START + 14 * SECOND, "its data")


def test_the_wheel_pans_a_zoomed_chart_and_scrolls_the_page_otherwise(page):
    page.set_viewport_size({"width": 1280, "height": 640})
    drag(page, "Speed", 0.4, 0.6)
    until(lambda: shown(page)[1] - shown(page)[0] < 10, "the zoom")
    before = shown(page)
    page.mouse.wheel(0, 100)
    until(lambda: shown(page)[0] > before[0] + 0.5, "the pan")
    assert page.evaluate("scrollY") == 0
    assert shown(page)[1] - shown(page)[0] == pytest.approx(before[1] - before[0], abs=0.01)
    page.get_by_role("button", name="Zoom out").click()
    loaded(page, "1500 samples")
    page.locator("[role=img][aria-label^='Chart Speed']").focus()
    page.keyboard.press("+")
    until(lambda: shown(page)[1] - shown(page)[0] < 16, "the zoom by key")
    page.keyboard.press("-")
    loaded(page, "1500 samples")
    chart(page, "Speed").hover()
    page.mouse.wheel(0, 100)
    until(lambda: page.evaluate("scrollY") > 0, "the page to scroll")
    assert address(page).endswith(NEWEST)


def test_two_fingers_pan_and_pinch(open_page, server):
    phone = {"has_touch": True, "is_mobile": True, "viewport": {"width": 390, "height": 844}}
    page = open_page(f"{server.url}#/history/car?{FIRST}", timezone_id="UTC", **phone)
    loaded(page, "3000 samples")
    over = chart(page, "Speed")
    over.scroll_into_view_if_needed()
    box = over.bounding_box()
    assert box is not None
    touch = page.context.new_cdp_session(page)

    def fingers(kind, *shares):
        y = box["y"] + box["height"] / 2
        points = [{"x": box["x"] + box["width"] * share, "y": y, "id": i} for i, share in enumerate(shares)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    fingers("touchStart", 0.4, 0.6)
    fingers("touchMove", 0.2, 0.8)
    fingers("touchEnd")
    until(lambda: shown(page)[1] < 50, "the pinch")
    # The times under the fingers, 24 s and 36 s, are now at 20 % and 80 %.
    assert shown(page) == pytest.approx([20, 40], abs=0.3)
    # On a phone, no label covers a value.
    table = page.locator(".compare")
    head = table.locator("tr[data-field=displacement] th")
    value = table.locator("tr[data-field=displacement] td").first
    assert head.evaluate("(th) => th.scrollWidth <= th.clientWidth")
    assert value.evaluate("(td) => td.scrollWidth <= td.clientWidth")


# The slider's moves: when each was, and to which share of the range, both in seconds.
MOVES = """(seconds) => {
  const slider = document.querySelector(".scrub");
  window.moves = [];
  const note = () => moves.push([performance.now() / 1000, seconds * slider.value / slider.max]);
  new MutationObserver(note).observe(slider, { attributeFilter: ["aria-valuetext"] });
}"""


def test_the_playback_is_as_fast_as_chosen(page):
    page.get_by_label("Speed of the playback").select_option("16")
    scrub = page.locator(".scrub")
    page.evaluate(MOVES, SECOND_S)

    def speed():
        scrub.focus()
        page.keyboard.press("Home")
        page.evaluate("moves.length = 0")
        page.get_by_role("button", name="Play").click()
        until(lambda: scrub.evaluate("(slider) => slider.value === slider.max"), "the end")
        # The end is no whole step, and a busy machine makes few of them.
        steps = page.evaluate("moves.slice(0, -1)")
        (began_s, first_s), *_, (ended_s, last_s) = [[0, 0], *steps, [0, 0]] if len(steps) < 2 else steps
        return (last_s - first_s) / (ended_s - began_s) if ended_s > began_s else 0

    # A busy machine draws a step late.
    until(lambda: speed() == pytest.approx(16, rel=0.2), "a playback that is 16 times as fast")
    assert page.get_by_role("button", name="Play").is_visible()


def test_the_range_is_saved_as_csv_parquet_and_mcap(page, server):
    # 50 samples: both ends are whole milliseconds.
    link = f"{server.url}#/history/car?from=2023-11-14T23:13:30.000Z&to=2023-11-14T23:13:31.000Z"
    page.goto(link)
    loaded(page, "50 samples")
    saved = {}
    for label in ("CSV", "Parquet", "MCAP"):
        with page.expect_download() as begun:
            page.get_by_role("button", name=label, exact=True).click()
        saved[label] = begun.value.path()
        assert begun.value.suggested_filename == f"car-vesc-20231114T231330Z.{label.lower()}"
    rows = list(csv.DictReader(saved["CSV"].read_text().splitlines()))
    assert [row["voltage_input"] for row in rows[:2]] == ["11.9", "11.8998"]
    assert rows[0]["time"] == "2023-11-14T23:13:30.000000Z"
    columns = pq.read_table(saved["Parquet"]).to_pydict()
    assert columns["voltage_input"] == [float(row["voltage_input"]) for row in rows]
    with saved["MCAP"].open("rb") as file:
        assert [message.log_time for _, _, message in make_reader(file).iter_messages()] == [
            LATER_US * 1000 + (10_000 + 20 * i) * 1_000_000 for i in range(50)
        ]


def test_a_download_says_what_is_wrong_before_it_sends_anything(page, monkeypatch):
    monkeypatch.setattr("iort_station.page.history.MOST_VALUES", 1000)
    monkeypatch.setattr("iort_station.page.history.MOST_BYTES", 1000)
    note = page.locator(".download .note")
    page.get_by_role("button", name="CSV").click()
    until(lambda: "more than 1,000 values: choose a shorter one" in note.inner_text(), "the reason")
    page.get_by_role("button", name="MCAP").click()
    until(lambda: "over 1,000 bytes: choose a shorter one" in note.inner_text(), "the other reason")


def test_another_stream_is_loaded_at_once_and_kept_in_the_address(page, past):
    page.locator("#stream").select_option("agent")
    loaded(page, "Nothing was stored in this range.")
    page.reload()
    until(lambda: len(past.asked) == 3 and page.evaluate("iort.link") == "live", "the address' stream")
    assert [asked["stream"] for asked in past.asked] == [VESC_STREAM, "agent", "agent"]
    assert "?stream=agent&from=" in page.url


def middle(page, at, unit):
    """Both cars' speeds in the middle of the chart, which is at ``at``."""

    def there():
        box = chart(page, "Speed").bounding_box()
        assert box is not None
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        match = re.fullmatch(rf"at ([\d.]+) {unit}", page.inner_text(".compare-view .history-status .num"))
        return match is not None and abs(float(match[1]) - at) < 0.1

    until(there, f"{at} {unit}")
    texts = page.locator("section.panel[aria-label=Speed] .reading .num").all_inner_texts()
    return [float(text) for text in texts]


def test_runs_are_compared_over_time_and_distance(page, server, past):
    page.locator(".runs summary").click()
    for box in page.locator(".runs input").all():
        box.check()
    page.get_by_role("link", name="Compare 2 runs").click()
    note = page.locator(".compare-view .history-note")
    until(lambda: "4500 samples" in plain(note.inner_text()), "the two runs")
    until(lambda: page.locator("#part-run option").count() == 2, "the runs that can be added")
    page.get_by_role("button", name="Add").click()
    until(lambda: "is compared already" in note.inner_text(), "the refusal")
    page.get_by_role("button", name="Remove car, Tue 14 Nov 23:13:20 UTC").click()
    until(lambda: "Add another run" in note.inner_text(), "one run alone")
    page.get_by_role("button", name="Add").click()
    until(lambda: "4500 samples" in plain(note.inner_text()), "the two runs again")
    # A lap is a range: twenty seconds from the start, and as many ten seconds later.
    laps = (
        "car/2023-11-14T22:13:20.000Z/2023-11-14T22:13:40.000Z",
        "car/2023-11-14T22:13:30.000Z/2023-11-14T22:13:50.000Z",
    )
    page.goto(f"{server.url}#/compare?runs={','.join(laps)}&stream=vesc")
    until(lambda: "2000 samples" in plain(note.inner_text()), "both laps")
    assert middle(page, 10, "s") == pytest.approx([1, 2], abs=0.02)
    page.locator("#compare-axis").select_option("distance")
    # From 1 m/s the second lap has 40 m. By v² = v0² + 2 a s:
    assert middle(page, 20, "m") == pytest.approx([2, math.sqrt(5)], abs=0.02)

    def zoomed():
        # Seen once on a busy machine: nothing came of a drag.
        drag(page, "Speed", 0.2, 0.3)
        return reached(lambda: "zoom=" in page.url, within_s=30)

    until(zoomed, "the zoom")
    page.reload()
    assert middle(page, 10, "m") == pytest.approx([math.sqrt(2), math.sqrt(3)], abs=0.02)
    page.locator("#compare-stream").select_option("agent")
    until(lambda: "car has no distance in agent" in note.inner_text(), "the reason")


@pytest.fixture
def any_past(serve, lab):
    """A lab's page, whose cars have a past."""
    return serve(**lab.served()).url


def test_times_are_typed_with_24_hours(open_page, any_past):
    page = open_page(any_past + VIEWS["history"].address, timezone_id="UTC", locale="en-US")
    page.locator(VIEWS["history"].filled).first.wait_for()
    page.fill("#from", "2026-05-04 14:00:00")
    page.fill("#to", "3 PM")
    page.get_by_role("button", name="Load", exact=True).click()
    page.get_by_text('to must be a date and a time like 2026-05-04 14:03:27, got "3 PM".').wait_for()
    page.fill("#to", "2026-05-04 15:00:00")
    page.get_by_role("button", name="Load", exact=True).click()
    until(lambda: "from=2026-05-04T14:00:00.000Z&to=2026-05-04T15:00:00.000Z" in page.url, "the range")


def test_the_lines_of_a_comparison_have_names(open_page, any_past):
    page = open_page(any_past + VIEWS["compare"].address, timezone_id="UTC")
    page.locator(VIEWS["compare"].filled).first.wait_for()
    legend = page.locator(".compare-view .charts .panel").first.locator(".reading .label")
    assert legend.all_inner_texts() == ["10:00:00 UTC", "11:00:00 UTC"]


def test_what_an_address_says_in_vain_is_told(open_page, any_past):
    page = open_page(any_past)
    wrong = "#/history/car-1?from=2026-05-04T10:00:00Z&to=2026-05-04T09:00:00Z"
    for address, reasons in {
        "#/history/car-1?from=yesterday&foo=1": (
            "from must be a time like 2026-05-04T10:00:00.000Z, got",
            "history has no parameter foo",
        ),
        wrong: ("from and to must be two times in their order",),
        "#/compare?runs=car1/now": ("runs must be at most 6 ranges like car1/",),
        "#/hstory/car-1": ('there is no view "hstory/car-1"',),
    }.items():
        page.goto(any_past + address)
        for reason in reasons:
            page.get_by_text(reason).wait_for()
    page.goto(f"{any_past}#/alarms")
    until(lambda: not page.get_by_text("Ignored in the address").is_visible(), "a good address")


def test_an_address_is_followed_although_the_view_before_writes_its_own(open_page, any_past):
    """The browser tells the page of an address only after it has gone there."""
    page = open_page(any_past + VIEWS["history"].address)
    page.locator(VIEWS["history"].filled).first.wait_for()
    for address, shown in {
        "#/history/car-1?from=2026-05-04T10:00:00Z&to=2026-05-04T09:00:00Z": "from and to must be two times",
        "#/hstory/car-1": 'there is no view "hstory/car-1"',
    }.items():
        page.evaluate(
            "(hash) => { location.hash = hash; document.querySelector('.history select')"
            ".dispatchEvent(new Event('change')); }",
            address,
        )
        page.get_by_text(shown).wait_for()


def test_the_range_that_is_shown_opens_in_foxglove(open_page, server):
    page = open_page(f"{server.url}#/history/car?{FIRST}", timezone_id="UTC")
    loaded(page, "3000 samples")
    page.get_by_role("button", name="Open this range in Foxglove").click()
    dialog = page.get_by_role("dialog", name="Open in Foxglove")
    command = "iort bridge car --from 2023-11-14T22:13:20.000Z --to 2023-11-14T22:14:19.981Z"
    assert dialog.locator("code").inner_text() == command
    link = dialog.get_by_role("link", name="Foxglove on this computer").get_attribute("href")
    assert link == "foxglove://open?ds=foxglove-websocket&ds.url=ws%3A%2F%2F127.0.0.1%3A8765%2F"
    dialog.get_by_role("button", name="Close").click()
    until(lambda: page.get_by_role("dialog").count() == 0, "the end of the dialog")
