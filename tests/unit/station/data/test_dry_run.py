"""A dry-run finds in stored samples the edges that the evaluator finds in the samples themselves."""

from __future__ import annotations

import json
import math
import threading
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from iort_agent.recorder.triggers import Triggers
from iort_agent.sources.recording import BagConfig
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.messages.batch import Batch, Messages
from iort_contract.messages.recorder import Trigger, encode_trigger
from iort_contract.ros.message import MessageType
from iort_contract.triggers import Edge, evaluator_of
from iort_station.cli.verbs import recorder
from iort_station.cost.report import incident_dollars
from iort_station.data.dry_run import dry_run, fits, lines
from iort_station.errors import StationError, UsageError
from testkit.agent import ManualClock
from testkit.dynamodb import TELEMETRY, item_of
from tests.recordings import recording
from tests.trigger_vectors import MS, VECTORS
from tests.unit.agent.recorder.rig import Rig
from tests.unit.station.data.test_queries import FakeCloud, cloud_of

START = 1_700_000_000_000_000
S = 1_000_000
Sample = tuple[str, int, dict[str, Any]]


def stored(samples: list[Sample], *, gain: float | None = None) -> FakeCloud:
    """A cloud with samples as the record lane stores them, a batch for each second of a stream."""
    cloud = cloud_of(gain=gain)
    numbers: dict[str, int] = defaultdict(int)
    seconds: dict[tuple[str, int], list[Sample]] = defaultdict(list)
    for sample in samples:
        seconds[sample[0], (sample[1] - START) // S].append(sample)
    for (stream, _), of in seconds.items():
        names = dict.fromkeys(name for _, _, values in of for name in values)
        columns = {name: [values.get(name) for _, _, values in of] for name in names}
        batch = Batch("0badcafe", numbers[stream], [t_us for _, t_us, _ in of], columns)
        numbers[stream] += 1
        cloud.table.put(TELEMETRY, item_of(batch, topic=f"dt/iort/car/{stream}"))
    return cloud


def announce(cloud: FakeCloud, kind: MessageType) -> None:
    """Store the type that a publisher gives its messages."""
    told = Batch("0badcafe", 0, [START], {name: [of] for name, of in kind.sample().items()})
    cloud.table.put(TELEMETRY, item_of(told, topic=f"dt/iort/car/{TYPES_STREAM}"))


def ride(n: int = 600) -> list[Sample]:
    """A minute at 10 Hz that brakes three times."""
    return [
        (
            "vesc",
            START + i * 100 * MS,
            {"speed": 4_614.0 * 3, "current_input": -20.0 if i % 200 == 150 else 1.0},
        )
        for i in range(n)
    ]


BRAKE = Trigger("brake", "current_input < -15 and speed_mps > 2", before_s=5, after_s=5, cooldown_s=0)


def as_recorded(values: dict[str, Any]) -> dict[str, Any]:
    return {key: None if isinstance(of, float) and math.isnan(of) else of for key, of in values.items()}


@pytest.mark.parametrize("name", VECTORS)
def test_its_edges_are_those_of_the_table(name: str) -> None:
    vector = VECTORS[name]
    samples = [(stream, START + t_ms * MS, as_recorded(values)) for stream, t_ms, values in vector.samples]
    gain = vector.vehicle.speed_to_erpm_gain if vector.vehicle else None
    trigger = Trigger("a", vector.when, others=vector.others)
    if name == "a missing field is null":
        with pytest.raises(StationError, match="has no y in vesc in this range"):
            dry_run(stored(samples), "car", trigger)
        return
    if name == "silent: not before the first sample":
        with pytest.raises(StationError, match="car has no stream scan"):
            dry_run(stored(samples), "car", trigger)
        return
    found = dry_run(stored(samples, gain=gain), "car", trigger)
    assert found.edges == [Edge(START + t_ms * MS, values) for t_ms, values in vector.edges]
    assert found.samples == len([s for s in samples if s[0] in evaluator_of(found.trigger).streams])


def test_windows_bytes_and_budget_are_told() -> None:
    found = dry_run(stored(ride(), gain=4614.0), "car", BRAKE)
    assert [edge.t_us for edge in found.edges] == [START + s * S for s in (15, 35, 55)]
    assert [(w.from_us, w.to_us) for w in found.windows] == [
        (START + (s - 5) * S, START + (s + 5) * S) for s in (15, 35, 55)
    ]
    (upload,) = found.uploads
    assert upload.stream == "vesc"
    # The last window ends with the ride.
    assert upload.messages == 101 + 101 + 100
    assert found.within_budget == found.bytes > 302 * 30
    third = Trigger(**{**vars(BRAKE), "budget_mb_day": found.bytes / 1e6 / 2})
    assert dry_run(stored(ride(), gain=4614.0), "car", third).within_budget == round(found.bytes / 2)
    only = Trigger(**{**vars(BRAKE), "topics": ("/camera/*",)})
    assert dry_run(stored(ride(), gain=4614.0), "car", only).uploads == []


def test_a_cooldown_and_a_range_leave_edges_out() -> None:
    cloud = stored(ride(), gain=4614.0)
    cooled = dry_run(cloud, "car", Trigger(**{**vars(BRAKE), "cooldown_s": 30}))
    assert (len(cooled.edges), len(cooled.windows)) == (3, 2)
    part = dry_run(cloud, "car", BRAKE, START + 20 * S, START + 55 * S)
    assert [edge.t_us for edge in part.edges] == [START + 35 * S]
    assert (part.first_us, part.last_us) == (START + 20 * S, START + 55 * S - 100 * MS)


def test_a_stream_is_silent_while_others_go_on() -> None:
    samples = [*ride(100), *[("scan", START + i * S, {"a": 1}) for i in range(3)]]
    found = dry_run(stored(samples), "car", Trigger("a", "silent(scan, 1500ms)"))
    assert [edge.t_us for edge in found.edges] == [START + 3_500 * MS]


@pytest.mark.parametrize(
    ("trigger", "error", "told"),
    [
        (Trigger("a", "sped > 2"), StationError, "car has no sped in vesc in this range"),
        (Trigger("a", "speed > 2", stream="scan"), StationError, "car has no stream scan"),
        (Trigger("a", "silent(scan, 1s)"), StationError, "car has no stream scan"),
        (Trigger("a", "speed == 'map'"), StationError, "cannot compare a number with a text"),
        (Trigger("a", "speed >"), UsageError, "invalid expression"),
        (Trigger("a", "speed_mps > 2"), StationError, "speed_mps needs the speed_to_erpm_gain of car"),
        (Trigger("a", on="stop"), UsageError, "a is fired by stop, which no stored sample tells"),
    ],
)
def test_what_is_not_there_or_not_allowed_is_said(
    trigger: Trigger, error: type[Exception], told: str
) -> None:
    with pytest.raises(error) as raised:
        dry_run(stored(ride(10)), "car", trigger)
    assert told in str(raised.value)


def test_the_other_streams_of_a_condition_need_no_names() -> None:
    samples = [*ride(100), *[("pose", START + i * S, {"x": i}) for i in range(10)]]
    cloud = stored(samples)
    announce(cloud, MessageType("pose", "/pose", "lab_msgs/Pose", "0" * 32, "int32 x\n"))
    found = dry_run(cloud, "car", Trigger("a", "speed > 1 and pose.x >= 4"))
    assert [edge.t_us for edge in found.edges] == [START + 4 * S]
    assert found.trigger.others == ("pose",)


def test_an_empty_range_has_no_edges() -> None:
    found = dry_run(stored(ride(10), gain=4614.0), "car", BRAKE, START - 10 * S, START - 5 * S)
    assert (found.samples, found.edges, found.windows, found.first_us) == (0, [], [], None)
    assert list(lines(FakeCloud(None), found, None, None)) == []


def test_patterns_are_of_topics_and_streams() -> None:
    assert fits(("/camera/*",), "image", "/camera/left/image")
    assert fits(("vesc",), "vesc")
    assert not fits(("/camera", "vesc."), "vesc1", "/camera/left")


class Chosen:
    """The verb's context: a cloud that is chosen already."""

    def __init__(self, cloud: FakeCloud) -> None:
        self._cloud = cloud

    def cloud(self) -> FakeCloud:
        return self._cloud


def run(cloud: FakeCloud, *options: str) -> Any:
    app = typer.Typer()
    app.add_typer(recorder.commands)
    return CliRunner().invoke(app, ["recorder", "dry-run", "--robots", "car", *options], obj=Chosen(cloud))


BRAKING = ("--when", BRAKE.when, "--last", "all", "--before", "5s", "--after", "5s", "--cooldown", "0")


def test_the_verb_prints_times_and_values_and_draws_them(tmp_path) -> None:
    cloud = stored(ride(), gain=4614.0)
    shown = run(cloud, *BRAKING, "--out", str(tmp_path / "when.png"))
    assert shown.exit_code == 0, shown.output
    assert "would have fired 3 times (600 samples" in shown.stdout
    assert "current_input -20, speed_mps 3" in shown.stdout
    assert "3 incidents would be kept, 30 s in all" in shown.stdout
    assert (tmp_path / "when.png").stat().st_size > 10_000
    done = run(cloud, *BRAKING, "--json")
    assert done.exit_code == 0, done.exception
    (told,) = json.loads(done.stdout)
    assert [edge["time_us"] for edge in told["edges"]] == [START + s * S for s in (15, 35, 55)]
    assert told["edges"][0]["values"] == {"current_input": -20, "speed_mps": 3}
    assert len(told["windows"]) == 3
    upload, stored_usd = incident_dollars(3, told["bytes_within_budget"])
    assert (told["dollars"], told["dollars_a_month"]) == (upload, stored_usd)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ((), "give either the name of a trigger that the robots have, or --when"),
        (("brake", "--when", "speed > 1"), "give either the name"),
        (("--when", "speed > "), "invalid expression"),
        (("--when", "speed > 1", "--budget", "5"), "--budget must be MB or GB a day"),
        (("--when", "speed > 1", "--before", "1h"), "before must be 0 to 600 s, got 3600"),
        (("--when", "speed > 1", "--out", "when.gif"), "must end in"),
    ],
)
def test_wrong_use_is_said(options: tuple[str, ...], told: str) -> None:
    done = run(stored(ride(10)), *options)
    assert isinstance(done.exception, UsageError)
    assert told in str(done.exception)


