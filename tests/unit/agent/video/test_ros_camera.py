"""Topics of images as a camera: the encodings, damaged messages, and the newest picture alone."""

from __future__ import annotations

import base64
import io
import threading
from collections import deque
from typing import Any, Callable

import pytest
from PIL import Image

from iort_agent.errors import VideoError
from iort_agent.ros import Graph
from iort_agent.ros.json_message import Writer
from iort_agent.video import Frame
from iort_agent.video.config import TopicCamera, VideoConfig
from iort_agent.video.ros_camera import MOST_PIXELS, RosCamera
from iort_contract.ros.definition import Definition, layout, parse
from testkit.agent import ManualClock
from tests.unit.agent.control.downlink_rig import FakeGraph
from tests.unit.agent.video.pictures import ENCODED, GREYS, SIZE, colour_at, yuv

TOPIC = "/camera/image"
CONFIG = VideoConfig(TopicCamera(TOPIC), width=SIZE, height=SIZE, rate_hz=10)
_RULE = "=" * 80
_HEADER = {1: "uint32 seq\ntime stamp\nstring frame_id", 2: "builtin_interfaces/Time stamp\nstring frame_id"}
_TIME = f"\n{_RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec"
_BODIES = {
    "Image": "uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data",
    "CompressedImage": "string format\nuint8[] data",
    "Joy": "float32[] axes",
}


def definition(name: str, ros: int) -> Definition:
    kind = f"sensor_msgs/{name}" if ros == 1 else f"sensor_msgs/msg/{name}"
    text = f"std_msgs/Header header\n{_BODIES[name]}\n{_RULE}\nMSG: std_msgs/Header\n{_HEADER[ros]}"
    return parse(kind, text + (_TIME if ros == 2 else ""))


class Waits(ManualClock):
    """Whoever waits lets the next thing happen."""

    def __init__(self) -> None:
        super().__init__()
        self.then: deque[Callable[[], object]] = deque()

    def wait(self, event: threading.Event, seconds: float | None) -> bool:
        if self.then:
            self.advance(0.2)
            self.then.popleft()()
        return super().wait(event, seconds)


