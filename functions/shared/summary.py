"""An event of `summarize` or `later`, from its records to the summary table, for every caller."""

from __future__ import annotations

import gc
import logging
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cache
from itertools import chain
from typing import Any

from botocore.config import Config

from functions.shared import clients
from functions.shared.clients import connect, variables
from functions.shared.direct import Direct
from functions.shared.incidents import Announcer
from functions.shared.metrics import MOST_VALUES, emit
from functions.shared.queues import DeadLetterQueue, Refused
from functions.shared.seconds import SECOND_BATCHES, Summaries, keep_decoded, summarize_topic
from functions.shared.share import REQUESTS_S, Change, OverShareError, Share, robot_of, robot_of_change
from functions.shared.tables import Tables
from iort_contract.catalog.environments import LaterEnvironment
from iort_contract.catalog.streams import AGENT_STREAM, INCIDENT_STREAM, RTT_FIELDS, RTT_STREAM
from iort_contract.catalog.vesc import FAULT_FIELD, TEMPERATURES, VOLTAGE_FIELD, measured_degc
from iort_contract.codec import Statistics
from iort_contract.dynamodb import TableError, plain, quick
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch, BatchId, decode_item
from iort_contract.statistics import count_holes, numbers_of
from iort_contract.tables import PUT_OFF_TO_S, RECEIVED_MS, RECOMPUTE_FROM_S, RECOMPUTED, REPLAY
from iort_contract.topics import PING_PATHS, parse_topic

_log = logging.getLogger(__name__)


@dataclass
class Decoded:
    """The good batches of some stream records by topic, the refused ones, and the waiting ones; ``at_s`` is
    the newest arrival in the table."""

    batches: dict[str, list[Batch]] = field(default_factory=lambda: defaultdict(list))
    records: dict[tuple[str, BatchId], Change] = field(default_factory=dict)
    refused: list[Refused] = field(default_factory=list)
    put_off: list[Change] = field(default_factory=list)
    at_s: float = 0.0

    def refuse(self, topic: str, keys: AbstractSet[BatchId], reason: str) -> None:
        """Add batches of a topic to the refused ones."""
        self.batches[topic] = [batch for batch in self.batches[topic] if batch.id not in keys]
        for change in (self.records[topic, key] for key in sorted(keys)):
            self.refused.append(Refused(change["SequenceNumber"], reason, change["NewImage"]))

    def wait(self, topic: str) -> None:
        """Move the batches of a topic to the waiting ones."""
        self.put_off += [self.records[topic, batch.id] for batch in self.batches.pop(topic)]

    def news(self, since_ms: int) -> dict[str, list[Batch]]:
        """The batches that the cloud received since then, by topic."""
        found: dict[str, list[Batch]] = {}
        for topic, batches in self.batches.items():
            for batch in batches:
                received = self.records[topic, batch.id]["NewImage"].get(RECEIVED_MS)
                if received is None or Decimal(received["N"]) >= since_ms:
                    found.setdefault(topic, []).append(batch)
        return found


def decode_records(records: Iterable[Mapping[str, Any]], share: Share | None = None) -> Decoded:
    """Decode stream records and charge each to its robot. Records over the robot's share are not decoded.
    Removals (expiry) carry no image and are skipped, and so are expiries that the archive has put off."""
    share = share or Share.unlimited()
    decoded = Decoded()
    for record in records:
        change = record["dynamodb"]
        image = change.get("NewImage")
        # The rule stores a batch that is sent again as a whole, without this attribute.
        if image is None or (record["eventName"] == "MODIFY" and PUT_OFF_TO_S in image):
            continue
        at_s = float(change.get("ApproximateCreationDateTime", time.time()))
        decoded.at_s = max(decoded.at_s, at_s)
        robot = robot_of_change(change)
        if robot and share.over(robot, at_s):
            decoded.put_off.append(change)
            continue
        meter = share.meter(robot, at_s)
        try:
            item = plain(image)
            topic, batch = decode_item(item)
        except ContractError as error:
            _log.warning("refused %s of %s: %s", change["Keys"], record["eventID"], error)
            decoded.refused.append(Refused(change["SequenceNumber"], str(error), image))
            meter.charge(REQUESTS_S)
        else:
            keep_decoded(str(topic), item, batch)
            decoded.batches[str(topic)].append(batch)
            decoded.records[str(topic), batch.id] = change
            meter.charge()
    return decoded


