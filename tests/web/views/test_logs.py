"""A dashboard's log widget whose query takes longer than the interval between two dashboards."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from iort_station.page.server import PageServer
from testkit.waiting import GUARD_S, until
from tests.web.cars import SUBSCRIBE_KEY

if TYPE_CHECKING:
    from playwright.sync_api import Page

    from local.pubnub.standin import PubNubStandIn

WIDGET = {
    "number": 3,
    "x": 0,
    "y": 0,
    "width": 24,
    "height": 6,
    "title": "Warnings",
    "kind": "log",
    "text": "",
    "period_s": 300,
    "series": [],
    "alarms": [],
}


class Logs:
    """A server whose queries wait until the test releases them; it records the requests."""

    def __init__(self) -> None:
        self.dashboards = 0
        self.queries: list[dict[str, str]] = []
        self.done = threading.Event()

    def dashboard(self, asked: Any) -> dict[str, Any]:
        self.dashboards += 1
        return {"name": asked["name"], "from_s": 0, "to_s": 60 * int(asked["minutes"]), "widgets": [WIDGET]}

    def log(self, asked: Any) -> dict[str, Any]:
        self.queries.append(dict(asked))
        assert self.done.wait(GUARD_S)
        return {
            "columns": ["@message"],
            "rows": [[f"{asked['minutes']}\n  in details"]],
            "found": 1,
            "from_s": 0,
            "to_s": 60,
        }


def test_the_page_waits_for_a_log_query_across_dashboard_updates(
    open_page: Callable[..., Page], pubnub: PubNubStandIn
) -> None:
    logs = Logs()
    answers: dict[str, Any] = {
        "dashboards": lambda _: {"dashboards": ["iort-platform"]},
        "dashboard": logs.dashboard,
        "log": logs.log,
        "robots": lambda _: {"robots": {}},
    }
    told: dict[str, Any] = {"subscribe_key": SUBSCRIBE_KEY, "origin": pubnub.origin, "tls": False}
    with PageServer(namespace="iort", answers=answers, **told) as server:
        page = open_page(f"{server.url}#/cloudwatch")
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
