"""What an import would bring: the recordings among some paths, opened and counted; and what speaks against
one."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.dynamodb import starting_between
from iort_contract.limits import ContractError
from iort_contract.messages.batch import batch_id
from iort_contract.recordings import RecordingError
from iort_contract.recordings.files import INDEX, Reader
from iort_contract.recordings.rosbag import Recording, Unread
from iort_contract.recordings.scan import Scan
from iort_contract.recordings.tool_csv import VescLog
from iort_contract.tables import BATCH
from iort_station.cloud import Cloud
from iort_station.data.mcap_files import metadata
from iort_station.data.recorded import Recorded
from iort_station.errors import StationError, UsageError
from iort_station.imports.batches import FIRST_US
from iort_station.imports.choice import Choice, TopicChoice
from iort_station.imports.ledger import Import, Ledger, content_of, shared
from iort_station.imports.stores import ARCHIVE, TABLE
from iort_station.times import iso

_SUFFIXES = (".bag", ".mcap", ".db3", ".csv")
_METADATA = "metadata.yaml"
# A clock may be ahead by this much.
_AHEAD_US = 86_400_000_000
# A drive of which this share of the table's retention has passed goes into the archive.
_OLD = 0.9


@dataclass
class Plan:
    """One recording: its content, the topics that are imported and how, and what it holds. ``run`` names its
    run of the agent; ``store`` is the table or the archive. ``refused`` says why it is not imported, and what
    to do; ``there`` that it is imported already; ``begun`` that an import of it was interrupted. ``notes``
    are for the operator."""

    path: Path
    size: int
    content: str = ""
    run: str = ""
    store: str = TABLE
    topics: dict[str, TopicChoice] = field(default_factory=dict)
    kinds: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    first_us: int = 0
    last_us: int = 0
    shift_us: int = 0
    scan: Scan | None = None
    notes: list[str] = field(default_factory=list)
    refused: str = ""
    there: str = ""
    begun: bool = False

    @property
    def is_log(self) -> bool:
        """Whether it is a log of VESC Tool."""
        return self.path.suffix.lower() == ".csv"

    @property
    def streams(self) -> dict[str, int]:
        """The samples by stream."""
        counts: Counter[str] = Counter()
        for topic, choice in self.topics.items():
            counts[choice.stream] += self.counts.get(topic, 0)
        return dict(sorted(counts.items()))

    @property
    def goes_on(self) -> bool:
        """Whether it is to be imported."""
        return not self.refused and not self.there

    def entry(self, robot: str) -> Import:
        """The note of its import."""
        streams = tuple(self.streams)
        return Import(robot, self.run, self.store, streams, self.path.name, self.first_us, self.last_us)

    def open(self, unread: Unread) -> Recording:
        """The recording, of a bag."""
        topics = tuple((topic, choice.stream) for topic, choice in self.topics.items())
        large = any(choice.upload for choice in self.topics.values())
        return Recording(self.path, topics, "", unread, large=large, reader=self.scan)

    def log(self) -> VescLog:
        """The recording, of VESC Tool."""
        (choice,) = self.topics.values()
        return VescLog(self.path, choice.stream, original=not self.shift_us)


def recordings(given: Sequence[str]) -> Iterator[Path]:
    """The recordings that some paths name: files, folders of ROS 2, folders with recordings, and patterns.
    Each comes once. Raises `UsageError` for a path without any."""
    found: dict[Path, None] = {}
    for one in given:
        path = Path(one).expanduser()
        # A pattern that no shell has expanded.
        paths = (
            [path] if path.exists() else sorted(Path(path.anchor).glob(str(path.relative_to(path.anchor))))
        )
        if not paths:
            raise UsageError(f"{one}: no such file or folder")
        try:
            seen: set[Path] = set()
            some = [each for path in paths for each in _within(path, seen)]
        except OSError as error:
            raise UsageError(f"{error.filename}: cannot be read: {error.strerror}") from error
        if not some:
            raise UsageError(f"{one}: has no recording: {', '.join(_SUFFIXES)}, or a folder of ROS 2")
        found.update(dict.fromkeys(each.resolve() for each in some))
    yield from found


def _within(path: Path, seen: set[Path]) -> Iterator[Path]:
    """The recordings of a path. Folders that were ``seen`` are not entered again: links may go round."""
    if path.is_file():
        # The file of a folder of ROS 2 stands for the folder.
        is_part = path.suffix in {".mcap", ".db3"} and (path.parent / _METADATA).is_file()
        yield path.parent if is_part else path
    elif (path / _METADATA).is_file():
        yield path
    elif path.is_dir() and (folder := path.resolve()) not in seen:
        seen.add(folder)
        for each in sorted(path.iterdir()):
            if each.is_dir() or each.suffix.lower() in _SUFFIXES:
                yield from _within(each, seen)


def look(
    paths: Sequence[Path],
    choice: Choice,
    *,
    start_us: int | None,
    progress: Callable[[float], None] = lambda _bytes: None,
) -> list[Plan]:
    """Open the recordings, and count what they hold; in the order of their times. Of one that cannot be read
    the plan says why."""
    plans: list[Plan] = []
    for path in paths:
        files = [path] if path.is_file() else sorted(one for one in path.iterdir() if one.is_file())
        plan = Plan(path, sum(one.stat().st_size for one in files))
        plans.append(plan)
        try:
            _survey(plan, choice, start_us)
        except RecordingError as error:
            plan.refused = str(error)
            continue
        plan.content = content_of([one for one in files if one.name != _METADATA], progress)
        settings = repr((sorted(plan.topics.items()), plan.shift_us)).encode()
        plan.run = sha256(plan.content.encode() + settings).hexdigest()[:16]
    return sorted(plans, key=lambda one: (one.first_us, str(one.path)))


def _survey(plan: Plan, choice: Choice, start_us: int | None) -> None:
    if not plan.size:
        raise RecordingError(f"{plan.path}: is empty: was it copied whole?")
    if plan.is_log:
        _survey_log(plan, choice, start_us)
    else:
        reader: Any = _opened(plan)
        try:
            plan.kinds = {one.topic: one.msgtype for one in reader.connections}
            counts = reader.counts()[INDEX]
            plan.first_us, plan.last_us = reader.start_ns // 1000, reader.end_ns // 1000
        finally:
            reader.close()
        if not any(counts.values()):
            raise RecordingError(f"{plan.path}: it has no message")
        there = {topic: kind for topic, kind in plan.kinds.items() if counts.get(topic)}
        plan.topics, left_out = choice.of(there)
        plan.left_out.update(left_out)
        plan.counts = {topic: counts[topic] for topic in plan.topics}
        if not plan.topics:
            why = "; ".join(f"{topic}: {why}" for topic, why in plan.left_out.items())
            raise RecordingError(f"{plan.path}: no topic of it is imported ({why})")
        if start_us is not None:
            plan.shift_us = start_us - plan.first_us
    plan.first_us += plan.shift_us
    plan.last_us += plan.shift_us
    _check_clock(plan)


def _survey_log(plan: Plan, choice: Choice, start_us: int | None) -> None:
    stream = choice.vesc_stream
    with VescLog(plan.path, stream, original=start_us is None) as rows:
        times_us = [row.stamp_ns // 1000 for row in rows]
    plan.topics, plan.counts = {"": TopicChoice(stream)}, {"": len(times_us)}
    plan.first_us, plan.last_us, plan.shift_us = min(times_us), max(times_us), start_us or 0


def _opened(plan: Plan) -> Reader | Scan:
    """The recording, by its index or without one."""
    reader = Reader(plan.path)
    try:
        reader.open()
    except RecordingError as error:
        scan = Scan(plan.path)
        scan.open()
        if not scan.connections:
            raise RecordingError(f"{error}; without its index no message of it can be read either") from error
        plan.scan = scan
        plan.notes.append(scan.end or f"read without its index: {_short(error)}")
        plan.left_out.update({topic: form or "not ROS" for topic, form in scan.skipped.items()})
        return scan
    return reader


def _short(error: Exception) -> str:
    return str(error).partition(": ")[2].partition(";")[0]


def _check_clock(plan: Plan) -> None:
    now_us = time.time_ns() // 1000
    if plan.last_us < FIRST_US:
        raise RecordingError(
            f"{plan.path}: its clock was not set: it begins at {iso(plan.first_us)}; --start TIME gives the "
            "time of its first message"
        )
    if plan.first_us > now_us + _AHEAD_US:
        raise RecordingError(
            f"{plan.path}: its clock was ahead: it begins at {iso(plan.first_us)}; --start TIME gives the "
            "time of its first message"
        )
    if plan.last_us > now_us + _AHEAD_US:
        plan.notes.append(f"what it has until {iso(plan.last_us)}, when its clock was ahead, is left out")
        plan.last_us = last_us()
    if plan.first_us < FIRST_US:
        plan.notes.append(f"what it has before its clock was set, from {iso(plan.first_us)}, is left out")


def last_us() -> int:
    """The latest time that is believed."""
    return time.time_ns() // 1000 + _AHEAD_US


def check(
    cloud: Cloud, robot: str, plans: Sequence[Plan], *, archive: bool, overlap: bool, retention_s: int
) -> None:
    """Decide about each plan: where it goes, whether it is there already, and what speaks against it."""
    ledger, accepted = Ledger(cloud), list[Plan]()
    old_us = time.time_ns() // 1000 - round(_OLD * retention_s * 1e6)
    for plan in plans:
        if plan.refused:
            continue
        # Of a drive on the border, the table would delete the beginning before it is archived.
        begin_us = plan.first_us if plan.first_us >= FIRST_US else plan.last_us
        plan.store = ARCHIVE if archive or begin_us < old_us else TABLE
        imports = ledger.of(plan.content)
        own = next((one for one in imports if (one.robot, one.run) == (robot, plan.run)), None)
        if own is not None and own.done_ms:
            plan.there = f"imported on {iso(own.done_ms * 1000)}"
            continue
        if own is not None:
            # It goes on where it was begun.
            plan.begun, plan.store = True, own.store
        if not overlap:
            plan.refused = (
                _of_another(plan, robot, imports)
                or _twice(plan, robot, imports)
                or _among(plan, accepted)
                or ("" if plan.begun else _recorded(cloud, robot, plan, {plan.run}))
            )
        if not plan.refused:
            accepted.append(plan)


def _of_another(plan: Plan, robot: str, imports: Sequence[Import]) -> str:
    other = next((one for one in imports if one.robot != robot), None)
    if other is not None:
        return (
            f"{plan.path}: is imported for {other.robot} already, and a recording is of one robot; "
            f"--overlap imports it for {robot}, too"
        )
    said = said_robot(plan.path)
    if said not in {"", robot}:
        return f"{plan.path}: says that it is {said}'s, and not {robot}'s; --overlap imports it all the same"
    return ""


def _twice(plan: Plan, robot: str, imports: Sequence[Import]) -> str:
    for one in imports:
        both = sorted(set(one.streams) & set(plan.streams))
        if one.robot == robot and one.run != plan.run and both:
            return (
                f"{plan.path}: its {', '.join(both)} is imported already, with other settings: import the "
                "other topics by --topic; --overlap imports it a second time"
            )
    return ""


def _among(plan: Plan, others: Sequence[Plan]) -> str:
    for one in others:
        if both := shared(one.entry(""), plan.entry("")):
            return f"{plan.path}: overlaps {one.path} in {', '.join(both)}: leave one; --overlap imports both"
    return ""


def begin(cloud: Cloud, robot: str, plan: Plan, own: Collection[str], *, overlap: bool) -> str:
    """Begin a plan's import, unless another one imports the same time, or has done so since `check`: returns
    why not. ``own`` are the runs that are imported together."""
    ledger, entry = Ledger(cloud), plan.entry(robot)
    if (other := ledger.begin(entry, overlap=overlap)) is not None:
        both = ", ".join(shared(other, entry))
        return (
            f"{plan.path}: overlaps {other.name} in {both}, whose import has begun: let it end, or do it "
            "again if it was interrupted; --overlap imports both"
        )
    if not (overlap or plan.begun) and (why := _recorded(cloud, robot, plan, own)):
        ledger.end(entry)
        return why
    return ""


def _recorded(cloud: Cloud, robot: str, plan: Plan, own: Collection[str]) -> str:
    """Whether the robot has recorded in the same time, by other runs than its ``own``."""
    for stream in plan.streams:
        if stream in OWN_STREAMS:
            continue
        keys = starting_between(plan.first_us, plan.last_us)
        for item in Recorded(cloud, robot, stream).headers(keys, (BATCH,)):
            try:
                one = batch_id(item[BATCH]["S"])
            except ContractError:
                continue
            if one.boot not in own:
                return (
                    f"{plan.path}: {robot} has {stream} of this time already, at {iso(one.t_us)} by the run "
                    f"{one.boot}: is it the same drive? --overlap imports it beside that"
                )
    return ""


def said_robot(path: Path) -> str:
    """The robot that a file says it is of, as an incident does; empty if it says none."""
    if path.suffix != ".mcap":
        return ""
    # A file without an index, or with a damaged one, says nothing.
    with suppress(StationError):
        for one in metadata(path):
            if robot := _robot_of(one.metadata):
                return robot
    return ""


def _robot_of(metadata: Mapping[str, str]) -> str:
    try:
        agent = json.loads(metadata.get("agent", "{}"))
    except ValueError:
        return ""
    return str(agent.get("robot", "")) if isinstance(agent, dict) else ""
