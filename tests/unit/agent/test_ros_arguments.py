"""What ROS adds to the agent's command line."""

from __future__ import annotations

from pathlib import Path

import pytest

from iort_agent import cli
from iort_agent.errors import ConfigError
from iort_agent.ros.arguments import Split, for_another, split

ROS2 = ["--ros-args", "-r", "__node:=recorder", "-r", "/a:=/b", "-p", "config:=car.yaml", "--"]


def parsed(*arguments: str) -> tuple[str, str | None, list[str]]:
    options = cli._parse(list(arguments))
    return str(options.config), options.log_level, options.ignored


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--config", "c", "/a:=/b", "_rate:=5"], Split(["--config", "c"], {}, ["_rate:=5"])),
        ([*ROS2, "--drain-s", "1"], Split(["--drain-s", "1"], {"config": "car.yaml"}, [])),
        (["--ros-args", "--param", "iort_agent:config:=c"], Split([], {"config": "c"}, [])),
        (["--ros-args", "-p", "use_sim_time:=true", "-p", "r:=1"], Split([], {}, ["r:=1"])),
        (["--ros-args", "--log-level", "WARN"], Split([], {"log_level": "warning"}, [])),
        (["--ros-args", "--log-level", "iort_agent:=debug"], Split([], {"log_level": "debug"}, [])),
        (["--ros-args", "--disable-rosout-logs", "-p", "config:=c"], Split([], {"config": "c"}, [])),
        (["--ros-args", "-p"], Split([], {}, [""])),
    ],
)
def test_ros_arguments_are_taken_out(arguments: list[str], expected: Split) -> None:
    assert split(arguments, "iort_agent") == expected


@pytest.mark.parametrize(
    ("node", "found"),
    [
        ("/**", True),
        ("/*", True),
        ("iort_agent", True),
        ("/lab/iort_agent", True),
        ("other", False),
        ("/lab/recorder", False),
    ],
)
def test_a_file_of_parameters_is_read_for_the_own_node(tmp_path: Path, node: str, found: bool) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(f"{node}:\n  ros__parameters: {{config: car.yaml, other: 1, log_level: ''}}\n")
    _, parameters, ignored = split(["--ros-args", "--params-file", str(file)], "iort_agent")
    assert parameters == ({"config": "car.yaml", "log_level": ""} if found else {})
    assert ignored == []


def test_a_renamed_node_has_parameters_by_its_new_name(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text("/lab/recorder: {ros__parameters: {config: car.yaml}}\n")
    arguments = ["--ros-args", "--params-file", str(file), "-r", "__node:=recorder"]
    assert split(arguments, "iort_agent").parameters == {"config": "car.yaml"}


@pytest.mark.parametrize("text", [None, "{", "[1]", "5", "/**: 1", "/**: {ros__parameters: 1}"])
def test_a_file_of_other_parameters_has_none_and_one_that_cannot_be_read_is_an_error(
    tmp_path: Path, text: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "parameters.yaml"
    if text is not None:
        file.write_text(text)
    arguments = ["--ros-args", "--params-file", str(file)]
    if text in (None, "{"):
        with pytest.raises(ConfigError):
            split(arguments, "iort_agent")
        assert cli.main(arguments) == 2
        assert f"iort-agent: {file}: " in capsys.readouterr().err
    else:
        assert split(arguments, "iort_agent").parameters == {}


def test_the_agent_runs_with_the_configuration_of_its_parameters() -> None:
    assert parsed(*ROS2) == ("car.yaml", None, [])
    assert parsed("run", *ROS2[:-1], "-p", "log_level:=debug") == ("car.yaml", "debug", [])
    assert parsed("--config", "c", *ROS2) == ("c", None, [])
    # `ros2 launch` gives an empty text for what is not set.
    assert parsed(*ROS2[:-1], "-p", "log_level:=") == ("car.yaml", None, [])
    assert parsed("/a:=/b", "_rate:=5", "--config", "c") == ("c", None, ["_rate:=5"])


def test_another_node_has_the_remappings_and_not_the_name() -> None:
    given = ["run", "/a:=/b", "__name:=recorder", "--config", "c", "--ros-args", "-r", "__node:=recorder"]
    given += ["-r", "__ns:=/lab", "--remap", "recorder:/drive:=/cmd", "-r", "recorder:__node:=x"]
    given += ["-p", "config:=c", "-e", "/lab/agent", "--", "rest"]
    ros2 = ["--ros-args", "-r", "__ns:=/lab", "--remap", "/drive:=/cmd", "-e", "/lab/agent"]
    assert for_another(given, "recorder") == ["/a:=/b", *ros2]
    assert for_another(["--config", "c", "--ros-args", "-p", "config:=c"], "recorder") == []