# The cars' metrics, function ``health``.
Measured = Mapping[str, float | list[float]]


def measure(stream: str, batches: Sequence[Batch]) -> Measured:
    """The metrics of one robot's batches of one stream; each batch counts once, however many seconds it has.

    Battery (V) and temperature (degC) are the worst of the batches; gaps between samples are counted within
    each batch.
    """
    if stream == RTT_STREAM:
        return {f"RoundTrip{path.capitalize()}Ms": _numbers(batches, RTT_FIELDS[path]) for path in PING_PATHS}
    if stream == AGENT_STREAM:
        backlog = _numbers(batches, "backlog_batches")
        return {
            "AgentReports": sum(len(batch.times_us) for batch in batches),
            "BacklogBatches": backlog[-1:],
            "ThreadErrors": sum(_numbers(batches, "thread_errors")),
        }
    volts = [value for value in _numbers(batches, VOLTAGE_FIELD) if value > 0]
    # A temperature has few different values.
    found = (measured_degc(name, value) for name in TEMPERATURES for value in set(_numbers(batches, name)))
    degc = [value for value in found if value is not None]
    return {
        "SampleGaps": sum(count_holes(batch.times_us) for batch in batches),
        "FaultSamples": sum(map(bool, _numbers(batches, FAULT_FIELD))),
        "BatteryVolts": [min(volts)] if volts else [],
        "TemperatureDegC": [max(degc)] if degc else [],
    }


def together(measured: Iterable[Measured]) -> Iterator[Measured]:
    """Merge the metrics of several robots into as few log lines as possible: counts are added, values are
    listed."""
    counts: dict[str, float] = {}
    values: dict[str, list[float]] = {}
    for one in measured:
        for name, value in one.items():
            if isinstance(value, list):
                values.setdefault(name, []).extend(value)
            else:
                counts[name] = counts.get(name, 0) + value
    yield {**counts, **{name: found[:MOST_VALUES] for name, found in values.items()}}
    for start in range(MOST_VALUES, max(map(len, values.values()), default=0), MOST_VALUES):
        yield {name: found[start : start + MOST_VALUES] for name, found in values.items()}


def _numbers(batches: Iterable[Batch], name: str) -> list[int | float]:
    columns = (batch.columns.get(name, ()) for batch in batches)
    return list(chain.from_iterable(map(numbers_of, columns)))


# Topics to process in parallel; a client keeps ten connections.
_AT_ONCE = 4
# A stream keeps its records for 24 hours. Older ones were put into the table by hand (`iort move`, a
# replay), and are no news of their car.
_NEWS_MS = 24 * 3_600_000
# A car adds to a second for a second, and a round reads it after that.
_ROUNDS = 5
_BEYOND = f"its second has {SECOND_BATCHES} batches of the stream before it, or too large ones"
logging.getLogger("functions").setLevel(logging.INFO)


Refuse = Callable[[Sequence[Refused]], Sequence[Refused]]
# Tells of a topic's incidents; returns the batches to give again.
Announce = Callable[[str, Sequence[Batch]], Sequence[Batch]]


@dataclass(frozen=True)
class Bounds:
    """The limits of a robot's share: the shares, the queue for waiting batches, and the robot's notice."""

    share: Share
    put_off: Callable[[Sequence[Change]], Sequence[Change]]
    tell: Callable[[str, int, float], None]


