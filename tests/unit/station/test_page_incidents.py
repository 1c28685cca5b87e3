"""The page's answers about incidents: listed, counted, downloaded, and kept by a button or with a note."""

from __future__ import annotations

import base64
import hashlib
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from iort_contract.messages.files import File, file_key
from iort_contract.messages.recorder import KEPT, LOST, UPLOADED, Incident
from iort_station.data import findings
from iort_station.data.pictures import Line, Picture
from iort_station.errors import StationError, UsageError
from iort_station.fleet.control import slept
from iort_station.page import incidents as page
from iort_station.page import insights
from iort_station.page.answers import answers, downloads, keyed_actions
from testkit.dynamodb import FILES
from testkit.waiting import GUARD_S
from tests.unit.station.fleet.test_recorder import START, Lab, S

CONTENT = b"messages"


def incident(number: int, state: str = KEPT, start_us: int = START, **more: object) -> Incident:
    return Incident(f"{number:08x}", "brake", start_us, start_us + 40 * S, state, **more)  # type: ignore[arg-type]  # fields


@pytest.fixture
def lab():
    return Lab()


def test_a_robots_incidents_are_those_of_the_range_in_their_newest_state(lab):
    lab.tell(incident(1), START)
    lab.tell(incident(1, LOST, why="the ring has nothing"), START + S)
    lab.tell(incident(2, start_us=START + 100 * S), START + 100 * S)
    lab.tell(incident(3), START, robot="van")
    ask = answers(lab)["incidents"]
    told = ask({"robot": "car", "from_us": str(START)})
    assert told["found"] == 2
    second, first = told["incidents"]
    assert (second["id"], second["state"]) == ("00000002", KEPT)
    assert (first["state"], first["why"], first["robot"]) == (LOST, "the ring has nothing", "car")
    early = ask({"robot": "car", "from_us": str(START), "to_us": str(START + 60 * S)})
    assert [one["id"] for one in early["incidents"]] == ["00000001"]
    for wrong in ({"robot": "car"}, {"robot": "", "from_us": "0"}, {"robot": "car", "from_us": "-1"}):
        with pytest.raises(StationError):
            ask(wrong)


def test_a_list_is_cut_to_the_newest(lab, monkeypatch):
    monkeypatch.setattr(page, "_MOST", 1)
    for number in (1, 2):
        lab.tell(incident(number, start_us=START + number * S), START + number * S)
    told = page.incidents(lab, {"robot": "car", "from_us": "0"})
    assert ([one["id"] for one in told["incidents"]], told["found"]) == (["00000002"], 2)


def test_the_last_days_incidents_are_counted_by_robot(lab):
    now_us = time.time_ns() // 1000
    for number, robot, ago_s in ((1, "car", 60), (2, "car", 7_200), (3, "van", 60), (4, "van", 100_000)):
        lab.tell(incident(number, start_us=now_us - ago_s * S), now_us - ago_s * S, robot)
    assert answers(lab)["incident_counts"]({}) == {"counts": {"car": 2, "van": 1}}


class Held:
    """Counts the questions to a lab's table, and answers them while it ``may``."""

    def __init__(self, lab):
        self.asked, self.may = 0, threading.Event()
        self.begun = threading.Event()
        self.may.set()
        self._query, lab.table.query = lab.table.query, self.query

    def query(self, **given):
        self.asked += 1
        self.begun.set()
        assert self.may.wait(GUARD_S)
        return self._query(**given)


def test_they_are_counted_once_for_all_viewers_and_again_after_a_while(lab):
    now, held = [0.0], Held(lab)
    counts = page.Counts(lab, clock=lambda: now[0])
    with ThreadPoolExecutor(8) as viewers:
        assert list(viewers.map(lambda _: counts.answer(), range(8))) == [{"counts": {}}] * 8
    once = held.asked
    # A question a robot.
    assert 0 < once < 8
    now_us = time.time_ns() // 1000
    lab.tell(incident(1, start_us=now_us - 60 * S), now_us - 60 * S)
    now[0] = page.COUNTED_S - 1
    assert counts.answer() == {"counts": {}}
    assert held.asked == once
    now[0] = page.COUNTED_S
    assert counts.answer() == {"counts": {"car": 1}}


def test_who_asks_while_they_are_counted_gets_the_last_ones(lab):
    now, held = [0.0], Held(lab)
    counts = page.Counts(lab, clock=lambda: now[0])
    assert counts.answer() == {"counts": {}}
    held.may.clear()
    held.begun.clear()
    now_us = time.time_ns() // 1000
    lab.tell(incident(1, start_us=now_us), now_us)
    now[0] = page.COUNTED_S
    with ThreadPoolExecutor(1) as reader:
        reading = reader.submit(counts.answer)
        assert held.begun.wait(GUARD_S)
        assert counts.answer() == {"counts": {}}
        held.may.set()
        assert reading.result() == {"counts": {"car": 1}}


def test_a_failure_to_count_is_told_and_not_kept(lab):
    counts, query = page.Counts(lab), lab.table.query
    lab.table.query = lambda **_: (_ for _ in ()).throw(StationError("no such right"))
    with pytest.raises(StationError):
        counts.answer()
    lab.table.query = query
    assert counts.answer() == {"counts": {}}


