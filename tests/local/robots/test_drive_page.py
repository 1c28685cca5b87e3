"""Two people, two pages and one car: only one drives, the other sees who, and may take over."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from playwright.sync_api import TimeoutError  # noqa: A004 - as playwright names it

from bench.load.agent_process import AgentProcess
from iort_contract.catalog.vesc import VESC_STREAM
from iort_station.page import control, socket
from iort_station.page.answers import actions, answers
from iort_station.page.server import PageServer
from tests.browser import until

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from playwright.sync_api import Page

    from iort_station.fleet.robots import Bundle
    from local.cloud import EmbeddedCloud

DRIVE = {
    "topic": "/drive",
    "type": "ackermann_msgs/AckermannDriveStamped",
    "partial": True,
    "motion": {"lease_s": 0.5, "stop": {"drive": {"speed": 0.0}}},
}


@pytest.fixture
def car(bundle: Callable[..., Bundle]) -> Iterator[Bundle]:
    source = {"type": "sim", "stream": VESC_STREAM, "rate_hz": 50}
    driven = bundle(
        sources=[source],
        ping={"rate_hz": 5},
        downlink={"cmd": {"drive": DRIVE}, "drive": {"command": "drive", "max_speed_mps": 1.5}},
    )
    with AgentProcess(driven, drain_s=0):
        yield driven


def hold(page: Page, *reasons: str) -> str:
    """Hold Space until the car is driven, or refused for one of the reasons; try again on a slow machine."""

    def tried() -> str:
        page.keyboard.up("Space")
        page.locator(".drive[data-phase=free]").wait_for()
        page.keyboard.down("Space")
        page.locator(".drive[data-phase=driving], .drive[data-phase=over]").wait_for()
        return page.locator(".drive-said").inner_text()

    found: list[str] = []
    until(
        lambda: found.append(tried()) or any(one in found[-1] for one in ("Driving.", *reasons)),
        "the car to be driven, or refused",
    )
    return found[-1]


def seen(page: Page, text: str) -> bool:
    """Whether a page shows a text soon: a hold may end by itself on a slow machine."""
    try:
        page.get_by_text(text).first.wait_for(timeout=2000)
    except TimeoutError:
        return False
    return True


def test_one_drives_the_other_sees_it_and_takes_over(
    embedded: EmbeddedCloud, car: Bundle, open_page: Callable[..., Page]
) -> None:
    cloud = embedded.cloud
    told: dict[str, Any] = {"answers": answers(cloud), "open_actions": actions(cloud)}
    with PageServer(
        namespace=cloud.namespace, **socket.reaching(cloud, "iot"), **told, actions=control.actions(cloud)
    ) as server:
        ada, bob = (open_page(server.invitation(f"#/car/{car.robot}")) for _ in range(2))
        onlooker = open_page(f"{server.url}#/")
        for page, name in ((ada, "ada"), (bob, "bob")):
            page.fill("[name=driver]", name)
            page.get_by_role("button", name="Take the wheel").click()
        # The car's own limit, whatever the viewer would like.
        assert ada.get_attribute("[name=top]", "max") == "1.5"
        ada.keyboard.down("ArrowUp")
        until(
            lambda: hold(ada) == "Driving." and seen(onlooker, "ada drives"), "the onlooker to see who drives"
        )
        assert onlooker.get_by_role("button", name="Take the wheel").count() == 0

        def bob_is_refused() -> bool:
            """Ada's hold may end by itself on a slow machine."""
            bob.keyboard.up("Space")
            return hold(ada) == "Driving." and "Ada drives this car" in hold(bob, "Ada drives this car")

        until(bob_is_refused, "the second driver to be refused")
        bob.keyboard.up("Space")
        bob.get_by_role("button", name="Take over from ada").click()
        bob.get_by_role("button", name="Really take over?").click()
        assert hold(bob) == "Driving."
        ada.locator(".drive[data-phase=over]").wait_for()
        # An emergency stop ends it, and the stick that is still held moves nothing after the release.
        ada.keyboard.up("Space")
        ada.keyboard.press("Escape")
        ada.get_by_role("button", name=f"Stop {car.robot}").click()
        bob.locator(".drive[data-phase=over]").wait_for()
        until(lambda: "stands." in ada.inner_text(".stop-words"), "the car's confirmation")
        ada.get_by_role("button", name="Release").click()
        ada.get_by_role("button", name="Really release").click()
        until(lambda: not ada.locator(".stop-strip").is_visible(), "the release")
        assert bob.locator(".drive[data-phase=over]").count() == 1
