"""The fix of a stream's event source mapping: the threads around the model in `stream_model`."""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

from ministack.core.responses import request_scope
from ministack.services import dynamodb, lambda_svc

from local.emulator.fixes.stream_model import Answer, Discarded, Settings, Stream
from local.persistence.ledger import LedgerError
from local.persistence.streams import Streams, position_of

_log = logging.getLogger(__name__)
# AWS waits longer between attempts; tests must not.
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 5.0
# The two clocks differ by less than this.
_SLACK_S = 0.005
# The stream of a new on-demand table has four shards, which Lambda reads at once. More shards than cores
# would only make smaller events.
_SHARDS = min(4, os.cpu_count() or 1)
# Records to read ahead; for each shard at least as many as one event may hold.
_AHEAD = 2_000 * _SHARDS


def close_stream_retries() -> None:
    """Retries of a stream's event source mapping.

    AWS: splits a failed batch, gives it up after its retries or its age, and tells the destination
      (https://docs.aws.amazon.com/lambda/latest/dg/services-dynamodb-errors.html).
    ministack: invokes the function with the same batch until it succeeds, in the thread that also serves the
      queues. A stream has here a shard for each core, and a mapping a thread for each of its concurrent
      batches. The ledger knows the first record that a mapping has not finished: there it goes on after a
      restart (local/persistence/streams.py).
    Test:
      tests/local/emulator/test_stream_fixes.py::test_only_the_failing_record_goes_to_the_destination
    Patch: none; it replaces the whole poller by local/emulator/fixes/stream_model.py
    """
    # The emulator keeps its streams in the ledger, which is installed before.
    lambda_svc._poll_dynamodb_streams = StreamMappings(dynamodb._stream_records).poll


@dataclass
class _Running:
    """The state of one mapping: its position in the stream, and the lanes whose function runs."""

    account: str
    region: str
    mapping: dict[str, Any]
    stream: Stream
    position: int
    marked: int | None
    busy: set[int] = field(default_factory=set)
    # Discarded records whose destination has no message yet.
    untold: list[Discarded] = field(default_factory=list)
    pauses: dict[int, tuple[float, float]] = field(default_factory=dict)
    windows: dict[int, float] = field(default_factory=dict)


