"""The picture of an incident: made from parts of its file, and never more than it may cost."""

from __future__ import annotations

import hashlib
import io
import json
import struct
import zlib

import numpy as np
import pytest
from botocore.exceptions import ConnectTimeoutError, ReadTimeoutError
from mcap.writer import CompressionType, Writer
from PIL import Image
from rosbags.typesys import Stores, get_typestore

from iort_contract.messages.files import File, file_key
from iort_contract.messages.recorder import CHANNEL_STREAM
from iort_station.data import pictures
from iort_station.data.pictures import SIDE, Picture, picture
from iort_station.errors import StationError
from iort_station.fleet import files
from testkit.dynamodb import FILES
from tests.images import jpeg
from tests.unit.station.fleet.test_recorder import START, Lab

S_NS, US = 1_000_000_000, 1_000
EDGE_US, FROM_US = START + 30_000_000, START
# The ring's clock is 7 s off the robot's.
RING_US = START + 7_000_000
STORES = {"ros1": get_typestore(Stores.ROS1_NOETIC), "ros2": get_typestore(Stores.ROS2_JAZZY)}
COMPRESSED, RAW = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"
BRAKE = "current_input < -15 and speed_mps > 2"


def incident_file(fill, *, when=BRAKE, compression=CompressionType.ZSTD, **about):
    """An incident's file: ``fill`` writes its messages."""
    out = io.BytesIO()
    writer = Writer(out, compression=compression, chunk_size=200_000)
    writer.start("", "test")
    fill(writer)
    known = {
        "edge_us": str(EDGE_US),
        "from_us": str(FROM_US),
        "ring_from_us": str(RING_US),
        "ring_to_us": str(RING_US + 40_000_000),
        "edges": json.dumps([{"trigger": "brake", "t_us": EDGE_US, "when": when}]),
    }
    writer.add_metadata("iort.incident", {**known, **about})
    writer.finish()
    return out.getvalue()


def vesc(writer, **fields):
    """Half a minute of the serial VESC: JSON, whose current jumps at the edge."""
    schema = {"properties": {name: {} for name in ("current_input", "speed", "state", *fields)}}
    schema_id = writer.register_schema("iort.vesc", "jsonschema", json.dumps(schema).encode())
    channel = writer.register_channel("vesc", "json", schema_id, {CHANNEL_STREAM: "vesc"})
    for i in range(2000):
        at = (RING_US + i * 20_000) * US
        values = {"current_input": -20.0 if i >= 1500 else 3.0, "speed": 5000.0, "state": "ok", **fields}
        writer.add_message(channel, at, json.dumps(values).encode(), at, i)


def topic(writer, ros, kind, name="/camera"):
    """A channel of ROS 1 or ROS 2, and what writes a message to it."""
    store, ros2 = STORES[ros], ros == "ros2"
    named = kind if ros2 else kind.replace("/msg", "")
    text = store.generate_msgdef(kind, ros_version=2 if ros2 else 1)[0]
    schema = writer.register_schema(named, "ros2msg" if ros2 else "ros1msg", text.encode())
    channel = writer.register_channel(name, "cdr" if ros2 else "ros1", schema, {CHANNEL_STREAM: "camera"})
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
    sequence = {} if ros2 else {"seq": 0}
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera", **sequence)

    def write(after_s, **fields):
        content = types[kind](header=header, **fields)
        data = bytes(store.serialize_cdr(content, kind) if ros2 else store.serialize_ros1(content, kind))
        at = (RING_US + EDGE_US - FROM_US) * US + round(after_s * S_NS)
        writer.add_message(channel, at, data, at, 0)

    return write


def compressed(content, kind="jpeg"):
    return {"format": kind, "data": np.frombuffer(content, np.uint8)}


def raw(pixels, encoding, step=0, *, big=0):
    """An image as pixels, with ``step`` unused bytes at the end of each row."""
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(pixels.shape[0], -1)
    rows = np.pad(rows, ((0, 0), (0, step)))
    about = {"height": pixels.shape[0], "width": pixels.shape[1], "encoding": encoding, "is_bigendian": big}
    return {**about, "step": rows.shape[1], "data": rows.reshape(-1)}


