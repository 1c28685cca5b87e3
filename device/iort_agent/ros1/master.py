"""Calls to a ROS master and to other nodes, over XML-RPC and with a timeout."""

from __future__ import annotations

import http.client
import os
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