class StreamMappings:
    """All stream mappings; `poll` replaces ministack's own poller."""

    def __init__(self, streams: Streams, clock: Callable[[], float] = time.time) -> None:
        self._streams, self._clock, self._began_s = streams, clock, clock()
        self._running: dict[str, _Running] = {}
        self._lock = threading.Lock()
        self._telling = threading.Lock()

    def poll(self) -> bool:
        """Start every invocation that is due; returns whether one was started."""
        started = False
        for account, region, mapping in lambda_svc._iter_all_esms():
            if mapping.get("Enabled", True) and ":dynamodb:" in mapping.get("EventSourceArn", ""):
                with request_scope(account, region):
                    started = self._serve(account, region, mapping) or started
        return started

    def _serve(self, account: str, region: str, mapping: dict[str, Any]) -> bool:
        table = mapping["EventSourceArn"].split("/stream/")[0].rsplit("/", 1)[-1]
        function, _ = lambda_svc._get_func_record_for_qualifier(
            mapping["FunctionName"], mapping.get("Qualifier")
        )
        if function is None or table not in dynamodb._tables:
            return False
        running = self._of(account, region, mapping, table)
        self._read(running, table)
        started = False
        for number, lane in enumerate(running.stream.lanes):
            with self._lock:
                pause_until, _ = running.pauses.get(number, (0.0, 0.0))
                if number in running.busy or time.monotonic() < pause_until:
                    continue
                now_s = self._clock()
                batch = lane.batch(now_s)
                if batch:
                    running.busy.add(number)
                else:
                    _wake_at(lane.due_s, now_s, running.windows, number)
            self._tell(running, function)
            if batch:
                started = True
                arguments = (running, function, number, batch)
                threading.Thread(target=self._invoke, args=arguments, daemon=True).start()
        return started

    def _of(self, account: str, region: str, mapping: dict[str, Any], table: str) -> _Running:
        running = self._running.get(mapping["UUID"])
        settings = replace(Settings.of(mapping), began_s=self._began_s)
        partition = dynamodb._tables[table]["pk_name"]
        if running is None:
            latest = mapping.get("StartingPosition") == "LATEST"
            position = (dynamodb.stream_end_position if latest else dynamodb.stream_start_position)(table)
            # ministack stores where a new mapping begins.
            position = lambda_svc._dynamodb_stream_positions.get(mapping["UUID"], position)
            marked = self._streams.position(mapping["UUID"], mapping["EventSourceArn"])
            running = self._running[mapping["UUID"]] = _Running(
                account,
                region,
                mapping,
                Stream(settings, partition, _SHARDS),
                position if marked is None else marked,
                marked,
            )
        elif running.stream.settings != settings and not running.stream.size and not running.busy:
            running.stream = Stream(settings, partition, _SHARDS)
        return running

    @staticmethod
    def _read(running: _Running, table: str) -> None:
        ahead = running.stream.size
        if ahead >= _AHEAD:
            return
        running.position = max(running.position, dynamodb.stream_start_position(table))
        records = dynamodb.stream_records_since(table, running.position, _AHEAD - ahead)
        running.stream.put(lambda_svc._apply_filter_criteria(records, running.mapping))
        # After the records: `_tell` asks in the other order.
        running.position += len(records)

    def _invoke(self, running: _Running, function: dict[str, Any], number: int, batch: list[Any]) -> None:
        with request_scope(running.account, running.region):
            answer = _answer(lambda_svc._execute_function(function, {"Records": batch}))
            failed = answer.error or answer.throttled
            with self._lock:
                running.stream.lanes[number].answered(answer)
                _, last_s = running.pauses.get(number, (0.0, _FIRST_PAUSE_S / 2))
                pause_s = min(2 * last_s, _LONGEST_PAUSE_S)
                if failed:
                    running.pauses[number] = (time.monotonic() + pause_s, pause_s)
                else:
                    running.pauses.pop(number, None)
                running.busy.discard(number)
            running.mapping["LastProcessingResult"] = "FAILED" if failed else f"OK - {len(batch)} records"
            self._tell(running, function)
        if failed:
            # The poller sleeps up to a second when it has nothing to do.
            threading.Timer(pause_s, lambda_svc._esm_wake.set).start()
        else:
            lambda_svc._esm_wake.set()

    def _tell(self, running: _Running, function: dict[str, Any]) -> None:
        """Send discarded records to the mapping's destination, and note how far the mapping is."""
        mapping = running.mapping
        # No mark may pass records that are on their way to the destination.
        with self._telling:
            with self._lock:
                running.untold += running.stream.discarded()
                position = running.position
                oldest = running.stream.oldest
            if oldest is not None:
                position = position_of(oldest)
            since = self._streams.ledger.undone
            for one in running.untold:
                _log.warning("gave up %d records of %s", len(one.records), mapping["EventSourceArn"])
                lambda_svc._send_ddb_stream_failure_record(
                    mapping, function, list(one.records), mapping["EventSourceArn"], {}, one.condition.value
                )
            if running.untold:
                try:
                    self._streams.ledger.commit(since)
                except LedgerError as error:
                    _log.warning("the destination of %s is told again: %s", mapping["UUID"], error)
                    return
                running.untold.clear()
            if position != running.marked:
                # A full disk: the records are read again after a restart.
                with suppress(LedgerError):
                    self._streams.mark(mapping["UUID"], mapping["EventSourceArn"], position)
                    running.marked = position


def _wake_at(due_s: float | None, now_s: float, windows: dict[int, float], number: int) -> None:
    """Wake the poller when a lane's batching window is over; it could sleep a second longer."""
    if due_s is not None and windows.get(number) != due_s:
        windows[number] = due_s
        timer = threading.Timer(max(0.0, due_s - now_s) + _SLACK_S, lambda_svc._esm_wake.set)
        timer.daemon = True
        timer.start()


def _answer(result: dict[str, Any]) -> Answer:
    if result.get("throttle"):
        return Answer(throttled=True)
    body = result.get("body")
    if isinstance(body, (str, bytes)):
        try:
            body = json.loads(body or "null")
        except ValueError:
            body = None
    return Answer(payload=body, error=bool(result.get("error")))
