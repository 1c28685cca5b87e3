"""A car that nobody looks at says little; a lease wakes it, and it sleeps again when the lease ends."""

from __future__ import annotations

from typing import Any

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import LIVE_BROKER_EVERY_S, LIVE_MAX_RATE_HZ
from iort_station.fleet.viewing import Viewer
from iort_station.page.answers.index import actions
from iort_station.page.live.listener import Listener
from iort_station.page.server import PageServer
from tests.local.conftest import until
from tests.local.data.drives import Agent

_FULL_MS, _IDLE_MS = 100, 10_000


def test_a_lease_wakes_a_car_and_its_end_lets_it_sleep(embedded, bundle):
    car = bundle(sources=[{"type": "sim", "stream": VESC_STREAM, "rate_hz": 50, "pose": {"rate_hz": 0}}])
    heard: list[dict[str, Any]] = []

    def periods() -> list[int]:
        return [update["next_ms"] for update in list(heard)]

    def take(update: dict[str, Any], *_: int) -> None:
        # One that a later message has overtaken in the cloud is skipped, as on the page.
        if not heard or update["seq"] > heard[-1]["seq"]:
            heard.append(update)

    listener = Listener(
        robot=car.robot,
        namespace=embedded.namespace,
        on_update=take,
        **embedded.keys.reading(),
    )
    with listener:
        agent = Agent(car)
        try:
            until(heard.__len__)
            assert set(periods()) == {_IDLE_MS}
            with Viewer(embedded.cloud, [car.robot]):
                until(lambda: periods().count(_FULL_MS) >= 20)
            until(lambda: periods()[-1] == _IDLE_MS)
            count = len(heard)
            assert agent.told()["lanes"]["live"]["viewers"] == 0
            until(lambda: len(heard) > count)
            assert periods()[count:] == [_IDLE_MS]
        finally:
            agent.stop()
            agent.report()


def test_a_page_wakes_its_car_and_one_that_is_cut_off_lets_it_sleep(embedded, bundle, open_page):
    car = bundle(sources=[{"type": "sim", "stream": VESC_STREAM, "rate_hz": 50, "pose": {"rate_hz": 0}}])

    def lane() -> dict[str, Any]:
        found: dict[str, Any] = agent.told()["lanes"]["live"]
        return found

    told = {"namespace": embedded.namespace, **embedded.keys.reading()}
    with PageServer(**told, open_actions=actions(embedded.cloud)) as server:
        agent = Agent(car)
        try:
            until(agent.status)
            assert lane()["viewers"] == 0
            page = open_page(f"{server.url}#/car/{car.robot}")
            until(lambda: lane()["viewers"] == 1)
            assert lane()["asked_hz"] == LIVE_MAX_RATE_HZ
            page.context.set_offline(True)
            until(lambda: lane()["viewers"] == 0)
            assert lane()["asked_hz"] == 1 / LIVE_BROKER_EVERY_S
        finally:
            agent.stop()
            agent.report()
