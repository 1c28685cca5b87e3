"""The cost model: what each capability takes, in units of the price list, times the prices. Pure.

`bill` has the line items for a `Usage`; `thesis_bill` for the same driving in the layout of the thesis that
this project started from; `pubnub_bill` is what PubNub bills."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from math import ceil
from typing import NamedTuple

from iort_contract.catalog.questions import QUESTIONS
from iort_contract.cloud import IOT, PUBNUB
from iort_contract.messages.live import VIEW_RENEW_S
from iort_station.cost.prices import MONTH_DAYS, PRICES, PUBNUB_MAU_PLANS
from iort_station.cost.usage import Usage

METER, WRITE, READ, PUBNUB_UNIT = 5 * 1024, 1024, 4 * 1024, 2048
# "For most use cases, storage is the sum of item sizes, plus 100 bytes an item of indexing overhead."
_ITEM_OVERHEAD = 100
_HOUR_S = 3600.0

# --- sizes, as `python -m bench.load.message_sizes` measures them ---------------------------------------


class Measured(NamedTuple):
    """Bytes of a batch's message and item, and of a second's summary, by their number of samples. Messages
    count with their topics, as AWS meters them; items with names and values."""

    samples: int
    record: int
    telemetry_item: int
    summary_item: int


# One second with this many samples. In a shorter batch above 50 Hz values change less between samples, so it
# is up to a quarter smaller than in this table.
TABLE = (
    Measured(1, 257, 240, 383),
    Measured(2, 281, 264, 540),
    Measured(5, 337, 320, 557),
    Measured(10, 398, 380, 552),
    Measured(20, 498, 480, 573),
    Measured(50, 734, 716, 589),
    Measured(100, 1043, 1024, 586),
    Measured(200, 1551, 1532, 587),
    Measured(500, 3087, 3068, 580),
    Measured(1000, 5444, 5424, 576),
    Measured(2000, 10368, 10348, 600),
)
# An update for PubNub, the telemetry item of one sample of the agent's metrics, and the thesis' flat JSON
# message and item of one sample.
UPDATE_BYTES, OWN_ITEM_BYTES, SAMPLE_BYTES, SAMPLE_ITEM_BYTES = 480, 236, 356, 277
# The archive's Parquet beside the items that are in it, of an hour that is driven from end to end.
ARCHIVED_SHARE = 0.60
# Bytes that the functions log in embedded metric format; a test compares them with functions/.
_LIVE_LINE, _SUMMARIZE_LINE, _HEALTH_LINE, _PONG_LINE, _PRESENCE_LINE = 480, 310, 300, 220, 230
_ANSWER_LINE, _ARCHIVE_LINE, _ANALYSIS_LINE, _INCIDENT_LINE = 260, 330, 260, 225
# A picture's mark and the topic before it; and the units of 5 KB of a session's messages, by their bytes of
# some 0.2, 1, 4 and 3 KB.
_PICTURE_HEAD, _SESSION_UNITS = 100, 4
# Lambda's own lines START, END and REPORT of an invocation.
PLATFORM_BYTES = 264


def sizes_of(rate_hz: float, batch_s: float) -> Measured:
    """The sizes for a VESC's stream at this rate, in batches of this length."""
    return _interpolated(rate_hz * batch_s)._replace(summary_item=_interpolated(rate_hz).summary_item)


def _interpolated(samples: float) -> Measured:
    rounded = min(max(1, round(samples)), TABLE[-1].samples)
    below = max(row for row in TABLE if row.samples <= rounded)
    above = min(row for row in TABLE if row.samples >= rounded)
    share = (rounded - below.samples) / max(1, above.samples - below.samples)
    return Measured(*(round(low + share * (high - low)) for low, high in zip(below, above, strict=True)))


def units(size: float, unit: int) -> int:
    """The number of billed units of this size."""
    return max(1, ceil(size / unit))


# --- what the capabilities take -------------------------------------------------------------------------

# Units of a robot-hour by the price's name.
Table = dict[str, float]
# A shard of a stream is a partition of the table. Lambda 2 is invoked once a window, or once these records
# are there; a test compares both with the stack.
_PARTITION_WRITES = 1000
WINDOW_S, RECORDS_A_CALL = 2.0, 500
# A robot subscribes, with one filter a packet, to four answers of its shadow, three of its pings, its
# viewers and commands.
SUBSCRIPTIONS = 9
# As stacks/archive.py, stacks/storage.py and stacks/analysis.py deploy them: a test compares them. So many
# drives are analysed at once, each on a whole processor for `DRIVE_S` more than it computes.
ARCHIVE_MB, STANDARD_DAYS, ANALYSIS_MB, DRIVES_AT_ONCE, DRIVE_S = 1769, 30, 1769, 40, 1.0


