"""The panels of a car's past: its trajectory, fields of several streams, a table, laps and alarms."""

from __future__ import annotations

import csv
import functools
import math
import re
import threading

import pytest

from iort_contract.track import Track
from iort_station.page.answers import answers
from testkit.waiting import GUARD_S, until
from tests.browser import drawn, plain
from tests.unit.station.data.test_runs import driven_cloud
from tests.web.cars import GAIN
from tests.web.lab import VIEWS

driven = functools.cache(driven_cloud)
RANGE = "from=2023-11-14T22:13:20.000Z&to=2023-11-14T22:14:50.000Z"
MAP = "section.map"
LENGTH_S = 90


class Past:
    """The server's own answers about a drive of laps, and what was asked of it."""

    def __init__(self, track=None):
        self.asked = []
        served = answers(driven(), track)
        names = ("streams", "fields", "runs", "history", "vehicles", "laps", "raceline")
        self.answers = {name: served[name] for name in names}

        def watched(asked):
            self.asked.append((asked["stream"], asked["rows"]))
            return served["history"](asked)

        self.answers["history"] = watched


@pytest.fixture
def past():
    return Past()


@pytest.fixture
def url(serve, past):
    return serve(vehicles={"car": {"speed_to_erpm_gain": GAIN}}, answers=past.answers).url


@pytest.fixture
def show(open_page, url):
    """Open the past with these panels."""

    def shown(fields="", **options):
        query = f"&fields={fields}" if fields else ""
        page = open_page(f"{url}#/history/car?stream=vesc&{RANGE}{query}", timezone_id="UTC", **options)
        loaded(page)
        return page

    return shown


def loaded(page):
    until(lambda: "samples in" in page.inner_text(".history-note"), "the samples")
    drawn(page)


def choose(page, label, value):
    """Choose from a list that is made when it gets the focus."""
    chosen = page.get_by_label(label)
    chosen.focus()
    chosen.select_option(value)


def playhead(page):
    """The seconds of the playhead since the start."""
    hour, minute, second = re.search(r"(\d\d):(\d\d):([\d.]+)", page.inner_text(".scrub-at")).groups()
    return (int(hour) - 22) * 3600 + (int(minute) - 13) * 60 + float(second) - 20


def mark(page):
    """Where the car's mark is in the trajectory's plot, in pixels."""
    return page.evaluate(
        """() => {
          const box = document.querySelector(".map .u-over").getBoundingClientRect();
          const mark = document.querySelector(".map .plane-mark").getBoundingClientRect();
          return [mark.x + mark.width / 2 - box.x, mark.y + mark.height / 2 - box.y];
        }"""
    )


def pixels(page, properties, selector=".map canvas"):
    """How many pixels of a canvas have one of these colours."""
    return page.evaluate(
        """([properties, selector]) => {
          const canvas = document.querySelector(selector);
          const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
          const probe = document.body.appendChild(document.createElement("span"));
          const wanted = properties.map((name) => {
            probe.style.color = `var(${name})`;
            return getComputedStyle(probe).color.match(/\\d+/g).map(Number);
          });
          probe.remove();
          return wanted.map((colour) => {
            let count = 0;
            const near = (i) => colour.every((part, c) => Math.abs(data[i + c] - part) < 20);
            for (let i = 0; i < data.length; i += 4) if (data[i + 3] > 200 && near(i)) count += 1;
            return count;
          });
        }""",
        [properties, selector],
    )


def test_the_past_opens_with_the_way_of_the_car_in_the_colours_of_its_speed(show, past):
    page = show()
    assert page.locator(MAP).get_attribute("aria-label") == "Trajectory of pose"
    legend = plain(page.inner_text(".ramp"))
    assert re.fullmatch(r"Speed\s+-?\d+\.\d\d\s+\d+\.\d\d\s+m/s", legend), legend
    counts = pixels(page, ["--ramp-3", "--ramp-4", "--ramp-5"])
    assert min(counts) > 0, counts
    # Positions come in more rows than a chart is wide.
    assert set(past.asked) == {("vesc", "1500"), ("pose", "5000")}
    choose(page, "Colour by a field", "-")
    until(lambda: not page.locator(".ramp").is_visible(), "one colour")
    drawn(page)
    assert pixels(page, ["--ramp-5", "--accent"])[0] == 0 < pixels(page, ["--accent"])[0]
    assert "fields=map:pose," in page.url


