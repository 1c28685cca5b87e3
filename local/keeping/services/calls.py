"""Which calls to a service may change its documents."""

from __future__ import annotations

from collections.abc import Mapping
from urllib.parse import parse_qs

# An action whose name begins like this changes nothing that has to be kept before it is answered.
_READS = (
    "Get",
    "List",
    "Describe",
    "Search",
    "Lookup",
    "Simulate",
    "Test",
    "Head",
    "BatchGet",
    "Query",
    "Scan",
)
# Frequent actions on what is in no document: metrics, logs, messages and items.
_DATA = (
    "PutMetricData",
    "PutLogEvents",
    "SendMessage",
    "ReceiveMessage",
    "DeleteMessage",
    "ChangeMessageVis",
    "PutItem",
    "UpdateItem",
    "DeleteItem",
    "BatchWriteItem",
    "Transact",
    "ExecuteStatement",
    "BatchExecute",
    "ExecuteTransaction",
)
_FORM = "application/x-www-form-urlencoded"


def may_change(
    method: str, path: str, headers: Mapping[str, str], body: bytes, query: Mapping[str, list[str]]
) -> bool:
    """Whether a call may change its service's documents, by the name of its action or else by its method."""
    if action := _action(path, headers, body, query):
        return not action.startswith((*_READS, *_DATA))
    return method not in ("GET", "HEAD", "OPTIONS") and not path.endswith("/invocations")


def is_object(path: str) -> bool:
    """Whether a path of S3 names an object, which is a file, rather than a bucket."""
    return "/" in path.strip("/")


def _action(path: str, headers: Mapping[str, str], body: bytes, query: Mapping[str, list[str]]) -> str:
    """The action's name in one of AWS' protocols; "" for REST."""
    if target := headers.get("x-amz-target"):
        return target.rpartition(".")[2]
    if path.startswith("/service/"):
        return path.rpartition("/")[2]
    form = query
    if headers.get("content-type", "").startswith(_FORM):
        form = {**query, **parse_qs(body.decode(errors="replace"))}
    return next(iter(form.get("Action", ())), "")
