"""Queries of recorded samples, and the units of their fields."""

from __future__ import annotations

import re
from decimal import Decimal

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from functions.shared.tables import attribute
from iort_contract.catalog.derived import Vehicle
from iort_contract.catalog.derived import derive as derive_lists
from iort_contract.catalog.streams import AGENT_STREAM, RTT_STREAM, TYPES_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.codec import flat_second, packed_second
from iort_contract.limits import MAX_BATCH_SPAN_US
from iort_contract.messages.batch import Batch
from iort_contract.ros.message import MessageType
from iort_contract.topics import build_topic
from iort_station import data
from iort_station.cli.verbs import samples
from iort_station.data import conditions, select
from iort_station.data.inventory import unit
from iort_station.errors import StationError
from testkit.dynamodb import ARCHIVE, ROBOTS, SUMMARY, TELEMETRY, FakeDynamoDB, item_of, serialize
from tests.unit.contract.ros.ros1_messages import LINE
from tests.unit.contract.ros.ros_values import HEADER, ROS2_HEADER

TOPIC = build_topic("dt", "car", "vesc")
START = 1_700_000_000_000_000


class FakeCloud:
    """A fake `iort_station.cloud.Cloud` with only the table in memory."""

    namespace = "iort"

    def __init__(self, client):
        self.table, self.bucket = client, None

    def client(self, service):
        return {"dynamodb": self.table, "s3": self.bucket}[service]

    def output(self, _noun, name):
        tables = {"TelemetryTable": TELEMETRY, "SummaryTable": SUMMARY, "RobotsTable": ROBOTS}
        return (tables | {"ArchiveTable": ARCHIVE, "FilesBucket": "files"})[name]

    def urgent(self):
        return self


def cloud_of(*batches, page_items=2, robot="car", gain=None):
    client = FakeDynamoDB(page_items=page_items)
    for batch in batches:
        client.put(TELEMETRY, item_of(batch))
    row = {"robot": robot} | ({"speed_to_erpm_gain": Decimal(gain)} if gain else {})
    client.put(ROBOTS, {name: serialize(value) for name, value in row.items()})
    return FakeCloud(client)


def ride(n=100, *, each=10, period_us=20_000, fields=("speed",)):
    """Batches of n samples; each value is the sample's index."""
    return [
        Batch(
            "0badcafe",
            i // each,
            [START + k * period_us for k in range(i, min(n, i + each))],
            {name: list(range(i, min(n, i + each))) for name in fields},
        )
        for i in range(0, n, each)
    ]


def test_a_query_gives_every_sample_once_and_in_order():
    found = data.query(cloud_of(*ride()), "car", "vesc")
    assert found.times_us.tolist() == [START + 20_000 * i for i in range(100)]
    assert found.times_us.dtype == np.int64
    assert found.columns["speed"].tolist() == list(range(100))
    assert found.unit("speed") == "erpm"
    assert len(found) == 100


@given(st.integers(-30_000, 2_030_000), st.integers(0, 2_060_000), st.integers(1, 4))
def test_a_range_includes_its_start_and_excludes_its_end(offset, length, page_items):
    cloud = cloud_of(*ride(), page_items=page_items)
    first, last = START + offset, START + offset + length
    found = data.query(cloud, "car", "vesc", first, last)
    every = [START + 20_000 * i for i in range(100)]
    assert found.times_us.tolist() == [t for t in every if first <= t < last]


def test_a_batch_that_starts_before_the_range_is_read():
    long = Batch("0badcafe", 0, [START, START + MAX_BATCH_SPAN_US - 1], {"speed": [1, 2]})
    found = data.query(cloud_of(long), "car", "vesc", START + MAX_BATCH_SPAN_US - 1, START + 9_000_000)
    assert found.columns["speed"].tolist() == [2]