def test_a_range_that_is_chosen_before_the_fields_are_known_gets_its_way_later(open_page, serve, past):
    known, fields = threading.Event(), past.answers["fields"]

    def later(asked):
        known.wait(GUARD_S)
        return fields(asked)

    past.answers["fields"] = later
    page = open_page(f"{serve(answers=past.answers).url}#/history/car?{RANGE}", timezone_id="UTC")
    page.fill("#from", "2023-11-14 22:13:20")
    page.fill("#to", "2023-11-14 22:14:00")
    page.get_by_role("button", name="Load", exact=True).click()
    loaded(page)
    assert page.locator(MAP).count() == 0
    known.set()
    until(lambda: page.locator(MAP).count() == 1, "the way")


def test_pointing_at_the_way_moves_the_playhead_and_the_playhead_the_car(show):
    page = show("map:pose:speed,speed")
    scrub = page.locator(".scrub")
    scrub.focus()
    page.keyboard.press("Home")
    until(lambda: playhead(page) < 0.1, "the start")
    drawn(page)
    first = mark(page)
    for _ in range(40):
        page.keyboard.press("ArrowRight")
    until(lambda: mark(page) != first, "the car to move")
    box = page.locator(f"{MAP} .u-over").bounding_box()
    # Where it was at the start, it was then, and at the start of other laps.
    page.mouse.move(box["x"] + first[0] + 1, box["y"] + first[1])
    until(lambda: math.dist(mark(page), first) < 12, "the car under the pointer")
    there = playhead(page)
    # A click rests there, and the address says so.
    page.mouse.click(box["x"] + first[0] + 1, box["y"] + first[1])
    until(lambda: "&at=" in page.url, "the rest")
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] + 300)
    drawn(page)
    assert playhead(page) == pytest.approx(there, abs=0.1)


def test_zooming_time_narrows_the_way_and_a_lap_is_shown_alone(show):
    page = show("map:pose,speed")
    whole = pixels(page, ["--accent"])[0]
    page.locator(".laps summary").click()
    laps = page.locator(".laps .chip")
    until(lambda: laps.count() > 2, "the laps")
    assert "the best" in page.inner_text(".laps")
    lap = laps.nth(1)
    length = float(re.search(r": ([\d.]+) s", lap.inner_text())[1])
    lap.click()
    until(lambda: lap.get_attribute("aria-pressed") == "true", "the lap")
    loaded(page)
    ends = page.evaluate(
        """() => {
          const query = new URLSearchParams(location.hash.split("?")[1]);
          return ["from", "to"].map((end) => Date.parse(query.get(end)));
        }"""
    )
    assert (ends[1] - ends[0]) / 1000 == pytest.approx(length, abs=0.02)
    assert pixels(page, ["--accent"])[0] < 0.8 * whole
    # The others can still be chosen; the same one again shows all of them.
    laps.nth(2).click()
    until(lambda: laps.nth(2).get_attribute("aria-pressed") == "true", "the next lap")
    loaded(page)
    laps.nth(2).click()
    until(lambda: RANGE in page.url, "the whole range")
    loaded(page)
    until(lambda: pixels(page, ["--accent"])[0] > 0.95 * whole, "the whole way")


def test_the_way_is_drawn_on_the_track_with_its_fastest_line(open_page, serve):
    angle = [2 * math.pi * i / 60 for i in range(60)]
    circle = ([8 * math.cos(a) for a in angle], [8 * math.sin(a) for a in angle])
    track = Track(*map(tuple, circle), (1.0,) * 60, (1.0,) * 60)
    counts = []
    for known in (None, track):
        server = serve(vehicles={}, answers=Past(known).answers, track=known)
        page = open_page(f"{server.url}#/history/car?stream=vesc&{RANGE}&fields=map:pose", timezone_id="UTC")
        loaded(page)
        if known:
            page.wait_for_function(
                "performance.getEntriesByName(new URL('raceline.json?', location).href).length"
            )
            drawn(page)
        counts.append(pixels(page, ["--grid", "--muted"]))
    # The grid has the ground's colour, too.
    assert counts[1][0] > 3 * counts[0][0]
    assert counts[1][1] > counts[0][1]


