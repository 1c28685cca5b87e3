"""The library that `iort_station` offers: its names, their documentation and types, and what they return."""

from __future__ import annotations

import inspect
import subprocess
import sys
import textwrap

import numpy as np
import polars as pl
import pytest

import iort_station
from iort_contract.catalog.streams import INCIDENT_STREAM
from iort_contract.messages.batch import Batch
from iort_contract.messages.recorder import UPLOADED, Incident
from iort_contract.topics import RECORD, build_topic
from iort_station import Lab, StationError, UsageError
from local.deployment import ROOT
from testkit.dynamodb import TELEMETRY, item_of
from tests.unit.station.data import test_recorded
from tests.unit.station.data.test_queries import START, FakeCloud, cloud_of, ride


def public() -> dict[str, object]:
    """Every public name, and what it is: of a class also its methods."""
    found: dict[str, object] = {}
    for name in iort_station.__all__:
        found[name] = getattr(iort_station, name)
        if inspect.isclass(found[name]) and not issubclass(found[name], BaseException):
            own = vars(found[name]).items()
            found |= {
                f"{name}.{of}": value for of, value in own if of[0] != "_" and inspect.isfunction(value)
            }
    return found


def test_there_are_under_thirty_names_each_with_a_docstring_and_types():
    names = public()
    assert len(names) < 30, sorted(names)
    for name, value in names.items():
        assert (inspect.getdoc(value) or "").rstrip().endswith((".", "``")), name
        if inspect.isfunction(value):
            parameters = [one for one in inspect.signature(value).parameters.values() if one.name != "self"]
            assert all(one.annotation is not inspect.Parameter.empty for one in parameters), name
            assert inspect.signature(value).return_annotation is not inspect.Signature.empty, name
    assert issubclass(UsageError, StationError)
    assert (ROOT / "station" / "iort_station" / "py.typed").exists()


