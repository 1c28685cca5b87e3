"""A car that nobody looks at says little; a lease wakes it, and it sleeps again when the lease ends."""

from __future__ import annotations

from typing import Any

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import LIVE_BROKER_EVERY_S, LIVE_MAX_RATE_HZ
from iort_station.page.answers import actions
from iort_station.page.server import PageServer
from testkit.waiting import until
from tests.local.data.drives import Agent


def test_a_page_wakes_its_car_and_one_that_is_cut_off_lets_it_sleep(embedded, bundle, open_page):
    car = bundle(sources=[{"type": "sim", "stream": VESC_STREAM, "rate_hz": 50, "pose": {"rate_hz": 0}}])

    def lane() -> dict[str, Any]:
        found: dict[str, Any] = agent.told()["lanes"]["live"]
        return found

    told = {"namespace": embedded.namespace, **embedded.keys.reading()}
    with PageServer(**told, open_actions=actions(embedded.cloud)) as server, Agent(car) as agent:
        until(agent.status)
        assert lane()["viewers"] == 0
        page = open_page(f"{server.url}#/car/{car.robot}")
        until(lambda: lane()["viewers"] == 1)
        assert lane()["asked_hz"] == LIVE_MAX_RATE_HZ
        page.context.set_offline(True)
        until(lambda: lane()["viewers"] == 0)
        assert lane()["asked_hz"] == 1 / LIVE_BROKER_EVERY_S
