"""The service type std_srvs/Trigger for rospy: an empty request, and a response of success and message.

It is made here, of two fields: who calls such a service has the package std_srvs, and the agent need not.
"""

from __future__ import annotations

import importlib
import struct
from typing import Any, Callable, Tuple

# Returns success and message. Runs in a thread of its own for each call, and may wait.
OnTrigger = Callable[[], Tuple[bool, str]]
KIND = "std_srvs/Trigger"
_EMPTY_MD5SUM, _MD5SUM = "d41d8cd98f00b204e9800998ecf8427e", "937c9679a518e3a18d831e57125ea522"
_HEAD = struct.Struct("<BI")


def trigger() -> Any:
    """The service's class, for `rospy.Service`."""
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
