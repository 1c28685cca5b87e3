"""Two people, two pages and one car: only one drives, the other sees who, and may take over."""

from __future__ import annotations

import secrets
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import pytest
from playwright.sync_api import TimeoutError  # noqa: A004 - as playwright names it

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.commands import Command, encode_command
from iort_contract.topics import CMD, build_topic
from iort_station.page import answers as control
from iort_station.page import motion
from iort_station.page.answers import actions, answers
from iort_station.page.server import PageServer
from testkit.car import AgentProcess
from testkit.waiting import until

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from playwright.sync_api import Locator, Page

    from iort_station.cloud import Cloud
    from iort_station.fleet.robots import Bundle
    from local.cloud import EmbeddedCloud

LEASE_S = 10.0
DRIVE = {
    "topic": "/drive",
    "type": "ackermann_msgs/AckermannDriveStamped",
    "partial": True,
    "max_age_s": LEASE_S,
    "motion": {"lease_s": LEASE_S, "stop": {"drive": {"speed": 0.0}}},
}


class Ada:
    """Drives with long leases, which do not end by themselves on a slow machine as those of a page do."""

    def __init__(self, cloud: Cloud, robot: str) -> None:
        self._data = cloud.client("iot-data")
        self._topic = build_topic(CMD, robot, "drive", cloud.namespace)

    def drive(self, *, takeover: bool = False) -> None:
        now_us = time.time_ns() // 1000
        command = Command(
            session=secrets.token_hex(8),
            started_us=now_us,
            seq=0,
            sent_us=now_us,
            valid_ms=round(LEASE_S * 1000),
            lease_ms=round(LEASE_S * 1000),
            message={"drive": {"speed": 0.5}},
            by="ada",
            takeover=takeover,
        )
        self._data.publish(topic=self._topic, qos=1, payload=encode_command(command))


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
        page.locator(".drive[data-phase=free], .drive[data-phase=holding]").wait_for()
        page.keyboard.down("Space")
        page.locator(".drive[data-phase=driving], .drive[data-phase=over]").wait_for()
        return page.locator(".drive-said").inner_text()

    found: list[str] = []
    until(
        lambda: found.append(tried()) or any(one in found[-1] for one in ("Driving.", *reasons)),
        "the car to be driven, or refused",
    )
    return found[-1]


def moves(page: Page) -> bool:
    """Whether the page drives the car, or begins to."""
    return page.locator(".drive[data-phase=starting], .drive[data-phase=driving]").count() > 0


def seen(page: Page, text: str) -> bool:
    """Whether a page shows a text soon."""
    return shows(page.get_by_text(text).first)


def shows(place: Locator) -> bool:
    """Whether it is there soon."""
    try:
        place.wait_for(timeout=2000)
    except TimeoutError:
        return False
    return True


def test_one_drives_the_other_sees_it_and_takes_over(
    embedded: EmbeddedCloud, car: Bundle, open_page: Callable[..., Page]
) -> None:
    cloud, ada = embedded.cloud, Ada(embedded.cloud, car.robot)
    told: dict[str, Any] = {"answers": answers(cloud), "open_actions": actions(cloud)}
    with PageServer(
        namespace=cloud.namespace,
        **motion.reaching(cloud, "iot"),
        **told,
        actions=control.keyed_actions(cloud),
    ) as server:
        bob = open_page(server.invitation(f"#/car/{car.robot}"))
        onlooker = open_page(f"{server.url}#/")
        bob.fill("[name=driver]", "bob")
        bob.get_by_role("button", name="Take the wheel").click()
        # The car's own limit, whatever the viewer would like.
        assert bob.get_attribute("[name=top]", "max") == "1.5"

        def onlooker_sees() -> bool:
            ada.drive()
            return seen(onlooker, "ada drives")

        until(onlooker_sees, "the onlooker to see who drives")
        assert onlooker.get_by_role("button", name="Take the wheel").count() == 0

        def bob_is_refused() -> bool:
            ada.drive(takeover=True)
            return "Ada drives this car" in hold(bob, "Ada drives this car")

        until(bob_is_refused, "the second driver to be refused")
        bob.keyboard.up("Space")

        def bob_takes_over() -> bool:
            """The buttons are there while the other one drives."""
            ada.drive(takeover=True)
            with suppress(TimeoutError):
                bob.get_by_role("button", name="Take over from ada").click(timeout=8000)
                bob.get_by_role("button", name="Really take over?").click(timeout=8000)
                return True
            return False

        until(bob_takes_over, "the takeover to be confirmed")
        assert hold(bob) == "Driving."
        # The one who loses the wheel learns it.

        def bob_loses() -> bool:
            # On a slow machine a command may come too late.
            ada.drive(takeover=True)
            return shows(bob.locator(".drive[data-phase=over]"))

        until(bob_loses, "the end of the hold")
        until(lambda: hold(bob) == "Driving.", "the lease of the other driver to end")
        # An emergency stop ends it, and the stick that is still held moves nothing after the release.
        bob.get_by_role("button", name=f"Stop {car.robot}").click()
        until(lambda: not moves(bob), "the end of the hold")
        until(lambda: "stands." in bob.inner_text(".stop-words"), "the car's confirmation")
        bob.get_by_role("button", name="Release").click()
        bob.get_by_role("button", name="Really release").click()
        until(lambda: not bob.locator(".stop-strip").is_visible(), "the release")
        assert not moves(bob)
