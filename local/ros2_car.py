"""A simulated car as a robot in a ROS 2 graph, for `make demo ROS2=1`: python -m local.ros2_car --duration 20

It publishes what a car's drivers do: /odom, and /sensors/core where the package vesc_msgs is installed. It
obeys /cmd_vel, and /drive where ackermann_msgs is installed, as a car does behind its multiplexer: until the
driver stops it and is silent. Otherwise it drives laps. Its last line is what it has published, by topic.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import os
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from iort_agent.common.schema import Place, load
from iort_agent.common.threads import SystemClock
from iort_agent.sources.sim import ALL, SimConfig, SimGraph
from iort_agent.sources.sim.driver import Wish
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.commands import ROS2_DRIVE_TYPE, stick_downlink
from local.deployment import ROOT
from local.processes import LocalError

CORE, ODOMETRY, DRIVE, TWIST = "/sensors/core", "/odom", "/drive", "/cmd_vel"
# The optional packages, and what the demo does with them.
VESC, ACKERMANN = "vesc_msgs", "ackermann_msgs"
_ODOM = "odom"
# A multiplexer forgets a driver that has stopped the car and is silent.
_FORGOTTEN_S = 0.5
# Both ends of a connection are not there at the same moment.
_CONNECT_S = 1.0
_QUEUE = 1000
# ROS 2's driver gives charge and energy in Ah and Wh.
_TEN_THOUSANDTHS = ("charge_drawn", "charge_regen", "energy_drawn", "energy_regen")


class Ros2(NamedTuple):
    """The ROS 2 that is sourced: its environment, and which of the optional packages it has."""

    environment: dict[str, str]
    packages: list[str]

    @property
    def stream(self) -> str:
        """The car's first stream."""
        return VESC_STREAM if VESC in self.packages else _ODOM

    def source(self) -> dict[str, Any]:
        """The source of the car.yaml: everything that the car publishes."""
        topics = {CORE: VESC_STREAM, ODOMETRY: _ODOM} if VESC in self.packages else {ODOMETRY: _ODOM}
        return {
            "type": "ros2",
            "topics": {topic: {"stream": stream, "time": "header"} for topic, stream in topics.items()},
        }

    def downlink(self, lease_ms: int) -> dict[str, Any]:
        """The section `downlink` of the car.yaml."""
        downlink = stick_downlink(lease_ms)
        command = downlink["cmd"]["drive"]
        if ACKERMANN in self.packages:
            command["type"] = ROS2_DRIVE_TYPE
            return downlink
        command |= {"topic": TWIST, "type": "geometry_msgs/msg/Twist"}
        command["motion"]["stop"] = {"linear": {"x": 0.0}}
        downlink["drive"] |= {"speed": "linear.x", "steering": "angular.z"}
        return downlink


