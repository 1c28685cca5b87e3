"""rospy and the message types that are installed on this machine. Nothing here is imported before it is
used."""

from __future__ import annotations

import importlib
import struct
import sys
from typing import Any, Callable, NamedTuple, Tuple

from iort_agent.errors import SourceError

_HELP = (
    "the agent's Python cannot import rospy. ROS 1 installs it for the system's Python only: "
    "`source /opt/ros/noetic/setup.bash` (Debian: apt install python3-rospy), then "
    "`/usr/bin/python3 -m venv --system-site-packages <folder>` and install the agent into that"
)


class Installed(NamedTuple):
    """An installed message type: its genpy class, and the text of its definition."""

    message_class: Any
    text: str


def rospy() -> Any:
    """rospy, imported afresh after a shutdown, because a node can begin only once for each import.

    Raises `SourceError` without rospy.
    """
    core = sys.modules.get("rospy.core")
    if core is not None and core.is_shutdown_requested():
        for module in [name for name in sys.modules if name.partition(".")[0] == "rospy"]:
            del sys.modules[module]
    try:
        return importlib.import_module("rospy")
    except ImportError as error:
        raise SourceError(f"{_HELP} ({error})") from error


def installed(kind: str) -> Installed:
    """The installed type of a name. Raises `SourceError` if it is not installed."""
    try:
        found = importlib.import_module("roslib.message").get_message_class(kind)
    except ImportError as error:
        raise SourceError(f"{_HELP} ({error})") from error
    except Exception as error:
        raise SourceError(f"the ROS message type {kind} cannot be loaded: {error}") from error
    if found is None:
        package = kind.partition("/")[0]
        raise SourceError(
            f"the ROS message type {kind} is not installed: build its package, {package}, and source the "
            f"workspace, or apt install python3-{package.replace('_', '-')}"
        )
    return Installed(found, found._full_text)  # noqa: SLF001 - genpy's own name for it


# Returns success and message. Runs in a thread of its own for each call, and may wait.
OnTrigger = Callable[[], Tuple[bool, str]]
KIND = "std_srvs/Trigger"
_EMPTY_MD5SUM, _MD5SUM = "d41d8cd98f00b204e9800998ecf8427e", "937c9679a518e3a18d831e57125ea522"
_HEAD = struct.Struct("<BI")


def trigger() -> Any:
    """The class of the service type std_srvs/Trigger, for `rospy.Service`. It is made here, of two fields:
    who calls such a service has the package std_srvs, and the agent need not."""
    message: Any = importlib.import_module("genpy").Message

    def write(self: Any, buffer: Any) -> None:
        text = self.message.encode()
        buffer.write(_HEAD.pack(self.success, len(text)) + text)

    request = {
        **_named(f"{KIND}Request", _EMPTY_MD5SUM, ""),
        "serialize": lambda _self, _buffer: None,
        "deserialize": lambda self, _data: self,
    }
    response = {
        **_named(f"{KIND}Response", _MD5SUM, "bool success\nstring message\n"),
        "__slots__": ["success", "message"],
        "_slot_types": ["bool", "string"],
        "serialize": write,
    }
    classes = {
        "_request_class": type("TriggerRequest", (message,), {"__slots__": [], "_slot_types": [], **request}),
        "_response_class": type("TriggerResponse", (message,), response),
    }
    return type("Trigger", (), {"_type": KIND, "_md5sum": _MD5SUM, **classes})


def _named(kind: str, md5sum: str, text: str) -> dict[str, Any]:
    return {"_type": kind, "_md5sum": md5sum, "_full_text": text}
