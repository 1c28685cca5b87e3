"""Incidents as the operator sees them: merged from samples, listed, downloaded, and kept with a note."""

from __future__ import annotations

import hashlib
import json

import pytest
from typer.testing import CliRunner

from iort_contract.catalog.streams import INCIDENT_STREAM
from iort_contract.messages.files import File, file_key
from iort_contract.messages.recorder import KEPT, LOST, OVER_BUDGET, UPLOADED, Incident
from iort_station.cli.main import app
from iort_station.cli.options import CloudOptions
from iort_station.data import findings
from iort_station.data.incidents import incidents
from iort_station.errors import StationError, UsageError
from testkit.dynamodb import FILES
from tests.unit.station.fleet.test_recorder import START, Lab, S

CONTENT = b"messages"


def incident(state: str = KEPT, number: int = 1, start_us: int = START, **more: object) -> Incident:
    return Incident(f"{number:08x}", "brake", start_us, start_us + 40 * S, state, **more)  # type: ignore[arg-type]  # fields


@pytest.fixture
def lab():
    return Lab()


@pytest.fixture
def iort(lab, monkeypatch):
    monkeypatch.setattr(CloudOptions, "cloud", lambda _self: lab)
    return lambda *words: CliRunner().invoke(app, words, env={"COLUMNS": "160"})


def test_an_incident_is_listed_once_in_its_newest_state(lab):
    lab.tell(incident(), START + 30 * S)
    lab.tell(incident(KEPT, bytes=2_000_000, messages=7), START + 45 * S)
    lab.tell(incident(UPLOADED, bytes=2_000_000, messages=7, missing=1), START + 86_400 * S)
    lab.tell(incident(number=2, start_us=START + 60 * S), START + 90 * S, robot="van")

    second, first = incidents(lab)

    assert (second.robot, second.incident.state) == ("van", KEPT)
    assert (first.robot, first.t_us) == ("car", START + 86_400 * S)
    # Every number is whole again.
    assert first.incident == incident(UPLOADED, bytes=2_000_000, messages=7, missing=1)
    assert isinstance(first.incident.bytes, int)
    assert incidents(lab, "car") == [first]


def test_an_upload_counts_although_the_clock_was_set_back_before_it(lab):
    lab.tell(incident(), START + 30 * S)
    lab.tell(incident(UPLOADED), START - 30 * S)
    assert incidents(lab, "car")[0].incident.state == UPLOADED


@pytest.mark.parametrize(
    ("start_s", "end_s", "there"),
    [(None, None, True), (0, 1, True), (40, 60, True), (-60, 0, False), (41, 60, False), (None, 0, False)],
)
def test_a_range_has_the_incidents_whose_window_has_a_part_in_it(lab, start_s, end_s, there):
    lab.tell(incident(), START + 30 * S)
    lab.tell(incident(UPLOADED), START + 86_400 * S)
    start_us, end_us = (None if at is None else START + at * S for at in (start_s, end_s))
    assert [one.incident.state for one in incidents(lab, "car", start_us, end_us)] == [UPLOADED] * there


def test_a_sample_that_is_no_incident_is_passed_over(lab):
    lab.record(INCIDENT_STREAM, {"id": ["no id"], "state": ["kept"]})
    lab.record(INCIDENT_STREAM, {"id": [7.5], "state": [None]})
    lab.tell(incident(), START + 30 * S)
    assert len(incidents(lab, "car")) == 1


def test_a_table_of_incidents_says_why_one_is_not_uploaded(lab, iort):
    lab.tell(incident(OVER_BUDGET, why="brake has spent its 500 MB"), START)
    lab.tell(incident(UPLOADED, number=2, bytes=12_300_000, missing=3), START)
    lab.tell(incident(KEPT, number=3, why="speed=3"), START)
    done = iort("incidents", "car")
    assert done.exit_code == 0, done.output
    # A narrow terminal breaks words in other columns.
    for number, state in ((1, "over budget"), (2, "uploaded")):
        assert any(state in line and f"{number:08x}" in line for line in done.stdout.splitlines())
    assert done.stderr == "car 00000001: brake has spent its 500 MB\n"
    told = json.loads(iort("incidents", "--json").stdout)
    assert [one["id"] for one in told] == ["00000001", "00000002", "00000003"]
    assert (told[1]["from"], told[1]["bytes"]) == ("2023-11-14T22:13:20.000000Z", 12_300_000)
    assert "no incidents in this range" in iort("incidents", "van").stderr
    assert "van1 is not registered" in str(iort("incidents", "van1").exception)


@pytest.fixture
def bucket(lab, s3):
    lab.bucket = s3
    assert lab.output("storage", "FilesBucket") == FILES

    def put(number: int = 1, sha256: str | None = None) -> None:
        digest = hashlib.sha256(CONTENT).hexdigest()
        file = File(f"brake-{number:08x}.mcap", "recording", "application/x-mcap", 8, digest, START)
        key = file_key("car", file)
        s3.put_object(Bucket=FILES, Key=key, Body=CONTENT, Metadata={"sha256": sha256 or digest})
        lab.tell(incident(UPLOADED, number, key=key, bytes=8), START + number)

    return put


