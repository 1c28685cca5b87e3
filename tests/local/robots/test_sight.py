"""Driving by sight, from the picture of a simulated car to what `iort sight` proves of it, on the embedded
cloud."""

from __future__ import annotations

import json
import queue
import secrets
import time
from typing import TYPE_CHECKING, Any

from PIL import Image

from iort_agent.video import first_number
from iort_contract.cloud import DRIVER
from iort_contract.counter import read_counter
from iort_contract.limits import LIVE_MAX_RATE_HZ
from iort_contract.messages.commands import DRIVE_RATE_HZ, encode_command
from iort_contract.messages.live import VIEW_LEASE_MS, Lease, decode_live, encode_lease, lease_topic
from iort_contract.messages.shadow import decode_reported
from iort_contract.messages.video import (
    PICTURES,
    Look,
    decode_picture,
    encode_look,
    look_topic,
    picture_topic,
)
from iort_contract.topics import CMD, LIVE, build_topic, parse_topic
from iort_station import data
from iort_station.fleet import stopping
from iort_station.fleet.broker import Broker
from iort_station.fleet.driving import Driver, Phase, Stick
from iort_station.fleet.roles import Role
from iort_station.fleet.seat import monotonic_us
from local.demo import DOWNLINK
from testkit.waiting import until
from tests.local.data.drives import Agent
from tests.local.robots.test_shadow import Shadow

if TYPE_CHECKING:
    from iort_station.cloud import Cloud

# A slow machine is late, too.
MAX_AGE_MS = 2_000
VIDEO = {"source": {"type": "sim"}, "width": 320, "height": 240, "max_age_ms": MAX_AGE_MS, "pictures_hz": 5}


class Eyes:
    """Drives by the pictures that come over the broker, as a page without WebRTC does."""

    def __init__(self, cloud: Cloud, robot: str) -> None:
        motion = stopping.motion(cloud, [robot])[robot]
        assert motion.drive is not None
        assert motion.video is not None
        self.driver = Driver(motion.drive, "ada", 0.5, picture_us=motion.video.max_age_ms * 1000)
        self.driver.stick = Stick(1.0, 0.0)
        self.looks, self.seen = True, 0
        self._names = robot, cloud.namespace
        self._heard: queue.SimpleQueue[tuple[str, bytes]] = queue.SimpleQueue()
        self._viewer, self._asked_s = secrets.token_hex(8), -1e9
        self.sent = 0
        filters = [f"{LIVE}/{cloud.namespace}/{robot}/+", picture_topic(*self._names)]
        self.broker = Broker(
            cloud, Role(cloud, DRIVER), filters=filters, on_message=lambda *one: self._heard.put(one)
        )

    def tick(self) -> None:
        robot, namespace = self._names
        if time.monotonic() - self._asked_s > 1:
            self._asked_s = time.monotonic()
            lease = Lease(self._viewer, LIVE_MAX_RATE_HZ, VIEW_LEASE_MS, broker=True)
            self.broker.publish(lease_topic(robot, namespace), encode_lease(lease))
            look = Look(self._viewer, secrets.token_hex(8), PICTURES)
            self.broker.publish(look_topic(robot, namespace), encode_look(look))
        while not self._heard.empty():
            topic, message = self._heard.get()
            now_us = monotonic_us()
            if topic != picture_topic(robot, namespace):
                self.driver.hear(parse_topic(topic).name, decode_live(message), now_us)
            elif self.looks:
                picture = decode_picture(message)
                self.seen += 1
                # One computer has one clock.
                self.driver.see(picture.number, time.time_ns() // 1000 - picture.captured_us, now_us)
        if (command := self.driver.tick(monotonic_us())) is not None:
            topic = build_topic(CMD, robot, self.driver.limits.command, namespace)
            self.broker.publish(topic, encode_command(command))
            self.sent += self.driver.phase is Phase.DRIVING

    def until(self, done: Any, what: str) -> None:
        """Drive on until that is so."""
        until(lambda: (self.tick(), done())[1], what, poll_s=1 / DRIVE_RATE_HZ)


def test_what_a_driver_saw_is_told_of_each_command_and_kept_in_an_incident(embedded, bundle, iort, tmp_path):
    car = bundle(sources=[{"type": "sim", "rate_hz": 50}], downlink=DOWNLINK, recorder={}, video=VIDEO)
    cloud, robot, shadow = embedded.cloud, car.robot, Shadow(embedded, car.robot)
    forwards = ("send", robot, "drive", '{"drive": {"speed": 0.5}}', "--lease-ms", "1000")
    with Agent(car):
        until(lambda: decode_reported(shadow.reported()).video)
        assert "takes no motion without its picture; nothing is sent" in str(iort(*forwards).exception)
        until(lambda: "has accepted drive" in iort(*forwards, "--blind").output)
        eyes = Eyes(cloud, robot)
        with eyes.broker:
            eyes.until(lambda: eyes.seen, "a picture")
            eyes.until(lambda: eyes.driver.age_us(monotonic_us()) is not None, "a sample")

            def drives() -> bool:
                if eyes.driver.phase in (Phase.FREE, Phase.OVER):
                    # A slow machine may be late at first.
                    for held in (False, True):
                        eyes.driver.hold(held=held, now_us=monotonic_us())
                return eyes.driver.phase is Phase.DRIVING

            eyes.until(drives, "the car to be driven by its picture")
            count, sent = eyes.seen + 10, eyes.sent + 40
            eyes.until(lambda: drives() and eyes.seen > count and eyes.sent > sent, "some more pictures")
            # They freeze.
            eyes.looks = False
            eyes.until(lambda: not drives() and "the picture is" in eyes.driver.reason, "the end of the hold")
            for _ in range(3):
                eyes.tick()
        assert iort("recorder", "take", robot, "--last", "10m", "--why", "seen").exit_code == 0
    until(lambda: len(data.query(cloud, robot, "video", "-1h", "now")))
    folder = tmp_path / "seen"
    done = iort("sight", robot, "--last", "1h", "--pictures", str(folder), "--json")
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    by_sight = [one for one in told["commands"] if one["by"] == "ada" and one["outcome"] == "accepted"]
    assert len(by_sight) > 20
    assert not any(one["blind"] for one in by_sight)
    for one in by_sight:
        if not one["ends"]:
            assert one["age_ms"] <= MAX_AGE_MS
            # By two clocks of the robot: the one that runs on, and the one that is set. On a busy machine the
            # sample is made some time after the command came.
            assert one["t_us"] - one["captured_us"] - one["age_ms"] * 1000 > -100_000
    assert told["summary"]["blind"] >= 1
    assert told["summary"]["not_recorded"] == 0
    files = list(folder.iterdir())
    assert files
    for file in files:
        with Image.open(file) as image:
            pixels = image.convert("L")
            assert read_counter(lambda x, y, of=pixels: of.getpixel((x, y)), *pixels.size) == int(file.stem)
    assert all(one["frame"] >= first_number(one["run"]) for one in by_sight)
    named = {one["frame"] for one in by_sight}
    assert named <= {int(file.stem) for file in files}, "the ring had each picture that was driven by"
