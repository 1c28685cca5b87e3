"""The robots and listeners of the questions."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from iort_contract.topics import PING, PONG, RECORD, build_topic, record_topic
from iort_station.errors import StationError
from iort_station.fleet import robots
from iort_station.fleet.robots import Bundle
from iort_station.page.pubnub import Listener
from testkit.mqtt import Robot
from testkit.target import Target
from testkit.waiting import InstrumentError
from verify.question import CannotAskError
from verify.tools.spoofing import spoofed


def registered(target: Target, base: str) -> Bundle:
    """The robot of that name, registered on first use."""
    name = target.name(base)
    folder = target.folder / "robots" / name
    return Bundle(name, folder) if folder.exists() else target.robot(base)


@contextmanager
def removed_after(target: Target, base: str) -> Iterator[tuple[str, Path]]:
    """The name of a robot that a question registers, and its folder; the robot is removed at the end."""
    name = target.name(base)
    try:
        yield name, target.folder / "claims" / name
    finally:
        # It may not be registered yet, or be removed already.
        with suppress(StationError):
            robots.remove(target.cloud, name)


def listener(target: Target, robot: str) -> Listener:
    """A subscriber of the robot's channel. Raises `CannotAskError` if PubNub's keys are not stored."""
    try:
        return target.listener(robot)
    except StationError as error:
        raise CannotAskError(str(error)) from error


class Pair(NamedTuple):
    """The robot that attacks, connected, and its neighbour."""

    target: Target
    robot: Robot
    victim: str

    def send(self, lane: str, name: str, message: bytes) -> None:
        """Publish the message with every key of the cloud in the neighbour's name."""
        namespace = self.target.cloud.namespace
        topic = build_topic(lane, self.robot.name, name, namespace)
        if lane == RECORD:
            topic = record_topic(self.robot.name, name, namespace)
        self.publish(topic, spoofed(message, self.victim, lane, name, namespace))

    def publish(self, topic: str, payload: bytes) -> None:
        """Publish; raises `InstrumentError` if the broker refuses."""
        answer = self.robot.publish(topic, payload)
        if answer != "SUCCESS":
            raise InstrumentError(f"the broker answered {answer} on {topic}")

    def asked(self, name: str, message: bytes) -> dict[str, Any]:
        """The answer on the robot's own lane pong."""
        self.robot.subscribe(build_topic(PONG, self.robot.name, name, self.target.cloud.namespace))
        self.send(PING, name, message)
        answer: dict[str, Any] = json.loads(self.robot.next_message()[1])
        return answer


@contextmanager
def pair_of(target: Target, base: str) -> Iterator[Pair]:
    """A robot of that name, connected, and the shared neighbour."""
    victim, bundle = registered(target, "verify-victim").robot, registered(target, base)
    with Robot(bundle.folder) as robot:
        yield Pair(target, robot.online(), victim)
