"""The log widgets of CloudWatch's dashboards: the queries that they hold, answered by Logs Insights.

What is asked is what a deployed dashboard says; a page cannot ask anything else of the logs.
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
from iort_station.operations.cloudwatch import body_of

# More rows than anybody reads in a widget, and more of a line.
MAX_ROWS, MAX_TEXT = 100, 2_000
# AWS tells nobody when a query has ended.
_POLL_S, _PATIENCE_S = 0.3, 60.0
_UNDER_WAY = {"Scheduled", "Running", "Unknown"}
_SOURCE = re.compile(r"""\s*SOURCE\s+(['"])(?P<group>[^'"]+)\1\s*(\||$)""")
# A pointer to the whole record, for GetLogRecord.
_POINTER = "@ptr"


def rows(cloud: Cloud, name: str, number: int, *, minutes: int, now_s: float | None = None) -> Logs:
    """What the widget ``number`` of a dashboard finds in the last ``minutes``.

    Raises `StationError` where there is no such log widget, or Logs Insights has no answer. Of the account's
    other dashboards a page shows the metrics alone: logs say more than whoever can reach it may need to know.
    """
    if not name.startswith(f"{cloud.namespace}-"):
        raise StationError(
            f"dashboard {name[:80]!r} is another deployment's, whose logs stay in the AWS console"
        )
    widgets = body_of(cloud, name)
    widget = widgets[number] if number < len(widgets) else {}
    if widget.get("type") != "log":
        raise StationError(f"widget {number} of dashboard {name[:80]!r} is none of logs")
    properties: Mapping[str, Any] = widget.get("properties", {})
    groups, query = parsed(str(properties.get("query", "")))
    if not groups:
        raise StationError("its query names no log group as SOURCE 'name': see the AWS console")
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
        "rows": [[row.get(field, "")[:MAX_TEXT] for field in columns] for row in found[:MAX_ROWS]],
        "found": len(found),
        "from_s": to_s - minutes * 60,
        "to_s": to_s,
    }


def parsed(query: str) -> tuple[list[str], str]:
    """The log groups of the ``SOURCE`` lines that a widget's query begins with, and the rest of it."""
    groups: list[str] = []
    while (source := _SOURCE.match(query)) is not None:
        groups.append(source["group"])
        query = query[source.end() :]
    return groups, query.strip()


def _awaited(client: Any, query_id: str) -> Mapping[str, Any]:
    until, never = time.monotonic() + _PATIENCE_S, threading.Event()
    while True:
        answer: Mapping[str, Any] = client.get_query_results(queryId=query_id)
        status = str(answer.get("status", ""))
        if status == "Complete":
            return answer
        if status not in _UNDER_WAY:
            raise StationError(f"Logs Insights gave up on the query: {status.lower()}")
        if time.monotonic() >= until:
            client.stop_query(queryId=query_id)
            raise StationError(f"Logs Insights has no answer after {_PATIENCE_S:g} s")
        never.wait(_POLL_S)
