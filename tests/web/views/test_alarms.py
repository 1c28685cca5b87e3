"""The views of alarms, of CloudWatch's logs, and of insights, in a browser."""

from __future__ import annotations

import threading

import pytest

from iort_contract.catalog.metrics import METRICS
from testkit.waiting import GUARD_S, until
from tests.browser import plain, show
from tests.unit.station.data.test_queries import START
from tests.web.cars import SAMPLE
from tests.web.lab import END, NOW_S, VIEWS, Lab, insights


def test_every_view_counts_the_alarms_and_each_says_what_to_do(open_page, lab, server):
    page = open_page(server.url)
    badge = page.locator("#alarms")
    for view, (address, _) in VIEWS.items():
        page.goto(server.url + address)
        until(lambda: badge.inner_text() == "3", f"the badge on the view {view}")
    assert badge.get_attribute("aria-label") == "3 raised, 2 of them not acknowledged"
    page.locator("#to-alarms").click()
    faulty = page.locator("[data-alarm=FaultSamples]")
    until(faulty.count, "the alarm")
    entry = METRICS["FaultSamples"].alarm
    assert entry
    assert entry.advice.replace("`", "") in faulty.inner_text()
    # The moment in the past of the cars that the alert named, and of a refused message's car.
    links = faulty.locator("a")
    assert links.all_inner_texts() == ["car-1", "car-2"]
    address = links.first.get_attribute("href") or ""
    assert address.startswith("#/history/car-1?from=20")
    message = page.locator("[data-alarm=Quarantined] .cases")
    until(message.count, "the messages in quarantine")
    assert "column speed must have 10 values" in message.inner_text()
    assert "iort errors 0a1b2c" in message.inner_text()
    page.locator("#acknowledge-as").fill("grace")
    faulty.locator("button").click()
    until(lambda: "Acknowledged by grace" in faulty.inner_text(), "the acknowledgement")
    assert lab.asked == [
        {"alarm": "FaultSamples", "since_ms": str(round((NOW_S - 600) * 1000)), "by": "grace"}
    ]
    assert faulty.locator("button").count() == 0
    # It comes back: it is new again.
    lab.alarms[0] = {**lab.alarms[0], "since_s": NOW_S, "acknowledged": None}
    page.reload()
    until(lambda: faulty.locator("button").count() == 1, "the button")
    assert page.locator("#acknowledge-as").input_value() == "grace"


# The words of each raised alarm about cars.
RAISED = """() => Object.fromEntries([...document.querySelectorAll("[data-alarm]")]
  .map((node) => [node.dataset.alarm, node.querySelector("li")?.innerText ?? ""]))"""


def test_live_values_raise_the_alarms_of_cars(open_page, lab, server, car):
    lab.alarms = [{**one, "state": "OK"} for one in lab.alarms]
    page = open_page(f"{server.url}#/alarms")
    until(lambda: "not raised" in page.inner_text(".quiet"), "the cloud's alarms")
    assert page.locator("#alarms").is_hidden()
    # The threshold is the deployment's.
    bad = {**SAMPLE, "fault_code": 2, "temperature_pcb": 80.5, "voltage_input": 10.6}

    def raised():
        # A car that is gone raises nothing: on a busy machine it sends again.
        show(page, car.send(bad))
        words = page.evaluate(RAISED)
        both = set(words) == {"FaultSamples", "TemperatureDegC"} and page.inner_text("#alarms") == "2"
        return words["FaultSamples"].split("\n") if both else None

    assert until(raised, "the car's alarms")[:2] == ["car-1", "under voltage (2)"]
    # Without an answer nobody knows.
    lab.refuses = True
    page.reload()
    until(lambda: page.inner_text("#alarms") == "?", "the badge without a number")
    until(lambda: "no such right" in page.inner_text(".history-note"), "the reason")
    assert page.locator("text=No alarm is raised").is_hidden()


WIDGET = {
    "number": 3,
    "x": 0,
    "y": 0,
    "width": 24,
    "height": 6,
    "title": "Warnings",
    "kind": "log",
    "text": "",
}


class Logs:
    """A server whose queries wait until the test releases them; it records the requests."""

    def __init__(self):
        self.dashboards = 0
        self.queries = []
        self.done = threading.Event()

    def dashboard(self, asked):
        self.dashboards += 1
        widget = {**WIDGET, "period_s": 300, "series": [], "alarms": []}
        return {"name": asked["name"], "from_s": 0, "to_s": 60 * int(asked["minutes"]), "widgets": [widget]}

    def log(self, asked):
        self.queries.append(dict(asked))
        assert self.done.wait(GUARD_S)
        rows = [[f"{asked['minutes']}\n  in details"]]
        return {"columns": ["@message"], "rows": rows, "found": 1, "from_s": 0, "to_s": 60}


