"""The node of a ROS 2 graph and its topics, in a graph without ROS."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any

import pytest

from iort_agent.common.threads import SystemClock
from iort_agent.errors import SourceError
from iort_agent.ros import ros2_node
from iort_agent.ros.qos import DEPTH, DEPTH_OF_LARGE, Offer, QosConfig, request
from iort_agent.ros.ros2_node import Node
from iort_agent.ros.ros2_session import LOST
from iort_agent.ros.ros2_topic import Topic
from iort_agent.sources.intake import Intake, TopicConfig
from testkit.agent import ManualClock
from testkit.waiting import GUARD_S, until
from tests.unit.agent.ros2_graph import BEST_EFFORT, LATCHED, RELIABLE, FakeGraph, FakeTypes, fits

IMU, IMAGE, LOST_TYPE = "a_msgs/msg/Imu", "a_msgs/msg/Image", "b_msgs/msg/Lost"
TEXTS = {IMU: "float64 x\n", IMAGE: "uint8[] data\n"}
CDR = b"\x00\x01\x00\x00"


class Desk:
    """A topic that is looked at when the test wants."""

    def __init__(self, qos: QosConfig | None = None, hashes: Mapping[str, str] | None = None) -> None:
        self.graph, self.clock = FakeGraph(), ManualClock()
        self.topic = Topic("/t", self.graph, FakeTypes(TEXTS, hashes), self.clock)
        self.topic.qos = qos or QosConfig()
        self.heard: list[tuple[Mapping[str, str], bytes, int]] = []
        self.every = 1
        self.topic.takers = (lambda *message: self.heard.append(message[:3]),)

    def look(self, times: int = 1) -> None:
        for _ in range(times):
            self.topic.look(self.graph.topics().get("/t", ()), self.every)
            self.graph.deliver()

    def bodies(self) -> list[bytes]:
        return [data for _, data, _ in self.heard]

    def requests(self) -> list[str]:
        return [str(one.request.offer) for one in self.graph.subscriptions]


@pytest.mark.parametrize(
    ("offers", "config", "asked"),
    [
        ([], {}, BEST_EFFORT),
        ([RELIABLE], {}, RELIABLE),
        ([LATCHED], {}, LATCHED),
        ([LATCHED, LATCHED], {}, LATCHED),
        ([LATCHED, RELIABLE], {}, RELIABLE),
        ([RELIABLE, BEST_EFFORT], {}, BEST_EFFORT),
        ([LATCHED, BEST_EFFORT], {}, BEST_EFFORT),
        ([Offer(reliable=False, transient_local=True)], {}, Offer(reliable=False, transient_local=True)),
        ([BEST_EFFORT], {"reliability": "reliable"}, RELIABLE),
        ([LATCHED], {"reliability": "best_effort", "durability": "volatile"}, BEST_EFFORT),
        ([RELIABLE], {"durability": "transient_local"}, LATCHED),
    ],
)
def test_the_request_is_the_most_that_all_publishers_offer(
    offers: list[Offer], config: dict[str, Any], asked: Offer
) -> None:
    found = request(offers, QosConfig(**config))
    assert found == (asked, DEPTH, False)
    assert config or all(fits(found.offer, offer) for offer in offers)


def test_the_depth_is_that_of_the_settings_and_small_for_large_messages() -> None:
    assert request([RELIABLE], large=True).depth == DEPTH_OF_LARGE
    assert request([RELIABLE], QosConfig(depth=7), large=True).depth == 7


def test_a_request_is_patient_only_where_the_middleware_has_room_for_what_comes_meanwhile() -> None:
    assert request([RELIABLE], patient=True).patient
    assert not request([RELIABLE], large=True, patient=True).patient
    assert not request([RELIABLE], QosConfig(depth=7), patient=True).patient


def test_a_topic_is_patient_until_somebody_wants_its_messages_at_once() -> None:
    desk = Desk()
    bodies: list[bytes] = []
    ring = desk.topic.takers
    desk.topic.patient = frozenset(ring)
    publisher = desk.graph.publisher("/t", IMU)
    desk.look()
    assert [one.request.patient for one in desk.graph.subscriptions] == [True]
    desk.topic.takers = (*ring, lambda _header, data, *_times: bodies.append(data))
    for n in range(20):
        publisher.publish(CDR + bytes([n]))
        desk.look()
    assert [one.request.patient for one in desk.graph.subscriptions] == [False]
    assert desk.bodies() == bodies == [CDR + bytes([n]) for n in range(20)]


def test_a_topic_is_heard_once_somebody_publishes_it() -> None:
    desk = Desk()
    desk.look()
    assert not desk.topic.heard()
    publisher = desk.graph.publisher("/t", IMU)
    desk.look()
    publisher.publish(CDR + b"1", 77)
    desk.look()
    ((header, data, source_ns),) = desk.heard
    assert (data, source_ns) == (CDR + b"1", 77)
    assert header == {
        "type": IMU, "md5sum": f"sha256_{IMU}", "message_definition": TEXTS[IMU], "callerid": "/driver",
        "latching": "0",
    }  # fmt: skip
    assert desk.graph.subscriptions[0].request == (RELIABLE, DEPTH, False)
    assert desk.topic.report() == {"qos": "reliable, volatile"}


def test_publishers_are_told_apart_where_rclpy_names_them() -> None:
    desk = Desk()
    desk.graph.publisher("/t", IMU)
    desk.look()
    (subscription,) = desk.graph.subscriptions
    for gid in (b"\x01", b"\x02", b"\x01"):
        subscription.take(CDR + gid, {"source_timestamp": 1, "publisher_gid": {"data": gid}})
    first, second, third = [header for header, _, _ in desk.heard]
    assert (first["callerid"], second["callerid"]) == ("01", "02")
    assert first is third
    assert {**first, "callerid": ""} == {**second, "callerid": ""}


def test_a_restarted_publisher_needs_no_other_subscription_and_is_the_same_publisher() -> None:
    desk = Desk()
    for body in (b"1", b"2"):
        publisher = desk.graph.publisher("/t", IMU)
        desk.look()
        publisher.publish(CDR + body)
        desk.look()
        publisher.end()
        desk.look()
    assert desk.bodies() == [CDR + b"1", CDR + b"2"]
    assert desk.heard[0][0] is desk.heard[1][0]
    assert len(desk.graph.subscriptions) == 1


def test_messages_that_may_be_large_are_kept_in_small_numbers() -> None:
    desk = Desk()
    desk.graph.publisher("/t", IMAGE)
    desk.look()
    assert desk.graph.subscriptions[0].request.depth == DEPTH_OF_LARGE


def test_a_publisher_with_less_is_heard_and_nothing_is_lost_or_taken_twice_meanwhile() -> None:
    desk = Desk()
    first = desk.graph.publisher("/t", IMU)
    desk.look()
    first.publish(CDR + b"1")
    second = desk.graph.publisher("/t", IMU, BEST_EFFORT)
    first.publish(CDR + b"2")
    desk.graph.connects = False
    desk.look()
    assert desk.requests() == ["reliable, volatile", "best_effort, volatile"]
    for publisher, body in ((first, b"3"), (second, b"4"), (first, b"5")):
        publisher.publish(CDR + body)
    # Equal bytes at another time are another message.
    first.publish(CDR + b"5")
    desk.graph.connects = True
    desk.look()
    first.publish(CDR + b"6")
    desk.look()
    assert desk.requests() == ["best_effort, volatile"]
    assert sorted(desk.bodies()) == [CDR + body for body in (b"1", b"2", b"3", b"4", b"5", b"5", b"6")]
    assert desk.topic.report() == {"qos": "best_effort, volatile"}


def test_a_subscription_that_does_not_connect_replaces_the_one_before_after_some_looks() -> None:
    desk = Desk()
    desk.graph.publisher("/t", IMU)
    desk.look()
    desk.graph.publisher("/t", IMU, BEST_EFFORT)
    desk.graph.connects = False
    desk.look(4)
    assert desk.requests() == ["best_effort, volatile"]


def test_more_is_requested_once_it_was_offered_for_a_while() -> None:
    desk = Desk()
    first = desk.graph.publisher("/t", IMU, BEST_EFFORT)
    desk.look()
    first.end()
    desk.graph.publisher("/t", IMU)
    desk.look(4)
    assert desk.requests() == ["best_effort, volatile"]
    desk.look(3)
    assert desk.requests() == ["reliable, volatile"]
    assert desk.topic.report() == {"qos": "reliable, volatile"}


def test_a_latched_message_that_comes_again_with_another_request_is_known() -> None:
    desk, samples = Desk(), []

    def emit(stream: str, *_sample: Any, **_more: Any) -> float:
        samples.append(stream)
        return 0.0

    intake = Intake("/t", TopicConfig("arrival", "t"), emit=emit, clock=desk.clock)
    desk.topic.takers = (*desk.topic.takers, intake.receive)
    plain = desk.graph.publisher("/t", IMU)
    desk.graph.publisher("/t", IMU, LATCHED).publish(CDR + bytes(12), 77)
    latched = desk.graph.publishers_[1]
    desk.look()
    latched.publish(CDR + bytes(12), 78)
    desk.look()
    plain.end()
    desk.look(9)
    assert desk.requests() == ["reliable, transient_local"]
    assert [source_ns for _, _, source_ns in desk.heard] == [78, 78]
    assert samples.count("t") == 1


def test_what_the_settings_demand_and_a_publisher_does_not_offer_is_counted(
    caplog: pytest.LogCaptureFixture,
) -> None:
    desk = Desk(QosConfig(reliability="reliable"))
    desk.graph.publisher("/t", IMU)
    desk.look()
    other = desk.graph.publisher("/t", IMU, BEST_EFFORT)
    desk.look(3)
    other.publish(CDR)
    desk.look()
    assert desk.heard == []
    assert desk.topic.report() == {"incompatible_qos": 1, "qos": "reliable, volatile"}
    assert "topic /t: a publisher does not offer reliable, volatile: it is not heard" in caplog.text


def test_messages_that_the_middleware_has_lost_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    desk = Desk()
    desk.graph.publisher("/t", IMU)
    desk.look()
    for many in (3, 4):
        desk.graph.subscriptions[0].told(LOST, many)
    assert desk.topic.report()["lost_by_middleware"] == 7
    assert "the middleware has lost 3 message(s)" in caplog.text


def test_two_types_of_one_topic_are_heard_each_by_its_own_subscription() -> None:
    desk = Desk()
    publishers = [desk.graph.publisher("/t", kind) for kind in (IMU, IMAGE)]
    desk.look()
    for publisher in publishers:
        publisher.publish(CDR + publisher.endpoint.kind.encode())
    desk.look()
    assert {header["type"]: data for header, data, _ in desk.heard} == {
        kind: CDR + kind.encode() for kind in (IMU, IMAGE)
    }


def test_a_changed_type_ends_the_subscription_to_the_one_before() -> None:
    desk = Desk()
    publisher = desk.graph.publisher("/t", IMU)
    desk.look()
    publisher.publish(CDR + b"last")
    publisher.end()
    desk.graph.publisher("/t", IMAGE).publish(CDR + b"nobody hears it yet")
    desk.look()
    assert [one.kind for one in desk.graph.subscriptions] == [IMAGE]
    assert desk.bodies() == [CDR + b"last"]


def test_a_type_that_is_not_installed_is_named_and_the_other_one_is_heard() -> None:
    desk = Desk()
    desk.graph.publisher("/t", LOST_TYPE)
    desk.graph.publisher("/t", IMU)
    desk.look(12)
    assert desk.topic.report() == {"type_not_installed": 1, "qos": "reliable, volatile"}
    assert desk.topic.why == f"topic /t: the ROS type {LOST_TYPE} is not installed"
    assert [one.kind for one in desk.graph.subscriptions] == [IMU]


def test_a_refused_subscription_is_tried_again() -> None:
    desk = Desk()
    desk.graph.refused = lambda _topic: True
    desk.graph.publisher("/t", IMU)
    desk.look(6)
    assert desk.topic.report() == {"refused_by_middleware": 1}
    assert desk.topic.why == f"topic /t: {IMU} cannot be subscribed to: no room"
    desk.graph.refused = lambda _topic: False
    desk.look(6)
    assert desk.topic.heard()
    assert desk.topic.why is None


def test_a_definition_of_another_hash_is_not_taken_for_the_publishers() -> None:
    ours, theirs = "RIHS01_11", "RIHS01_22"
    desk = Desk(hashes={IMU: ours})
    publisher = desk.graph.publisher("/t", IMU, type_hash=theirs)
    desk.look()
    publisher.publish(CDR)
    desk.look(8)
    ((header, _, _),) = desk.heard
    assert (header["md5sum"], "message_definition" in header) == (theirs, False)
    assert desk.topic.report()["definition_differs"] == 1
    # One that tells no hash, such as micro-ROS, is believed to have ours.
    publisher.end()
    desk.graph.publisher("/t", IMU).publish(CDR)
    desk.look()
    assert desk.heard[-1][0]["md5sum"] == ours


def test_two_publishers_have_one_header_that_names_none() -> None:
    desk = Desk()
    publishers = [desk.graph.publisher("/t", IMU, node=node) for node in ("/front", "/rear")]
    desk.look()
    for publisher in publishers:
        publisher.publish(CDR)
    desk.look()
    assert [header["callerid"] for header, _, _ in desk.heard] == ["", ""]
    assert desk.heard[0][0] is desk.heard[1][0]


def test_a_topic_that_nobody_wants_any_more_is_left() -> None:
    desk = Desk()
    desk.graph.publisher("/t", IMU).publish(CDR)
    desk.look()
    desk.topic.takers = ()
    desk.look()
    assert desk.graph.subscriptions == []
    assert desk.topic.heard()


def test_a_graph_that_does_not_change_is_seldom_asked() -> None:
    desk = Desk()
    desk.every = 5
    desk.graph.publisher("/t", IMU)
    desk.look()
    questions = desk.graph.questions
    desk.look(10)
    assert desk.graph.questions == questions + 2


@pytest.fixture
def graph() -> FakeGraph:
    return FakeGraph()


@pytest.fixture
def node(graph: FakeGraph) -> Iterator[Node]:
    node = Node("iort_agent", graph.join, SystemClock(), FakeTypes(TEXTS))
    node.users = 1
    node.start()
    yield node
    node.close()


def soon(condition: Any) -> None:
    until(condition)


def test_a_handler_hears_a_topic_that_appears_later(node: Node, graph: FakeGraph) -> None:
    heard: list[bytes] = []

    def take(_header: Mapping[str, str], data: bytes) -> None:
        heard.append(data)

    node.subscribe("/t", take)
    time.sleep(0.05)
    publisher = graph.publisher("/t", IMU)
    soon(lambda: node.connections("/t") == 1)
    publisher.publish(CDR)
    soon(lambda: heard == [CDR])
    node.unsubscribe("/t", take)
    soon(lambda: graph.subscriptions == [])
    assert node.connections("/t") == 0
    assert node.topics == ("/t",)


def test_a_handler_that_fails_costs_neither_the_node_nor_other_handlers(
    node: Node, graph: FakeGraph, caplog: pytest.LogCaptureFixture
) -> None:
    heard: list[bytes] = []

    def fail(_header: Mapping[str, str], _data: bytes) -> None:
        raise ValueError("no room")

    node.subscribe("/t", fail)
    node.subscribe("/t", lambda _header, data: heard.append(data))
    publisher = graph.publisher("/t", IMU)
    soon(lambda: node.connections("/t") == 1)
    for i in range(2):
        publisher.publish(CDR + bytes([i]))
    soon(lambda: len(heard) == 2)
    assert node.failed is None
    assert "topic /t: a message could not be taken" in caplog.text


def test_a_name_that_ros_does_not_allow_is_named(node: Node, graph: FakeGraph) -> None:
    graph.forbidden = {"/a/1b"}
    with pytest.raises(SourceError, match="/a/1b is no name of a topic in ROS 2"):
        node.subscribe("/a/1b", lambda *_: None)
    node.offer("/a/1b", lambda: (True, ""))
    node.subscribe("/t", lambda *_: None)
    graph.publisher("/t", IMU)
    soon(lambda: node.connections("/t") == 1)


def test_names_are_remapped(node: Node, graph: FakeGraph) -> None:
    graph.remapped["/t"] = "/car1/t"
    graph.publisher("/car1/t", IMU)
    node.subscribe("/t", lambda *_: None)
    soon(lambda: [one.topic for one in graph.subscriptions] == ["/car1/t"])
    assert node.report("/t") == {"qos": "reliable, volatile"}


def test_an_advertised_topic_is_published(node: Node, graph: FakeGraph) -> None:
    assert not node.publish("/cmd", CDR)
    node.advertise("/cmd", IMU)
    soon(lambda: node.publish("/cmd", CDR))
    assert graph.published == [("/cmd", CDR)]
    assert (node.listeners("/cmd"), node.listeners("/other")) == (3, 0)
    with pytest.raises(SourceError, match=f"{LOST_TYPE} is not installed"):
        node.advertise("/cmd", LOST_TYPE)


def test_a_node_that_has_left_the_graph_publishes_no_more() -> None:
    graph = FakeGraph()
    node = Node("iort_agent", graph.join, SystemClock(), FakeTypes(TEXTS))
    node.users = 1
    node.start()
    node.advertise("/cmd", IMU)
    soon(lambda: node.publish("/cmd", CDR))
    node.close()

    def gone(*_: object) -> Any:
        raise RuntimeError("destroyed")

    graph.wake = graph.resolve = gone  # type: ignore[method-assign]  # as rclpy's are then
    node.advertise("/other", IMU)
    assert not node.publish("/cmd", CDR)
    assert not node.publish("/other", CDR)


def test_a_stop_is_published_while_a_handler_holds_the_reading_thread(node: Node, graph: FakeGraph) -> None:
    held, free = threading.Event(), threading.Event()
    freed: list[bool] = []

    def take(_header: Mapping[str, str], _data: bytes) -> None:
        held.set()
        freed.append(free.wait(GUARD_S))

    node.advertise("/cmd", IMU)
    node.subscribe("/t", take)
    publisher = graph.publisher("/t", IMU)
    soon(lambda: node.connections("/t") == 1)
    publisher.publish(CDR)
    assert held.wait(GUARD_S)
    assert node.publish("/cmd", CDR)
    free.set()
    soon(lambda: freed)
    assert freed == [True], "the stop waited for the handler"


def test_other_nodes_are_known(node: Node, graph: FakeGraph) -> None:
    assert len(node.living("iort_agent")) == 1
    assert not node.living("other")
    graph.others += ["/other", "/other"]
    assert len(node.living("other")) == 2


def test_a_missing_type_is_what_the_node_waits_for(node: Node, graph: FakeGraph) -> None:
    assert node.waits() is None
    graph.publisher("/t", LOST_TYPE)
    node.subscribe("/t", lambda *_: None)
    soon(node.waits)
    assert node.waits() == f"topic /t: the ROS type {LOST_TYPE} is not installed"


def test_a_service_that_cannot_be_offered_is_told(node: Node, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.ERROR)
    node.offer("/iort_agent/stop", lambda: (True, ""))
    soon(lambda: "the service /iort_agent/stop is not offered" in caplog.text)


def test_the_last_user_closes_the_session(graph: FakeGraph, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros2_node, "_JOIN_S", GUARD_S)
    node = Node("iort_agent", graph.join, SystemClock(), FakeTypes(TEXTS))
    node.users = 2
    node.start()
    node.close()
    assert not graph.closed
    node.close()
    assert graph.closed