def test_fields_of_several_streams_share_a_chart_and_its_axis_of_time(show, past):
    page = show("speed")
    assert {stream for stream, _ in past.asked} == {"vesc"}
    choose(page, "Lines of Speed", "pose/x")
    chart = page.locator("section[aria-label='Speed · X, pose']")
    until(chart.is_visible, "both lines")
    assert "fields=speed~pose/x" in page.url
    until(lambda: {stream for stream, _ in past.asked} == {"vesc", "pose"}, "the other stream")
    loaded(page)
    until(lambda: chart.locator(".reading").count() == 2, "its line")
    readings = chart.locator(".reading")
    assert [re.sub(r"[\d.\-]+", "", plain(text)).split() for text in readings.all_inner_texts()] == [
        ["Speed", "m/s"],
        ["X,", "pose", "m"],
    ]
    # Each has its own axis, and both have a value wherever the cursor is.
    chart.locator("[role=img]").focus()
    for key in ("Home", "ArrowRight", "ArrowRight", "Shift+ArrowRight", "End"):
        page.keyboard.press(key)
        drawn(page)
        values = [plain(text) for text in chart.locator(".reading .num").all_inner_texts()]
        assert all(re.fullmatch(r"-?\d+\.\d\d", value) for value in values), (key, values)
        assert re.search(r": Speed -?[\d.]+ m/s, X, pose -?[\d.]+ m$", plain(page.inner_text("#spoken")))
    # The same list removes one.
    choose(page, "Lines of Speed · X, pose", "speed")
    until(lambda: "fields=pose/x" in page.url, "one line")


def test_a_field_is_drawn_over_a_field_of_another_stream_and_says_how_they_are_joined(show):
    page = show("xy:speed:current_motor")
    panel = page.locator("section[aria-label='Field over field']")
    assert "of the same sample" in panel.inner_text()
    choose(page, "The y axis", "pose/x")
    until(
        lambda: "for each vesc, the last pose before it" in panel.locator(".note").text_content(), "the join"
    )
    assert "fields=xy:speed:pose/x" in page.url
    # The list that was used still has the focus.
    loaded(page)
    until(lambda: page.evaluate("document.activeElement.ariaLabel") == "The y axis", "its focus")
    panel.locator("[role=img]").focus()
    page.keyboard.press("Home")
    drawn(page)
    assert re.search(r"22:13:20\.\d: Speed -?[\d.]+ m/s, X -?[\d.]+ m$", plain(page.inner_text("#spoken")))
    page.keyboard.press("Shift+ArrowRight")
    until(lambda: playhead(page) > 1, "the playhead")
    assert pixels(page, ["--accent"], ".xy canvas")[0] > 50


def test_a_table_has_the_rows_at_the_playhead_to_sort_and_to_copy(show):
    page = show("table:vesc,speed", permissions=["clipboard-read", "clipboard-write"])
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    rows, current = page.locator(".rows tbody tr"), page.locator(".rows tr[aria-current]")
    assert rows.count() == 100
    assert re.match(r"100 of [\d\s]+ rows", plain(page.inner_text(".rows-panel .note")))
    page.locator(".scrub").focus()
    page.keyboard.press("Home")
    until(
        lambda: current.count() == 1 and current.inner_text().startswith("Tue 14 Nov 22:13:20.0"), "the first"
    )
    page.locator(".rows").focus()
    for _ in range(3):
        page.keyboard.press("ArrowDown")
    place = "(row) => [...row.parentNode.children].indexOf(row)"
    until(lambda: current.evaluate(place) == 3, "the fourth row")
    assert playhead(page) > 0.05
    heads = [text.split(",")[0] for text in page.locator(".rows th[scope=col]").all_inner_texts()]
    at = heads.index("Motor current")

    def column():
        return [
            float(plain(text)) for text in page.locator(f".rows td:nth-child({at + 1})").all_inner_texts()
        ]

    sort = page.locator(".rows th[scope=col]").nth(at).get_by_role("button")
    sort.click()
    assert column() == sorted(column())
    sort.click()
    assert page.locator(".rows th[scope=col]").nth(at).get_attribute("aria-sort") == "descending"
    highest = column()
    assert highest == sorted(highest, reverse=True)
    # A click on a row moves the playhead there.
    rows.first.click()
    until(lambda: "&at=" in page.url, "the rest")
    page.get_by_role("button", name="Copy CSV").click()
    until(lambda: "Copied" in page.inner_text(".rows-panel header"), "the copy")
    copied = list(csv.DictReader(page.evaluate("navigator.clipboard.readText()").splitlines()))
    assert len(copied) > 1000
    assert [round(float(row["current_motor (A)"]), 2) for row in copied[:100]] == highest
    assert {row["time"][:14] for row in copied} == {"2023-11-14T22:"}


# A chart's canvas is cleared when it is drawn, and only then.
COUNT_DRAWS = """() => {
  [window.draws, window.lines] = [0, 0];
  const { clearRect } = CanvasRenderingContext2D.prototype;
  CanvasRenderingContext2D.prototype.clearRect = function (...box) {
    window.draws += 1;
    clearRect.apply(this, box);
  };
  const count = (changes) => (window.lines += changes.length);
  new MutationObserver(count).observe(document.querySelector(".rows tbody"), { childList: true });
}"""