def capabilities(usage: Usage) -> dict[str, Table]:
    """What each capability takes in a robot-hour: the lanes of a bill."""
    sizes = sizes_of(usage.rate_hz, usage.batch_s)
    item, streams, robots = sizes.telemetry_item, usage.streams, usage.robots
    batches, own = usage.batches_per_s * _HOUR_S, usage.own_batches_per_s * _HOUR_S
    clock, pings = usage.clock_pings_per_s * _HOUR_S, usage.ping_hz * _HOUR_S
    passing, by_pubnub = usage.live_at_broker_per_s * _HOUR_S, _by_pubnub_per_s(usage) * _HOUR_S
    connects, questions = usage.connects_per_hour, usage.questions_per_hour
    # By AWS IoT each viewer is connected while somebody looks, and receives each message then.
    receivers = usage.watched * (usage.viewers if usage.live_transport == IOT else 0)
    # The batches of one stream in an event; one query reads them and those of the second before. A second
    # whose batches arrive in two events is written twice.
    of_stream, calls_per_s = usage.stream_batches_per_s, summarize_calls_per_s(usage)
    together = max(1.0, of_stream * _shards_of(usage) / calls_per_s)
    read = ceil(together + max(1.0, of_stream)) * item
    seconds = batches * min(1.0, 1 / of_stream + (of_stream > 1) / together)
    calls = calls_per_s * _HOUR_S / robots
    # A batch in an event takes 5 ms, which only AWS knows. A line is about Lambda 2, one about each stream.
    summarize_ms = usage.summarize_ms + 5.0 * (batches + own) / calls
    logged = calls * _SUMMARIZE_LINE + (batches / together + own) * _HEALTH_LINE
    # A line has the metrics of many messages, of 24 bytes each.
    live_logged = live_lines_per_s(usage) * _HOUR_S / robots * _LIVE_LINE + by_pubnub * 24
    answer_mb = max(question.memory_mb for question in QUESTIONS.values())
    return {
        # AWS meters CONNECT, SUBSCRIBE and a device's PUBACK, not the broker's answers or keep-alives. The
        # robot fetches its shadow of less than 1 KB: a request, and an answer that it acknowledges. When a
        # connection begins and when it ends, the broker publishes: presence.
        "connection": {
            "connection": 60,
            "message": connects * (1 + SUBSCRIPTIONS + 3),
            "shadow": connects,
            **dict.fromkeys(("rule", "action", "write"), 2 * connects),
            **_function(usage, 2 * connects, 256, 20.0, 2 * connects * _PRESENCE_LINE),
        },
        # By Basic Ingest, which has no messaging charge; then telemetry and summary.
        "record": {
            **dict.fromkeys(("rule", "action"), batches * units(sizes.record, METER)),
            "write": batches * units(item, WRITE) + seconds * units(sizes.summary_item, WRITE),
            "read": batches / together * units(read, READ),
            **_kept(usage, (batches, item), (min(batches, streams * _HOUR_S), sizes.summary_item)),
            **_function(usage, calls, usage.summarize_memory_mb, summarize_ms, logged),
        },
        # The agent's own streams, of a sample a batch; Lambda 2's calls are counted with the others.
        "agent, rtt": {
            **dict.fromkeys(("rule", "action", "read"), own),
            "write": 2 * own,
            **_kept(usage, (2 * own, OWN_ITEM_BYTES)),
        },
        # A lease is sent and received. Two more rules, for faults and a low battery, evaluate each message
        # that passes the broker.
        "live": {
            "message": 2 * usage.leases_per_s * _HOUR_S + passing + receivers * usage.live_hz * _HOUR_S,
            **dict.fromkeys(("rule", "action"), 2 * passing + by_pubnub),
            "connection": 60 * receivers / robots,
            **_function(usage, by_pubnub, usage.live_memory_mb, usage.live_ms, live_logged),
        },
        # `iort send` publishes, the robot receives and acknowledges.
        "commands": {"message": 3 * usage.command_hz * _HOUR_S},
        # Ping and pong on each path; two of the three paths pass a rule, and one passes a function.
        "ping": {
            "message": 2 * clock + 6 * pings,
            **dict.fromkeys(("rule", "action"), clock + 2 * pings),
            **_function(usage, pings, 256, 5.0, pings * _PONG_LINE),
        },
        # Questions that fit into a message, with their answers, which the robot acknowledges; each is counted
        # in the robot's row. The function reads the newest drives' parameters; its time is a calibration's.
        "questions": {
            "message": 4 * questions,
            **dict.fromkeys(("rule", "action", "write"), questions),
            "read": 13 * questions,
            **_function(usage, questions, answer_mb, 30.0, questions * _ANSWER_LINE),
        },
        "incidents": _incidents(usage) if usage.incidents_per_hour else {},
        "video": _video(usage) if usage.video_minutes else {},
        "archive": _archive(usage) if usage.archive_days else {},
        "analysis": _analysis(usage) if usage.drive_minutes else {},
    }