def process(
    event: Mapping[str, Any],
    tables: Tables,
    refuse: Refuse,
    *,
    bounds: Bounds | None = None,
    beside_others: bool = False,
    robot_metrics: bool = False,
    at_once: int = 1,
    news_since_ms: int = 0,
    announce: Announce | None = None,
) -> dict[str, Any]:
    """Summarise the event's records. Undecodable records go to ``refuse``, since a retry would not help.
    Records over a robot's share wait, by ``bounds``. The answer names the records that were not taken there.

    The good records after one of those are kept as well: the service sends them again, which changes nothing,
    and no second waits until the retries end. For a replay the answer names all undecodable records, which
    are in quarantine already. ``at_once`` topics are processed in parallel, since they are independent and
    mostly wait for the table. Records received before ``news_since_ms`` are summarised, but not counted in
    metrics that have an alarm, and their incidents are not announced. If another function may summarise the
    same seconds ``beside`` this one, they are read again after writing.
    """
    decoded = decode_records(event["Records"], bounds.share if bounds else None)
    topics = _summarized(tables, decoded, at_once, bounds.share if bounds else None)
    _put(tables, topics)
    if beside_others:
        topics = _settled(tables, decoded, topics, at_once)
    for topic in topics:
        name = parse_topic(topic)
        tables.note_stream(name.robot, name.name)
        if tables.marks is not None:
            starts = [batch.t_us for batch in decoded.batches[topic]]
            tables.marks.note(topic, starts, int(time.time() * 1000))
    for topic, summaries in topics.items():
        decoded.refuse(topic, summaries.beyond, _BEYOND)
    left = {one.number for one in (decoded.refused if event.get(REPLAY) else refuse(decoded.refused))}
    if bounds is not None and decoded.put_off:
        left |= _put_off(bounds, decoded)
    good = [batch for batches in decoded.batches.values() for batch in batches]
    news = decoded.news(news_since_ms)
    if announce is not None:
        for topic, batches in news.items():
            if parse_topic(topic).name == INCIDENT_STREAM:
                untold = announce(topic, batches)
                left |= {decoded.records[topic, batch.id]["SequenceNumber"] for batch in untold}
    emit(
        "summarize",
        BatchesSummarized=len(good),
        SamplesSummarized=sum(len(batch.times_us) for batch in good),
        BatchesRefused=len(decoded.refused),
        BatchesMissing=sum(summaries.missing for topic, summaries in topics.items() if topic in news),
        BatchesPutOff=len(decoded.put_off),
    )
    measured = [
        (parse_topic(topic).robot, measure(parse_topic(topic).name, batches))
        for topic, batches in news.items()
    ]
    if robot_metrics:
        for robot, values in measured:
            emit("health", robot=robot, **values)
    else:
        for values in together(values for _, values in measured):
            emit("health", robot=None, **values)
    return {"batchItemFailures": [{"itemIdentifier": number} for number in sorted(left)]}


def _settled(
    tables: Tables, decoded: Decoded, topics: dict[str, Summaries], at_once: int
) -> dict[str, Summaries]:
    """The summaries that are still right once they are written. What was stored since they were read may have
    been summarised since, and just been overwritten. Raises `TableError` where that does not end: a robot may
    add to its seconds as fast as they are read."""
    for _ in range(_ROUNDS):
        again = _summarized(tables, decoded, at_once)
        if again == topics:
            return topics
        topics = again
        _put(tables, topics)
    raise TableError(f"seconds of {', '.join(topics)} change as fast as they are summarised")


def _put(tables: Tables, topics: Mapping[str, Summaries]) -> None:
    tables.put_seconds(
        {
            (topic, second): summary
            for topic, summaries in topics.items()
            for second, summary in summaries.seconds.items()
        }
    )


def _put_off(bounds: Bounds, decoded: Decoded) -> set[str]:
    """Queue the batches over their robot's share and notify the robot; return the sequence numbers that
    failed."""
    left = {change["SequenceNumber"] for change in bounds.put_off(decoded.put_off)}
    for robot, batches in Counter(map(robot_of_change, decoded.put_off)).items():
        bounds.tell(robot, batches, decoded.at_s)
    return left


