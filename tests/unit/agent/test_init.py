"""`iort-agent init`: what it hears of a graph, what it chooses, and the file that it writes."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, Iterator, Mapping, Sequence

import pytest
import yaml

from iort_agent import cli
from iort_agent.common.threads import Clock, SystemClock
from iort_agent.config import load_config
from iort_agent.errors import ConfigError, SourceError
from iort_agent.ros import OnBytes
from iort_agent.sources.ros1 import Ros1Config
from iort_agent.verbs.init import Seams, init
from iort_agent.verbs.survey import Polls, Vesc, ports
from iort_agent.video.config import TopicCamera
from iort_contract.messages.commands import DOWNLINK_NOTE, VIDEO_NOTE, stick_downlink
from iort_contract.ros.definition import Definition, parse
from iort_contract.topics import stream_of
from testkit.agent import ManualClock
from testkit.waiting import until
from tests.unit.agent.control.downlink_rig import HEADER
from tests.vesc_standin import VescStandin

STAMPED = f"Header header\nfloat64 x\n{HEADER}"
PICTURE = f"Header header\nuint8[] data\n{HEADER}"
IDENTITY = "robot: car7\nendpoint: localhost\ncertificate: c.pem\nprivate_key: k.pem\n"


def stamped(clock: Clock, late_s: int, rest: bytes) -> bytes:
    return struct.pack("<IIII", 0, clock.now_us() // 1_000_000 - late_s, 0, 0) + rest


class FakeNode:
    """A graph whose publishers are asked for messages whenever somebody looks."""

    failed: str | None = None
    sim_time = False

    def __init__(self, clock: ManualClock, publishers: Mapping[str, tuple[str, str, Any]]) -> None:
        # Topic -> type, definition, and the bytes of a message, or a function of the clock for them.
        self._clock, self._publishers = clock, publishers
        self._handlers: dict[str, OnBytes] = {}
        self.more: dict[str, Sequence[str]] = {}
        self.closed = False

    def types(self) -> Mapping[str, Sequence[str]]:
        for topic, handler in self._handlers.items():
            kind, text, data = self._publishers.get(topic, ("", "", None))
            if data is not None:
                header = {"type": kind, "message_definition": text}
                handler(header, data(self._clock) if callable(data) else data)
        return {**{topic: [kind] for topic, (kind, _, _) in self._publishers.items()}, **self.more}

    def subscribe(self, topic: str, handler: OnBytes) -> None:
        self._handlers[topic] = handler

    def connections(self, topic: str) -> int:
        return int(topic in self._publishers)

    def definition(self, kind: str) -> Definition:
        if kind != "std_msgs/Bool":
            raise SourceError(f"{kind} is not installed")
        return parse(kind, "bool data")

    def start(self) -> None:
        pass

    def close(self) -> None:
        self.closed = True


CAR: Mapping[str, tuple[str, str, Any]] = {
    "/sensors/core": ("vesc_msgs/VescStateStamped", STAMPED, lambda clock: stamped(clock, 0, bytes(8))),
    "/odom": ("nav_msgs/Odometry", STAMPED, lambda clock: stamped(clock, 7200, bytes(8))),
    "/drive": ("a/Drive", "float64 x", bytes(8)),
    "/camera/image_raw": ("sensor_msgs/Image", PICTURE, lambda clock: stamped(clock, 0, bytes(90_000))),
    "/camera2": ("sensor_msgs/CompressedImage", "", None),
    "/cloud": ("a/Points", "float64[] x", bytes(400_000)),
    "/button": ("std_msgs/Bool", "bool data", None),
    "/rosout": ("rosgraph_msgs/Log", "string a", bytes(4)),
    "/planner/debug_path": ("a/Path", "string a", bytes(4)),
    "/_hidden": ("a/Path", "string a", bytes(4)),
}
CHOSEN = {
    "/sensors/core": {"stream": "vesc", "time": "header"},
    "/odom": {"stream": "odom", "time": "arrival"},
    "/drive": {"stream": "topic-drive", "time": "arrival"},
    "/button": {"stream": "button", "time": "arrival"},
}


class Robot:
    def __init__(self, folder: Path, *nodes: FakeNode, clock: Clock, at: Sequence[str] = ()) -> None:
        self.out, self._nodes, self._at, self._clock = folder / "car.yaml", nodes, at, clock
        for name in ("c.pem", "k.pem"):
            (folder / name).touch()

    def init(self, *wanted: str, every: bool = False, version: int = 1, listen_s: float = 5) -> Path:
        def graphs(_clock: Clock, reasons: list[str]) -> Iterator[tuple[int, str, Any]]:
            reasons.append("no master")
            yield from ((version, f"ROS {version}", node) for node in self._nodes)

        seams = Seams(self._clock, graphs, lambda: iter(self._at))
        return init(self.out, every=every, wanted=wanted, listen_s=listen_s, seams=seams)


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    clock = ManualClock()
    return Robot(tmp_path, FakeNode(clock, CAR), clock=clock)


def topics(file: Path) -> dict[str, Any]:
    (source,) = yaml.safe_load(file.read_text())["sources"]
    assert source.pop("type") == "ros1"
    found: dict[str, Any] = source.pop("topics")
    assert source == {}
    return found


def test_names_that_yaml_reads_otherwise_are_streams_too(tmp_path: Path) -> None:
    names = ["on", "no", "null", "true", "e5", "y"]
    clock = ManualClock()
    publishers = {f"/{name}": ("a/Drive", "float64 x", bytes(8)) for name in names}
    written = Robot(tmp_path, FakeNode(clock, publishers), clock=clock).init()
    assert {name: topic["stream"] for name, topic in topics(written).items()} == {
        f"/{name}": name for name in names
    }


def test_what_is_small_is_recorded_and_what_is_not_says_why(
    robot: Robot, capsys: pytest.CaptureFixture[str]
) -> None:
    written = robot.init()
    assert written == robot.out
    assert topics(written) == CHOSEN
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    for topic, why in (
        ("/camera/image_raw", "4 Hz, 90,016 bytes   - large: --topic /camera/image_raw sends it as files"),
        ("/camera2", "silent"), ("/cloud", "- more than the 512 KB a second"), ("/rosout", "- ROS' own"),
        ("/planner/debug_path", "- for debugging"), ("/_hidden", "- ROS' own"), ("/odom", "  odom"),
    ):  # fmt: skip
        assert why in rows[topic]
    lines = written.read_text().splitlines()
    assert (
        "    /sensors/core: {stream: vesc, time: header}  # vesc_msgs/VescStateStamped, 4 Hz, 24 bytes"
        in lines
    )
    (cloud,) = (line for line in lines if "/cloud" in line)
    assert cloud.startswith(
        "    # /cloud: {stream: cloud, time: arrival}  # a/Points, 4 Hz, 400,000 bytes; more"
    )


def test_the_parser_of_car_yaml_takes_what_is_written(robot: Robot) -> None:
    written = robot.init()
    written.write_text(IDENTITY + written.read_text())
    (source,) = load_config(written).sources
    assert isinstance(source, Ros1Config)
    assert {topic: settings.stream for topic, settings in source.topics} == {
        topic: settings["stream"] for topic, settings in CHOSEN.items()
    }


def test_a_bundles_file_stays_and_the_new_one_beside_it_can_be_checked(robot: Robot) -> None:
    downlink = DOWNLINK_NOTE + yaml.safe_dump({"downlink": stick_downlink()}, sort_keys=False)
    before = f"{IDENTITY}# Mine.\nsources:\n# no more\n\n- type: sim\n  rate_hz: 50\n\n{downlink}"
    robot.out.write_text(before)
    written = robot.init()
    assert robot.out.read_text() == before
    assert written.name == "car.new.yaml"
    assert topics(written) == CHOSEN
    assert DOWNLINK_NOTE in written.read_text()
    config, old = load_config(written), load_config(robot.out)
    assert (config.robot, config.downlink) == (old.robot, old.downlink)
    with pytest.raises(ConfigError, match="exists already"):
        robot.init()


@pytest.mark.parametrize(
    "before", ["", IDENTITY, f"{IDENTITY}sources: []\n", f"sources: [\n {{}}]\n{IDENTITY}"]
)
def test_a_file_without_sources_or_with_others_gets_new_ones(robot: Robot, before: str) -> None:
    robot.out.write_text(before)
    written = robot.init()
    assert topics(written) == CHOSEN
    assert {**yaml.safe_load(written.read_text()), "sources": 0} == {
        **(yaml.safe_load(before) or {}),
        "sources": 0,
    }


@pytest.mark.parametrize("before", ["sources: [\n]\n", "- a\n", "'sources': []\n", "robot: a\n...\n"])
def test_a_file_that_cannot_be_rewritten_is_told_what_to_paste(robot: Robot, before: str) -> None:
    robot.out.write_text(before)
    with pytest.raises(ConfigError, match=r"must be a mapping|put this into it by hand:\n(.|\n)*/odom: "):
        robot.init()
    assert [file.name for file in robot.out.parent.glob("*.yaml")] == ["car.yaml"]


def test_commands_take_the_form_of_the_graphs_types(robot: Robot) -> None:
    robot.out.write_text(f"{IDENTITY}sources: []\n" + yaml.safe_dump({"downlink": stick_downlink()}))
    written = robot.init(version=2)
    text = yaml.safe_load(written.read_text())
    assert text["downlink"]["cmd"]["drive"]["type"] == "ackermann_msgs/msg/AckermannDriveStamped"
    assert text["sources"][0]["type"] == "ros2"


def test_topics_can_be_chosen_by_pattern_and_large_ones_go_as_files(robot: Robot) -> None:
    written = robot.init("/camera/*", "/rosout")
    assert topics(written) == {
        "/camera/image_raw": {"stream": "camera-image_raw", "time": "header", "large": "upload"},
        "/rosout": {"stream": "rosout", "time": "arrival"},
    }
    written.write_text(IDENTITY + written.read_text())
    assert load_config(written).files.large_folder == written.parent / "large"


def test_all_topics_can_be_chosen(robot: Robot) -> None:
    assert set(topics(robot.init(every=True))) == set(CAR) - {"/_hidden"}


def test_a_folder_for_files_is_asked_for_where_the_section_is_there(robot: Robot) -> None:
    robot.out.write_text(f"{IDENTITY}files: {{large_folder: here}}\n")
    written = robot.init("/camera/*")
    assert yaml.safe_load(written.read_text())["files"] == {"large_folder": "here"}
    written.unlink()
    robot.out.write_text(f"{IDENTITY}files: {{rate_kb_s: 100}}\n")
    with pytest.raises(ConfigError, match=r"files\.large_folder: set it first"):
        robot.init("/camera/*")


def test_a_camera_is_hinted_at_once(robot: Robot) -> None:
    hint = "# video: {source: {type: topic, topic: /camera/image_raw}}"
    written = robot.init()
    assert [line.partition("  #")[0] for line in written.read_text().splitlines() if "video:" in line] == [
        hint
    ]
    written.write_text(IDENTITY + written.read_text().replace(hint, hint[2:]))
    config = load_config(written)
    assert config.video is not None
    assert config.video.source == TopicCamera("/camera/image_raw")
    again = robot.init()
    assert again.read_text().count("video:") == 1, "it has one"
    again.unlink()
    robot.out.write_text(IDENTITY + VIDEO_NOTE)
    assert hint in robot.init().read_text()


def test_a_pattern_without_a_topic_is_an_error_and_nothing_is_written(robot: Robot) -> None:
    with pytest.raises(SourceError, match="--topic /nobody: the graph has no such topic"):
        robot.init("/odom", "/nobody")
    assert not robot.out.exists()


def test_what_nobody_publishes_or_of_several_types_or_not_sourced_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = ManualClock()
    silent = ("std_msgs/Bool", "", None)
    node = FakeNode(clock, {"/a": ("a/msg/A", "", None), "/b": silent, "/d": silent})
    node.more = {"/c": ["std_msgs/Bool"], "/d": ["a/msg/A", "b/msg/B"]}
    robot = Robot(tmp_path, node, clock=clock)
    text = robot.init(version=2).read_text()
    assert "    /b: {stream: b, time: arrival}  # std_msgs/Bool, silent\n" in text
    assert "; its package is not sourced here\n" in text
    assert "    # /c: {stream: c, time: arrival}  # std_msgs/Bool, nobody publishes it; nobody" in text
    assert "; several types: a/msg/A, b/msg/B\n" in text
    assert "no message came" in capsys.readouterr().err


def test_names_of_streams_are_free_and_valid(tmp_path: Path) -> None:
    clock, message = ManualClock(), ("std_msgs/Bool", "bool data", b"\0")
    names = ["/a/b", "/a_b", "/pose", f"/{'x' * 70}"]
    vesc = ("vesc_msgs/msg/VescStateStamped", "bool data", b"\0")
    robot = Robot(
        tmp_path, FakeNode(clock, {**dict.fromkeys(names, message), "/v": vesc, "/w": vesc}), clock=clock
    )
    assert [one["stream"] for one in topics(robot.init()).values()] == [
        "a-b", "a_b", "topic-pose", "vesc", "w", stream_of(names[3]),
    ]  # fmt: skip


def test_simulated_time_is_not_trusted(tmp_path: Path) -> None:
    clock = ManualClock()
    node = FakeNode(clock, {"/sensors/core": CAR["/sensors/core"]})
    node.sim_time = True
    assert topics(Robot(tmp_path, node, clock=clock).init())["/sensors/core"]["time"] == "arrival"


def test_a_node_that_must_leave_and_a_robot_without_anything_are_errors(tmp_path: Path) -> None:
    clock = ManualClock()
    with pytest.raises(SourceError, match="nothing to record; no master"):
        Robot(tmp_path, clock=clock).init()
    node = FakeNode(clock, {})
    with pytest.raises(SourceError, match="nothing to record"):
        Robot(tmp_path, node, clock=clock).init()
    node.failed = "the node has ended"
    with pytest.raises(SourceError, match="has ended"):
        Robot(tmp_path, node, clock=clock).init()
    assert node.closed


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A VESC has answered before its time is over."""
    end = Polls.end

    def patiently(polls: Polls, least_s: float) -> Vesc:
        until(lambda: polls._source.counts.samples > 1, "a VESC's answers")
        return end(polls, least_s)

    monkeypatch.setattr(Polls, "end", patiently)