def _function(usage: Usage, calls: float, memory_mb: int, billed_ms: float, logged: float) -> Table:
    """A function's invocations; ``logged`` counts the bytes of its own log lines in an hour."""
    logged += calls * PLATFORM_BYTES * (usage.function_logs == "all")
    gb_s = calls * memory_mb / 1024 * billed_ms / 1000
    return {"invocation": calls, "compute_arm": gb_s, "logs": logged / 1e9}


def _kept(usage: Usage, *items: tuple[float, int]) -> Table:
    """The storage of items in gigabyte-months: how many an hour, and of what size."""
    stored = sum(count * (size + _ITEM_OVERHEAD) for count, size in items)
    gb_months = stored / 1e9 * usage.retention_days / MONTH_DAYS
    return {"storage": gb_months, **({"recovery": gb_months} if usage.recoverable else {})}


def _incidents(usage: Usage) -> Table:
    """Incidents that are mailed and sent to a webhook, each with a sample when it opens and one when its file
    is there; neither the file nor mails are counted here: the first thousand of a month are free. A sample is
    a batch of its own, and a second. Its function reads the robot's row, and notes there, in up to 2 KB, what
    it told; the receiver's answer takes most of its time."""
    samples = 2 * usage.incidents_per_hour
    # A mail when it opens is counted in the row; it and both messages of the webhook are noted.
    noted = 1.5 * samples
    return {
        **dict.fromkeys(("rule", "action"), samples),
        "read": 2 * samples,
        "write": 2 * samples + 2 * noted + samples / 2,
        **_kept(usage, (2 * samples, 4 * OWN_ITEM_BYTES)),
        **_function(usage, samples, 256, 400.0, noted * _INCIDENT_LINE),
    }


def _video(usage: Usage) -> Table:
    """Video, of which AWS sees nothing but its signalling while it goes directly. At most: both ends of a
    session have a relay, and what leaves AWS IoT is counted as data transfer too, which its pages do not
    name."""
    minutes, viewers = usage.video_minutes, usage.viewers
    relayed, pictures = (minutes * share for share in (usage.video_relayed, usage.video_broker))
    # A robot sends a picture once for all viewers.
    sent = pictures * 60 * usage.picture_hz
    a_picture = units(usage.picture_bytes + _PICTURE_HEAD, METER)
    # A viewer renews; a session has a question, its answer, an offer and its answer. Each is sent and heard.
    looks = viewers * (minutes * 60 / VIEW_RENEW_S + _SESSION_UNITS)
    left_kb = viewers * (relayed * 60 * usage.video_kbps / 8 + sent * usage.picture_bytes / 1000)
    # The numbers and times of what was captured: a batch a second on the record lane, as of `agent, rtt`.
    batches = minutes * 60
    return {
        "message": 2 * looks + sent * a_picture * (1 + viewers),
        # A page has a connection of its own for it.
        "connection": minutes * viewers,
        "relay_minute": 2 * relayed * viewers,
        "transfer_out": left_kb / 1e6,
        **dict.fromkeys(("rule", "action", "read"), batches),
        "write": 2 * batches,
        **_kept(usage, (2 * batches, OWN_ITEM_BYTES)),
    }