def plain(colour, size=(64, 48), kind="PNG"):
    out = io.BytesIO()
    Image.new("RGB", size, colour).save(out, kind)
    return out.getvalue()


class Bucket:
    """Counts what is fetched of the bucket."""

    def __init__(self, client):
        self._client, self.fetched = client, []

    def __getattr__(self, name):
        return getattr(self._client, name)

    def get_object(self, **asked):
        answer = self._client.get_object(**asked)
        self.fetched.append(answer["ContentLength"])
        return answer


@pytest.fixture
def look(s3):
    """The picture of a file's content, and what was fetched for it."""

    def made(content):
        digest = hashlib.sha256(content).hexdigest()
        key = file_key("car", File("i.mcap", "recording", "application/x-mcap", len(content), digest, START))
        s3.put_object(Bucket=FILES, Key=key, Body=content)
        lab = Lab()
        lab.bucket = Bucket(s3)
        found = picture(lab, files.stored(lab, key))
        return found, lab.bucket.fetched

    return made


def colour_of(found):
    """The colour in the middle of a picture."""
    with Image.open(io.BytesIO(found.jpeg), formats=("JPEG",)) as image:
        assert max(image.size) <= SIDE
        return image.convert("RGB").getpixel((image.width // 2, image.height // 2))


def near(found, colour):
    return np.abs(np.subtract(colour_of(found), colour)).max() < 40


@pytest.mark.parametrize("ros", ["ros1", "ros2"])
@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
def test_it_is_the_image_nearest_to_the_edge_and_only_a_part_is_fetched(look, ros, compression):
    """Its time is the ring's, which is off the robot's by seconds."""

    def fill(writer):
        vesc(writer)
        write = topic(writer, ros, COMPRESSED)
        for i in range(-200, 60):
            # Only that at the edge is red; the others are large.
            content = plain((255, 0, 0), kind="JPEG") if i == 0 else jpeg(abs(i) % 7, width=320, height=240)
            write(i * 0.1 + 0.02, **compressed(content))

    content = incident_file(fill, compression=compression)
    found, fetched = look(content)
    assert near(found, (255, 0, 0))
    assert (found.topic, found.line) == ("/camera", None)
    assert found.after_s == pytest.approx(0.02)
    assert sum(fetched) < len(content) / 4
    assert len(fetched) < 12


@pytest.mark.parametrize("ros", ["ros1", "ros2"])
@pytest.mark.parametrize(
    ("encoding", "pixels", "colour"),
    [
        ("rgb8", np.full((48, 64, 3), (250, 10, 10), np.uint8), (250, 10, 10)),
        ("bgr8", np.full((48, 64, 3), (10, 10, 250), np.uint8), (250, 10, 10)),
        ("bgra8", np.full((48, 64, 4), (10, 10, 250, 9), np.uint8), (250, 10, 10)),
        ("rgba8", np.full((48, 64, 4), (10, 250, 10, 9), np.uint8), (10, 250, 10)),
        ("mono8", np.full((48, 64, 1), 130, np.uint8), (130, 130, 130)),
        ("bayer_rggb8", np.tile(np.array([[250, 9], [9, 90]], np.uint8), (24, 32))[..., None], (250, 9, 90)),
        ("bayer_gbrg8", np.tile(np.array([[9, 90], [250, 9]], np.uint8), (24, 32))[..., None], (250, 9, 90)),
        # Red as Y 76, U 85, V 255: two values a pixel.
        ("uyvy", np.tile(np.array([[85, 76], [255, 76]], np.uint8), (48, 32, 1)), (254, 0, 0)),
        ("yuv422_yuy2", np.tile(np.array([[76, 85], [76, 255]], np.uint8), (48, 32, 1)), (254, 0, 0)),
    ],
)
def test_raw_images_are_read_in_the_usual_encodings(look, ros, encoding, pixels, colour):
    def fill(writer):
        topic(writer, ros, RAW)(0.5, **raw(pixels, encoding, step=6))

    assert near(look(incident_file(fill))[0], colour)


def test_a_large_raw_image_and_depths_become_small(look):
    large = np.zeros((2160, 3840, 3), np.uint8)
    large[..., 1] = 200
    found = look(incident_file(lambda writer: topic(writer, "ros2", RAW)(0, **raw(large, "rgb8"))))[0]
    assert near(found, (0, 200, 0))
    for kind, encoding, big in (("<u2", "16UC1", 0), (">u2", "mono16", 1), ("<f4", "32FC1", 0)):
        depths = np.repeat(np.linspace(0, 4000, 64), 48).reshape(64, 48).T[..., None].astype(kind)

        def fill(writer, depths=depths, encoding=encoding, big=big):
            topic(writer, "ros1", RAW)(0, **raw(depths, encoding, big=big))

        assert near(look(incident_file(fill))[0], (127, 127, 127))


def test_without_an_image_it_is_the_conditions_field_around_the_edge(look):
    found, fetched = look(incident_file(vesc))
    assert (found.jpeg, found.line.field) == (b"", "current_input")
    times_s, values = np.array(found.line.times_s), np.array(found.line.values)
    assert 100 <= len(times_s) <= 200
    assert times_s[0] >= -15
    assert times_s[-1] == pytest.approx(10, abs=0.3)
    assert (values[times_s < -0.01] == 3).all()
    assert (values[times_s > 0.2] == -20).all()
    assert len(fetched) < 12


@pytest.mark.parametrize(
    ("when", "field"),
    [
        ("speed_mps > 2", "speed"),
        ("delta(speed, 1s) < -3000", "speed"),
        ("camera.x > 3 or height > 5", "height"),
        # Neither has a number that the file knows.
        ("stop", "speed"),
        ("state == 'bad'", "speed"),
        ("silent(imu, 1s)", "speed"),
        ("x >", "speed"),
    ],
)
def test_derived_fields_and_those_of_topics_are_drawn_or_else_the_speed(look, when, field):
    def fill(writer):
        vesc(writer)
        write = topic(writer, "ros2", RAW.replace("Image", "FluidPressure"), "/height")
        for i in range(-50, 50):
            write(i / 10, fluid_pressure=float(i), variance=0.0)

    when = when.replace("height", "fluid_pressure")
    found = look(incident_file(fill, when=when))[0]
    assert found.line.field == field.replace("height", "fluid_pressure")


def test_what_cannot_be_shown_gives_way_to_what_can(look):
    def fill(writer):
        vesc(writer)
        # Depths in a form of their own, an image of another kind, and a broken one.
        topic(writer, "ros2", COMPRESSED, "/a")(
            0, **compressed(b"12bytesahead" + plain("red"), "compressedDepth")
        )
        topic(writer, "ros2", COMPRESSED, "/b")(0, **compressed(jpeg()[:100]))
        topic(writer, "ros2", RAW, "/c")(0, **raw(np.zeros((4, 4, 3), np.uint8), "nv12"))

    assert look(incident_file(fill))[0].line.field == "current_input"


def bomb(width, height):
    """A PNG that claims such a size in few bytes."""

    def part(name, content):
        return (
            struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))
        )

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + part(b"IHDR", head)
        + part(b"IDAT", zlib.compress(bytes(1000)))
        + part(b"IEND", b"")
    )


