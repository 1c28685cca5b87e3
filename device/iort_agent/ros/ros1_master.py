"""Calls to a ROS master and to other nodes, over XML-RPC and with a timeout; rospy's own calls, too."""

from __future__ import annotations

import http.client
import importlib
import os
import threading
import xml.parsers.expat
import xmlrpc.client
from typing import Any

_TIMEOUT_S = 3.0
# Raised when nobody answers, or when the one who answers is not a ROS master.
ERRORS = (OSError, xmlrpc.client.Error, http.client.HTTPException, xml.parsers.expat.ExpatError, ValueError)


def uri() -> str:
    """The address of the master: ROS_MASTER_URI, or else ROS' default."""
    return os.environ.get("ROS_MASTER_URI") or "http://localhost:11311"


class Master:
    """A master, as one node sees it. Raises one of `ERRORS` if it does not answer."""

    def __init__(self, uri: str, caller: str) -> None:
        self.proxy = proxy(uri)
        self._caller = caller

    def ask(self, method: str, *arguments: Any) -> Any:
        """The value of the answer; also raises if the master refuses."""
        answer = getattr(self.proxy, method)(self._caller, *arguments)
        if not isinstance(answer, list) or len(answer) != 3:
            raise xmlrpc.client.ResponseError(f"{method}: the answer is not a ROS master's")
        status, text, value = answer
        if status != 1:
            raise xmlrpc.client.ResponseError(f"{method}: {text}")
        return value

    def unreachable(self) -> str | None:
        """Why the master does not answer; None if it does."""
        try:
            self.ask("getPid")
        except ERRORS as error:
            return str(error)
        return None


def proxy(uri: str, timeout_s: float = _TIMEOUT_S) -> Any:
    """A master's or a node's calls. Raises `OSError` for an invalid address."""
    return xmlrpc.client.ServerProxy(uri, transport=_Transport(timeout_s))


class _Transport(xmlrpc.client.Transport):
    def __init__(self, timeout_s: float) -> None:
        super().__init__()
        self._timeout_s = timeout_s

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = self._timeout_s
        return connection


# A busy publisher may take longer to answer than a master.
_BUSY_TIMEOUT_S = 10.0


def mend(caller: str) -> None:
    """Let the rospy that is imported now make one attempt at a time to connect to each publisher of a topic,
    and end it, as the node ``caller``.

    rospy starts a thread for each attempt. Two at once make two connections to one publisher, and the second
    ends the first, with the messages that are on their way. An attempt to reach a computer that is switched
    off never ends, while the node begins another one every few seconds.
    """
    handlers = importlib.import_module("rospy.impl.masterslave").ROSHandler
    topics = importlib.import_module("rospy.impl.registration").get_topic_manager
    lock, running = threading.Lock(), set()

    def connect(handler: Any, topic: str, uri: str) -> tuple[int, str, int]:
        attempt = topic, uri
        with lock:
            if attempt in running:
                return 1, "another attempt runs", 0
            running.add(attempt)
        try:
            subscriber = topics().get_subscriber_impl(topic)
            if subscriber is None or subscriber.has_connection(uri):
                return 1, "nothing to do", 0
            protocols = [one for each in handler.protocol_handlers for one in each.get_supported()]
            status, told, chosen = proxy(uri, _BUSY_TIMEOUT_S).requestTopic(caller, topic, protocols)
            if status != 1 or not chosen:
                return 0, told, 0
            (protocol,) = (one for one in handler.protocol_handlers if one.supports(chosen[0]))
            made: tuple[int, str, int] = protocol.create_transport(topic, uri, chosen)
            return made
        finally:
            with lock:
                running.remove(attempt)

    handlers._connect_topic = connect  # noqa: SLF001 - rospy has no public name for it
