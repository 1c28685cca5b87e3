"""CloudWatch's deployed dashboards with their metrics and alarms, also on the embedded cloud."""

from __future__ import annotations

import json
import re
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timezone
from typing import Any, Literal

from botocore.exceptions import ClientError

from iort_contract.messages.page import Alarm, Dashboard, Logs, Series, Widget
from iort_station.cloud import Cloud
from iort_station.errors import StationError

_PERIOD_S = 300
# GetMetricData's limit of queries per call.
_MAX_QUERIES = 500
# A metric has at least a namespace and a name.
_LEAST_PARTS = 2
# DescribeAlarms' limit of names per call.
_MAX_NAMES = 100


def dashboards(cloud: Cloud) -> list[str]:
    """The names of all dashboards; this deployment's come first."""
    pages = cloud.client("cloudwatch").get_paginator("list_dashboards").paginate()
    names = [str(entry["DashboardName"]) for page in pages for entry in page.get("DashboardEntries", [])]
    ours = cloud.namespace.lower()
    return sorted(names, key=lambda name: (not name.lower().startswith(ours), name))


def dashboard(cloud: Cloud, name: str, *, minutes: int, now_s: float | None = None) -> Dashboard:
    """A dashboard's widgets with the last ``minutes`` of their metrics; raises `StationError`."""
    client, widgets = cloud.client("cloudwatch"), body_of(cloud, name)
    # The newest period ends with a full minute.
    to_s = int(time.time() if now_s is None else now_s) // 60 * 60 + 60
    from_s = to_s - minutes * 60
    return {
        "name": name,
        "from_s": from_s,
        "to_s": to_s,
        "widgets": [_widget(client, number, widget, from_s, to_s) for number, widget in enumerate(widgets)],
    }


def body_of(cloud: Cloud, name: str) -> list[Mapping[str, Any]]:
    """A dashboard's deployed widgets; raises `StationError` for an unknown name or an invalid body."""
    try:
        body = json.loads(cloud.client("cloudwatch").get_dashboard(DashboardName=name)["DashboardBody"])
        return list(body["widgets"])
    except ClientError as error:
        raise StationError(f"dashboard {name[:80]!r} does not exist") from error
    except (KeyError, TypeError, ValueError) as error:
        raise StationError(f"dashboard {name[:80]!r} has an invalid body") from error


def metrics(rows: Sequence[Sequence[Any]]) -> Iterator[tuple[list[str], dict[str, Any]]]:
    """The rows of a widget's ``metrics``: namespace, name and dimensions, and the row's options.

    ``"."`` repeats one entry of the previous row, ``"..."`` all its entries up to this place. A row with only
    options is an expression.
    """
    before: list[str] = []
    for row in rows:
        options = dict(row[-1]) if row and isinstance(row[-1], Mapping) else {}
        given = [str(part) for part in row if not isinstance(part, Mapping)]
        parts: list[str] = []
        for i, part in enumerate(given):
            if part == "...":
                parts += before[len(parts) : len(before) - (len(given) - i - 1)]
            else:
                parts.append(before[len(parts)] if part == "." and len(parts) < len(before) else part)
        if parts:
            before = parts
        yield parts, options


def _widget(client: Any, number: int, widget: Mapping[str, Any], from_s: int, to_s: int) -> Widget:
    properties: Mapping[str, Any] = widget.get("properties", {})
    period_s = int(properties.get("period", _PERIOD_S))
    drawn: Widget = {
        "number": number,
        "x": int(widget.get("x", 0)),
        "y": int(widget.get("y", 0)),
        "width": int(widget.get("width", 6)),
        "height": int(widget.get("height", 6)),
        "kind": "other",
        "title": str(properties.get("title", "")),
        "text": "",
        "series": [],
        "alarms": [],
        "period_s": period_s,
    }
    if widget.get("type") == "text":
        return {**drawn, "kind": "text", "text": str(properties.get("markdown", ""))}
    if widget.get("type") == "alarm":
        return _with_alarms(client, drawn, properties)
    if widget.get("type") == "log":
        # The page requests its rows separately, since Logs Insights is slow: see `rows`.
        return {**drawn, "kind": "log"}
    if widget.get("type") != "metric" or "metrics" not in properties:
        return {**drawn, "text": f"a widget of type {widget.get('type')}: see the AWS console"}
    kind: Literal["number", "series"] = "number" if properties.get("view") == "singleValue" else "series"
    queries, shown = _queries(properties, period_s)
    if not queries:
        return {**drawn, "kind": kind}
    period_s = min((q["MetricStat"]["Period"] for q in queries if "MetricStat" in q), default=period_s)
    try:
        series = _series(client, queries, shown, from_s, to_s)
    except ClientError as error:
        text = f"CloudWatch refuses this widget's metrics: {_reason(error)}"
        return {**drawn, "text": text}
    return {**drawn, "kind": kind, "series": series, "period_s": period_s}


