"""What the doctor finds in a deployment, on AWS or embedded: stacks, robots, lag, alarms."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime, timezone
from email.utils import parsedate_to_datetime
from typing import Any, NamedTuple

from iort_contract.catalog.metrics import METRIC_DEPLOYMENT, METRIC_FUNCTION, METRIC_NAMESPACE, METRICS
from iort_contract.tables import ONLINE
from iort_contract.topics import parse_topic
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import files, registry
from iort_station.fleet.files import StoredFile
from iort_station.operations import alarms, archive
from iort_station.times import iso_s

# What the doctor says: one line for each thing that it looked at.

OK, WARN, FAIL = "ok", "warn", "fail"


class Finding(NamedTuple):
    """One line; ``todo`` says what to do unless all is well."""

    what: str
    level: str
    text: str
    todo: str = ""


def graded(what: str, text: str, todo: str, *, warn: bool, fail: bool = False) -> Finding:
    """A finding whose level two conditions decide."""
    return Finding(what, FAIL if fail else WARN if warn else OK, text, todo if warn or fail else "")


_MINUTES = 5
# Summaries later than this are late; a user sees it, and the stream of a table keeps 24 h.
_LATE_S, _FAR_BEHIND_S = 10.0, 300.0
_CLOCK_OFF_S = 5.0
_NAMED = 4
# Below this share of its time, what an embedded cloud does besides would count as load.
_LEAST_BUSY = 0.1


class Load(NamedTuple):
    """The last minutes of Lambda 2; None where CloudWatch has no point."""

    behind_s: float | None
    batches_s: float | None
    samples_s: float | None


def findings(cloud: Cloud, busy: float | None = None) -> Iterator[Finding]:
    """Look at everything; ends at stacks that cannot be read.

    ``busy`` is the share of what an embedded cloud's machine takes that it has to do now.
    """
    try:
        function = cloud.output("processing", "SummarizeFunction")
        for table in ("TelemetryTable", "RobotsTable"):
            cloud.output("storage", table)
    except StationError as error:
        yield Finding("stacks", FAIL, str(error), "deploy them: `make deploy`, or `make up` on this machine")
        return
    yield Finding("stacks", OK, f"of {cloud.namespace} are deployed")
    rows = list(registry.listed(cloud))
    connected = sum(bool(row.get(ONLINE)) for row in rows)
    yield Finding("robots", OK, f"{connected} of {len(rows)} are connected")
    yield _lag(load(cloud, function), connected, busy)
    yield from _alarms(cloud)


def load(cloud: Cloud, function: str) -> Load:
    """Lambda 2's figures of the last minutes."""
    ours = {METRIC_DEPLOYMENT: cloud.namespace}
    now_s = int(time.time())
    queries = [_query("behind", "AWS/Lambda", "IteratorAge", "Maximum", {"FunctionName": function})]
    for key, name in (("batches", "BatchesSummarized"), ("samples", "SamplesSummarized")):
        of = {**ours, METRIC_FUNCTION: METRICS[name].function}
        queries.append(_query(key, METRIC_NAMESPACE, name, "Sum", of))
    answer = cloud.client("cloudwatch").get_metric_data(
        MetricDataQueries=queries,
        StartTime=datetime.fromtimestamp(now_s // 60 * 60 - 60 * _MINUTES, timezone.utc),
        EndTime=datetime.fromtimestamp(now_s, timezone.utc),
    )
    found = {
        one["Id"]: {at.timestamp(): value for at, value in zip(one["Timestamps"], one["Values"], strict=True)}
        for one in answer["MetricDataResults"]
    }
    behind = found["behind"]
    # Of its newest two minutes: what was late before has been caught up.
    newest = [value for at, value in behind.items() if at >= max(behind) - 60]
    # The present minute is not over.
    over = {key: [value for at, value in of.items() if at <= now_s - 60] for key, of in found.items()}
    rates = {key: sum(values) / len(values) / 60 for key, values in over.items() if values}
    return Load(max(newest) / 1000 if newest else None, rates.get("batches"), rates.get("samples"))


def _query(key: str, namespace: str, name: str, statistic: str, of: Mapping[str, str]) -> dict[str, Any]:
    dimensions = [{"Name": name, "Value": value} for name, value in of.items()]
    metric = {"Namespace": namespace, "MetricName": name, "Dimensions": dimensions}
    return {"Id": key, "MetricStat": {"Metric": metric, "Period": 60, "Stat": statistic}}


def _lag(found: Load, connected: int, busy: float | None) -> Finding:
    """How far the summaries are behind the recordings."""
    if found.behind_s is None:
        return graded(
            "summaries",
            f"Lambda 2 had nothing to do in the last {_MINUTES} minutes",
            "robots are connected: do they record? `iort robots show NAME`, `iort errors`",
            warn=connected > 0,
        )
    rates = ""
    if found.batches_s is not None and found.samples_s is not None:
        rates = f", {found.batches_s:,.1f} batches and {found.samples_s:,.0f} samples a second"
        if busy is not None and busy > _LEAST_BUSY:
            rates += f" of about {found.batches_s / busy:,.0f} batches that this machine takes"
    return graded(
        "summaries",
        f"{found.behind_s:.1f} s behind the recordings at most{rates}",
        "nothing is lost, and charts are late. If it grows, this deployment takes no more: fewer or slower "
        "streams; a function that fails is in `iort errors` and `iort alarms`",
        warn=found.behind_s > _LATE_S,
        fail=found.behind_s > _FAR_BEHIND_S,
    )


def clock(cloud: Cloud) -> Finding:
    """The clock of this machine, by the date of AWS' answer."""
    answer = cloud.client("cloudwatch").describe_alarms(MaxRecords=1)
    said = answer["ResponseMetadata"]["HTTPHeaders"].get("date", "")
    try:
        off_s = time.time() - parsedate_to_datetime(said).timestamp() - 0.5
    except (TypeError, ValueError):
        return Finding("clock", OK, "AWS' answer has no date to compare it with")
    return graded(
        "clock",
        f"this machine's is {off_s:+.1f} s off, by AWS' answer",
        "set the clock: `timedatectl set-ntp true`. `--last` and the page's ages are wrong",
        warn=abs(off_s) > _CLOCK_OFF_S,
    )


def _alarms(cloud: Cloud) -> Iterator[Finding]:
    raised = [alarm["key"] for alarm in alarms.alarms(cloud) if alarm["state"] == alarms.RAISED]
    named = ", ".join(raised[:_NAMED]) + (", ..." if len(raised) > _NAMED else "")
    text = f"{len(raised)} raised: {named}" if raised else "none is raised"
    yield graded("alarms", text, "`iort alarms` says what each means, and what to do", warn=bool(raised))


# What the doctor finds in everything that is stored: all of it is read and decoded.

# Receives the number of further items or bytes that were read.
Progress = Callable[[int], None]
_LOST = "readers leave it out, and say so; an older backup may have it"
_ARCHIVE = "readers take what the table still has of this hour; an older backup may have it"
_FILE = "it cannot be fetched; an older backup may have it, or the robot"


def topics(cloud: Cloud) -> list[str]:
    """The topics of all streams: of registered robots, and of removed ones whose recordings are archived."""
    return sorted({*archive.topics(cloud, None, None), *archive.archived_topics(cloud)})


def of_recordings(cloud: Cloud, names: Sequence[str], progress: Progress) -> Iterator[Finding]:
    """Read these topics' batches in the table, and the hours in the archive. Each that is damaged is a
    finding; the first ones of a stream are named."""
    items = hours = damaged = 0
    for name in names:
        found = archive.verify(cloud, name, progress)
        topic = parse_topic(name)
        what = f"{topic.robot} {topic.name}"
        items += found.items
        hours += found.hours
        damaged += len(found.damaged) + found.refused.count
        for hour, count in found.lacking.items():
            yield Finding(
                what, WARN, f"{count:,} batches of {hour} are in the table only", "`iort archive run`"
            )
        for hour, problem in found.damaged.items():
            yield Finding(what, FAIL, f"in the archive's hour {hour}: {problem}", _ARCHIVE)
        for one in found.refused.named:
            yield Finding(what, FAIL, f"cannot be decoded: {one.removeprefix(f'{name} ')}", _LOST)
        if (more := found.refused.count - len(found.refused.named)) > 0:
            yield Finding(what, FAIL, f"{more:,} more cannot be decoded", _LOST)
    if not damaged:
        text = f"{items:,} items of the table and {hours:,} hours of the archive can be decoded"
        yield Finding("recordings", OK, text)


def of_files(cloud: Cloud, listed: Sequence[StoredFile], progress: Progress) -> Iterator[Finding]:
    """Read the robots' files, and compare each with the SHA-256 that the robot gave.

    On AWS they are not read: S3 checks their bytes itself, and fetching them costs money.
    """
    size = f"{len(listed):,} files, {sum(one.size for one in listed) / 1e9:,.1f} GB"
    if cloud.endpoint_url is None:
        yield Finding("files", OK, f"{size}: S3 checks their bytes itself, so they were not fetched")
        return
    damaged = 0
    for one in listed:
        if problem := files.damage(cloud, one, progress):
            damaged += 1
            at = iso_s(one.second * 1_000_000)
            yield Finding(f"{one.robot} {one.name}", FAIL, f"of {at}, {one.key}: {problem}", _FILE)
    if not damaged:
        yield Finding("files", OK, f"{size}, as the robots sent them")
