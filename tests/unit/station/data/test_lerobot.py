"""Datasets for learning: fields and images at even steps, in the files that LeRobot reads."""

from __future__ import annotations

import io
import json
import os
import subprocess

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.writer import Writer
from PIL import Image
from rosbags.typesys import Stores, get_typestore

from iort_contract.catalog.derived import Vehicle
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.messages.batch import Batch
from iort_contract.ros.message import Messages, MessageType, RosType
from iort_contract.topics import RECORD, build_topic
from iort_station.data.episodes import Field, Kept, Shape, Stored, episodes, usual_fields
from iort_station.data.images import Images
from iort_station.data.lerobot import write
from iort_station.errors import StationError
from iort_station.output import whole_folder
from testkit.dynamodb import TELEMETRY, item_of
from tests.conftest import NO_LEROBOT
from tests.unit.station.data.test_queries import START, cloud_of

ROS1 = get_typestore(Stores.ROS1_NOETIC)
PICTURES = "sensor_msgs/msg/CompressedImage"
DEFINITION, MD5 = ROS1.generate_msgdef(PICTURES)
CAMERA = RosType("/camera", "sensor_msgs/CompressedImage", MD5, DEFINITION)
DECLARED = MessageType("camera", CAMERA.topic, CAMERA.name, MD5, DEFINITION)
SPEED, SERVO = Field("vesc", "speed"), Field("servo", "data")
SHAPE = Shape(fps=10, state=(SPEED,), action=(SERVO, SPEED), cameras=("camera",))
SECOND = 1_000_000


def picture(brightness, size=(64, 48)):
    """A JPEG of one brightness."""
    file = io.BytesIO()
    Image.new("RGB", size, (brightness,) * 3).save(file, "JPEG")
    return file.getvalue()