def played(folder: Path, trigger: Trigger, samples: list[Sample]) -> tuple[list[Edge], list[tuple[int, int]]]:
    """The edges and the incidents' windows of a robot's recorder that hears these samples, some at a time."""
    change = encode_trigger(trigger)["recorder"]["triggers"][trigger.name]
    wanted = {trigger.name: {key: value for key, value in change.items() if value is not None}}
    rig = Rig(folder, triggers=wanted)
    edges: list[Edge] = []

    def on_edge(trigger: Trigger, edge: Any, ring_us: int) -> None:
        edges.append(Edge(edge.t_us, edge.values))
        rig.incidents.fire(trigger, edge, ring_us)

    watch = Triggers(rig.plan, rig.ring.now_us, on_edge, replayed=lambda _: True)
    for i, (stream, t_us, values) in enumerate(samples):
        watch.note(stream, t_us, values)
        if i % 37 == 0:
            watch.step()
        rig.clock.advance((t_us - samples[max(0, i - 1)][1]) / S)
    watch.step(last=True)
    windows = sorted((one.from_us, one.to_us) for one in rig.plan.incidents.values())
    return edges, windows


def as_on_the_robot(folder: Path, trigger: Trigger, samples: list[Sample], gain: float | None) -> list[Edge]:
    found = dry_run(stored(samples, gain=gain), "car", trigger)
    edges, windows = played(folder, found.trigger, samples)
    assert found.edges == edges
    assert [(window.from_us, window.to_us) for window in found.windows] == windows
    return edges