def find() -> Ros2:
    """The ROS 2 that is sourced. Raises `LocalError`."""
    names = ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH")
    parts = ("ROS_", "RMW_", "AMENT_", "FASTRTPS_", "FASTDDS_", "CYCLONEDDS_", "ZENOH_")
    environment = {name: v for name, v in os.environ.items() if name in names or name.startswith(parts)}
    if "ROS_DOMAIN_ID" not in environment:
        # As all of the demo, for this machine only. Humble knows the first, the others the second.
        name, value = ("ROS_LOCALHOST_ONLY", "1")
        if environment.get("ROS_DISTRO") != "humble":
            name, value = "ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"
        environment.setdefault(name, value)
    look = subprocess.run(  # noqa: S603 - our own module
        [sys.executable, "-m", __spec__.name, "--look"],
        env=environment,
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if look.returncode:
        version = ".".join(map(str, sys.version_info[:2]))
        scripts = sorted(str(path) for path in Path("/opt/ros").glob("*/setup.bash"))
        script = scripts[-1] if scripts else "/opt/ros/jazzy/setup.bash"
        why = (look.stderr.splitlines() or ["no reason"])[-1]
        raise LocalError(
            f"ROS2=1 needs a ROS 2 of this Python, {version}: `source {script}`, then `make demo ROS2=1`. If "
            "that one is of another Python: `make clean`, then `make demo ROS2=1 PYTHON=/usr/bin/python3` "
            f"({why})"
        )
    return Ros2(environment, json.loads(look.stdout))


def published(log: Path) -> int:
    """How many messages a car has published, by the last line of its log."""
    counts: dict[str, int] = json.loads(log.read_text().splitlines()[-1])
    return sum(counts.values())


def message(kind: str) -> Any:
    """The class of a message, such as ``nav_msgs.Odometry``; None without its package."""
    package, name = kind.split(".")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except ImportError:
        return None


class Car:
    """The node of the car."""

    def __init__(self, graph: SimGraph, wheelbase_m: float, speed_to_erpm_gain: float) -> None:
        self.node = importlib.import_module("rclpy").create_node("car")
        self._graph, self._wheelbase_m, self._gain = graph, wheelbase_m, speed_to_erpm_gain
        self._clock = SystemClock()
        self._speed_mps = 0.0
        self._stopped: dict[str, float] = {}
        self.sent: Counter[str] = Counter()
        kinds = {CORE: message(f"{VESC}.VescStateStamped"), ODOMETRY: message("nav_msgs.Odometry")}
        self.publishers = {
            topic: self.node.create_publisher(kind, topic, _QUEUE)
            for topic, kind in kinds.items()
            if kind is not None
        }
        self._kinds = kinds
        if (drive := message(f"{ACKERMANN}.AckermannDriveStamped")) is not None:
            self.node.create_subscription(drive, DRIVE, self._on_drive, _QUEUE)
        self.node.create_subscription(message("geometry_msgs.Twist"), TWIST, self._on_twist, _QUEUE)
        self.node.create_timer(_FORGOTTEN_S / 5, self._forget)

    def emit(self, stream: str, t_us: int, values: Mapping[str, Any], *, more: bool = False) -> float:  # noqa: ARG002 - as a source calls it
        """Publish a sample of the simulated car."""
        topic = CORE if stream == VESC_STREAM else ODOMETRY
        if topic == CORE:
            self._speed_mps = float(values["speed"] or 0) / self._gain
        if topic not in self.publishers:
            return 0.0
        sent = self._kinds[topic]()
        sent.header.stamp.sec, microseconds = divmod(t_us, 1_000_000)
        sent.header.stamp.nanosec = microseconds * 1000
        if topic == CORE:
            for name, value in values.items():
                if hasattr(sent.state, name):
                    # rclpy takes no float for an integer.
                    number = type(getattr(sent.state, name))
                    setattr(sent.state, name, number(value / 1e4 if name in _TEN_THOUSANDTHS else value))
        else:
            sent.header.frame_id, sent.child_frame_id = "map", "base_link"
            sent.pose.pose.position.x, sent.pose.pose.position.y = values["x"], values["y"]
            sent.pose.pose.orientation.z = math.sin(values["heading"] / 2)
            sent.pose.pose.orientation.w = math.cos(values["heading"] / 2)
            sent.twist.twist.linear.x = self._speed_mps
        self.publishers[topic].publish(sent)
        self.sent[topic] += 1
        return 0.0

    def _on_drive(self, sent: Any) -> None:
        self._obey(DRIVE, Wish(sent.drive.speed, sent.drive.steering_angle))

    def _on_twist(self, sent: Any) -> None:
        speed = sent.linear.x
        turn = math.atan(self._wheelbase_m * sent.angular.z / speed) if speed else 0.0
        self._obey(TWIST, Wish(speed, turn))

    def _obey(self, topic: str, wish: Wish) -> None:
        self._graph.drive(topic, wish)
        self._stopped.pop(topic, None)
        if not wish.speed_mps:
            self._stopped[topic] = self._clock.monotonic()

    def _forget(self) -> None:
        for topic, at in list(self._stopped.items()):
            if self._clock.monotonic() - at > _FORGOTTEN_S:
                del self._stopped[topic]
                self._graph.release(topic)


def main() -> None:
    """Drive once everything that is published is heard."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--settings", default="{}", help="of a source `sim`, as JSON")
    parser.add_argument("--look", action="store_true", help="print the optional packages that are installed")
    given = parser.parse_args()
    rclpy = importlib.import_module("rclpy")
    if given.look:
        kinds = {VESC: "VescStateStamped", ACKERMANN: "AckermannDriveStamped"}
        found = [package for package, name in kinds.items() if message(f"{package}.{name}") is not None]
        sys.stdout.write(json.dumps(found) + "\n")
        return
    settings = {"stream": VESC_STREAM, "fields": ALL, **json.loads(given.settings)}
    config = load(SimConfig, settings, Place(Path("settings")))
    source = config.build(SystemClock())
    signals = importlib.import_module("rclpy.signals").SignalHandlerOptions
    rclpy.init(args=[], signal_handler_options=signals.NO)
    car = Car(source.graph, config.vehicle.wheelbase_m, config.vehicle.speed_to_erpm_gain)
    spinning = threading.Thread(target=rclpy.spin, args=(car.node,), daemon=True)
    spinning.start()
    wait = threading.Event().wait
    while not all(publisher.get_subscription_count() for publisher in car.publishers.values()):
        wait(0.05)  # rclpy has no event for it
    wait(_CONNECT_S)
    source.run(car.emit, threading.Event())
    wait(_CONNECT_S)
    sys.stdout.write(json.dumps(car.sent) + "\n")
    sys.stdout.flush()
    rclpy.shutdown()
    spinning.join()


if __name__ == "__main__":
    main()