def recompute(event: Mapping[str, Any], tables: Tables) -> dict[str, Any]:
    """Summarise stored batches again with the vehicle's current parameters, which the operator has corrected.
    Seconds before ``event[RECOMPUTE_FROM_S]`` stay unchanged.

    Nothing is counted or quarantined a second time. The answer has the written seconds and the undecodable
    records.
    """
    tables.forget_vehicles()
    decoded = decode_records(event["Records"])
    written: dict[tuple[str, int], Mapping[str, Statistics]] = {}
    for topic, summaries in _summarized(tables, decoded, 1).items():
        for second, summary in summaries.seconds.items():
            if second >= event[RECOMPUTE_FROM_S]:
                written[topic, second] = summary
        decoded.refuse(topic, summaries.beyond, _BEYOND)
    tables.put_seconds(written)
    return {
        RECOMPUTED: sorted(second for _, second in written),
        "batchItemFailures": [{"itemIdentifier": refused.number} for refused in decoded.refused],
    }


def _summarized(
    tables: Tables, decoded: Decoded, at_once: int, share: Share | None = None
) -> dict[str, Summaries]:
    """Summaries by topic. A topic whose robot is far over its share is missing: its batches wait."""
    share = share or Share.unlimited()

    def one(topic: str) -> Summaries | None:
        meter = share.meter(robot_of(topic), decoded.at_s)
        try:
            meter.check()
            return summarize_topic(tables, topic, decoded.batches[topic], meter.check)
        except OverShareError:
            return None
        finally:
            meter.charge(REQUESTS_S)

    topics = list(decoded.batches)
    if at_once == 1 or len(topics) == 1:
        found = list(map(one, topics))
    else:
        with ThreadPoolExecutor(min(at_once, max(1, len(topics)))) as pool:
            found = list(pool.map(one, topics))
    summaries: dict[str, Summaries] = {}
    for topic, made in zip(topics, found, strict=True):
        if made is None:
            decoded.wait(topic)
        else:
            summaries[topic] = made
    return summaries


@cache
def caller() -> Any:
    """A client that calls functions, and gives up long before its own function must end."""
    quickly = Config(connect_timeout=2, read_timeout=5, retries={"total_max_attempts": 2})
    return connect("lambda", config=quickly)


@cache
def _announcer() -> Announcer:
    # Most environments see no incident, and need no client for it.
    return Announcer(caller, variables(LaterEnvironment).incident_function)


@cache
def stored_tables() -> Tables:
    """The tables of this environment's deployment."""
    given = variables(LaterEnvironment)
    # Requests come from this code only. Validating them took a third of the CPU time; the User-Agent,
    # made anew for each request, a fifth of it for a driving car.
    client = quick(connect("dynamodb", config=Config(parameter_validation=False, user_agent="iort")))
    tables = Tables(
        Direct(client, clients.credentials(), clients.authorities()),
        telemetry=given.telemetry_table,
        summary=given.summary_table,
        robots=given.robots_table,
        archive=given.archive_table,
    )
    # botocore's models are a hundred thousand permanent objects; the garbage collector need not scan them.
    gc.collect()
    gc.freeze()
    return tables


def processed(
    event: Mapping[str, Any], *, bounds: Bounds | None = None, beside_others: bool = False
) -> dict[str, Any]:
    """`process` with what this environment's deployment has."""
    given = variables(LaterEnvironment)
    return process(
        event,
        stored_tables(),
        DeadLetterQueue(clients.sqs(), given.rejected_queue).refuse,
        bounds=bounds,
        beside_others=beside_others,
        robot_metrics=given.robot_metrics,
        at_once=_AT_ONCE,
        news_since_ms=int(time.time() * 1000) - _NEWS_MS,
        announce=_announcer().announce,
    )
