"""What ROS adds to a command line: ROS 1's ``NAME:=VALUE``, and ROS 2's ``--ros-args ... --``.

The nodes read remappings and names from sys.argv by themselves, as every node does. Here they are only told
apart from the agent's own arguments, and the parameters that are meant for the agent are found.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Iterator, NamedTuple, Sequence

from iort_agent.common.schema import read_yaml

# The parameters that the agent has; the last one is every node's.
CONFIG, LOG_LEVEL, _SIM_TIME = "config", "log_level", "use_sim_time"
_BEGIN, _END = "--ros-args", "--"
_WITH_VALUE = (
    *("-p", "--param", "-r", "--remap", "--params-file", "--log-level"),
    *("--log-config-file", "--log-file-name", "-e", "--enclave"),
)
# These are not of one node alone.
_FOR_ALL = ("-r", "--remap", "-e", "--enclave")
# A name with one underscore is a parameter.
_REMAPPING = re.compile(r"(?:~|/|[A-Za-z]|__?)[\w/]*:=(?!.*:=).*", re.ASCII)
_PARAMETER = re.compile(r"_[^_]")
_NODE = re.compile(r"(?:__node|__name):=(.+)")
# ROS' names of the levels that the agent calls otherwise.
_LEVELS = {"warn": "warning", "fatal": "error"}


class Split(NamedTuple):
    """The agent's own arguments, its parameters, and the arguments that have no effect."""

    own: list[str]
    parameters: dict[str, str]
    ignored: list[str]


def is_remapping(argument: str) -> bool:
    """Whether ROS 1's roslaunch has added the argument."""
    return _REMAPPING.fullmatch(argument) is not None


def split(arguments: Sequence[str], node: str) -> Split:
    """Take ROS' arguments out of a command line. ``node`` is the agent's name, unless they change it.

    Raises `ConfigError` for a file of parameters that cannot be read.
    """
    own: list[str] = []
    options: list[tuple[str, str]] = []
    rest = iter(arguments)
    for argument in rest:
        if argument == _BEGIN:
            options += _ros2(rest)
        elif is_remapping(argument):
            options.append(("", argument))
        else:
            own.append(argument)
    for _, value in options:
        renamed = _NODE.search(value)
        node = renamed[1] if renamed else node
    parameters: dict[str, str] = {}
    ignored = [value for option, value in options if not option and _PARAMETER.match(value)]
    for option, value in options:
        if option == "--params-file":
            parameters.update(_in_file(Path(value), node))
        elif option in ("-p", "--param"):
            name, _, given = value.partition(":=")
            name = name.rpartition(":")[2]
            if name in (CONFIG, LOG_LEVEL):
                parameters[name] = given
            elif name != _SIM_TIME:
                ignored.append(value)
        elif option == "--log-level":
            level = value.rpartition(":=")[2].lower()
            parameters[LOG_LEVEL] = _LEVELS.get(level, level)
    return Split(own, parameters, ignored)


def for_another(arguments: Sequence[str], base: str) -> list[str]:
    """The arguments that give another node the remappings of the node ``base``, but not its name."""
    ros1: list[str] = []
    ros2: list[str] = []
    rest = iter(arguments)
    for argument in rest:
        if argument == _BEGIN:
            for option, value in _ros2(rest):
                # A rule may be for this node alone.
                rule = value[len(base) + 1 :] if value.startswith(f"{base}:") else value
                if option in _FOR_ALL and not _NODE.match(rule):
                    ros2 += [option, rule]
        elif is_remapping(argument) and not _NODE.match(argument):
            ros1.append(argument)
    return ros1 + ([_BEGIN, *ros2] if ros2 else [])


def _ros2(rest: Iterator[str]) -> Iterator[tuple[str, str]]:
    """The options of ROS 2 up to their end, with their values."""
    for argument in rest:
        if argument == _END:
            return
        yield argument, next(rest, "") if argument in _WITH_VALUE else ""


def _in_file(file: Path, node: str) -> Iterator[tuple[str, str]]:
    """The agent's parameters in a file of those of all nodes, which `ros2 launch` writes, too."""
    content = read_yaml(file)
    for name, section in content.items() if isinstance(content, dict) else ():
        values: Any = section.get("ros__parameters") if isinstance(section, dict) else None
        if str(name).rpartition("/")[2] in (node, "*", "**") and isinstance(values, dict):
            yield from ((key, str(values[key])) for key in (CONFIG, LOG_LEVEL) if values.get(key) is not None)