def test_the_page_waits_for_a_log_query_across_dashboard_updates(open_page, serve):
    logs = Logs()
    answers = {
        "dashboards": lambda _: {"dashboards": ["iort-platform"]},
        "dashboard": logs.dashboard,
        "log": logs.log,
        "robots": lambda _: {"robots": {}},
    }
    page = open_page(f"{serve(answers=answers).url}#/cloudwatch")
    until(lambda: len(logs.queries) == 1, "the first query")
    first = page.locator(".log-widget").element_handle()
    page.evaluate("document.querySelector('.widgets > *').dataset.old = 'yes'")
    # The page does so every half minute.
    page.locator("#dashboard").dispatch_event("change")
    until(lambda: page.locator(".widgets > :not([data-old])").count() == 1, "the dashboard to be new")
    assert page.evaluate("(node) => node.isConnected", first)
    # Another range is another query, and the page no longer waits for the first.
    page.locator("#minutes").select_option("15")
    until(lambda: len(logs.queries) == 2, "the second query")
    logs.done.set()
    line = page.locator(".log-widget td.words")
    until(lambda: line.count() == 1, "the matches")
    # The details of a line wait for a click.
    assert line.inner_text() == "15"
    line.locator("summary").click()
    assert line.inner_text().split("\n") == ["15", "  in details"]
    assert [asked["minutes"] for asked in logs.queries] == ["60", "15"]


class Analysed(Lab):
    """A lab whose newest drive is one run until it is analysed."""

    def __init__(self):
        super().__init__()
        self.analysed = True
        # The analysis runs until the test has seen its progress.
        self.ends = False

    def answers(self):
        extent = {"from_us": START, "to_us": END}
        part = {**extent, "batches": 90, "samples": 4500}
        run = {**extent, "run": "0badcafe", "state": "ended", "lost": 0, "streams": {"vesc": part}}
        runs = {"runs": [run], "older": False, "streams": {"vesc": extent}}
        more = {"insights": self.insights, "runs": lambda _: runs, "analysis": self.progress}
        return {**super().answers(), **more}

    def analyse(self, asked):
        self.asked.append(dict(asked))
        return {"run": "iort-1"}

    def progress(self, _asked):
        self.analysed = self.ends
        return {"running": not self.analysed, "drives": 1, "done": int(self.analysed)}

    def insights(self, asked):
        return insights(asked) if self.analysed else {**insights(asked), "findings": [], "drives": []}


@pytest.fixture
def analysed():
    return Analysed()


@pytest.fixture
def analyses(serve, analysed):
    return serve(answers=analysed.answers(), actions={"analyse": analysed.analyse})


def laps_found(page):
    until(lambda: page.locator(".laps-table tbody tr").count() >= 6, "the laps")


def test_a_finding_has_its_interval_its_advice_and_its_evidence(open_page, analyses):
    page = open_page(analyses.invitation("#/insights/car-1"), timezone_id="UTC")
    finding = page.locator(".finding[data-severity=warning]")
    finding.wait_for()
    interval = finding.locator("[role=img]").get_attribute("aria-label")
    assert interval == "55.0 mΩ (52.0 to 58.0), usually 40.0 mΩ (37.0 to 43.0)"
    assert "replace the battery if the resistance stays" in finding.inner_text()
    assert page.locator(".drives tr[data-failed=true]").inner_text().endswith("ran out of memory")
    finding.get_by_role("link", name="Show the evidence").click()
    assert "#/history/car-1?stream=vesc&from=" in page.url
    assert page.url.endswith("&fields=voltage_input,current_input")


def test_two_laps_are_compared_and_all_their_fields_are_a_click_away(open_page, analyses):
    page = open_page(analyses.invitation("#/insights/car-1"), timezone_id="UTC")
    laps_found(page)
    times = [float(text.split()[0]) for text in page.locator(".laps-table td:nth-child(4)").all_inner_texts()]
    best, second = sorted(range(len(times)), key=times.__getitem__)[:2]
    assert page.locator("tr[data-best=true]").get_attribute("data-lap") == str(best + 1)
    chart = page.locator(f"section[aria-label='Lap {second + 1} behind lap {best + 1}']")
    behind = chart.locator(".reading .num")
    until(lambda: plain(behind.inner_text()) == f"{times[second] - times[best]:.3f}", "the delta at the end")
    page.get_by_label(f"Compare lap {second + 1}").uncheck()
    third = next(i for i in range(len(times)) if i not in {best, second})
    page.get_by_label(f"Compare lap {third + 1}").check()
    page.locator(f"section[aria-label='Lap {third + 1} behind lap {best + 1}']").wait_for()
    assert page.url.endswith(f"laps={best + 1},{third + 1}")
    page.reload()
    page.locator(f"section[aria-label='Lap {third + 1} behind lap {best + 1}']").wait_for()
    page.get_by_role("link", name="All fields of 2 laps").click()
    page.locator(".compare-view .charts canvas").first.wait_for()
    assert page.locator(".parts li").count() == 2
    # Another lap of the run joins them there.
    until(lambda: page.locator("#part-lap option").count() == len(times) + 1, "the laps of the run")
    page.locator("#part-lap").select_option(index=second + 1)
    page.get_by_role("button", name="Add").click()
    until(lambda: page.locator(".parts li").count() == 3, "the third lap")


def test_before_the_first_analysis_the_page_says_so_and_shows_the_laps_of_the_newest_run(
    open_page, analyses, analysed
):
    analysed.analysed = False
    page = open_page(analyses.invitation("#/insights/car-1"), timezone_id="UTC")
    laps_found(page)
    note = page.locator(".insights-view .history-note").first
    assert "No drive of car-1 has been analysed yet" in note.inner_text()
    assert page.locator(".finding").count() == 0
    page.get_by_label("Drives of the last").select_option("last 7 days")
    page.get_by_role("button", name="Analyse").click()
    until(lambda: "0 of 1 drives are analysed" in note.inner_text(), "the progress")
    analysed.ends = True
    page.locator(".finding").first.wait_for()
    assert analysed.asked == [{"robot": "car-1", "last_s": "604800"}]