def test_incidents_are_downloaded_and_checked(lab, iort, bucket, tmp_path):
    bucket()
    bucket(2)
    lab.tell(incident(KEPT, 3), START)
    done = iort("incidents", "get", "00000001", "--out", str(tmp_path))
    assert done.exit_code == 0, done.output
    assert (tmp_path / "brake-00000001.mcap").read_bytes() == CONTENT
    assert iort("incidents", "get", "--all", "--robot", "car", "--out", str(tmp_path)).exit_code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["brake-00000001.mcap", "brake-00000002.mcap"]
    bucket(4, sha256="0" * 64)
    assert "1 of 3 files could not be fetched" in str(
        iort("incidents", "get", "--all", "--out", str(tmp_path)).exception
    )


def test_what_cannot_be_downloaded_is_named(lab, iort, bucket, tmp_path):
    lab.tell(incident(LOST, 3, why="the ring has nothing"), START)
    get = ("incidents", "get", "--out", str(tmp_path))
    assert "is not uploaded, but lost: the ring has nothing" in str(iort(*get, "00000003").exception)
    assert "no incident 00000009 in this range; the nearest: 00000003" in str(
        iort(*get, "00000009").exception
    )
    bucket()
    lab.bucket.delete_object(Bucket=FILES, Key=incidents(lab, "car")[0].incident.key)
    assert "not in the bucket any more: 00000001" in str(iort(*get, "--all").exception)
    assert "give the ids of incidents, or --all" in str(iort(*get).exception)


def test_a_key_that_is_none_of_the_robot_s_stops_no_other_download(lab, iort, bucket, tmp_path):
    bucket()
    bucket(2)
    theirs = incidents(lab, "car")[0].incident.key
    lab.tell(incident(UPLOADED, 7, key="../../etc/passwd"), START + 7)
    lab.tell(incident(UPLOADED, 8, key=theirs), START + 8, robot="van")
    done = iort("incidents", "get", "--all", "--out", str(tmp_path))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["brake-00000001.mcap", "brake-00000002.mcap"]
    told = str(done.exception)
    assert told.startswith("not in the bucket any more: ")
    assert "00000007" in told
    assert "00000008" in told


def test_samples_of_other_types_stop_no_listing(lab):
    lab.record(INCIDENT_STREAM, {"id": ["feedbeef"], "state": [5], "from_us": ["x"], "bytes": ["many"]})
    lab.record(INCIDENT_STREAM, {"id": ["feedbeee"], "state": ["kept"], "from_us": [1e300], "to_us": [True]})
    lab.tell(incident(), START + 30 * S)
    assert [one.incident.id for one in incidents(lab)] == ["00000001"]


class Notes:
    """A table that keeps notes."""

    def __init__(self) -> None:
        self.notes: list[object] = []

    def put_note(self, note: object) -> None:
        self.notes.append(note)


def test_a_note_may_keep_the_messages_before_it(lab, iort, monkeypatch):
    table = Notes()
    monkeypatch.setattr(findings, "findings_table", lambda _cloud: table)
    done = iort("note", "car", "hit the wall", "--at", "2023-11-14T22:13:20Z", "--keep", "60s", "--by", "ann")
    assert done.exit_code == 0, done.output
    (taken,) = lab.takes().values()
    assert (taken.from_us, taken.to_us) == (START - 60 * S, START)
    assert (taken.by, taken.why) == ("ann", "hit the wall")
    iort("note", "car", "a plain note")
    assert (len(table.notes), len(lab.takes())) == (2, 1)
    # Nothing is written if it cannot be kept.
    long = iort("note", "car", "x", "--keep", "2h")
    assert "at most 1800 s; nothing is written" in str(long.exception)
    assert len(table.notes) == 2
    with pytest.raises(StationError):
        findings.write_note(lab, "car1", "x", by="", keep_us=S)
    assert isinstance(iort("note", "car", "--keep", "60s").exception, UsageError)


def test_no_note_is_written_if_the_shadow_has_no_room_for_what_it_keeps(lab, iort, monkeypatch):
    table = Notes()
    monkeypatch.setattr(findings, "findings_table", lambda _cloud: table)
    full = {f"t{i}": {"when": "x" * 560} for i in range(7)}
    lab.states["car"] = {"desired": {"recorder": {"triggers": full}}}
    refused = iort("note", "car", "hit the wall", "--keep", "60s")
    assert refused.exit_code != 0
    assert "its shadow has no more room; nothing is changed" in str(refused.exception)
    assert (table.notes, lab.takes()) == ([], {})
    # Once there is room, it is written once.
    lab.states["car"]["desired"]["recorder"]["triggers"].popitem()
    again = iort("note", "car", "hit the wall", "--keep", "60s")
    assert again.exit_code == 0, again.output
    assert (len(table.notes), len(lab.takes())) == (1, 1)