@given(
    st.lists(st.tuples(st.integers(0, 30), st.integers(1, 5)), min_size=1, max_size=8),
    st.integers(1, 3),
)
def test_overlapping_batches_give_every_sample_in_order(starts, page_items):
    """Interleaved clocks: samples with the same microsecond are all kept."""
    batches = []
    for seq, (at, n) in enumerate(starts):
        times = [START + 100_000 * (at + i // 2) for i in range(n)]
        batches.append(Batch("0badcafe", seq, times, {"speed": [seq] * n}))
    found = data.query(cloud_of(*batches, page_items=page_items), "car", "vesc")
    in_order = sorted(batches, key=lambda batch: str(batch.id))
    expected = sorted(((t, batch.seq) for batch in in_order for t in batch.times_us), key=lambda one: one[0])
    assert list(zip(found.times_us.tolist(), found.columns["speed"].tolist(), strict=True)) == expected


def test_nulls_and_missing_fields_are_nan():
    cloud = cloud_of(
        Batch("0badcafe", 0, [START, START + 1], {"speed": [None, 1.5]}),
        Batch("0badcafe", 1, [START + 2], {"speed": [2], "duty_cycle": [0.1]}),
    )
    found = data.query(cloud, "car", "vesc")
    np.testing.assert_array_equal(found.columns["speed"], [np.nan, 1.5, 2])
    np.testing.assert_array_equal(found.columns["duty_cycle"], [np.nan, np.nan, 0.1])
    frame = found.pandas()
    assert list(frame.columns) == ["speed", "duty_cycle"]
    assert str(frame.index.tz) == "UTC"
    assert frame.index[0].value == START * 1000


def test_texts_bools_and_large_integers_keep_their_types():
    large = 2**53 + 1
    batch = Batch(
        "0badcafe", 0, [START, START + 1], {"s": ["1", None], "b": [True, False], "i": [large, None]}
    )
    columns = data.query(cloud_of(batch), "car", "vesc").columns
    assert columns["s"].tolist() == ["1", None]
    assert columns["b"].tolist() == [True, False]
    assert columns["i"].tolist() == [large, None]


def test_invalid_items_are_counted_and_the_rest_is_given():
    cloud = cloud_of(*ride(20))
    for at, change in enumerate(({"samples": "!"}, {"n": 7}, {"v": 9}, {"codec": "x"})):
        item = item_of(Batch("0badcafe", 0, [START + 5_000_000 + at], {"speed": [1]}))
        cloud.table.put(TELEMETRY, item | {name: serialize(value) for name, value in change.items()})
    found = data.query(cloud, "car", "vesc")
    assert len(found) == 20
    assert found.refused == 4
    assert "base64" in found.reason


def test_where_and_fields_work_on_derived_fields():
    cloud = cloud_of(*ride(), gain="10")
    found = data.query(cloud, "car", "vesc", fields=["speed_mps"], where="speed_mps >= 9.8")
    assert list(found.columns) == ["speed_mps"]
    assert found.columns["speed_mps"].tolist() == [9.8, 9.9]
    assert found.unit("speed_mps") == "m/s"


def test_derived_fields_equal_those_of_lambda_2():
    lists = {"speed": [1, None, 3.5], "voltage_input": [12, 11.5, None], "current_input": [1e300, 2, 3]}
    vehicle = Vehicle(4614.0, 3.0)
    arrays = {name: np.array(values, dtype=float) for name, values in lists.items()}
    ours = conditions.derive(arrays, vehicle)
    assert {name: conditions.values(column) for name, column in ours.items()} == derive_lists(lists, vehicle)


def test_every_combines_samples_across_pages():
    batches = ride(150, fields=("speed", "fault_code"))
    found = data.query(cloud_of(*batches, page_items=1), "car", "vesc", every="1s")
    assert found.times_us.tolist() == [START, START + 1_000_000, START + 2_000_000]
    assert found.columns["speed"].tolist() == [24.5, 74.5, 124.5]
    assert found.columns["fault_code"].tolist() == [49, 99, 149]


def test_every_ignores_null():
    batch = Batch(
        "0badcafe", 0, [START, START + 1, START + 500_000], {"speed": [None, 3, None], "s": ["a", "b", "c"]}
    )
    found = data.query(cloud_of(batch), "car", "vesc", every="500ms")
    np.testing.assert_array_equal(found.columns["speed"], [3, np.nan])
    assert found.columns["s"].tolist() == ["b", "c"]


def test_summary_gives_the_seconds_that_begin_in_the_range():
    cloud = cloud_of(*ride())
    for second in range(3):
        # In today's packed form and in the older flat form.
        packed = packed_second({"n": 50}, {"speed": [float(second), 1.5, 2, 2]})
        stored = packed if second % 2 else flat_second(packed)
        item = {name: attribute(value) for name, value in stored.items()}
        key = {"topic": {"S": TOPIC}, "second": {"N": str(START // 1_000_000 + second)}}
        cloud.table.put(SUMMARY, item | key)
    found = data.query(cloud, "car", "vesc", START + 1, START + 2_000_001, fields=["speed"], summary=True)
    assert found.times_us.tolist() == [START + 1_000_000, START + 2_000_000]
    assert list(found.columns) == ["speed_min", "speed_mean", "speed_max", "speed_last"]
    assert found.columns["speed_min"].tolist() == [1, 2]
    assert found.columns["speed_mean"].tolist() == [1.5, 1.5]
    assert found.unit("speed_min") == "erpm"
    with pytest.raises(StationError, match="has no volts; the nearest: speed_min"):
        data.query(cloud, "car", "vesc", fields=["volts"], summary=True)
    with pytest.raises(StationError, match="has no speed; the nearest: speed_min, speed_max, speed_mean;"):
        data.query(cloud, "car", "vesc", where="speed > 1", summary=True)
    assert len(data.query(cloud, "car", "vesc", where="speed_min > 1", summary=True)) == 1


@pytest.mark.parametrize(("drawn", "unit"), [([1, 2, None, 4], "1e-4 Ah"), ([1e-4, 2e-4, None, 4e-4], "Ah")])
def test_charge_has_the_unit_of_its_driver(drawn, unit):
    times = [START + 20_000 * i for i in range(4)]
    cloud = cloud_of(Batch("0badcafe", 0, times, {"charge_drawn": drawn, "charge_regen": [0, 0, 0, 0]}))
    for found in (data.query(cloud, "car", "vesc"), data.query(cloud, "car", "vesc", every="1s")):
        assert [found.unit(name) for name in ("charge_drawn", "charge_regen")] == [unit, unit]


@pytest.mark.parametrize(("drawn", "unit"), [(4, "1e-4 Ah"), (4e-4, "Ah")])
def test_charge_in_a_summary_has_the_unit_of_its_driver(drawn, unit):
    cloud = cloud_of(*ride())
    summary = {"n": 50, "charge_drawn_mean": drawn * 0.7, "charge_drawn_max": drawn}
    key = {"topic": {"S": TOPIC}, "second": {"N": str(START // 1_000_000)}}
    cloud.table.put(SUMMARY, {name: attribute(value) for name, value in summary.items()} | key)
    assert data.query(cloud, "car", "vesc", summary=True).unit("charge_drawn_mean") == unit


def test_an_empty_range_gives_an_empty_result():
    found = data.query(cloud_of(*ride()), "car", "vesc", START - 10, START)
    assert len(found) == 0


@pytest.mark.parametrize(
    ("question", "answer"),
    [
        ({"robot": "bus"}, "robot bus is not registered; the nearest: car; `iort robots list` lists all"),
        ({"stream": "imu"}, "car has no stream imu; the nearest: vesc; `iort streams car` lists all"),
        ({"fields": ["volts"]}, "car has no volts in vesc in this range; the nearest: speed, speed_mps;"),
        ({"where": "volts > 1"}, "car has no volts"),
        ({"fields": ["speed_mps"]}, "speed_mps needs the speed_to_erpm_gain of car"),
        ({"where": "speed >"}, "invalid expression"),
        ({"start": "yesterday"}, "time must be now, -10m"),
        ({"start": 5, "end": 4}, "ends before it starts"),
        ({"every": "1 fortnight"}, "got '1 fortnight'"),
        ({"robot": "a/b"}, "got 'a/b'"),
    ],
)
def test_a_mistake_is_answered_with_the_available_names(question, answer):
    arguments = {"robot": "car", "stream": "vesc", **question}
    with pytest.raises(StationError) as refused:
        data.query(cloud_of(*ride()), **arguments)
    assert answer in str(refused.value)


def test_a_selection_reads_only_the_needed_fields():
    selection = select("car", "vesc", fields=["speed_mps"], where="duty_cycle > 0")
    names = ["speed", "duty_cycle", "voltage_input", "speed_mps"]
    assert list(filter(selection.wanted(), names)) == ["speed", "duty_cycle", "speed_mps"]


# --- units from a stream's message types ------------------------------------------------------------------


def driven(stream, columns, *said):
    """A cloud with one second of a stream, and message types sent one a second from the start."""
    cloud = cloud_of()
    put(cloud, stream, Batch("0badcafe", 0, [START], {name: [1.5] for name in columns}))
    for i, kind in enumerate(said):
        sample = {name: [value] for name, value in kind.sample().items()}
        put(cloud, TYPES_STREAM, Batch("0badcafe", i, [START + i * 1_000_000], sample))
    return cloud


def put(cloud, stream, batch):
    cloud.table.put(TELEMETRY, item_of(batch, build_topic("dt", "car", stream)))


def test_the_type_of_a_stream_gives_its_units_under_any_name():
    state = "float64 speed\n"
    vesc = MessageType("esc", "/sensors/core", "vesc_msgs/VescState", "", state)
    other = MessageType("other", "/o", "lab/Other", "", state)
    cloud = driven("esc", ["speed"], vesc, other)
    assert data.query(cloud, "car", "esc").unit("speed") == "erpm"
    assert data.query(cloud, "car", "esc", fields=["speed"], every="1s").unit("speed") == "erpm"
    cloud = driven("other", ["speed", "voltage_input", "current_motor", "duty_cycle"], vesc, other)
    assert data.query(cloud, "car", "other").unit("speed") == ""


def test_a_type_applies_if_it_was_sent_before_the_end_of_the_range():
    drive = MessageType("s", "/s", "ackermann_msgs/AckermannDrive", "", "float32 speed\n")
    vesc = drive._replace(kind="vesc_msgs/VescState")
    cloud = driven("s", ["speed"], drive, vesc)
    assert data.query(cloud, "car", "s", START, START + 1_000_000).unit("speed") == "m/s"
    assert data.query(cloud, "car", "s", START, START + 1_000_001).unit("speed") == "erpm"


def test_only_a_vesc_log_has_the_vescs_units_under_any_name():
    log = ["speed", "voltage_input", "current_motor", "duty_cycle", "gnss_lat"]
    found = data.query(driven("ride", log), "car", "ride", fields=["speed", "gnss_lat"])
    assert [found.unit(name) for name in found.columns] == ["erpm", "deg"]
    assert data.query(driven("ride", ["speed"]), "car", "ride").unit("speed") == ""


def test_types_are_read_only_when_a_unit_is_needed():
    cloud = driven("ride", ["speed"])
    found = data.query(cloud, "car", "ride")
    before = cloud.table.calls["query"]
    found.unit("speed")
    asked = cloud.table.calls["query"]
    assert asked > before
    found.unit("speed")
    assert cloud.table.calls["query"] == asked


def test_a_mistyped_robot_of_a_large_fleet_is_answered_with_the_three_nearest_names():
    cloud = cloud_of(robot="lab-a-07")
    for i in range(100):
        cloud.table.put(ROBOTS, {"robot": serialize(f"truck{i}")})
    for name in ("lab-b-07", "lab-a-17"):
        cloud.table.put(ROBOTS, {"robot": serialize(name)})
    with pytest.raises(StationError, match=r"the nearest: lab-a-17, lab-a-07, lab-b-07; `iort robots"):
        data.query(cloud, "lab-a-70", "vesc")


class Options:
    """What `iort query` reads of the options before its name."""

    def __init__(self, cloud):
        self.cloud = lambda: cloud


@pytest.mark.parametrize(
    ("name", "begins"),
    [("b.csv", b"time,speed"), ("b.jsonl", b'{"time'), ("b.parquet", b"PAR1"), ("b.txt", b"time (UTC)")],
)
def test_a_file_has_the_format_of_its_ending_and_every_row(tmp_path, name, begins):
    arguments = ["query", "car", "vesc", "--last", "all"]
    done = CliRunner().invoke(
        samples.commands,
        [*arguments, "--out", str(tmp_path / name)],
        obj=Options(cloud_of(*ride())),
    )
    assert done.exit_code == 0, done.exception
    content = (tmp_path / name).read_bytes()
    assert content.startswith(begins)
    if name == "b.parquet":
        assert pq.read_table(tmp_path / name).num_rows == 100
    else:
        assert [value for value in range(100) if not re.search(rb"\b%d\b" % value, content)] == []
    piped = CliRunner().invoke(samples.commands, arguments, obj=Options(cloud_of(*ride())))
    assert len(piped.stdout.splitlines()) == 102, "the head, the units and every row"


@pytest.mark.parametrize(
    ("name", "said"),
    [("b.xlsx", "must end in .csv, .jsonl"), ("b", "must end in"), ("b.mcap", "iort export writes .mcap")],
)
def test_a_file_of_an_unknown_ending_is_refused_before_the_query(tmp_path, name, said):
    done = CliRunner().invoke(samples.commands, ["query", "car", "vesc", "--out", str(tmp_path / name)])
    assert said in str(done.exception)
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize(
    ("stream", "name", "expected"),
    [
        (VESC_STREAM, "speed", "erpm"),
        (VESC_STREAM, "speed_mps_max", "m/s"),
        (RTT_STREAM, "rule_ms", "ms"),
        (AGENT_STREAM, "cpu_percent", "%"),
        (AGENT_STREAM, "clock_offset_ms", "ms"),
        ("imu", "linear_acceleration.x", "m/s^2"),
        ("imu", "angular_velocity.z_mean", "rad/s"),
        ("odom", "twist.twist.linear.y", "m/s"),
        ("odom", "pose.pose.position.z", "m"),
        ("odom", "pose.pose.orientation.z", ""),
        ("odom", "composition.x", ""),
        ("odom", "position", ""),
        ("lab", "linear.x", ""),
    ],
)
def test_a_field_has_its_known_unit(stream: str, name: str, expected: str) -> None:
    assert unit(stream, name) == expected


VECTOR = LINE + "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
VESC_STATE = LINE + "MSG: vesc_msgs/VescState\nfloat64 speed\nfloat64 charge_drawn\nint32 fault_code\n"
STAMPED_VESC = "Header header\nvesc_msgs/VescState state\n" + HEADER + VESC_STATE
FIX = "Header header\nfloat64 latitude\nfloat64 altitude\nfloat64[9] position_covariance\n" + HEADER
DRIVE = "Header header\nackermann_msgs/AckermannDrive drive\n" + HEADER + LINE
DRIVE += "MSG: ackermann_msgs/AckermannDrive\nfloat32 steering_angle\nfloat32 speed\n"
IMU = "Header header\nVescImu imu\n" + HEADER + LINE + "MSG: vesc_msgs/VescImu\n"
IMU += "geometry_msgs/Vector3 linear_acceleration\n" + VECTOR
OWN = "vesc_msgs/VescState[2] motors\nsensor_msgs/Range near\ngeometry_msgs/Vector3 angular_velocity\n"
OWN += "float64 speed\n" + VESC_STATE + LINE + "MSG: sensor_msgs/Range\nfloat32 range\n" + VECTOR


@pytest.mark.parametrize(
    ("kind", "definition", "name", "expected"),
    [
        ("vesc_msgs/VescStateStamped", STAMPED_VESC, "speed", "erpm"),
        ("vesc_msgs/VescStateStamped", STAMPED_VESC, "charge_drawn_max", "1e-4 Ah"),
        ("vesc_msgs/VescStateStamped", STAMPED_VESC, "state.speed", "erpm"),
        ("vesc_msgs/VescStateStamped", "", "speed", "erpm"),
        ("vesc_msgs/VescStateStamped", "what is this", "speed_mean", "erpm"),
        ("vesc_msgs/VescStateStamped", STAMPED_VESC, "speed_mps", "m/s"),
        ("vesc_msgs/VescImuStamped", IMU, "linear_acceleration.x", ""),
        ("sensor_msgs/NavSatFix", FIX, "latitude", "deg"),
        ("sensor_msgs/NavSatFix", FIX, "altitude_mean", "m"),
        ("sensor_msgs/NavSatFix", FIX, "position_covariance.3", "m^2"),
        ("ackermann_msgs/AckermannDriveStamped", DRIVE, "speed", "m/s"),
        ("lab/Robot", OWN, "motors.1.speed", "erpm"),
        ("lab/Robot", OWN, "near.range_min", "m"),
        ("lab/Robot", OWN, "angular_velocity.z", "rad/s"),
        ("lab/Robot", OWN, "speed", ""),
        ("lab/Robot", OWN, "nothing", ""),
    ],
)  # fmt: skip
def test_the_unit_follows_from_the_type_of_the_messages(kind, definition, name, expected):
    assert unit("any", name, kind=MessageType("any", "/t", kind, "", definition)) == expected
    ros2_kind, ros2_definition = kind.replace("/", "/msg/"), definition.replace(HEADER, ROS2_HEADER)
    # The ROS 2 driver counts in Ah.
    ros2_unit = expected.replace("1e-4 ", "")
    assert unit("any", name, kind=MessageType("any", "/t", ros2_kind, "", ros2_definition)) == ros2_unit


def test_the_ros_2_driver_has_its_own_units_in_any_stream():
    kind = MessageType("esc", "/t", "vesc_msgs/VescStateStamped", "", STAMPED_VESC)
    assert unit("esc", "charge_drawn", ros2=True, kind=kind) == "Ah"


@pytest.mark.parametrize(
    ("stream", "expected"), [(VESC_STREAM, "deg"), ("lab", "")], ids=["a log's", "somebody's"]
)
def test_the_columns_of_a_log_have_units(stream, expected):
    assert unit(stream, "gnss_lat") == expected