# Of these the station says that the field or the stream is not there.
ABSENT = {"a missing field is null", "silent: not before the first sample"}


@pytest.mark.parametrize("name", [name for name in VECTORS if name not in ABSENT])
def test_a_robot_that_hears_the_same_samples_finds_the_same_edges(name: str, tmp_path: Path) -> None:
    vector = VECTORS[name]
    samples = [(stream, START + t_ms * MS, as_recorded(values)) for stream, t_ms, values in vector.samples]
    gain = vector.vehicle.speed_to_erpm_gain if vector.vehicle else None
    edges = as_on_the_robot(tmp_path, Trigger("a", vector.when, others=vector.others), samples, gain)
    assert edges == [Edge(START + t_ms * MS, values) for t_ms, values in vector.edges]


@pytest.mark.parametrize(
    ("when", "least"),
    [
        ("speed_mps > 1 and current_input < 0", 3),
        ("delta(speed, 500ms) < -1000", 3),
        ("duty_cycle > 0.02 for 500ms", 3),
        ("current_motor > 5 or silent(vesc, 50ms)", 3),
    ],
)
def test_a_recording_has_the_same_edges_in_the_table_as_in_a_robot_that_plays_it(
    when: str, least: int, tmp_path: Path
) -> None:
    heard: list[Sample] = []
    bag = BagConfig(path=recording("f1tenth-motor-servo.bag"), speed=0, stamps="original")
    bag.build(ManualClock(now_us=START)).run(lambda *sample: heard.append(sample), threading.Event())
    samples = [sample for sample in heard if sample[0] != TYPES_STREAM]
    trigger = Trigger("a", when, before_s=1, after_s=0.5, cooldown_s=2)
    assert len(as_on_the_robot(tmp_path, trigger, samples, gain=4614.0)) >= least


def test_incidents_cost_their_requests_and_a_month_of_storage() -> None:
    assert incident_dollars(0, 0) == (0.0, 0.0)
    few, many = incident_dollars(1, 10**9), incident_dollars(1, 10**10)
    assert many[1] == pytest.approx(10 * few[1]) == pytest.approx(0.23)
    assert few[0] < many[0] < 0.02


def test_messages_count_with_their_bytes_and_what_was_cut_out_of_them() -> None:
    cloud = stored(ride(), gain=4614.0)
    kind = MessageType("image", "/camera/left/image", "lab_msgs/Frame", "0" * 32, "uint8[] data\n")
    cut = {"data.at": 0, "data.key": "k", "data.sha256": "0" * 64, "data.size": 100_000}
    for second in range(60):
        times = [START + second * S + i * 200 * MS for i in range(5)]
        columns = {name: [of] * 5 for name, of in {**cut, "data.content_type": "image/png"}.items()}
        raws = Messages(kind.id, kind.layout, [b"\0\0\0\0"] * 5)
        batch = Batch("0badcafe", second, times, columns, 0, raws)
        cloud.table.put(TELEMETRY, item_of(batch, topic="dt/iort/car/image"))
    announce(cloud, kind)
    found = dry_run(cloud, "car", Trigger(**{**vars(BRAKE), "topics": ("/camera/*",)}))
    (upload,) = found.uploads
    assert (upload.stream, upload.topics) == ("image", ("/camera/left/image",))
    assert upload.messages == 51 + 51 + 50
    assert upload.bytes == upload.messages * (100_000 + 4 + 47)