@pytest.mark.parametrize("size", [(5000, 4001), (30_000, 30_000), (60_000, 60_000)])
def test_an_image_that_claims_to_be_vast_is_not_decoded(look, size):
    def fill(writer):
        topic(writer, "ros1", COMPRESSED)(0, **compressed(bomb(*size), "png"))

    assert look(incident_file(fill))[0] == Picture()


def test_a_jpeg_of_many_passes_is_not_decoded(look):
    out = io.BytesIO()
    Image.new("RGB", (640, 480), (255, 0, 0)).save(out, "JPEG", progressive=True)
    usual = out.getvalue()
    last = usual[usual.rindex(b"\xff\xda") : -2]
    found = [
        look(incident_file(lambda w, c=content: topic(w, "ros1", COMPRESSED)(0, **compressed(c))))[0]
        for content in (usual, usual[:-2] + 100 * last + usual[-2:])
    ]
    assert near(found[0], (255, 0, 0))
    assert found[1] == Picture()


def test_an_image_of_pixels_that_are_not_there_is_not_made(look):
    about = {**raw(np.zeros((4, 4, 3), np.uint8), "rgb8")}
    for wrong in ({"width": 100_000, "height": 100_000}, {"step": 0}, {"height": 0}, {"step": 2**32 - 1}):

        def fill(writer, wrong=wrong):
            topic(writer, "ros1", RAW)(0, **{**about, **wrong})

        assert look(incident_file(fill))[0] == Picture()


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_chunk_that_unpacks_to_more_than_it_may_is_not_unpacked(compression):
    import lz4.frame
    import zstandard

    vast = bytes(pictures._MOST_UNPACKED + 1)
    packed = (zstandard.compress if compression == "zstd" else lz4.frame.compress)(vast)
    assert len(packed) < 1_000_000
    with pytest.raises(ValueError, match="too large"):
        pictures._unpacked(compression, packed)


