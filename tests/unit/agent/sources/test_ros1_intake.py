"""One ROS 1 topic's intake, from the connection header to the sample; no ROS is needed."""

from __future__ import annotations

import struct
import sys
import threading
from types import SimpleNamespace
from typing import Any

import pytest

from iort_agent.errors import SourceError
from iort_agent.sources.intake import Intake
from iort_agent.sources.ros1 import Ros1Config, TopicConfig
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.ros.message import MessageType, RosMessage, message_type
from testkit.agent import ManualClock
from tests.unit.contract.ros.ros1_messages import LINE, STAMPED, header, u32

T0 = 1_700_000_000_000_000
CONNECTION = {"type": "a_msgs/A", "md5sum": "1", "message_definition": STAMPED + "uint8 u"}


class Desk:
    def __init__(self, **settings: Any) -> None:
        self.clock = ManualClock(now_us=T0)
        self.samples: list[tuple[str, int, dict[str, Any]]] = []
        self.types: list[MessageType] = []
        self.more: list[bool] = []
        # Until when the live lane wants none.
        self.next_at = 0.0
        # How many samples a full disk refuses.
        self.fails = 0
        config = TopicConfig(**{"stream": "s", "time": "header", **settings})
        self.intake = Intake("/t", config, emit=self._emit, clock=self.clock, large=config.large)

    def _emit(self, stream: str, t_us: int, values: Any, *, more: bool = False) -> float:
        if self.fails:
            self.fails -= 1
            raise OSError("the disk is full")
        if stream != TYPES_STREAM:
            self.samples.append((stream, t_us, values))
            self.more.append(more)
        else:
            self.types.append(message_type(values))
        return self.next_at

    def take(self, data: bytes, **header: str) -> None:
        self.intake.take({**CONNECTION, **header}, data)


def test_messages_wait_until_the_live_lane_wants_one() -> None:
    desk = Desk(time="arrival")
    desk.next_at, header = desk.clock.monotonic() + 0.1, {**CONNECTION, "message_definition": "uint8 u"}
    for data in (b"\x00", b"\x01", b"\x02"):
        desk.intake.receive(header, data)
        desk.clock.advance(0.04)
    assert len(desk.samples) == 1
    desk.intake.receive(header, b"\x03")
    assert [(t_us - T0, values["u"]) for _, t_us, values in desk.samples] == [
        (i * 40_000, i) for i in range(4)
    ]
    assert desk.more == [False, True, True, False]
    for _ in range(16):
        desk.intake.receive(header, b"\x04")
    assert len(desk.samples) == 20, "or until they are many"


def test_a_message_that_cannot_be_taken_costs_no_other_one(caplog: pytest.LogCaptureFixture) -> None:
    desk = Desk(time="arrival")
    desk.next_at, header = desk.clock.monotonic() + 0.1, {**CONNECTION, "message_definition": "uint8 u"}
    desk.intake.receive(header, b"\x00")
    desk.fails = 1
    for data in (b"\x01", b"\x02"):
        desk.intake.receive(header, data)
    desk.intake.take_received()
    assert [values["u"] for _, _, values in desk.samples] == [0, 2]
    assert "topic /t: a message could not be taken" in caplog.text


def test_the_last_message_of_a_silent_topic_waits_for_the_next_look() -> None:
    desk = Desk(time="arrival")
    desk.next_at = desk.clock.monotonic() + 0.1
    desk.intake.receive(CONNECTION, b"\x00")
    desk.intake.receive(CONNECTION, b"\x01")
    desk.intake.look(lambda: 1)
    assert len(desk.samples) == 1
    desk.clock.advance(0.5)
    desk.intake.look(lambda: 1)
    assert len(desk.samples) == 2


def test_a_publishers_type_is_said_when_it_connects() -> None:
    desk = Desk()
    header = {**CONNECTION}
    for _ in range(3):
        desk.intake.take(header, b"")
    said = MessageType("s", "/t", "a_msgs/A", "1", CONNECTION["message_definition"])
    assert desk.types == [said]