def _with_alarms(client: Any, drawn: Widget, properties: Mapping[str, Any]) -> Widget:
    """The widget with the states of its alarms, in its order, without deleted ones."""
    names = [str(arn).partition(":alarm:")[2] for arn in properties.get("alarms", [])]
    try:
        found = [
            alarm
            for i in range(0, len(names), _MAX_NAMES)
            for alarm in client.describe_alarms(
                AlarmNames=names[i : i + _MAX_NAMES], AlarmTypes=["MetricAlarm"], MaxRecords=_MAX_NAMES
            )["MetricAlarms"]
        ]
    except ClientError as error:
        return {**drawn, "text": f"CloudWatch refuses this widget's alarms: {_reason(error)}"}
    alarms: list[Alarm] = [
        {
            "name": alarm["AlarmName"],
            "about": alarm.get("AlarmDescription", ""),
            "state": alarm["StateValue"],
            "reason": alarm.get("StateReason", ""),
            "since_s": alarm["StateUpdatedTimestamp"].timestamp(),
        }
        for alarm in sorted(found, key=lambda alarm: names.index(alarm["AlarmName"]))
    ]
    return {**drawn, "kind": "alarms", "alarms": alarms}


def _reason(error: ClientError) -> str:
    return str(error.response.get("Error", {}).get("Message", error))


def _queries(
    properties: Mapping[str, Any], period_s: int
) -> tuple[list[dict[str, Any]], dict[str, dict[str, Any]]]:
    """GetMetricData's queries, and the label and axis of each drawn one by its id."""
    queries: list[dict[str, Any]] = []
    shown: dict[str, dict[str, Any]] = {}
    for i, (parts, options) in enumerate(metrics(properties["metrics"])):
        key = str(options.get("id", f"iort{i}"))
        visible = bool(options.get("visible", True))
        query: dict[str, Any] = {"Id": key, "ReturnData": visible}
        if "label" in options:
            query["Label"] = str(options["label"])
        if "expression" in options:
            query |= {
                "Expression": str(options["expression"]),
                "Period": int(options.get("period", period_s)),
            }
        elif len(parts) >= _LEAST_PARTS:
            names = iter(parts[2:])
            dimensions = [{"Name": name, "Value": value} for name, value in zip(names, names, strict=False)]
            metric = {"Namespace": parts[0], "MetricName": parts[1], "Dimensions": dimensions}
            query["MetricStat"] = {
                "Metric": metric,
                "Period": int(options.get("period", period_s)),
                "Stat": str(options.get("stat", properties.get("stat", "Average"))),
            }
        else:
            continue
        queries.append(query)
        if visible:
            label = options.get("label", parts[1] if parts else key)
            shown[key] = {
                "label": label,
                "right": options.get("yAxis") == "right",
                "searched": str(options.get("expression", "")).startswith("SEARCH("),
            }
    return queries[:_MAX_QUERIES], shown


def _series(
    client: Any,
    queries: Sequence[Mapping[str, Any]],
    shown: Mapping[str, Mapping[str, Any]],
    from_s: int,
    to_s: int,
) -> list[Series]:
    # A SEARCH returns a result for each metric found. All have the query's id; their labels distinguish them,
    # and results of the same label are distinguished by their order.
    found: dict[tuple[str, str, int], dict[float, float]] = {}
    pages = client.get_paginator("get_metric_data").paginate(
        MetricDataQueries=list(queries),
        StartTime=datetime.fromtimestamp(from_s, timezone.utc),
        EndTime=datetime.fromtimestamp(to_s, timezone.utc),
        ScanBy="TimestampAscending",
    )
    for page in pages:
        seen: Counter[tuple[str, str]] = Counter()
        for result in page["MetricDataResults"]:
            if result["Id"] in shown:
                stamps = (stamp.timestamp() for stamp in result["Timestamps"])
                key = result["Id"], result.get("Label", "")
                values = found.setdefault((*key, seen[key]), {})
                values.update(zip(stamps, result["Values"], strict=True))
                seen[key] += 1
    series: list[Series] = []
    for query_id, options in shown.items():
        several = [(label, values) for (id_, label, _), values in found.items() if id_ == query_id]
        for label, values in several or [("", {})]:
            series.append(
                {
                    "label": (options["searched"] and label) or str(options["label"]),
                    "right": bool(options["right"]),
                    "times_s": sorted(values),
                    "values": [values[at] for at in sorted(values)],
                }
            )
    return series


# Log records as people read them: what happened in the first line, and the details after it.

_TRACEBACK = "Traceback (most recent call last):"
# Lambda's keys of a record in JSON that are not details. Its own lines have the second spelling.
_LEVELS = ("level", "log_level")
_TOLD = (*_LEVELS, "timestamp", "message", "errorType", "errorMessage", "stackTrace", "location")