@pytest.mark.parametrize("over", [".map", ".xy:not(.map)", "section[aria-label='Speed · X, pose']"])
def test_pointing_moves_what_shows_the_playhead_and_draws_no_chart_again(show, over):
    page = show("map:pose:speed,speed~pose/x,xy:speed:current_motor,voltage_input,table:vesc")
    page.evaluate(COUNT_DRAWS)
    plot = page.locator(f"{over} .u-over")
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    seen = set()
    for step in range(1, 20):
        page.mouse.move(box["x"] + box["width"] * step / 20, box["y"] + box["height"] * (0.3 + step % 3 / 5))
        drawn(page)
        seen.add((playhead(page), *mark(page)))
    assert len(seen) > 5, "the pointer moves the playhead and the car"
    current, at = page.locator(".rows tr[aria-current]"), page.locator(".scrub-at")
    until(lambda: current.inner_text()[:19] == at.inner_text()[:19], "the table at the playhead")
    assert (page.evaluate("draws"), page.evaluate("lines")) == (0, 0)
    # Other colours are drawn: this is counted.
    page.emulate_media(color_scheme="dark")
    until(lambda: page.evaluate("draws") >= 4, "every chart in the other colours")


def test_the_arrangement_is_kept_and_shared_by_its_link(show, url, open_page):
    page = show("speed,voltage_input")
    labels = "[...document.querySelectorAll('.result .charts .panel')].map((panel) => panel.ariaLabel)"
    choose(page, "Add a panel", "table:pose")
    until(lambda: page.url.endswith("fields=speed,voltage_input,table:pose"), "the table")
    page.get_by_label("Move Battery voltage").focus()
    page.keyboard.press("ArrowLeft")
    until(lambda: page.url.endswith("fields=voltage_input,speed,table:pose"), "the other order")
    page.get_by_label("Close Speed").click()
    arranged = ["Battery voltage", "Table of pose"]
    until(lambda: page.evaluate(labels) == arranged, "the table alone")
    # The next visit of this browser has it, and whoever gets the link.
    link = page.url
    page.goto(f"{url}#/history/car?stream=pose&{RANGE}")
    until(lambda: page.locator("#stream").input_value() == "pose", "another stream")
    # A reload could come before an address of the same document.
    page.goto("about:blank")
    page.goto(f"{url}#/history/car?stream=vesc&{RANGE}")
    until(lambda: page.evaluate(labels) == arranged, "what is kept")
    other = open_page(link, timezone_id="UTC")
    until(lambda: other.evaluate(labels) == arranged, "what is shared")
    # A link changes nothing that is kept.
    # A visit of its own: in the same one the panels that are shown stay, and are written into the address.
    other.goto("about:blank")
    other.goto(f"{url}#/history/car?stream=vesc&{RANGE}")
    until(lambda: len(other.evaluate(labels)) > 2, "the usual panels")
    page.get_by_role("button", name="Reset").click()
    until(lambda: "fields=" not in page.url and len(page.evaluate(labels)) > 2, "the usual panels again")


@pytest.mark.parametrize(
    "fields",
    [
        "map:constructor,table:__proto__,xy:toString:constructor/x,speed~constructor/x,hasOwnProperty,speed",
        "map:pose:__proto__/x,map::,xy:speed,table:,xy:speed:speed:speed,~~,/,:,a/b/c,speed",
        "%3Cimg%20src=x%20onerror=window.hacked=1%3E/x,table:%3Cscript%3E,map:vesc:speed,speed",
    ],
)
def test_a_link_of_odd_panels_shows_those_that_there_are(show, fields):
    page = show(fields)
    until(page.locator("section[aria-label='Speed']").is_visible, "the panel that there is")
    assert page.evaluate("window.hacked") is None
    page.get_by_role("button", name="Reset").click()
    until(lambda: "fields=" not in page.url, "the usual panels")


def test_arrow_keys_move_the_cursor_on_the_way_and_rest_there(show):
    page = show("map:pose:speed,speed")
    page.locator(f"{MAP} [role=img]").focus()
    page.keyboard.press("Home")
    until(lambda: playhead(page) < 0.1, "the start")
    spoken = page.locator("#spoken")
    told = r"22:13:20\.0: x, m -?[\d.]+, y, m -?[\d.]+, Speed -?[\d.]+ m/s"
    until(lambda: re.search(told, plain(spoken.inner_text())), "it in words")
    assert spoken.get_attribute("role") == "status"
    page.keyboard.press("ArrowRight")
    one = spoken.inner_text()
    page.keyboard.press("Shift+ArrowRight")
    until(lambda: playhead(page) > 3, "a larger step")
    assert spoken.inner_text() != one
    page.keyboard.press("End")
    until(lambda: playhead(page) > LENGTH_S - 1, "the end")
    page.keyboard.press("Home")
    page.locator(".scrub").focus()
    until(lambda: "&at=2023-11-14T22:13:20" in page.url, "the rest")


