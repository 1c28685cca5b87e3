"""Attempts to connect to a publisher, in the place of rospy's own."""

from __future__ import annotations

import sys
import threading
from types import SimpleNamespace
from typing import Any

import pytest

from iort_agent.ros1 import master

TOPIC, URI = "/wheel", "http://127.0.0.1:1"
CHOSEN = ["TCPROS", "127.0.0.1", 2]


class Rospy:
    """A subscriber, its connections, and a publisher whose answers the test gives."""

    def __init__(self) -> None:
        self.connections: list[str] = []
        self.asked, self.answer = threading.Semaphore(0), threading.Semaphore(0)
        self.protocol_handlers = [self]

    def get_subscriber_impl(self, topic: str) -> Any:
        return SimpleNamespace(has_connection=self.connections.__contains__) if topic == TOPIC else None

    def get_supported(self) -> list[list[str]]:
        return [["TCPROS"]]

    def supports(self, protocol: str) -> bool:
        return protocol == "TCPROS"

    def create_transport(self, _topic: str, uri: str, chosen: list[Any]) -> tuple[int, str, int]:
        assert chosen == CHOSEN
        self.connections.append(uri)
        return 1, "", 0

    def requestTopic(self, *asked: Any) -> tuple[int, str, list[Any]]:  # noqa: N802 - ROS' name
        assert asked == ("/iort_agent", TOPIC, [["TCPROS"]])
        self.asked.release()
        assert self.answer.acquire(timeout=60)
        return 1, "", CHOSEN


@pytest.fixture
def rospy(monkeypatch: pytest.MonkeyPatch) -> Rospy:
    found, handlers = Rospy(), type("Handlers", (), {})
    for name, module in (
        ("masterslave", SimpleNamespace(ROSHandler=handlers)),
        ("registration", SimpleNamespace(get_topic_manager=lambda: found)),
    ):
        monkeypatch.setitem(sys.modules, f"rospy.impl.{name}", module)
    monkeypatch.setattr(master, "proxy", lambda *_: found)
    master.mend("/iort_agent")
    found.connect = lambda topic=TOPIC: handlers._connect_topic(found, topic, URI)
    return found


def test_two_attempts_at_once_make_one_connection(rospy: Any) -> None:
    first = threading.Thread(target=rospy.connect)
    first.start()
    assert rospy.asked.acquire(timeout=60)
    # The second begins while the first waits for its answer.
    rospy.connect()
    rospy.answer.release()
    first.join()
    rospy.connect()
    assert rospy.connections == [URI]


def test_a_publisher_that_did_not_answer_is_tried_again(rospy: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def silent(*_: Any) -> None:
        raise TimeoutError

    answering = rospy.requestTopic
    monkeypatch.setattr(rospy, "requestTopic", silent)
    with pytest.raises(TimeoutError):
        rospy.connect()
    monkeypatch.setattr(rospy, "requestTopic", answering)
    rospy.answer.release()
    rospy.connect()
    assert rospy.connections == [URI]


def test_a_topic_without_subscriber_is_not_connected(rospy: Any) -> None:
    rospy.connect("/other")
    assert rospy.connections == []
