"""A driver's seat: one driver, one car and the broker between them, for keys and for other sticks."""

from __future__ import annotations

import queue
import secrets
import time

from iort_contract.cloud import DRIVER
from iort_contract.limits import LIVE_MAX_RATE_HZ, ContractError
from iort_contract.messages.commands import DRIVE_RATE_HZ, encode_command
from iort_contract.messages.live import (
    VIEW_LEASE_MS,
    VIEW_RENEW_S,
    Lease,
    decode_live,
    encode_lease,
    lease_topic,
)
from iort_contract.topics import CMD, LIVE, build_topic, parse_topic
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry, stopping
from iort_station.fleet.broker import Broker
from iort_station.fleet.control import check_blind, operator
from iort_station.fleet.driving import Driver, Stick
from iort_station.fleet.roles import Role

TICK_US = round(1e6 / DRIVE_RATE_HZ)


def monotonic_us() -> int:
    """The time of the monotonic clock."""
    return time.monotonic_ns() // 1000


def driver_of(cloud: Cloud, robot: str, *, by: str | None, top_mps: float, blind: bool) -> Driver:
    """A driver of a robot that a stick can drive: ``by`` or else this computer's user.

    Raises `StationError` for a robot that cannot be driven or that is stopped, and `UsageError` for one with
    video, whose picture nobody sees here, unless it is driven ``blind``.
    """
    registry.get(cloud, robot)
    found = stopping.motion(cloud, [robot])[robot]
    if found.drive is None:
        raise StationError(
            f"{robot} cannot be driven: its car.yaml has no downlink.drive, or it has not run since"
        )
    if found.asked:
        raise StationError(f"{robot} is stopped: `iort stop {robot} --release` lets it move again")
    if not blind:
        check_blind(robot, found.video)
    return Driver(
        found.drive,
        by or operator(),
        min(top_mps, found.drive.max_speed_mps),
        picture_us=None if found.video is None else found.video.max_age_ms * 1000,
        blind=blind,
    )


class Seat:
    """Drives within a ``with`` block of its ``broker``. Whoever has it calls `tick` `DRIVE_RATE_HZ` times a
    second, and `leave` at the end."""

    def __init__(self, cloud: Cloud, robot: str, driver: Driver) -> None:
        self.driver = driver
        self._robot, self._namespace = robot, cloud.namespace
        self._heard: queue.SimpleQueue[tuple[str, bytes, int]] = queue.SimpleQueue()
        self._topic = build_topic(CMD, robot, driver.limits.command, cloud.namespace)
        self._lease = encode_lease(Lease(secrets.token_hex(8), LIVE_MAX_RATE_HZ, VIEW_LEASE_MS, broker=True))
        self._viewed_us = -int(VIEW_RENEW_S * 1e6)
        self.broker = Broker(
            cloud,
            Role(cloud, DRIVER),
            filters=[f"{LIVE}/{cloud.namespace}/{robot}/+"],
            on_message=lambda topic, message: self._heard.put((topic, message, monotonic_us())),
        )

    def tick(self, *, held: bool, stick: Stick, now_us: int) -> None:
        """Take what was heard of the car, and send the command that is due."""
        while not self._heard.empty():
            self._take(*self._heard.get())
        if now_us - self._viewed_us >= VIEW_RENEW_S * 1e6:
            self._viewed_us = now_us
            self.broker.publish(lease_topic(self._robot, self._namespace), self._lease)
        driver = self.driver
        driver.hold(held=held, now_us=now_us)
        driver.stick = stick
        command = driver.tick(now_us)
        if command is not None:
            self.broker.publish(self._topic, encode_command(command))

    def leave(self) -> None:
        """Have the car stop, and let others drive."""
        self.driver.leave()
        while (command := self.driver.tick(monotonic_us())) is not None:
            self.broker.publish(self._topic, encode_command(command))
            time.sleep(TICK_US / 1e6)

    def _take(self, topic: str, message: bytes, heard_us: int) -> None:
        try:
            self.driver.hear(parse_topic(topic).name, decode_live(message), heard_us)
        except ContractError:
            return  # the rules quarantine it