def readable(message: str) -> str:
    """A log record whose first line says what happened: an exception, or the logged text.

    A record is a text, or an object in JSON, as AWS writes those of our functions.
    """
    text = message.strip()
    if text.startswith("{"):
        try:
            record = json.loads(text)
        except ValueError:
            return text
        return _of_json(record)
    before, traceback, stack = text.partition(_TRACEBACK)
    if not traceback:
        return text
    # The exception ends a traceback; Lambda writes it before that.
    lines = [line for line in stack.splitlines() if line.strip()]
    exception = lines[-1] if lines and not lines[-1].startswith((" ", "\t", "\u00a0")) else ""
    logged = " ".join(before.split())
    head = logged if exception and exception in logged else _joined(logged, exception)
    return f"{head}\n{text}" if head else text


def _of_json(record: Mapping[str, Any]) -> str:
    level = next((str(record[name]) for name in _LEVELS if name in record), "")
    kind, said = (str(record.get(name) or "") for name in ("errorType", "errorMessage"))
    exception = f"{kind}: {said}" if kind and said else kind or said
    message = str(record.get("message") or "")
    head = _joined(message, "" if said and said in message else exception)
    if not head:
        return json.dumps(record)
    stack = record.get("stackTrace") or ""
    frames = stack if isinstance(stack, str) else "\n".join(str(frame).rstrip() for frame in stack)
    others = {name: value for name, value in record.items() if name not in _TOLD}
    details = [frames, *(f"{name}: {value}" for name, value in others.items())]
    return "\n".join(filter(None, (f"[{level}] {head}" if level else head, *details)))


def _joined(logged: str, exception: str) -> str:
    return ": ".join(filter(None, (logged.rstrip(":"), exception)))


# The log widgets of CloudWatch's dashboards, answered by Logs Insights.
#
# Only the queries of deployed dashboards are run, so the page cannot query other logs.

# The most rows of a widget, and the most characters of a cell.
MAX_ROWS, MAX_TEXT = 100, 4_000
# Logs Insights sends no event when a query ends.
_POLL_S, _PATIENCE_S = 0.3, 60.0
_UNDER_WAY = {"Scheduled", "Running", "Unknown"}
_SOURCE = re.compile(r"""\s*SOURCE\s+(['"])(?P<group>[^'"]+)\1\s*(\||$)""")
# The field for GetLogRecord.
_POINTER = "@ptr"


def rows(cloud: Cloud, name: str, number: int, *, minutes: int, now_s: float | None = None) -> Logs:
    """The rows that a dashboard's log widget finds in the last ``minutes``.

    Raises `StationError` if there is no such widget or no answer, and for another deployment's dashboard: its
    logs may be confidential.
    """
    if not name.startswith(f"{cloud.namespace}-"):
        raise StationError(
            f"dashboard {name[:80]!r} is another deployment's: see its logs in the AWS console"
        )
    widgets = body_of(cloud, name)
    widget = widgets[number] if number < len(widgets) else {}
    if widget.get("type") != "log":
        raise StationError(f"widget {number} of dashboard {name[:80]!r} is not a log widget")
    properties: Mapping[str, Any] = widget.get("properties", {})
    groups, query = parsed(str(properties.get("query", "")))
    if not groups:
        raise StationError("the widget's query must name a log group as SOURCE 'name': see the AWS console")
    to_s = int(time.time() if now_s is None else now_s)
    client = cloud.client("logs")
    asked = {"queryLanguage": properties["queryLanguage"]} if "queryLanguage" in properties else {}
    query_id = client.start_query(
        logGroupNames=groups, queryString=query, startTime=to_s - minutes * 60, endTime=to_s, **asked
    )["queryId"]
    answer = _awaited(client, query_id)
    found = [
        {cell["field"]: cell.get("value", "") for cell in row if cell["field"] != _POINTER}
        for row in answer.get("results", [])
    ]
    columns = list(dict.fromkeys(field for row in found for field in row))
    return {
        "columns": columns,
        "rows": [[_cell(field, row.get(field, "")) for field in columns] for row in found[:MAX_ROWS]],
        "found": len(found),
        "from_s": to_s - minutes * 60,
        "to_s": to_s,
    }


def parsed(query: str) -> tuple[list[str], str]:
    """Split a widget's query into the log groups of its first ``SOURCE`` lines and the rest."""
    groups: list[str] = []
    while (source := _SOURCE.match(query)) is not None:
        groups.append(source["group"])
        query = query[source.end() :]
    return groups, query.strip()


def _cell(field: str, value: str) -> str:
    return (readable(value) if field == "@message" else value)[:MAX_TEXT]


def _awaited(client: Any, query_id: str) -> Mapping[str, Any]:
    until, never = time.monotonic() + _PATIENCE_S, threading.Event()
    while True:
        answer: Mapping[str, Any] = client.get_query_results(queryId=query_id)
        status = str(answer.get("status", ""))
        if status == "Complete":
            return answer
        if status not in _UNDER_WAY:
            raise StationError(f"Logs Insights ended the query: {status.lower()}")
        if time.monotonic() >= until:
            client.stop_query(queryId=query_id)
            raise StationError(f"Logs Insights has no answer after {_PATIENCE_S:g} s")
        never.wait(_POLL_S)