def message(content, t_us=START):
    stamp = ROS1.types["builtin_interfaces/msg/Time"](t_us // SECOND, t_us % SECOND * 1000)
    header = ROS1.types["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id="")
    data = np.frombuffer(content, dtype=np.uint8)
    return bytes(ROS1.serialize_ros1(ROS1.types[PICTURES](header, "jpeg", data), PICTURES))


def recorded(*, seconds=3, images=None, speeds=None):
    """A car with 20 values a second of two streams, and 5 images a second, each 10 brighter than the last."""
    cloud = cloud_of()

    def put(stream, batch):
        cloud.table.put(TELEMETRY, item_of(batch, build_topic(RECORD, "car", stream)))

    for second in range(seconds):
        times = [START + second * SECOND + i * 50_000 for i in range(20)]
        numbers = [second * 20 + i for i in range(20)]
        put("vesc", Batch("0badcafe", second, times, {"speed": (speeds or {}).get(second, numbers)}))
        put("servo", Batch("0badcafe", second, times, {"data": [n / 100 for n in numbers]}))
    put("types", Batch("0badcafe", 0, [START], {k: [v] for k, v in DECLARED.sample().items()}))
    contents = [picture(10 * i) for i in range(5 * seconds)] if images is None else images
    for i, content in enumerate(contents):
        messages = Messages(CAMERA.id, CAMERA.layout, [message(content)])
        put("camera", Batch("0badcafe", i, [START + i * 200_000], {}, 0, messages))
    return Stored(cloud, "car", START, START + seconds * SECOND, {"robot": "car", "run": "0badcafe"})


def written(tmp_path, *sources, shape=SHAPE):
    out = tmp_path / "dataset"
    counts = write(out, sources, shape, task="drive", robot="car", units={SPEED: "erpm"})
    return out, counts


def brightness(path):
    with av.open(str(path)) as file:
        return [float(frame.to_ndarray(format="rgb24").mean()) for frame in file.decode(video=0)]


def test_a_step_has_the_last_values_and_the_last_image_before_it(tmp_path):
    out, counts = written(tmp_path, recorded())
    assert (counts.episodes, counts.frames, counts.damaged, counts.resized) == (1, 30, 0, 0)
    table = pq.read_table(out / "data/chunk-000/file-000.parquet")
    assert table["observation.state"].to_pylist() == [2 * i for i in range(30)]
    assert np.allclose(table["action"].to_pylist(), [[i / 50, 2 * i] for i in range(30)])
    assert np.allclose(table["timestamp"].to_pylist(), [i / 10 for i in range(30)])
    assert table["index"].to_pylist() == table["frame_index"].to_pylist() == list(range(30))
    shown = brightness(out / "videos/observation.images.camera/chunk-000/file-000.mp4")
    assert np.abs(np.array(shown) - [10 * (i // 2) for i in range(30)]).max() < 4


def test_the_files_say_what_they_are(tmp_path):
    out, _ = written(tmp_path, recorded(), recorded())
    info = json.loads((out / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_frames"]) == ("v3.0", 10, 60)
    assert info["features"]["observation.state"] == {
        "dtype": "float32",
        "shape": [1],
        "names": ["vesc.speed"],
    }
    assert info["features"]["observation.images.camera"]["shape"] == [48, 64, 3]
    statistics = json.loads((out / "meta/stats.json").read_text())
    assert statistics["observation.state"]["max"] == [58]
    assert np.allclose(statistics["observation.images.camera"]["max"], [[[140 / 255]]] * 3, atol=0.02)
    rows = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(row["dataset_from_index"], row["dataset_to_index"]) for row in rows] == [(0, 30), (30, 60)]
    about = json.loads((out / "meta/iort.json").read_text())
    assert about["units"] == {"vesc.speed": "erpm", "servo.data": ""}
    first = about["episodes"][0]
    assert (first["robot"], first["run"], first["from_us"]) == ("car", "0badcafe", START)


def test_an_episode_ends_where_a_value_is_not_known(tmp_path):
    source = recorded(seconds=6, speeds={2: [None] * 20, 3: [None] * 20})
    found = list(episodes(source, Shape(fps=10, state=(SPEED,), action=(SERVO,))))
    spans = [((int(e.times_us[0]) - START) / SECOND, (int(e.times_us[-1]) - START) / SECOND) for e in found]
    # The last value, of 1.95 s, holds for a second.
    assert spans == [(0.0, 2.9), (4.0, 5.9)]


def test_a_step_before_the_first_image_is_left_out(tmp_path):
    _, counts = written(tmp_path, recorded(seconds=4, images=[]), recorded(seconds=2))
    assert (counts.episodes, counts.frames) == (1, 20)


def test_images_of_another_size_are_resized_and_damaged_ones_counted(tmp_path):
    images = [picture(100), picture(100, (32, 32)), b"no image", b"", *[picture(100)] * 6]
    out, counts = written(tmp_path, recorded(seconds=2, images=images))
    assert (counts.frames, counts.not_kept, counts.damaged, counts.resized) == (20, 1, 1, 1)
    assert len(brightness(out / "videos/observation.images.camera/chunk-000/file-000.mp4")) == 20


def test_an_episode_begins_with_the_first_image_that_can_be_shown(tmp_path):
    later = recorded(seconds=3, images=[b"no image", b"", *[picture(100)] * 13])
    none = recorded(seconds=3, images=[b"no image"] * 15)
    short = recorded(seconds=2, images=[*[b"no image"] * 8, picture(100), picture(100)])
    out, counts = written(tmp_path, later, none, short, recorded(seconds=2))
    assert (counts.episodes, counts.frames, counts.not_kept, counts.damaged) == (2, 26 + 20, 1, 1 + 15 + 8)
    table = pq.read_table(out / "data/chunk-000/file-000.parquet")
    assert table["observation.state"].to_pylist() == [2 * i for i in range(4, 30)]
    shown = brightness(out / "videos/observation.images.camera/chunk-000/file-000.mp4")
    assert np.abs(np.array(shown) - 100).max() < 4
    assert len(shown) == 26


@pytest.mark.parametrize("size", [(1, 1), (20_000, 2), (3, 500)])
def test_an_image_of_a_size_that_no_video_has_is_resized(tmp_path, size):
    out, counts = written(tmp_path, recorded(seconds=2, images=[picture(100, size)] * 10))
    assert (counts.frames, counts.resized) == (20, 10)
    shown = brightness(out / "videos/observation.images.camera/chunk-000/file-000.mp4")
    assert np.abs(np.array(shown) - 100).max() < 4


def test_a_camera_whose_type_changes_is_shown_whole(tmp_path):
    source = recorded(seconds=2, images=[picture(100)] * 5)
    definition, md5 = ROS1.generate_msgdef(RAW)
    raw = RosType("/camera", "sensor_msgs/Image", md5, definition)
    declared = MessageType("camera", raw.topic, raw.name, md5, definition).sample()
    topics = {name: build_topic(RECORD, "car", name) for name in ("types", "camera")}
    types = Batch("1badcafe", 0, [START], {name: [value] for name, value in declared.items()})
    source.cloud.table.put(TELEMETRY, item_of(types, topics["types"]))
    for i in range(5):
        messages = Messages(raw.id, raw.layout, [raw_image("mono8", [200] * 64 * 48, 64, 48)])
        batch = Batch("1badcafe", i, [START + SECOND + i * 200_000], {}, 0, messages)
        source.cloud.table.put(TELEMETRY, item_of(batch, topics["camera"]))
    out, counts = written(tmp_path, source)
    assert (counts.frames, counts.damaged) == (20, 0)
    shown = brightness(out / "videos/observation.images.camera/chunk-000/file-000.mp4")
    assert np.abs(np.array(shown) - ([100] * 10 + [200] * 10)).max() < 4


def test_what_a_float32_cannot_hold_is_not_known(tmp_path):
    speeds = {2: [1e300] * 20, 3: [float("inf")] * 20}
    out, counts = written(tmp_path, recorded(seconds=6, speeds=speeds))
    assert (counts.episodes, counts.frames) == (2, 40)
    assert "Infinity" not in (out / "meta/stats.json").read_text()


def test_the_statistics_of_all_episodes_are_those_of_their_frames(tmp_path):
    out, _ = written(tmp_path, recorded(seconds=3), recorded(seconds=2), recorded(seconds=5))
    files = sorted((out / "data").rglob("*.parquet"))
    values = np.concatenate([pq.read_table(path)["action"].to_pylist() for path in files])
    found = json.loads((out / "meta/stats.json").read_text())["action"]
    for name in ("min", "max", "mean", "std"):
        assert np.allclose(found[name], getattr(np, name)(values, axis=0))
    assert found["count"] == [100]
    # As LeRobot joins them: the mean of the episodes' medians over the frames.
    medians = [np.median(pq.read_table(path)["action"].to_pylist(), axis=0) for path in files]
    assert np.allclose(found["q50"], np.average(medians, axis=0, weights=[30, 20, 50]))


def test_a_source_that_cannot_be_read_is_left_out_and_said(tmp_path):
    lost = StationError("incident f00d is not in the bucket any more")
    out, counts = written(tmp_path, lost, recorded(speeds={0: ["fast"] * 20}), recorded())
    assert (counts.episodes, counts.left_out, counts.reason) == (1, 2, str(lost))
    assert json.loads((out / "meta/info.json").read_text())["total_frames"] == 30


def test_nothing_is_left_of_a_dataset_without_episodes(tmp_path):
    with pytest.raises(StationError, match=r"no second has all of vesc\.speed, servo\.data"):
        written(tmp_path, recorded(images=[]))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("fields", "problem"),
    [((Field("vesc", "sped"),), "no sped in vesc"), ((Field("none", "data"),), "no second has all of none")],
)
def test_a_field_that_is_not_there_is_an_error(tmp_path, fields, problem):
    with pytest.raises(StationError, match=problem):
        written(tmp_path, recorded(), shape=Shape(fps=10, state=fields, action=(SERVO,)))


def test_a_text_is_no_field_to_learn_from():
    source = recorded(speeds={0: ["fast"] * 20})
    with pytest.raises(StationError, match=r"vesc\.speed must be a number, got a text"):
        list(episodes(source, Shape(fps=10, state=(SPEED,), action=(SERVO,))))


def test_another_folder_is_not_replaced(tmp_path):
    other = tmp_path / "dataset"
    other.mkdir()
    (other / "thesis.txt").write_text("years")
    # A dataset too, but another program's.
    (other / "meta").mkdir()
    (other / "meta/info.json").write_text("{}")
    with pytest.raises(StationError, match="is no dataset of `iort export`"):
        write(other, [recorded()], SHAPE, task="drive", robot="car", units={}, force=True)
    assert (other / "thesis.txt").read_text() == "years"


def incident(path):
    """A file as the recorder writes it: samples as JSON, and images as their robot published them."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        json_schema = writer.register_schema("iort.vesc", "jsonschema", b"{}")
        image = writer.register_schema(CAMERA.name, "ros1msg", DEFINITION.encode())
        vesc = writer.register_channel("vesc", "json", json_schema, {"iort_stream": "vesc"})
        camera = writer.register_channel(CAMERA.topic, "ros1", image, {"iort_stream": "camera"})
        for i in range(40):
            t_ns = (START + i * 50_000) * 1000
            writer.add_message(vesc, t_ns, json.dumps({"speed": 4614 * i}).encode(), t_ns)
            if i % 4 == 0:
                writer.add_message(camera, t_ns, message(picture(i)), t_ns)
        writer.finish()
    return path


def test_an_incident_becomes_an_episode_from_its_file_alone(tmp_path):
    source = Kept(incident(tmp_path / "a.mcap"), Vehicle(4614.0), {"incident": "f00d"})
    mps = Field("vesc", "speed_mps")
    out, counts = written(
        tmp_path, source, shape=Shape(fps=20, state=(mps,), action=(mps, SPEED), cameras=("camera",))
    )
    assert (counts.episodes, counts.frames) == (1, 39)
    table = pq.read_table(out / "data/chunk-000/file-000.parquet")
    assert table["observation.state"].to_pylist() == list(range(39))
    assert json.loads((out / "meta/iort.json").read_text())["episodes"][0]["incident"] == "f00d"
    with pytest.raises(StationError, match=r"a\.mcap has no sped in vesc"):
        source.samples("vesc", ["sped"])
    with pytest.raises(StationError, match=r"a\.mcap has no stream lidar"):
        source.samples("lidar", ["data"])


def test_the_old_dataset_stays_if_the_new_one_is_interrupted_or_cannot_be_moved(tmp_path):
    out, _ = written(tmp_path, recorded())
    before = (out / "meta/info.json").stat().st_ino

    def sources():
        yield recorded()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(out, sources(), SHAPE, task="drive", robot="car", units={}, force=True)
    with pytest.raises(FileNotFoundError), whole_folder(out, "meta/iort.json", "dataset", force=True):
        pass
    assert list(tmp_path.iterdir()) == [out]
    assert (out / "meta/info.json").stat().st_ino == before


def test_a_link_to_nothing_is_in_the_way(tmp_path):
    (tmp_path / "dataset").symlink_to(tmp_path / "gone")
    with pytest.raises(StationError, match="exists: give another --out"):
        written(tmp_path, recorded())
    assert (tmp_path / "dataset").is_symlink()


def test_a_file_that_is_no_incident_is_an_error(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"#ROSBAG V2.0\n" * 20)
    with pytest.raises(StationError, match=r"a\.mcap is no incident"):
        Kept(path, None, {})


def test_the_usual_fields_are_the_motor_controllers_and_the_command_topics():
    source = recorded()
    servo = MessageType("servo", "/commands/servo/position", "std_msgs/Float64", "", "float64 data")
    batch = Batch("0badcafe", 1, [START + 1], {name: [value] for name, value in servo.sample().items()})
    source.cloud.table.put(TELEMETRY, item_of(batch, build_topic(RECORD, "car", TYPES_STREAM)))
    assert usual_fields(source.cloud, "car") == ((SPEED,), (SERVO,))


RAW = "sensor_msgs/msg/Image"


def raw_image(encoding, data, width=2, height=1, step=None):
    header = ROS1.types["std_msgs/msg/Header"](0, ROS1.types["builtin_interfaces/msg/Time"](0, 0), "")
    step = len(data) // height if step is None else step
    content = np.array(data, dtype=np.uint8)
    made = ROS1.types[RAW](header, height, width, encoding, 0, step, content)
    return bytes(ROS1.serialize_ros1(made, RAW))


IMAGES = Images("sensor_msgs/Image", ROS1.generate_msgdef(RAW)[0])


@pytest.mark.parametrize(
    ("encoding", "data", "pixels"),
    [
        ("rgb8", [1, 2, 3, 4, 5, 6], [[1, 2, 3], [4, 5, 6]]),
        ("bgr8", [1, 2, 3, 4, 5, 6, 0, 0], [[3, 2, 1], [6, 5, 4]]),
        ("bgra8", [1, 2, 3, 9, 4, 5, 6, 9], [[3, 2, 1], [6, 5, 4]]),
        ("mono8", [7, 8], [[7, 7, 7], [8, 8, 8]]),
    ],
)
def test_the_encodings_of_images(encoding, data, pixels):
    assert IMAGES.pixels(raw_image(encoding, data)).tolist() == [pixels]
    assert IMAGES.pixels(raw_image(encoding, [])) is None


@pytest.mark.parametrize(
    ("raw", "problem"),
    [
        (raw_image("rgb16", [0, 0, 0, 0]), "encoding must be one of mono8, .*, got 'rgb16'"),
        (raw_image("rgb8", [1, 2, 3]), "an image of 2 by 1 rgb8 has 3 bytes, 3 a row"),
        (raw_image("mono8", [1, 2], height=2**20, step=2), "has 2 bytes"),
        (b"\0", "truncated"),
    ],
)
def test_an_image_that_is_none_is_an_error(raw, problem):
    with pytest.raises(StationError, match=problem):
        IMAGES.pixels(raw)


READ = """
import json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
data = LeRobotDataset("iort/test", root=sys.argv[1], video_backend="pyav")
seen = [data[i] for i in range(len(data))]
print(json.dumps({
    "episodes": data.num_episodes,
    "state": [float(each["observation.state"]) for each in seen],
    "action": [each["action"].tolist() for each in seen],
    "task": seen[0]["task"],
    "image": [float(each["observation.images.camera"].mean()) for each in seen],
    "shape": list(seen[0]["observation.images.camera"].shape),
}))
"""


@pytest.mark.skipif("IORT_LEROBOT" not in os.environ, reason=NO_LEROBOT)
def test_lerobot_reads_what_was_written(tmp_path):
    out, _ = written(tmp_path, recorded(), recorded(seconds=2))
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "cache")}
    answer = subprocess.run(
        [os.environ["IORT_LEROBOT"], "-c", READ, str(out)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert answer.returncode == 0, answer.stderr
    read = json.loads(answer.stdout.splitlines()[-1])
    steps = [*range(30), *range(20)]
    assert (read["episodes"], read["task"], read["shape"]) == (2, "drive", [3, 48, 64])
    assert read["state"] == [2 * i for i in steps]
    assert np.allclose(read["action"], [[i / 50, 2 * i] for i in steps])
    assert np.abs(np.array(read["image"]) * 255 - [10 * (i // 2) for i in steps]).max() < 4