def test_importing_it_loads_nothing_until_a_name_is_used():
    code = """
        import sys
        import iort_station
        heavy = {"numpy", "boto3", "pandas", "pyarrow", "polars", "iort_station.lab"}
        assert not heavy & sys.modules.keys(), heavy & sys.modules.keys()
        assert set(dir(iort_station)) == set(iort_station.__all__)
        iort_station.connect
        assert "iort_station.lab" in sys.modules and not {"pandas", "polars"} & sys.modules.keys()
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=True, cwd=ROOT)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = iort_station.nothing


@pytest.fixture
def lab() -> Lab:
    return Lab(cloud_of(*ride(), gain="4000"))


def test_a_query_is_numpy_arrow_pandas_and_polars(lab):
    found = lab.query("car", "vesc", START, START + 60_000, fields=["speed", "speed_mps"])
    assert found.columns["speed"].tolist() == [0, 1, 2]
    # A query's own times, and pandas' ones, are times of another.
    of_pandas = found.pandas().index
    assert len(lab.query("car", "vesc", found.times_us[1], found.times_us[2])) == 1
    assert len(lab.query("car", "vesc", of_pandas[1], of_pandas[2])) == 1
    table = found.arrow()
    assert table.column_names == ["time", "speed", "speed_mps"]
    assert {one.name: (one.metadata or {}).get(b"unit") for one in table.schema} == {
        "time": None,
        "speed": b"erpm",
        "speed_mps": b"m/s",
    }
    assert table.schema.metadata == {b"robot": b"car", b"stream": b"vesc"}
    frame, polars = found.pandas(), found.polars()
    assert frame["speed_mps"].tolist() == polars["speed_mps"].to_list() == [0, 1 / 4000, 2 / 4000]
    assert polars.schema["time"] == pl.Datetime("us", "UTC")
    assert [round(at.timestamp() * 1e6) for at in frame.index] == found.times_us.tolist()


def test_a_field_called_time_and_texts_stay_apart(lab):
    batch = Batch(
        "0badcafe", 0, [START, START + 1], {"time": [1.5, 2], "mode": ["go", None], "mixed": [1, "x"]}
    )
    columns = Lab(cloud_of(batch)).query("car", "vesc").arrow().to_pydict()
    assert columns.pop("time")[0].timestamp() * 1e6 == START
    assert columns == {"_time": [1.5, 2], "mode": ["go", None], "mixed": ["1", "x"]}


def test_without_polars_the_error_says_how_to_install_it(lab, monkeypatch):
    monkeypatch.setitem(sys.modules, "polars", None)
    with pytest.raises(StationError, match=r"pip install 'iort-station\[polars\]'"):
        lab.query("car", "vesc").polars()


@pytest.fixture
def driven() -> Lab:
    """A car with runs, messages, accounts and damage."""
    return Lab(test_recorded.later("half expired"))


def test_robots_streams_and_runs(driven):
    assert [robot.name for robot in driven.robots()] == ["car"]
    streams = {stream.name: stream for stream in driven.streams("car")}
    assert streams["vesc"].fields["speed"] == "erpm"
    assert streams["vesc"].from_us == test_recorded.START
    newest, *_, oldest = driven.runs("car")
    assert (oldest.id, oldest.state, oldest.from_us) == ("0badcafe", "ended", test_recorded.START)
    assert newest.from_us >= oldest.to_us
    assert oldest.streams["vesc"]["samples"] == 2700
    assert [run.id for run in driven.runs("car", count=1)] == [newest.id]


def test_messages_are_bytes_and_decode_to_samples(driven):
    messages = list(driven.messages("car", "scan"))
    assert len(messages) == 32
    assert {(one.topic, one.type, one.definition) for one in messages} == {
        ("/scan", "a_msgs/Names", "string[] names")
    }
    assert messages[0].decode() == {"names.0": "0badcafe0"}
    assert [one.time_us for one in messages] == sorted(one.time_us for one in messages)
    last = messages[-1].time_us
    assert [one.raw for one in driven.messages("car", "scan", last)] == [messages[-1].raw]


def test_messages_say_what_they_cannot_give(driven, lab):
    with pytest.raises(StationError, match="no ROS messages: `query` has their fields"):
        list(lab.messages("car", "vesc"))
    with pytest.raises(StationError, match="1 stored items cannot be read"):
        list(driven.messages("car", "vesc"))
    with pytest.raises(StationError, match="car has no stream radar"):
        list(lab.messages("car", "radar"))


def test_incidents_and_findings_are_of_a_range(lab):
    kept = Incident("0123456789abcdef", "low", START, START + 9, UPLOADED, key="k", bytes=5, messages=2)
    columns = {name: [value] for name, value in kept.sample().items()}
    topic = build_topic(RECORD, "car", INCIDENT_STREAM)
    lab._cloud.table.put(TELEMETRY, item_of(Batch("0badcafe", 0, [START + 20], columns), topic))
    (found,) = lab.incidents("car")
    assert (found.robot, found.id, found.bytes, found.changed_us) == ("car", kept.id, 5, START + 20)
    assert lab.incidents("car", START + 10) == []
    with pytest.raises(StationError, match="robot car8 is not registered; the nearest: car"):
        lab.incidents("car8")


def test_every_error_is_the_librarys(lab):
    with pytest.raises(UsageError, match="time must be"):
        lab.runs("car", "yesterday")
    with pytest.raises(UsageError, match="ends before it starts"):
        lab.findings("car", START, START - 1)
    for counting in (lab.runs, lab.findings, lab.laps):
        with pytest.raises(UsageError, match="count must be 1 or more, got -1"):
            counting("car", count=-1)
    with pytest.raises(UsageError, match="robot"):
        lab.query("no robot", "vesc")
    with pytest.raises(StationError, match="more than 10 values"):
        lab.query("car", "vesc", most=10)
    with pytest.raises(StationError, match="no speeed"):
        lab.query("car", "vesc", fields=["speeed"])

    class Refusing(FakeCloud):
        def client(self, _service):
            from botocore.exceptions import ClientError

            raise ClientError({"Error": {"Code": "AccessDenied"}}, "Query")

    with pytest.raises(StationError, match="AWS refused a call"):
        Lab(Refusing(None)).robots()


def test_laps_are_compared(driven):
    run = driven.laps("car")[0]
    assert not run.columns
    assert run.missing
    with pytest.raises(UsageError, match="no laps to compare"):
        run.compare(1, 2)
    assert np.all(driven.query("car", "vesc", where="speed > 48").columns["speed"] > 48)
