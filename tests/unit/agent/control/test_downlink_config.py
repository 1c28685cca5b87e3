"""Errors in the sections `downlink` and `share` name file and key at the start."""

from __future__ import annotations

from typing import Any

import pytest

from iort_agent.errors import ConfigError, SourceError
from tests.unit.agent.control.downlink_rig import CONFIG, Rig


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"motion": {"stop": {"speed": 0}}}, "stop: speed: std_msgs/Float64 has no such field"),
        ({"motion": {"stop": 0}}, r"cmd\.speed\.motion\.stop: must be a mapping .* got 0"),
        ({"motion": {}}, r"motion\.stop: required"),
        ({"motion": {"stop": {}, "lease_s": 60}}, "lease_s: must be .* got 60"),
        ({"topic": "speed"}, r"cmd\.speed\.topic: ROS topic must be .*, got 'speed'"),
        ({"type": "Float64"}, "must be package/Type"),
        ({"partial": 1}, "partial: must be true or false, got 1"),
    ],
)
def test_a_wrong_configuration(change: Any, error: str) -> None:
    with pytest.raises(ConfigError, match=error):
        Rig(cmd={"speed": {**CONFIG["cmd"]["speed"], **change}})


@pytest.mark.parametrize(
    ("config", "error"),
    [
        ({"cmd": {"a/b": CONFIG["cmd"]["say"]}}, "got 'a/b'"),
        ({"fleet": {"pose": {"topic": "/pose", "type": "a/B"}}}, "{robot} in it"),
        ({"fleet": {"pose": {"topic": "/{robot}/{robot}", "type": "a/B"}}}, "{robot} in it"),
        ({"share": {"pose": {"name": "pose"}}}, "ROS topic must be .*, got 'pose'"),
        ({"share": {"/a": {"name": "pose"}, "/b": {"name": "pose"}}}, "shared as pose already"),
    ],
)
def test_wrong_names(config: Any, error: str) -> None:
    with pytest.raises(ConfigError, match=error):
        Rig(**config)


def test_a_type_that_is_not_installed() -> None:
    with pytest.raises(SourceError, match="a_msgs/A is not installed"):
        Rig(cmd={"say": {"topic": "/say", "type": "a_msgs/A"}})