def test_a_definition_that_is_not_sent_is_the_installed_classes(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "# of the class\nuint8 N=3\nuint8 u\n"
    installed = SimpleNamespace(get_message_class=lambda _kind: SimpleNamespace(_full_text=text))
    monkeypatch.setitem(sys.modules, "roslib", SimpleNamespace(message=installed))
    monkeypatch.setitem(sys.modules, "roslib.message", installed)
    desk = Desk()
    desk.take(b"\x01", message_definition="")
    assert [said.definition for said in desk.types] == [text]
    ((_, _, sample),) = desk.samples
    assert (sample.kind.layout, dict(sample)) == (desk.types[0].layout, {"u": 1})


def test_a_definition_that_the_first_publisher_left_out_comes_with_the_second() -> None:
    desk = Desk()
    desk.take(b"\x01", message_definition="", callerid="/small")
    desk.take(b"\x02", message_definition="uint8 u", callerid="/whole")
    desk.take(b"\x03", message_definition="", callerid="/small")
    assert [dict(sample) for _, _, sample in desk.samples] == [{}, {"u": 2}, {"u": 3}]
    assert [said.definition for said in desk.types] == ["", "uint8 u", "uint8 u"]


def test_a_type_is_said_once_a_connection_where_publishers_take_turns() -> None:
    desk = Desk()
    first, second = ({**CONNECTION, "callerid": name} for name in ("/front", "/rear"))
    for _ in range(3):
        desk.intake.take(first, b"")
        desk.intake.take(second, b"")
    assert len(desk.types) == 2
    desk.intake.take({**first}, b"")
    assert len(desk.types) == 3


@pytest.mark.parametrize("time", ["header", "arrival"])
def test_a_message_is_recorded_as_it_was_published(time: str) -> None:
    desk = Desk(time=time)
    raws = [header(T0 // 1_000_000, i, frame) + b"\x01" for i, frame in enumerate(["laser", "", "grün"])]
    for raw in raws:
        desk.take(raw)
    messages = [values for _, _, values in desk.samples]
    assert all(isinstance(message, RosMessage) for message in messages)
    assert [message.raw for message in messages] == raws
    (kind,) = {message.kind for message in messages}
    assert kind.id == desk.types[0].id
    assert kind.layout == desk.types[0].layout


def test_selected_fields_are_a_sample_and_no_message() -> None:
    desk = Desk(time="arrival", fields=("v",))
    desk.take(b"\x01\x02", message_definition="uint8 u\nuint8 v")
    assert [values for _, _, values in desk.samples] == [{"v": 2}]
    assert not isinstance(desk.samples[0][2], RosMessage)


def test_large_contents_are_handed_over_with_their_message() -> None:
    definition = "uint8[] data\nuint8 u\nuint8[] none"
    raw = u32(3) + b"abc" + b"\x07" + u32(0)
    desk = Desk(time="arrival", large="upload")
    desk.take(raw, message_definition=definition)
    # What its definition does not fit is recorded all the same.
    desk.take(raw[:5], message_definition=definition)
    messages = [values for _, _, values in desk.samples]
    assert [(message.raw, message.large) for message in messages] == [(raw, {"data": b"abc"}), (raw[:5], {})]
    assert desk.intake.report()["undecodable"] == 1
    assert (dict(messages[0]), dict(messages[1])) == ({"u": 7}, {})


def test_a_believable_stamp_is_the_samples_time() -> None:
    desk = Desk()
    desk.take(header(T0 // 1_000_000 - 1) + b"\x01")
    assert desk.samples == [("s", T0 - 999_993, {"u": 1})]
    assert desk.intake.report() == {"messages": 1, "silent": False, "left_out": {}}


@pytest.mark.parametrize("sec", [0, 12, 1_600_000_000, 1_700_003_700, 1_699_996_300])
def test_a_stamp_that_cannot_be_is_flagged_and_not_believed(
    sec: int, caplog: pytest.LogCaptureFixture
) -> None:
    desk = Desk()
    for _ in range(3):
        desk.take(header(sec, 0) + b"\x01")
    assert [t_us for _, t_us, _ in desk.samples] == [T0] * 3
    assert desk.intake.report()["unbelieved_stamps"] == 3
    assert caplog.text.count("off the clock; using the time of arrival") == 1
    desk.clock.advance(60)
    desk.take(header(sec, 0) + b"\x01")
    assert "(and 2 more like it)" in caplog.text


def test_no_stamp_is_believed_in_a_simulation(caplog: pytest.LogCaptureFixture) -> None:
    desk = Desk()
    desk.intake.sim_time = True
    desk.take(header(T0 // 1_000_000 - 1) + b"\x01")
    assert desk.samples[0][1] == T0
    assert "use_sim_time" in caplog.text


@pytest.mark.parametrize("time", ["header", "arrival"])
def test_a_latched_message_that_comes_again_is_no_new_data(time: str) -> None:
    desk = Desk(time=time)
    old, new = (header(T0 // 1_000_000 + second) + b"\x01" for second in (0, 1))
    first, second = ({**CONNECTION, "latching": "1", "callerid": "/map"} for _ in range(2))
    desk.intake.take(first, old)
    desk.intake.look(lambda: 1)
    desk.clock.advance(6)
    desk.intake.look(lambda: 1)
    desk.intake.take(second, old)
    desk.intake.look(lambda: 1)
    assert len(desk.samples) == 1
    assert desk.intake.report() == {"messages": 1, "silent": True, "left_out": {}, "latched_again": 1}
    # The same twice by one connection was published twice; another publisher's is its own.
    desk.intake.take(second, old)
    desk.intake.take({**first, "callerid": "/other"}, old)
    desk.intake.take({**first}, new)
    desk.intake.look(lambda: 1)
    assert len(desk.samples) == 4
    assert desk.intake.report() == {"messages": 4, "silent": False, "left_out": {}, "latched_again": 1}


def test_what_does_not_latch_is_new_with_every_connection() -> None:
    desk = Desk()
    for _ in range(2):
        desk.take(header(T0 // 1_000_000) + b"\x01", latching="0", callerid="/pub")
    assert len(desk.samples) == 2


def test_arrival_time_asks_no_stamp(caplog: pytest.LogCaptureFixture) -> None:
    desk = Desk(time="arrival")
    desk.take(header(0) + b"\x01")
    assert desk.samples[0][1] == T0
    assert not caplog.records


def test_header_time_without_a_header_is_flagged() -> None:
    desk = Desk()
    desk.take(b"\x01", message_definition="uint8 u")
    assert desk.samples == [("s", T0, {"u": 1})]
    assert desk.intake.report()["no_stamp"] == 1


def test_a_changed_definition_is_another_decoder() -> None:
    desk = Desk(time="arrival")
    desk.take(b"\x01", message_definition="uint8 u")
    desk.take(b"\x01\x02", md5sum="2", message_definition="uint8 u\nuint8 v")
    desk.take(b"\x03", message_definition="uint8 u")
    assert [values for _, _, values in desk.samples] == [{"u": 1}, {"u": 1, "v": 2}, {"u": 3}]


@pytest.mark.parametrize(
    ("definition", "why"),
    [
        ("Unknown u", "the definition of a_msgs/Unknown is missing"),
        ("not a definition", "invalid line"),
        ("", "cannot import rospy"),
    ],
)
def test_what_cannot_be_looked_into_is_recorded_and_told(
    definition: str, why: str, caplog: pytest.LogCaptureFixture
) -> None:
    desk = Desk()
    for _ in range(3):
        desk.take(b"\x01", message_definition=definition)
    messages = [values for _, _, values in desk.samples]
    assert [(message.raw, dict(message)) for message in messages] == [(b"\x01", {})] * 3
    told = [text for text in caplog.messages if "cannot be looked into" in text]
    assert len(told) == 1
    assert why in told[0]


def test_a_type_of_which_no_message_can_be_is_recorded_without_a_layout() -> None:
    large = (
        "B[16777216] b\n"
        + LINE
        + "MSG: a_msgs/B\nC[16777216] c\n"
        + LINE
        + "MSG: a_msgs/C\nfloat64[9999999] d"
    )
    desk = Desk(time="arrival")
    desk.take(b"\x01", message_definition=large)
    ((_, _, message),) = desk.samples
    assert (message.raw, message.kind.layout) == (b"\x01", "")
    assert "the message would be too large" in message.kind.error


def test_a_message_of_more_fields_than_a_sample_may_have_is_recorded_whole() -> None:
    desk = Desk(time="arrival")
    raw = struct.pack("<576d", *range(576))
    desk.take(raw, message_definition="".join(f"float64[64] a{i}\n" for i in range(9)))
    ((_, _, message),) = desk.samples
    assert message.raw == raw
    assert (len(message), message["a7.63"]) == (512, 511.0)


def test_malformed_messages_are_counted_where_fields_are_selected_and_recorded_otherwise() -> None:
    for fields, samples in ((("u",), 1), (None, 2)):
        desk = Desk(time="arrival", fields=fields)
        desk.take(b"\x01\x02", message_definition="uint8 u")
        desk.take(b"\x01", message_definition="uint8 u")
        assert len(desk.samples) == samples
        assert desk.intake.report().get("malformed", 0) == 2 - samples
        assert desk.samples[-1][2] == {"u": 1}


def test_fields_that_do_not_exist_are_told(caplog: pytest.LogCaptureFixture) -> None:
    desk = Desk(time="arrival", fields=("w",))
    desk.take(b"\x01", message_definition="uint8 u")
    assert desk.samples == []
    assert "a_msgs/A has no field w" in caplog.text
    assert desk.intake.report()["empty"] == 1


def test_silence_is_told_once_and_its_end_too(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    desk = Desk(time="arrival")
    for _ in range(12):
        desk.clock.advance(1)
        desk.intake.look(lambda: 0)
    assert caplog.text.count("topic /t has been silent for 5 s: nobody publishes it") == 1
    assert desk.intake.report()["silent"]
    desk.take(b"\x01", message_definition="uint8 u")
    desk.intake.look(lambda: 1)
    assert "is heard again" in caplog.text
    assert desk.intake.report()["silent"] is False


def test_without_rospy_the_source_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rospy", None)
    source = Ros1Config(topics=(("/t", TopicConfig("header", "s")),)).build(ManualClock())
    with pytest.raises(SourceError, match=r"cannot import rospy.*--system-site-packages"):
        source.run(lambda *_: None, threading.Event())