def test_an_uploaded_incident_is_downloaded_and_checked(lab, s3, tmp_path, monkeypatch):
    lab.bucket = s3
    digest = hashlib.sha256(CONTENT).hexdigest()
    key = file_key("car", File("brake-1.mcap", "recording", "application/x-mcap", 8, digest, START))
    s3.put_object(Bucket=FILES, Key=key, Body=CONTENT, Metadata={"sha256": digest})
    lab.tell(incident(1), START)
    download = downloads(lab)["incident.mcap"]
    asked = {"robot": "car", "id": "00000001", "from_us": str(START)}
    with pytest.raises(StationError, match="car has uploaded no incident 00000001"):
        download(asked, tmp_path)
    lab.tell(incident(1, UPLOADED, key=key, bytes=8), START + S)
    path = download(asked, tmp_path)
    assert (path.name, path.read_bytes()) == ("brake-1.mcap", CONTENT)
    # A robot names its own files, and no other's.
    lab.tell(incident(2, UPLOADED, key=key, bytes=8), START, robot="van")
    with pytest.raises(StationError, match="not in the bucket any more"):
        download({**asked, "robot": "van", "id": "00000002"}, tmp_path)
    # The size is that of the file, whatever the robot has said of it.
    lab.tell(incident(3, UPLOADED, key=key, bytes=1), START + S)
    monkeypatch.setattr(page, "MOST_BYTES", 8)
    assert download({**asked, "id": "00000003"}, tmp_path) == path
    monkeypatch.setattr(page, "MOST_BYTES", 7)
    for id_ in ("00000001", "00000003"):
        with pytest.raises(StationError, match=f"over 7 bytes: run `iort incidents get {id_}`"):
            download({**asked, "id": id_}, tmp_path)
    s3.delete_object(Bucket=FILES, Key=key)
    monkeypatch.undo()
    with pytest.raises(StationError, match="not in the bucket any more"):
        download(asked, tmp_path)


def test_a_picture_is_made_once_and_the_last_ones_are_kept(lab, s3, monkeypatch):
    lab.bucket = s3
    made = []

    def make(_cloud, file):
        made.append(file.key)
        return Picture(b"jpeg", "/camera", 0.5) if len(made) == 1 else Picture(line=Line("x", [0.0], [1.0]))

    pictures = page.Pictures(lab, make)
    key = file_key("car", File("brake-1.mcap", "recording", "application/x-mcap", 8, "0" * 64, START))
    s3.put_object(Bucket=FILES, Key=key, Body=CONTENT)
    for number in (1, 2, 3):
        lab.tell(incident(number, UPLOADED, key=key, bytes=8), START)
    asked = [{"robot": "car", "id": f"{number:08x}", "from_us": str(START)} for number in (1, 2, 3)]
    nothing = {"jpeg": "", "topic": "", "after_s": 0.0, "field": "", "times_s": [], "values": []}
    first = {**nothing, "jpeg": base64.b64encode(b"jpeg").decode(), "topic": "/camera", "after_s": 0.5}
    assert [pictures.answer(asked[0]) for _ in range(3)] == [first] * 3
    assert made == [key]
    assert pictures.answer(asked[1]) == {**nothing, "field": "x", "times_s": [0.0], "values": [1.0]}
    # The one that nobody has asked for longest goes.
    monkeypatch.setattr(page, "MOST_PICTURES", 2)
    for each in (asked[0], asked[2], asked[0]):
        pictures.answer(each)
    assert len(made) == 3
    pictures.answer(asked[1])
    assert len(made) == 4
    with pytest.raises(StationError, match="car has uploaded no incident 00000009"):
        pictures.answer({**asked[0], "id": "00000009"})
    with pytest.raises(StationError, match="van has uploaded no incident"):
        pictures.answer({**asked[0], "robot": "van"})


@pytest.mark.parametrize(
    ("says", "online", "told"),
    [
        ("accepted", True, {"accepted": True, "reason": "", "online": True}),
        ("no recorder", True, {"accepted": False, "reason": "no recorder", "online": True}),
        ("", True, {"accepted": None, "reason": "", "online": True}),
        ("", False, {"accepted": None, "reason": "", "online": False}),
    ],
)
def test_the_button_has_a_robot_keep_the_last_seconds_and_tells_its_answer(says, online, told, monkeypatch):
    monkeypatch.setattr(page, "_ANSWER_S", 0.0)
    lab = Lab(says, online=online)
    assert slept(page.keep(lab, {"robot": "car", "last_s": "60"})) == told
    (taken,) = lab.takes().values()
    assert taken.to_us - taken.from_us == 60 * S
    assert taken.by


def test_only_what_a_recorder_may_keep_is_taken(lab):
    for last_s in ("0", "1801", "x"):
        with pytest.raises(StationError, match="last_s must be a whole number"):
            slept(page.keep(lab, {"robot": "car", "last_s": last_s}))
    assert not lab.takes()


def test_a_note_may_keep_what_was_before_it(lab, monkeypatch):
    class Table:
        def put_note(self, note):
            self.note = note

    monkeypatch.setattr(findings, "findings_table", lambda _cloud: Table())
    monkeypatch.setattr(insights, "notes", lambda _cloud, _request: {"notes": []})
    monkeypatch.setattr("iort_station.page.answers.has_drivers", lambda _cloud: False)
    write = keyed_actions(lab)["note"]
    write({"robot": "car", "text": "hit the kerb", "t_us": str(START), "keep_s": "60"})
    write({"robot": "car", "text": "a plain note"})
    (taken,) = lab.takes().values()
    assert (taken.from_us, taken.to_us, taken.why) == (START - 60 * S, START, "hit the kerb")
    with pytest.raises((StationError, UsageError)):
        write({"robot": "car", "text": "x", "keep_s": "7200"})
    assert len(lab.takes()) == 1