def test_a_vesc_is_found_by_its_answer(tmp_path: Path) -> None:
    with VescStandin(tmp_path / "vesc") as vesc:
        clock = SystemClock()
        polls = Polls(str(vesc.link), clock)
        until(lambda: polls._source.counts.samples > 1, "a VESC's answers")
        assert polls.end(0.2).samples > 1
        vesc.answer = lambda _frame, _n: []
        assert Polls(str(vesc.link), clock).end(0.2).why == "no VESC answers there"


@pytest.mark.usefixtures("patient")
def test_a_vesc_beside_a_graph_gets_a_stream_of_its_own(tmp_path: Path) -> None:
    clock = ManualClock()
    with VescStandin(tmp_path / "vesc") as vesc:
        robot = Robot(tmp_path, FakeNode(clock, CAR), clock=clock, at=[str(vesc.link)])
        robot._clock = SystemClock()  # a port's answers take real time
        text = robot.init("/sensors/core", listen_s=0.5).read_text()
    _, source = yaml.safe_load(text)["sources"]
    assert source == {"type": "vesc", "port": str(vesc.link), "stream": "vesc-2", "rate_hz": 50}


def test_ports_are_those_of_an_stm32_and_the_one_that_udev_names(tmp_path: Path) -> None:
    dev, sysfs = tmp_path / "dev", tmp_path / "sys"
    by_id = dev / "serial" / "by-id"
    by_id.mkdir(parents=True)
    for name, ids in (
        ("ttyACM0", ("0483", "5740")),
        ("ttyACM1", ("2341", "0043")),
        ("ttyACM2", ("0483", "5740")),
    ):
        (dev / name).touch()
        usb = tmp_path / "usb" / name
        (usb / "interface").mkdir(parents=True)
        for file, text in zip(("idVendor", "idProduct"), ids):
            (usb / file).write_text(f"{text}\n")
        (sysfs / name).mkdir(parents=True)
        (sysfs / name / "device").symlink_to(usb / "interface")
    (by_id / "usb-a").symlink_to(dev / "ttyACM0")
    (by_id / "usb-b").symlink_to(dev / "ttyACM1")
    assert list(ports(dev, sysfs)) == [str(by_id / "usb-a"), str(dev / "ttyACM2")]
    (dev / "vesc").symlink_to(dev / "ttyACM2")
    assert list(ports(dev, sysfs)) == [str(dev / "vesc"), str(by_id / "usb-a")]


def test_the_command_says_what_to_do_next(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("iort_agent.verbs.init.init", lambda out, **_options: out.with_name("car.new.yaml"))
    assert cli.main(["init", "--out", str(tmp_path / "car.yaml"), "--topic", "/a", "/b"]) == 0
    assert f"mv {tmp_path}/car.new.yaml {tmp_path}/car.yaml && iort-agent check" in capsys.readouterr().out
