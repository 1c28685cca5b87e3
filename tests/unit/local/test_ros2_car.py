"""The car.yaml of a car in a ROS 2 graph, with and without the optional packages of messages."""

from __future__ import annotations

from pathlib import Path

import pytest

from iort_agent.common.schema import Place, load
from iort_agent.control.config import DownlinkConfig
from iort_agent.sources.ros2 import Ros2Config
from iort_contract.messages.commands import ROS2_DRIVE_TYPE
from local.ros2_car import ACKERMANN, VESC, Ros2, published

PLACE = Place(Path("car.yaml"))


@pytest.mark.parametrize(
    ("packages", "streams", "command"),
    [
        ([], ["odom"], ("/cmd_vel", "geometry_msgs/msg/Twist", "linear.x", "angular.z")),
        ([VESC], ["odom", "vesc"], ("/cmd_vel", "geometry_msgs/msg/Twist", "linear.x", "angular.z")),
        (
            [VESC, ACKERMANN],
            ["odom", "vesc"],
            ("/drive", ROS2_DRIVE_TYPE, "drive.speed", "drive.steering_angle"),
        ),
    ],
)
def test_the_car_is_recorded_and_driven_by_what_is_installed(
    packages: list[str], streams: list[str], command: tuple[str, ...]
) -> None:
    ros2 = Ros2({}, packages)
    settings = ros2.source()
    assert settings.pop("type") == "ros2"
    source = load(Ros2Config, settings, PLACE)
    assert source.streams() == streams
    assert ros2.stream == streams[-1]
    downlink = load(DownlinkConfig, ros2.downlink(5_000), PLACE)
    downlink.check_topics()
    assert downlink.graph([source]).version == 2
    limits = downlink.drive_limits()
    assert limits is not None
    ((_, drive),) = downlink.cmd
    assert (drive.topic, drive.type, limits.speed, limits.steering) == command


def test_what_the_car_has_published_is_the_last_line_of_its_log(tmp_path: Path) -> None:
    log = tmp_path / "car.log"
    log.write_text('[INFO] something\n{"/odom": 3, "/sensors/core": 4}\n')
    assert published(log) == 7
