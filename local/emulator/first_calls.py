"""Calls of functions at the start of an embedded cloud, before others make theirs."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from iort_contract.cloud import PUBNUB
from iort_contract.messages.envelope import rule_event
from iort_contract.messages.files import File, FileRequest, encode_file_request
from iort_contract.messages.live import LiveSample, encode_live, encode_ping
from iort_contract.tables import CONNECTED_MS, ONLINE, ROBOT, SESSION_VERSION
from iort_contract.topics import FILE, LAMBDA, LIVE, PING, build_topic
from iort_station.cloud import Cloud
from iort_station.fleet import registry
from local.errors import LocalError


def warm_up(cloud: Cloud, live: str) -> None:
    """Invoke every function for which a robot or the page waits, with an event that it takes and that has no
    effect.

    A first invocation takes seconds on a small machine, and a live message that waits for it is stale. Admit
    is not among them: it counts each call as a robot that is admitted or refused, and a claim can wait.
    """

    def event(message: bytes, lane: str, name: str) -> dict[str, Any]:
        return rule_event(message, build_topic(lane, "warm-up", name, cloud.namespace), 0)

    # A sample of 1970 is stale and is dropped.
    stale = LiveSample(boot="00000000", seq=0, t_us=0, sent_us=0, sample={}, offset_us=0)
    file = File("warm-up", "other", "text/plain", 0, hashlib.sha256(b"").hexdigest(), 0)
    events: dict[tuple[str, str], dict[str, Any]] = {
        ("processing", "Live"): event(encode_live(stale), LIVE, "warm-up"),
        ("processing", "Summarize"): {"Records": []},
        ("processing", "Echo"): event(encode_ping(0, 0), PING, LAMBDA),
        # An event without a fault and without a low voltage.
        ("processing", "Alert"): event(b"", LIVE, "warm-up"),
        # Asks for no address, so that nothing counts for a quota.
        ("processing", "Upload"): event(encode_file_request(FileRequest("00000000", file, {})), PING, FILE),
        ("fleet", "Presence"): {},
        ("processing", "Query"): {},
    }
    if live != PUBNUB:
        del events["processing", "Live"]
    client = cloud.client("lambda")
    functions = [cloud.output(stack, f"{name}Function") for stack, name in events]
    # Each starts a process, which takes a core for a second.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for _ in pool.map(partial(_invoke, client), functions, events.values()):
            pass


def end_sessions(cloud: Cloud, began_ms: int) -> None:
    """Tell the registry that sessions from before ``began_ms`` have ended: the broker that would have told so
    was killed. A robot that is back already has a later session, and stays."""
    for row in registry.listed(cloud):
        if row.get(ONLINE) and row[CONNECTED_MS] < began_ms:
            ended = {
                "clientId": row[ROBOT],
                "eventType": "disconnected",
                "timestamp": time.time_ns() // 1_000_000,
                "disconnectReason": "SERVER_ERROR",
                "versionNumber": int(row[SESSION_VERSION]),
            }
            _invoke(cloud.client("lambda"), cloud.output("fleet", "PresenceFunction"), ended)


def _invoke(client: Any, function: str, event: Mapping[str, Any]) -> None:
    answer = client.invoke(FunctionName=function, Payload=json.dumps(event).encode())
    if "FunctionError" in answer:
        reason = answer["Payload"].read().decode(errors="replace")
        raise LocalError(f"function {function} does not start: {reason[:500]}")