def test_a_file_that_is_none_or_damaged_has_no_picture(look):
    whole = incident_file(vesc)
    for content in (
        b"",
        b"no file of messages",
        whole[: len(whole) // 2],
        whole[:8] + bytes(5000) + whole[-37:],
    ):
        assert look(content)[0] == Picture()
    rng = np.random.default_rng(1)
    for _ in range(60):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(whole), 40):
            damaged[at] = int(rng.integers(0, 256))
        assert isinstance(look(bytes(damaged))[0], Picture)
    assert look(incident_file(vesc, edge_us="soon"))[0] == Picture()
    assert look(incident_file(lambda _writer: None))[0] == Picture()


def test_no_more_is_fetched_than_it_may(look, monkeypatch):
    monkeypatch.setattr(pictures, "_SUMMARY_BYTES", 200_000)
    monkeypatch.setattr(pictures, "_MOST_BYTES", 100_000)

    def fill(writer):
        topic(writer, "ros1", RAW)(
            0, **raw(np.random.default_rng(0).integers(0, 255, (600, 800, 3), np.uint8), "rgb8")
        )

    found, fetched = look(incident_file(fill))
    assert found == Picture()
    assert sum(fetched) <= 300_000


def test_no_more_is_asked_for_than_it_may_in_however_small_parts(s3):
    s3.put_object(Bucket=FILES, Key="robots/car/a", Body=bytes(500_000))
    lab = Lab()
    lab.bucket = Bucket(s3)
    file = files.Ranged(
        lab, files.StoredFile("robots/car/a", "car", "a", 500_000, 0, 0.0), 10 * files._BLOCK_BYTES
    )

    def backwards():
        for at in range(1, 1000):
            file.seek(-at, io.SEEK_END)
            file.read(1)

    with pytest.raises(ValueError, match="too much"):
        backwards()
    assert len(lab.bucket.fetched) == 10


def test_no_more_is_unpacked_than_it_may_however_often_it_is_named(look, monkeypatch):
    """Two chunks whose messages take turns: each point needs the other one."""

    def fill(writer):
        schema = json.dumps({"properties": {"speed": {}}}).encode()
        channel = writer.register_channel(
            "vesc",
            "json",
            writer.register_schema("iort.vesc", "jsonschema", schema),
            {CHANNEL_STREAM: "vesc"},
        )
        for first in (0, 1):
            for i in range(first, 200, 2):
                at = (RING_US + EDGE_US - FROM_US + i * 10_000) * US
                writer.add_message(channel, at, json.dumps({"speed": i, "more": "x" * 500}).encode(), at, i)
            writer.flush()

    content = incident_file(fill)
    assert look(content)[0].line.values == list(range(200))
    monkeypatch.setattr(pictures, "_MOST_WORK", 3_000_000)
    assert look(content)[0] == Picture()


@pytest.mark.parametrize("failure", [ConnectTimeoutError, ReadTimeoutError])
def test_a_bucket_that_is_late_is_told_and_not_taken_for_a_damaged_file(failure):
    class Late:
        def get_object(self, **_asked):
            raise failure(endpoint_url="https://bucket")

    lab = Lab()
    lab.bucket = Late()
    with pytest.raises(StationError, match="https://bucket"):
        picture(lab, files.StoredFile("robots/car/none", "car", "none", 5000, 0, 0.0))


def test_a_bucket_that_does_not_answer_is_told(s3):
    lab = Lab()
    lab.bucket = s3
    with pytest.raises(s3.exceptions.NoSuchKey):
        picture(lab, files.StoredFile("robots/car/none", "car", "none", 5000, 0, 0.0))