class Rig:
    """A camera on a topic of a graph in memory, whose messages have the form of a ROS."""

    def __init__(self, ros: int = 1, config: VideoConfig = CONFIG) -> None:
        self.clock, self.ros, self.stop = Waits(), ros, threading.Event()
        self.graph = FakeGraph()
        graph: Graph = self.graph
        self.camera = RosCamera(graph, TOPIC, config, self.clock)
        self.camera.open()
        self.number = 0

    def hear(self, name: str, *, age_s: float = 0.0, **values: Any) -> None:
        stamp_us = self.clock.now_us() - round(age_s * 1e6)
        header = {
            **({"seq": 0} if self.ros == 1 else {}),
            "stamp": {"sec": stamp_us // 1_000_000, "nanosec": stamp_us % 1_000_000 * 1000},
            "frame_id": "camera",
        }
        told = definition(name, self.ros)
        if "data" in values:
            values["data"] = base64.b64encode(values["data"]).decode()
        self.hear_bytes(name, Writer(told).write({"header": header, **values}))

    def hear_bytes(self, name: str, data: bytes) -> None:
        told = definition(name, self.ros)
        self.graph._handlers[TOPIC]({"type": told.kind, "message_definition": layout(told)}, data)

    def image(self, shown: str, rows: list[bytes], *, big: bool = False, gap: int = 0, **values: Any) -> None:
        step = len(rows[0]) + gap
        image = {"height": SIZE, "width": SIZE, "encoding": shown, "is_bigendian": int(big), "step": step}
        data = b"".join(row + bytes(gap) for row in rows)
        self.hear("Image", **{**image, "data": data, **values})

    def read(self) -> Frame:
        self.number += 1
        frame = self.camera.read(self.number, self.stop)
        assert frame is not None
        return frame


def quarters(frame: Frame) -> list[tuple[int, int, int]]:
    """The colours in the middle of the picture's quarters."""
    seen = []
    width, height = frame.picture.width, frame.picture.height
    for x, y in ((1, 1), (3, 1), (1, 3), (3, 3)):
        y_, u, v = (
            memoryview(plane)[y * height // 4 // half * plane.line_size + x * width // 4 // half]
            for plane, half in zip(frame.picture.planes, (1, 2, 2))
        )
        seen.append((y_, u, v))
    return seen


PLACES = [
    (SIZE // 4, SIZE // 4),
    (3 * SIZE // 4, SIZE // 4),
    (SIZE // 4, 3 * SIZE // 4),
    (3 * SIZE // 4,) * 2,
]
COLOURS = [yuv(colour_at(*place)) for place in PLACES]
GREY_COLOURS = [yuv((sum(colour_at(*place)) // 3,) * 3) for place in PLACES]


def assert_near(seen: list[tuple[int, int, int]], expected: list[tuple[int, int, int]]) -> None:
    off = [abs(a - b) for one, other in zip(seen, expected) for a, b in zip(one, other)]
    assert max(off) <= 4, (seen, expected)


@pytest.mark.parametrize("gap", [0, 6])
@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize(("encoding", "big"), ENCODED)
def test_an_encoding_has_its_colours(encoding: str, big: bool, ros: int, gap: int) -> None:
    rig = Rig(ros)
    rig.image(encoding, ENCODED[encoding, big], big=big, gap=gap)
    frame = rig.read()
    assert (frame.picture.format.name, frame.picture.width, frame.number) == ("yuv420p", SIZE, 1)
    assert_near(quarters(frame), COLOURS)


@pytest.mark.parametrize(("encoding", "big"), GREYS)
def test_grey_is_grey(encoding: str, big: bool) -> None:
    rig = Rig()
    rig.image(encoding, GREYS[encoding, big], big=big)
    assert_near(quarters(rig.read()), GREY_COLOURS)


def compressed(form: str, *, width: int = SIZE, height: int = SIZE, **options: Any) -> bytes:
    image, out = Image.new("RGB", (width, height)), io.BytesIO()
    for y in range(height):
        for x in range(width):
            image.putpixel((x, y), colour_at(x * SIZE // width, y * SIZE // height))
    image.save(out, form, **options)
    return out.getvalue()


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize(
    "content", [compressed("JPEG", quality=95), compressed("JPEG", progressive=True), compressed("PNG")]
)
def test_a_compressed_image_has_its_colours(content: bytes, ros: int) -> None:
    rig = Rig(ros)
    rig.hear("CompressedImage", format="rgb8; jpeg compressed", data=content)
    frame = rig.read()
    assert_near(quarters(frame), COLOURS)
    # A JPEG is kept as it was.
    assert frame.jpeg == (content if content.startswith(b"\xff\xd8") else None)


def test_a_picture_of_another_shape_is_between_black_bars() -> None:
    rig = Rig()
    rig.hear("CompressedImage", format="png", data=compressed("PNG", width=128, height=64))
    frame = rig.read()
    rows = memoryview(frame.picture.planes[0])
    lines = [rows[y * frame.picture.planes[0].line_size + 8] for y in (4, 24, 40, 60)]
    assert lines[0] == lines[3] == 16
    assert lines[1] > 60
    assert lines[2] > 60


GOOD = ENCODED["rgb8", False]
DAMAGED: dict[str, dict[str, Any]] = {
    "another encoding": {"encoding": "32FC1"},
    "a step that is too short": {"step": SIZE * 3 - 1},
    "too few bytes": {"data": b"".join(GOOD)[:-1]},
    "no bytes": {"data": b""},
    "no width": {"width": 0},
    "a huge size": {"width": 2**31, "height": 2**31},
    "many pixels": {"width": MOST_PIXELS, "height": 2, "step": 2**32 - 1},
    "an odd width in pairs": {"encoding": "yuv422", "width": SIZE - 1},
    "an odd height in squares": {"encoding": "nv12", "height": SIZE - 1},
}


@pytest.mark.parametrize("values", DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_image_is_counted_and_the_next_is_taken(
    values: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    rig = Rig()
    rig.image("rgb8", GOOD, **values)
    rig.clock.then.append(lambda: rig.image("rgb8", GOOD))
    assert_near(quarters(rig.read()), COLOURS)
    assert rig.camera.report() == {"bad": 1}
    (record,) = caplog.records
    assert TOPIC in record.message


@pytest.mark.parametrize(
    "content",
    [
        b"neither",
        compressed("JPEG")[:200],
        compressed("PNG")[:-60],
        compressed("BMP"),
        compressed("JPEG", progressive=True).replace(b"\xff\xda", b"\xff\xda" * 100),
    ],
    ids=["neither", "half a JPEG", "half a PNG", "another format", "a JPEG of many scans"],
)
def test_a_damaged_compressed_image_is_counted_and_the_next_is_taken(content: bytes) -> None:
    rig = Rig(2)
    rig.hear("CompressedImage", format="jpeg", data=content)
    rig.clock.then.append(lambda: rig.hear("CompressedImage", format="jpeg", data=compressed("JPEG")))
    assert_near(quarters(rig.read()), COLOURS)
    assert rig.camera.report() == {"bad": 1}


def test_a_message_of_another_type_or_cut_off_is_counted() -> None:
    rig = Rig()
    rig.hear("Joy", axes=[1.0])
    rig.clock.then.append(lambda: rig.hear_bytes("Image", b"short"))
    rig.clock.then.append(lambda: rig.image("rgb8", GOOD))
    rig.read()
    assert rig.camera.report() == {"bad": 2}


def test_a_silent_topic_raises_and_says_what_was_wrong_with_the_last() -> None:
    rig = Rig()
    with pytest.raises(VideoError, match=r"the topic /camera/image gave no picture for 10 s$"):
        rig.read()
    rig.image("rgb8", GOOD)
    rig.read()
    with pytest.raises(VideoError, match=r"gave no picture for 2 s$"):
        rig.read()
    rig.image("32FC1", GOOD)
    with pytest.raises(VideoError, match="for 2 s, the last: an image's encoding must be one of mono8"):
        rig.read()


def test_only_the_newest_picture_waits() -> None:
    rig = Rig()
    for colour in (10, 120, 200):
        rig.image("mono8", [bytes([colour]) * SIZE] * SIZE)
        rig.clock.advance(0.1)
    frame = rig.read()
    assert_near(quarters(frame), [yuv((200, 200, 200))] * 4)
    assert frame.captured_us == rig.clock.now_us() - 100_000
    assert frame.monotonic == pytest.approx(rig.clock.monotonic() - 0.1)
    with pytest.raises(VideoError, match="gave no picture"):
        rig.read()


def test_pictures_beyond_the_rate_are_left_out() -> None:
    rig, stamps = Rig(), []
    for _ in range(60):
        rig.image("rgb8", GOOD)
        if rig.camera._newest._item is not None:
            stamps.append(rig.read().monotonic)
        rig.clock.advance(1 / 30)
    assert len(stamps) == 20, "10 of 30 a second"


@pytest.mark.parametrize(
    ("age_s", "believed"), [(0.3, True), (4.9, True), (5.1, False), (-0.5, False), (1e9, False)]
)
def test_a_stamp_that_can_be_is_the_capture_time(age_s: float, believed: bool) -> None:
    rig = Rig()
    rig.image("rgb8", GOOD, age_s=age_s)
    now_us, now = rig.clock.now_us(), rig.clock.monotonic()
    frame = rig.read()
    off_s = age_s if believed else 0.0
    assert frame.captured_us == now_us - round(off_s * 1e6)
    assert frame.monotonic == pytest.approx(now - off_s)


def test_pictures_that_are_late_when_they_come_are_told(caplog: pytest.LogCaptureFixture) -> None:
    rig = Rig()
    rig.image("rgb8", GOOD, age_s=0.5)
    rig.read()
    assert rig.camera.report() == {}
    rig.image("rgb8", GOOD, age_s=1.2)
    rig.clock.advance(0.2)
    rig.image("rgb8", GOOD, age_s=1.2)
    rig.read()
    assert rig.camera.report() == {"late": 1}
    assert "/camera/image gives pictures that are 1.2 s old by their stamps" in caplog.text


@pytest.mark.parametrize("age_s", [0.0, 30.0])
def test_a_picture_that_is_repeated_shows_nothing_new(age_s: float) -> None:
    rig = Rig()
    rig.image("rgb8", GOOD, age_s=age_s)
    rig.read()
    began = rig.clock.monotonic()

    def again() -> None:
        rig.image("rgb8", GOOD, age_s=age_s + rig.clock.monotonic() - began)
        rig.clock.then.append(again)

    rig.clock.then.append(again)
    with pytest.raises(VideoError, match="for 2 s, the last: it has the stamp of the one before"):
        rig.read()


def test_pictures_without_stamps_are_each_new() -> None:
    rig = Rig()
    for _ in range(3):
        rig.clock.advance(0.2)
        rig.image("rgb8", GOOD, age_s=rig.clock.now_us() / 1e6)
        assert rig.read().monotonic == rig.clock.monotonic()


def test_reading_ends_when_nobody_looks_and_the_topic_is_left() -> None:
    rig = Rig()
    rig.clock.then.append(rig.stop.set)
    assert rig.camera.read(1, rig.stop) is None
    rig.camera.close()
    assert TOPIC not in rig.graph._handlers
