"""The log widgets of CloudWatch's dashboards, answered by Logs Insights.

Only the queries of deployed dashboards are run, so the page cannot query other logs.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Mapping
from typing import Any

from iort_contract.messages.page import Logs
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.operations.monitoring.cloudwatch import body_of
from iort_station.operations.monitoring.log_records import readable

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
