"""The page over AWS IoT's WebSocket, with enforcement on: no third party, and no function."""

from __future__ import annotations

import math
import time
from dataclasses import replace

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import LIVE_MAX_RATE_HZ
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.topics import LIVE, build_topic
from iort_station.page import motion
from iort_station.page.answers import actions, answers
from iort_station.page.server import PageServer
from testkit.car import AgentProcess
from testkit.proxy import PASS, REFUSE, Proxy
from testkit.waiting import until
from tests.browser import plain, show, shown

SAMPLE = {"voltage_input": 11.65, "speed": 4000, "duty_cycle": 0.1, "temp_motor": -300.0}


class Car:
    """Sends live messages as an agent does, straight to the broker."""

    def __init__(self, cloud, name):
        self.cloud, self.name, self.seq = cloud, name, 0

    def send(self, sample=SAMPLE):
        now_us = time.time_ns() // 1000
        live = LiveSample("0a1b2c3d", self.seq, now_us - 3_000, now_us - 1_000, sample, offset_us=0)
        topic = build_topic(LIVE, self.name, VESC_STREAM, self.cloud.namespace)
        self.cloud.client("iot-data").publish(topic=topic, qos=0, payload=encode_live(live))
        self.seq += 1
        return {"robot": self.name, "stream": VESC_STREAM, "seq": live.seq}


def served(cloud):
    return PageServer(
        namespace=cloud.namespace,
        **motion.reaching(cloud, "iot"),
        answers=answers(cloud),
        open_actions=actions(cloud),
    )


def test_the_page_wakes_a_car_over_its_own_connection_and_lets_it_sleep(embedded, bundle, open_page):
    source = {"type": "sim", "stream": VESC_STREAM, "rate_hz": 50}
    car = bundle(sources=[source], live={"when": "watched"})
    count = f"iort.robots['{car.robot}']?.streams.{VESC_STREAM}?.received ?? 0"
    with served(embedded.cloud) as server, AgentProcess(car, drain_s=0):
        page = open_page(f"{server.url}#/alarms")
        until(lambda: page.evaluate(count), "the first message, which a car sends of itself")
        until(lambda: page.evaluate(f"iort.robots['{car.robot}'].state") == "idle", "the car to be idle")
        before, began = page.evaluate(count), time.monotonic()
        page.goto(f"{server.url}#/car/{car.robot}")
        # Idle, it would send so many in minutes.
        until(
            lambda: page.evaluate(count) >= before + 2 * LIVE_MAX_RATE_HZ, "two seconds at the full rate", 100
        )
        assert time.monotonic() - began > 1
        until(lambda: page.get_attribute("#car", "data-state") == "live", "the car to be live")
        assert "live over AWS IoT" in page.inner_text(".foot")
        assert page.locator("[data-value=leg_toLambda]").count() == 0
        # Below zero while the car knows its clock's offset only roughly.
        assert math.isfinite(float(plain(page.inner_text("[data-value=leg_toPage]"))))
        page.goto(f"{server.url}#/alarms")
        until(lambda: page.evaluate(f"iort.robots['{car.robot}'].state") == "idle", "the car to sleep again")


def test_a_slow_connection_that_drops_is_opened_anew(embedded, open_page):
    relay = int(embedded.cloud.websocket_url.split(":")[2].partition("/")[0])
    with Proxy("127.0.0.1", relay, latency_s=0.2) as proxy:
        cloud = replace(embedded.cloud, websocket=f"ws://127.0.0.1:{proxy.port}/mqtt")
        with served(cloud) as server:
            page, car = open_page(f"{server.url}#/car/far"), Car(embedded.cloud, "far")
            show(page, car.send())
            # A sensor that is not fitted, which Lambda 1 would have taken out.
            known = {**SAMPLE, "temp_motor": None}
            assert page.evaluate(f"iort.robots.far.streams.{VESC_STREAM}.sample") == known
            assert page.evaluate("iort.robots.far.delay_ms.newest.total") >= 200
            attempts = len(proxy.attempts)
            proxy.mode = REFUSE
            until(lambda: page.inner_text("#link") == "Connection lost", "the page to notice")
            proxy.mode = PASS
            until(lambda: "Connected again" in page.inner_text("#banner"), "the page to connect again")
            assert len(proxy.attempts) > attempts
            show(page, car.send({**SAMPLE, "voltage_input": 12.5}))
            assert shown(page, "voltage_input") == "12.50"


def test_a_site_without_a_server_listens_as_everybody_and_wakes_nobody(embedded, open_page):
    with PageServer(
        namespace=embedded.namespace,
        live="iot",
        broker=embedded.cloud.websocket_url.removesuffix("/mqtt"),
        identity=motion.identity(embedded.cloud),
    ) as site:
        page = open_page(f"{site.url}#/car/public")
        show(page, Car(embedded.cloud, "public").send())
        assert "cannot wake cars" in page.inner_text(".foot")
        # Its identity would be cut off for a lease.
        page.goto(f"{site.url}#/")
        show(page, Car(embedded.cloud, "another").send())
        assert page.inner_text("#link") == "Connected"
