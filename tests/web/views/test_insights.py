"""The insights of a car in a real browser; its laps are found by the server in the samples of a table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from iort_station.page import insights as laps
from iort_station.page.server import PageServer
from testkit.waiting import until
from tests.browser import plain
from tests.unit.station.analysis.test_laps import driven_cloud
from tests.unit.station.data.test_data import START
from tests.web.cars import SUBSCRIBE_KEY
from tests.web.insights import insights
from tests.web.lab import Lab

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from playwright.sync_api import Page

    from iort_contract.messages.analysis.insights import InsightsAnswer
    from local.pubnub.standin import PubNubStandIn

END = START + 90_000_000


class Analysed(Lab):
    """A lab with the driven laps of `driven_cloud`, which are one drive, or one run until it is analysed."""

    def __init__(self) -> None:
        super().__init__()
        self.analysed = True
        # The analysis runs until the test has seen its progress.
        self.ends = False

    def answers(self) -> dict[str, Any]:
        extent = {"from_us": START, "to_us": END}
        part = {**extent, "batches": 90, "samples": 4500}
        run = {**extent, "run": "0badcafe", "state": "ended", "lost": 0, "streams": {"vesc": part}}
        runs = {"runs": [run], "older": False, "streams": {"vesc": extent}}
        told = {"insights": self.insights, "runs": lambda _: runs, "analysis": self.progress}
        of_car = {
            name: lambda asked, answer=answer: answer({**asked, "robot": "car"})
            for name, answer in laps.laps_answers(driven_cloud()).items()  # type: ignore[arg-type]  # a fake
        }
        return {**super().answers(), **told, **of_car}

    def analyse(self, asked: Mapping[str, str]) -> dict[str, str]:
        self.asked.append(dict(asked))
        return {"run": "iort-1"}

    def progress(self, _asked: Mapping[str, str]) -> dict[str, Any]:
        self.analysed = self.ends
        return {"running": not self.analysed, "drives": 1, "done": int(self.analysed)}

    def insights(self, asked: Mapping[str, str]) -> InsightsAnswer:
        told = insights(asked)
        if not self.analysed:
            return {**told, "findings": [], "drives": []}
        newest = {**told["drives"][0], "from_us": START, "to_us": END}
        return {**told, "drives": [newest, *told["drives"][6:]]}  # type: ignore[typeddict-item]  # of another time


@pytest.fixture
def lab() -> Analysed:
    return Analysed()


@pytest.fixture
def server(pubnub: PubNubStandIn, lab: Analysed) -> Iterator[PageServer]:
    told: dict[str, Any] = {"subscribe_key": SUBSCRIBE_KEY, "origin": pubnub.origin, "tls": False}
    with PageServer(
        namespace="iort", answers=lab.answers(), actions={"analyse": lab.analyse}, **told
    ) as server:
        yield server


def laps_found(page: Page) -> None:
    until(lambda: page.locator(".laps-table tbody tr").count() >= 6, "the laps")


def test_a_finding_has_its_interval_its_advice_and_its_evidence(
    open_page: Callable[..., Page], server: PageServer
) -> None:
    page = open_page(server.invitation("#/insights/car-1"), timezone_id="UTC")
    finding = page.locator(".finding[data-severity=warning]")
    finding.wait_for()
    interval = finding.locator("[role=img]").get_attribute("aria-label")
    assert interval == "55.0 mΩ (52.0 to 58.0), usually 40.0 mΩ (37.0 to 43.0)"
    assert "replace the battery if the resistance stays" in finding.inner_text()
    assert page.locator(".drives tr[data-failed=true]").inner_text().endswith("ran out of memory")
    finding.get_by_role("link", name="Show the evidence").click()
    assert "#/history/car-1?stream=vesc&from=" in page.url
    assert page.url.endswith("&fields=voltage_input,current_input")


def test_two_laps_are_compared_and_all_their_fields_are_a_click_away(
    open_page: Callable[..., Page], server: PageServer
) -> None:
    page = open_page(server.invitation("#/insights/car-1"), timezone_id="UTC")
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
    open_page: Callable[..., Page], server: PageServer, lab: Analysed
) -> None:
    lab.analysed = False
    page = open_page(server.invitation("#/insights/car-1"), timezone_id="UTC")
    laps_found(page)
    note = page.locator(".insights-view .history-note").first
    assert "No drive of car-1 has been analysed yet" in note.inner_text()
    assert page.locator(".finding").count() == 0
    page.get_by_label("Drives of the last").select_option("last 7 days")
    page.get_by_role("button", name="Analyse").click()
    until(lambda: "0 of 1 drives are analysed" in note.inner_text(), "the progress")
    lab.ends = True
    page.locator(".finding").first.wait_for()
    assert lab.asked == [{"robot": "car-1", "last_s": "604800"}]
