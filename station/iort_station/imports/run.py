"""Imports recordings by their plans."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field

from iort_contract.archive import Hour, hour_of
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.recordings import RecordingError
from iort_contract.recordings.rosbag import Kind, Unread
from iort_contract.ros.decode import Decoder
from iort_contract.ros.definition import parse
from iort_station.cloud import Cloud
from iort_station.data.recorded import topic_of
from iort_station.fleet import registry
from iort_station.imports.attach import Attachments
from iort_station.imports.batches import FIRST_US, Counts, Run, Times, selected, time_of
from iort_station.imports.ledger import Ledger
from iort_station.imports.plan import Plan, begin, last_us
from iort_station.imports.stores import ARCHIVE, ArchiveStore, Store, TableStore

# Messages of an hour may come so much later: a header's stamp is believed for an hour.
_HOURS_OPEN = 2
# The progress is told after so many messages.
_EVERY = 1_000


@dataclass
class Outcome:
    """What came of one plan: the counts by stream, and where it stopped being good."""

    plan: Plan
    counts: dict[str, Counts] = field(default_factory=dict)
    end: str = ""
    unread: Mapping[str, str] = field(default_factory=dict)
    without_time: int = 0
    files: int = 0

    @property
    def samples(self) -> int:
        """The samples that are stored."""
        return sum(counts.stored for counts in self.counts.values())


def run(
    cloud: Cloud,
    robot: str,
    plans: Sequence[Plan],
    *,
    retention_s: int,
    units_per_s: int,
    every_s: float = 1.0,
    overlap: bool = False,
    progress: Callable[[int], None] = lambda _messages: None,
) -> list[Outcome]:
    """Import the plans that go on, in the order of their times; ``progress`` takes further messages. A plan
    is refused if another import has come before it, unless they may ``overlap``."""
    ledger, going = Ledger(cloud), [plan for plan in plans if plan.goes_on]
    topics = _Topics(cloud, robot)
    outcomes: list[Outcome] = []
    unwritten: list[Outcome] = []

    def settle() -> None:
        for outcome in unwritten:
            plan = outcome.plan
            ledger.done(plan.content, plan.entry(robot), outcome.samples, outcome.end)
            ledger.end(plan.entry(robot))
        unwritten.clear()

    own = {plan.run for plan in going}
    with closing(ArchiveStore(cloud, robot)) as archive:
        for number, plan in enumerate(going):
            plan.refused = begin(cloud, robot, plan, own, overlap=overlap)
            if not plan.refused:
                ledger.note(plan.content, plan.entry(robot))
                store: Store = archive
                if plan.store != ARCHIVE:
                    store = TableStore(cloud, units_per_s, again=plan.begun)
                times = Times(FIRST_US, last_us(), plan.shift_us)
                one = Run(topics, plan.run, store, times, retention_s)
                attachments = Attachments(cloud, robot, every_s)
                outcome = _Importing(Outcome(plan, one.counts), one, store, attachments, progress).all()
                outcomes.append(outcome)
                unwritten.append(outcome)
                registry.note_streams(cloud, robot, [*plan.streams, TYPES_STREAM])
            # An hour that the next one is in, too, is written once.
            following = going[number + 1 :]
            before = hour_of(following[0].first_us) if following else None
            archive.flush(before)
            if before is None or not archive.is_open():
                settle()
    return outcomes


@dataclass
class _Importing:
    """One import on its way."""

    outcome: Outcome
    run: Run
    store: Store
    attachments: Attachments
    progress: Callable[[int], None]

    def all(self) -> Outcome:
        """Import everything that can be read."""
        plan, outcome = self.outcome.plan, self.outcome
        losses: dict[str, int] = {}
        unread = Unread()
        outcome.unread = unread.lines
        try:
            if plan.is_log:
                self._log(losses)
            else:
                self._bag(unread, losses)
        except RecordingError as error:
            # What was read until there is good.
            outcome.end = str(error)
        outcome.end = outcome.end or (plan.scan.end if plan.scan is not None else "")
        losses.update({f"{topic}.unread": count for topic, count in unread.counts.items()})
        if outcome.end:
            losses[f"{plan.path.name}.unread"] = 1
        self.run.end(f"import {plan.path.name}", losses)
        outcome.without_time, outcome.files = sum(self.run.without_time.values()), self.attachments.kept
        return outcome

    def _log(self, losses: dict[str, int]) -> None:
        log = self.outcome.plan.log()
        with log as rows:
            for count, row in enumerate(rows, 1):
                self.run.sample(row.stream, row.stamp_ns // 1000, row.values)
                if count % _EVERY == 0:
                    self.progress(_EVERY)
        report = log.report()
        losses.update({f"skipped.{cause}": count for cause, count in report["skipped"].items()})
        losses.update({f"bad_cells.{column}": count for column, count in report["bad_cells"].items()})

    def _bag(self, unread: Unread, losses: dict[str, int]) -> None:
        plan = self.outcome.plan
        recording = plan.open(unread)
        streams = recording.open()
        ways: dict[int, tuple[Kind, _Way]] = {}
        hour: Hour | None = None
        try:
            for count, (kind, recorded_ns, raw) in enumerate(recording.raw(streams), 1):
                known = ways.get(id(kind))
                if known is None:
                    way = _Way(plan, kind, self.run, self.attachments)
                    known = ways[id(kind)] = kind, way
                    way.declare(recorded_ns, raw)
                known[1].take(recorded_ns, raw)
                if count % _EVERY == 0:
                    self.progress(_EVERY)
                    now = hour_of(recorded_ns // 1000 + plan.shift_us)
                    if now != hour:
                        over = Hour(now.number - _HOURS_OPEN)
                        self.run.settle(over)
                        self.store.flush(over)
                    hour = now
        finally:
            recording.close()
            for _, way in ways.values():
                losses.update(way.losses())


class _Way:
    """How the messages of one type of a topic become samples."""

    def __init__(self, plan: Plan, kind: Kind, run_: Run, attachments: Attachments) -> None:
        self._choice = plan.topics[kind.whole.topic]
        self._kind = kind._replace(stamped=False) if self._choice.arrival else kind
        self._run, self._attachments = run_, attachments
        self._decoder: Decoder | None = None
        if self._choice.fields and kind.whole.decoder is not None:
            definition = parse(kind.whole.name, kind.whole.definition)
            self._decoder = Decoder(definition, select=self._choice.fields)
        self._empty = 0

    def declare(self, recorded_ns: int, raw: bytes) -> None:
        """Import the type, with the first message of it."""
        if self._kind.sample is not None:
            self._run.sample(TYPES_STREAM, time_of(self._kind, recorded_ns, raw), self._kind.sample)

    def take(self, recorded_ns: int, raw: bytes) -> None:
        """Import a message."""
        kind = self._kind
        if self._decoder is not None:
            values = selected(self._decoder, raw)
            if values is None:
                self._empty += 1
            else:
                self._run.sample(kind.stream, time_of(kind, recorded_ns, raw), values)
        elif self._choice.upload and kind.large is not None:
            t_us = time_of(kind, recorded_ns, raw)
            self._run.sample(kind.stream, t_us, self._attachments.attached(kind, t_us, raw))
        else:
            self._run.message(kind, recorded_ns, raw)

    def losses(self) -> dict[str, int]:
        """What was not imported."""
        return {f"{self._kind.whole.topic}.malformed": self._empty} if self._empty else {}


class _Topics(dict[str, str]):
    """The topic of each stream."""

    def __init__(self, cloud: Cloud, robot: str) -> None:
        super().__init__()
        self._cloud, self._robot = cloud, robot

    def __missing__(self, stream: str) -> str:
        self[stream] = topic_of(self._cloud, self._robot, stream)
        return self[stream]