def test_an_alarm_is_counted_before_it_is_set_and_shows_the_cars_answer(open_page, server, lab):
    lab.keeps = {"accepted": False, "reason": "no recorder", "online": True}
    page = open_page(server.invitation(VIEWS["history"].address), timezone_id="UTC")
    chart = page.locator("section[aria-label='Battery voltage']")
    lab.counts.clear()
    chart.get_by_label("Alarm", exact=True).click()
    form, add = chart.locator(".alarm-form"), chart.get_by_role("button", name="Add alarm")
    assert add.is_disabled()
    lab.counts.set()
    until(add.is_enabled, "the count")
    assert "it would have come true 3 times, and told of it once (3000 samples)" in form.inner_text()
    lab.counts.clear()
    form.get_by_label("Threshold").fill("11.5")
    assert add.is_disabled()
    form.get_by_label("for").fill("0.5")
    lab.counts.set()
    until(lambda: form.locator("code").inner_text() == "voltage_input > 11.5 for 0.5s", "the condition")
    handle = chart.locator(".threshold")
    assert handle.get_attribute("aria-valuetext") == "11.50 V"
    until(add.is_enabled, "the count of the new one")
    assert lab.asked[-1]["when"] == "voltage_input > 11.5 for 0.5s"
    # Dragged to the middle of the plot, which is at zero.
    box, plot = handle.bounding_box(), chart.locator(".u-over").bounding_box()
    page.mouse.move(box["x"] + 60, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + 60, plot["y"] + plot["height"] / 2, steps=5)
    page.mouse.up()
    value = float(form.get_by_label("Threshold").input_value())
    assert abs(value) < 2
    assert "from=" in page.url
    handle.focus()
    page.keyboard.press("ArrowUp")
    until(lambda: float(form.get_by_label("Threshold").input_value()) > value, "the key")
    form.get_by_label("Threshold").fill("11.5")
    form.get_by_label("name").fill("full")
    until(add.is_enabled, "the count")
    add.click()
    until(lambda: "car-1 refuses: no recorder. It is taken back." in form.inner_text(), "the refusal")
    listed = page.locator(".own-alarms li")
    assert listed.count() == 1
    lab.keeps = {"accepted": True, "reason": "", "online": True}
    add.click()
    until(lambda: "car-1 has accepted it." in form.inner_text(), "the answer")
    asked = {"robot": "car-1", "stream": "vesc", "when": "voltage_input > 11.5 for 0.5s", "cooldown_s": "60"}
    assert lab.asked[-1] == {**asked, "name": "full"}
    until(lambda: listed.count() == 2, "the list")
    assert " ".join(listed.nth(1).inner_text().split()) == (
        "full accepted vesc: voltage_input > 11.5 for 0.5s Remove"
    )
    # What keeps messages is listed, and stays.
    assert "keeps messages" in listed.first.inner_text()
    assert listed.first.get_by_role("button").count() == 0
    page.get_by_label("Remove the alarm full").click()
    until(lambda: listed.count() == 1, "it to be gone")


def test_the_condition_is_of_what_the_car_sends(open_page, server):
    page = open_page(server.invitation("#/history/car-1?fields=duty_cycle,speed"), timezone_id="UTC")
    for label, threshold, condition in (
        ("Duty cycle", "50", "duty_cycle < 0.5"),
        ("Duty cycle", "48.1371543", "duty_cycle < 0.481371543"),
        ("Speed", "2", "speed_mps < 2"),
    ):
        chart = page.locator(f"section[aria-label='{label}']")
        if chart.locator(".alarm-form").is_hidden():
            chart.get_by_label("Alarm", exact=True).click()
        chart.get_by_label("When it is").select_option("<")
        chart.get_by_label("for").fill("0")
        chart.locator(".alarm-form").get_by_label("Threshold").fill(threshold)
        until(lambda chart=chart, told=condition: chart.locator("code").inner_text() == told, condition)


def test_who_may_only_look_sets_no_alarm(open_page, server):
    page = open_page(server.url + VIEWS["history"].address)
    page.locator(".own-alarms li").wait_for()
    assert page.get_by_label("Alarm", exact=True).count() == 0
    assert page.locator(".own-alarms button").count() == 0