def _archive(usage: Usage) -> Table:
    """What docs/reference/archive.md tells, kept for ``archive_days``. Deleting objects is free."""
    item = sizes_of(usage.rate_hz, usage.batch_s).telemetry_item
    sizes = usage.batches_per_s * _HOUR_S * item, usage.own_batches_per_s * _HOUR_S * OWN_ITEM_BYTES
    archived, own = (size * ARCHIVED_SHARE for size in sizes)
    # After a month objects go to a cheaper class, except those below 128 KB.
    is_moved = archived / usage.streams * usage.hours_per_day >= 128 * 1024
    months, standard = usage.archive_days / MONTH_DAYS, min(usage.archive_days, STANDARD_DAYS) / MONTH_DAYS
    days = 1 / usage.hours_per_day
    streams = usage.streams + 1 + bool(usage.agent_every_s) + bool(usage.ping_hz)
    # The schedules, an hour's and a day's, are the deployment's; each robot has its share. Each stream has an
    # hour and a day, and each night its search for hours that expire within a fifth of the retention.
    runs = 25 * days / usage.robots
    written, searches = streams * (1 + days), streams * days
    calls = written + searches + runs
    # Billed seconds of an hour or a day, of a run that only plans (both are assumptions), and of 180,000
    # samples: 2.2 s of processor, as measured.
    computing_s = 0.8 * written + 0.2 * (searches + runs) + 2.2 / 180_000 * _HOUR_S * usage.samples_per_s
    return {
        # Items are read, and counted before they expire: DynamoDB bills a count as a read.
        "read": 2 * sum(sizes) / READ + streams * (4 + min(14, usage.retention_days * 0.2)),
        # Hour and day have a note each, written and removed; the hour has a row, which the day writes once
        # more, in a transaction of twice the price.
        "write": streams * (2 + 2 + 1 + 2),
        "schedule": runs,
        # A task is sent, received and deleted.
        "queue_request": 3 * (written + searches),
        # An hour's object is written and read once; the day's is written, and moved if it is not too small.
        "s3_put": written,
        "s3_get": streams * (4 + days),
        "s3_move": usage.streams * days * is_moved,
        **_function(usage, calls, ARCHIVE_MB, 1000 * computing_s / calls, _ARCHIVE_LINE * calls),
        "s3_standard": (archived * (standard if is_moved else months) + own * months) / 1e9,
        "s3_instant": archived * (months - standard) * is_moved / 1e9,
    }


def _analysis(usage: Usage) -> Table:
    """Drives that are analysed in the next night. A robot-hour with 180,000 samples took 1.6 s of this
    project's test machine, as `make bench ONLY=analysis` measures it; its results were 0.5 MB, which are
    kept, here counted for a year."""
    drives, samples = 60 / usage.drive_minutes, usage.samples_per_s * _HOUR_S
    # A night of a robot, and its share of the run: five states besides one for each robot and one for each
    # drive, of which three call a function for a second.
    nights = 1 / usage.hours_per_day
    runs = nights / usage.robots
    calls = nights + 3 * runs
    logged = _ANALYSIS_LINE * (drives + calls)
    logged += drives * PLATFORM_BYTES * (usage.function_logs == "all")
    night = {
        **_function(usage, calls, ANALYSIS_MB, 1000.0, logged),
        # Rows of earlier drives are compared, a read unit each.
        "read": nights * 320,
        "s3_put": nights,
        "transition": nights + 5 * runs,
        "s3_standard": 12 * samples * 5e5 / 180_000 / 1e9,
        "schedule": runs,
    }
    of_drives = _drives(usage, drives, DRIVE_S + 1.6 / 180_000 * samples / drives)
    return {name: night.get(name, 0.0) + of_drives.get(name, 0.0) for name in night | of_drives}


def _drives(usage: Usage, drives: float, billed_s: float) -> Table:
    """Each drive is an express workflow. The functions read strongly consistent; the stream that tells of
    motion is read on two days to find the drives."""
    streams_read = usage.batches_per_s + 2 * usage.stream_batches_per_s
    return {
        "compute_arm": drives * billed_s * ANALYSIS_MB / 1024,
        **dict.fromkeys(("invocation", "transition", "express_request", "s3_get"), drives),
        "express_duration": drives * billed_s * 64 / 1024,
        "read": streams_read * _HOUR_S * sizes_of(usage.rate_hz, usage.batch_s).telemetry_item / READ,
        "write": 4 * drives,
        "s3_put": 5 * drives,
    }


def drive_items(usage: Usage, drives: float, billed_s: float) -> list[LineItem]:
    """The line items of ``drives`` in a robot-hour, each of ``billed_s`` seconds."""
    return _items({"analysis": _drives(usage, drives, billed_s)})


def summarize_calls_per_s(usage: Usage) -> float:
    """Invocations of Lambda 2 a second for the whole fleet: one per window and shard, or one per 500 records
    if that is more."""
    records = usage.robots * (usage.batches_per_s + usage.own_batches_per_s)
    return min(records, max(_shards_of(usage) / WINDOW_S, records / RECORDS_A_CALL))


