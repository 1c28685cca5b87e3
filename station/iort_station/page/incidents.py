"""What robots' event recorders have kept, for the live page: lists, files, and what a viewer has one keep."""

from __future__ import annotations

import threading
import time
from base64 import b64encode
from collections import Counter, OrderedDict
from collections.abc import Callable, Generator, Mapping
from pathlib import Path

from iort_contract.messages import insights as messages
from iort_contract.messages.recorder import MAX_SPAN_S, UPLOADED
from iort_contract.topics import ACCEPTED
from iort_station.cloud import Cloud
from iort_station.data import incidents as stored
from iort_station.data.incidents import RobotIncident
from iort_station.data.pictures import Line, Picture, picture
from iort_station.errors import StationError
from iort_station.fleet import files, recorder
from iort_station.fleet.files import StoredFile
from iort_station.operations.alarms import user
from iort_station.page.history import MOST_BYTES
from iort_station.page.requests import robot_of, text, whole

_MOST = 100
_DAY_US = 86_400_000_000
# As often as a page asks.
COUNTED_S = 25.0
# Some kilobytes each.
MOST_PICTURES = 1000
# A robot that is connected looks once a second.
_ANSWER_S = 15.0


def incidents(cloud: Cloud, request: Mapping[str, str]) -> messages.IncidentsAnswer:
    """The newest incidents of ``robot`` with a part in ``from_us`` to ``to_us``; that end is optional."""
    start_us = whole(request, "from_us", 0, 2**53)
    end_us = whole(request, "to_us", 0, 2**53) if "to_us" in request else None
    found = stored.incidents(cloud, robot_of(request), start_us, end_us)
    return {"incidents": [_entry(one) for one in found[:_MOST]], "found": len(found)}


class Counts:
    """How many incidents of the last day each robot has. It reads them for all viewers, one at a time, and
    not again within `COUNTED_S`: every robot's stream is read for it."""

    def __init__(self, cloud: Cloud, clock: Callable[[], float] = time.monotonic) -> None:
        self._cloud, self._clock = cloud, clock
        self._reading = threading.Lock()
        # When it was read, and the answer; it is replaced as a whole.
        self._newest: tuple[float, messages.IncidentCounts] | None = None

    def answer(self) -> messages.IncidentCounts:
        """The counts; while somebody else reads, those from before."""
        newest = self._newest
        if newest is not None and (self._clock() < newest[0] + COUNTED_S or self._reading.locked()):
            return newest[1]
        with self._reading:
            if self._newest is newest:
                since_us, began = time.time_ns() // 1000 - _DAY_US, self._clock()
                found = stored.incidents(self._cloud, start_us=since_us)
                self._newest = began, {"counts": dict(Counter(one.robot for one in found))}
            assert self._newest is not None
            return self._newest[1]


class Pictures:
    """What is to be seen of incidents. A file does not change: each is made once, and the last ones are
    kept."""

    def __init__(self, cloud: Cloud, make: Callable[[Cloud, StoredFile], Picture] = picture) -> None:
        self._cloud, self._make = cloud, make
        self._kept: OrderedDict[tuple[str, str, str], messages.IncidentPicture] = OrderedDict()
        self._keeping = threading.Lock()

    def answer(self, request: Mapping[str, str]) -> messages.IncidentPicture:
        """The picture of the uploaded incident ``id`` of ``robot``, which begins at ``from_us``."""
        named = (robot_of(request), text(request, "id"), text(request, "from_us"))
        with self._keeping:
            if named in self._kept:
                self._kept.move_to_end(named)
                return self._kept[named]
        made = _shown(self._make(self._cloud, _file(self._cloud, request)[1]))
        with self._keeping:
            self._kept[named] = made
            while len(self._kept) > MOST_PICTURES:
                self._kept.popitem(last=False)
        return made


def _shown(made: Picture) -> messages.IncidentPicture:
    line = made.line or Line("", [], [])
    return {
        "jpeg": b64encode(made.jpeg).decode(),
        "topic": made.topic,
        "after_s": made.after_s,
        "field": line.field,
        "times_s": line.times_s,
        "values": line.values,
    }


def keep(cloud: Cloud, request: Mapping[str, str]) -> Generator[None, None, messages.KeepAnswer]:
    """Have ``robot`` keep the last ``last_s``. It yields while it waits for the robot's answer."""
    robot, last_s = robot_of(request), whole(request, "last_s", 1, round(MAX_SPAN_S))
    now_us = time.time_ns() // 1000
    taken = recorder.take(cloud, robot, now_us - last_s * 1_000_000, now_us, by=user())
    answer = yield from recorder.take_answering(cloud, robot, taken, _ANSWER_S)
    accepted = answer.text == ACCEPTED if answer.text else None
    return {"accepted": accepted, "reason": answer.text if answer.refused else "", "online": answer.online}


def download(cloud: Cloud, request: Mapping[str, str], folder: Path) -> Path:
    """The file of the incident ``id`` of ``robot``, which begins at ``from_us``."""
    id_, file = _file(cloud, request)
    # Of the file itself: the robot has said how large it is.
    if file.size > MOST_BYTES:
        raise StationError(f"it has over {MOST_BYTES:,} bytes: run `iort incidents get {id_}`")
    return files.download(cloud, file, folder)


def _file(cloud: Cloud, request: Mapping[str, str]) -> tuple[str, StoredFile]:
    """The id and the file of the incident that a request names."""
    robot, id_, from_us = robot_of(request), text(request, "id"), whole(request, "from_us", 0, 2**53)
    found = stored.incidents(cloud, robot, from_us, from_us + 1)
    one = next((one.incident for one in found if one.incident.id == id_), None)
    if one is None or one.state != UPLOADED:
        raise StationError(f"{robot} has uploaded no incident {id_[:40]}")
    file = files.stored(cloud, one.key)
    # The robot itself has named the key.
    if file is None or file.robot != robot:
        raise StationError(f"the file of {one.id} is not in the bucket any more")
    return one.id, file


def _entry(one: RobotIncident) -> messages.IncidentEntry:
    incident = one.incident
    return {
        "id": incident.id,
        "robot": one.robot,
        "from_us": incident.from_us,
        "to_us": incident.to_us,
        "trigger": incident.trigger,
        "state": incident.state,
        "condition": incident.condition,
        "why": incident.why,
        "by": incident.by,
        "bytes": incident.bytes,
        "messages": incident.messages,
        "missing": incident.missing,
    }