def _shards_of(usage: Usage) -> int:
    item = sizes_of(usage.rate_hz, usage.batch_s).telemetry_item
    return units(usage.robots * usage.batches_per_s * units(item, WRITE), _PARTITION_WRITES)


def _by_pubnub_per_s(usage: Usage) -> float:
    return usage.live_per_s if usage.live_transport == PUBNUB else 0.0


def live_lines_per_s(usage: Usage) -> float:
    """Of the whole fleet: each environment of Lambda 1 gathers its metrics for ten seconds, or until it has a
    hundred values of one."""
    messages = usage.robots * _by_pubnub_per_s(usage)
    environments = max(1, ceil(messages * usage.live_ms / 1000))
    return min(messages, max(environments / 10.0, messages / 100.0))


# --- bills ----------------------------------------------------------------------------------------------


class LineItem(NamedTuple):
    """One line of a bill: ``units`` per robot-hour at the price named ``price`` in `PRICES`."""

    lane: str
    price: str
    units: float

    @property
    def service(self) -> str:
        return PRICES[self.price].service

    @property
    def dollars(self) -> float:
        """Dollars per robot-hour."""
        return self.units * PRICES[self.price].each


def _items(lanes: Mapping[str, Table]) -> list[LineItem]:
    return [LineItem(lane, price, count) for lane, table in lanes.items() for price, count in table.items()]


def bill(usage: Usage) -> list[LineItem]:
    """AWS' line items for a robot-hour; PubNub's are in `pubnub_bill`."""
    usage.check()
    return _items(capabilities(usage))


def total(items: Iterable[LineItem]) -> float:
    """Dollars per robot-hour."""
    return sum(item.dollars for item in items)


def dollars_per_month(items: Iterable[LineItem], usage: Usage) -> float:
    """Dollars per month for the whole fleet."""
    return total(items) * usage.robots * usage.hours_per_day * MONTH_DAYS


def thesis_bill(usage: Usage) -> list[LineItem]:
    """AWS' line items for the same driving in the thesis' layout.

    Each sample is a message through the broker, triggers two rules, is stored in two tables, and invokes
    Lambda 1. Functions have 128 MB on x86. Prices, retention and billed milliseconds are the same as ours.
    The layout has no pings, no metrics of the agent, and no alarms.
    """
    usage = replace(usage, function_logs="all", recoverable=False).check()
    samples, per_s = usage.samples_per_s * _HOUR_S, usage.robots * usage.samples_per_s
    # It has no window: Lambda polls a shard 4 times a second, and takes a hundred records at most.
    polls = max(4.0 * units(per_s, _PARTITION_WRITES), per_s / 100)
    calls = min(per_s, polls) * _HOUR_S / usage.robots

    lanes = {
        "connection": {"connection": 60, "message": usage.connects_per_hour},
        "record": {
            "message": samples * units(SAMPLE_BYTES, METER),
            **dict.fromkeys(("rule", "action"), samples),
            # Of both tables.
            "write": 2 * samples * units(SAMPLE_ITEM_BYTES, WRITE),
            **_kept(usage, (2 * samples, SAMPLE_ITEM_BYTES)),
            **_function(usage, calls, 128, usage.summarize_ms, 0.0),
        },
        "live": {
            **dict.fromkeys(("rule", "action"), samples),
            **_function(usage, samples, 128, usage.live_ms, 0.0),
        },
    }
    return [item._replace(price=item.price.replace("arm", "x86")) for item in _items(lanes)]


def pubnub_bill(usage: Usage, *, thesis: bool = False) -> list[LineItem]:
    """PubNub's line items for a robot-hour on its plan by transactions."""
    usage.check()
    messages_per_s = usage.samples_per_s if thesis else _by_pubnub_per_s(usage)
    messages = messages_per_s * _HOUR_S * units(UPDATE_BYTES, PUBNUB_UNIT)
    return _items({"live": {"pubnub_publish": messages, "pubnub_receive": messages * usage.viewers}})


def pubnub_mau_dollars_per_month(usage: Usage) -> float | None:
    """The price of PubNub's plan by monthly active users (viewers and Lambda 1); None above the listed
    plans."""
    if usage.live_transport != PUBNUB:
        return 0.0
    return next((dollars for most, dollars in PUBNUB_MAU_PLANS if usage.viewers + 1 <= most), None)
