"""The status as text for a person."""

from __future__ import annotations

import time
from typing import Any, Iterator, Mapping

from iort_agent.common.log_lines import neutral
from iort_agent.common.state import Files, LiveLane, Queue, RecordLane, Status
from iort_contract.catalog.streams import OWN_STREAMS

# A stream that is silent for longer is marked.
_SILENT_S = 5


def render(status: Status) -> str:
    """The status as lines."""
    lines = [
        f"robot     {status.robot}, running for {_duration(status.uptime_s)}, process {status.pid}",
        *_link(status),
        *_lanes(status),
    ]
    for source in status.sources:
        lines += _source(source)
    if status.files is not None:
        lines += _files(status.files)
    if status.clock is not None:
        offset_ms, uncertainty_ms = status.clock.offset_ms, status.clock.uncertainty_ms
        lines.append(
            f"clock     the cloud's is {offset_ms:+.1f} ms from ours, to within {uncertainty_ms:.1f} ms"
        )
    over = status.over_share
    if over is not None:
        lines.append(
            f"share     {over.batches} batch(es) over this robot's share of the cloud, the last at "
            f"{_clock(over.last_ms / 1000)}: their summaries are made later"
        )
    lines += [f"ALARM     {alarm}" for alarm in status.alarms]
    lines += [f"{trouble.level:<9} {_clock(trouble.at_s)} {trouble.text}" for trouble in status.troubles]
    return "\n".join(map(neutral, lines))


def _link(status: Status) -> Iterator[str]:
    link = status.connection
    since = _duration(link.since_s)
    state = f"connected for {since}" if link.connected else f"NOT connected for {since}"
    yield f"uplink    {state} to {link.endpoint}, {link.connects} connect(s)"
    if link.last_error:
        yield f"          last error: {link.last_error}"


def _lanes(status: Status) -> Iterator[str]:
    record, live, queue = status.lanes.record, status.lanes.live, status.spool
    viewers = "nobody" if not live.viewers else f"{live.viewers} viewer{'' if live.viewers == 1 else 's'}"
    yield f"record    {_on(record)}, {_queue(queue)}"
    slowed = f", SLOWED to {live.effective_hz:g} Hz a stream by AWS' limit" if live.slowed else ""
    yield (
        f"live      {_on(live)}, {live.asked_hz:g} of up to {live.rate_hz:g} Hz for {viewers}{slowed}, "
        f"{live.published} sent, "
        f"{live.refused} refused"
    )
    for name, stream in status.streams.items():
        fields = f", only {', '.join(stream.fields)}" if stream.fields else ""
        # The agent's own streams have their own pace.
        marked = stream.silent_s >= _SILENT_S and name not in OWN_STREAMS
        silent = f", SILENT for {_duration(stream.silent_s)}" if marked else ""
        yield (
            f"stream    {name}: {stream.per_s:g}/s, live {stream.live_hz:g}/s, "
            f"{stream.samples} samples, {stream.refused} refused{silent}{fields}"
        )


def _queue(queue: Queue) -> str:
    return (
        f"{queue.batches} batch(es), {queue.samples} sample(s), {queue.bytes:,} bytes waiting "
        f"{'on the disk' if queue.durable else 'IN MEMORY'}; "
        f"{queue.dropped_batches} batch(es) dropped"
    )


def _source(source: Mapping[str, Any]) -> Iterator[str]:
    """The counts of a source: one line, one more for each group of counts, and one for each topic that lost
    something."""
    counts = {
        name: value
        for name, value in source.items()
        if name != "source" and not (isinstance(value, Mapping) and "messages" in value)
    }
    flat = {name: value for name, value in counts.items() if not isinstance(value, Mapping)}
    yield f"source    {source['source']}{_told(flat, ': ')}"
    for name, value in counts.items():
        if name not in flat and _told(value):
            yield f"          {name}{_told(value, ': ')}"
    for name, missing in _not_recorded(source):
        yield f"topic     {name}: {missing}"


def _files(files: Files) -> Iterator[str]:
    current = f", now {files.current} ({files.current_bytes:,} bytes)" if files.current else ""
    yield (
        f"files     {files.waiting} waiting, {files.uploaded} uploaded, "
        f"{files.sent_bytes:,} bytes sent{current}"
    )
    if files.last_error:
        yield f"          last error: {files.last_error}"


def _told(counts: Mapping[str, Any], before: str = "") -> str:
    """The counts of a source that are neither zero nor empty; an empty text if all are."""
    parts = []
    for name, value in counts.items():
        if isinstance(value, Mapping):
            parts += [f"{name} ({_told(value)})"] if _told(value) else []
        elif value:
            texts = value if isinstance(value, list) else [value]
            parts.append(name if value is True else f"{name} {' '.join(map(str, texts))}")
    return before + ", ".join(parts) if parts else ""


def _not_recorded(source: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Each topic of a source that lost something, and what it lost."""
    for topic, counts in source.items():
        if not isinstance(counts, dict) or "messages" not in counts:
            continue
        words = []
        for cause, count in counts.items():
            # Some causes are counted by field.
            by_name = count.items() if isinstance(count, dict) else [("", count)]
            words += [
                f"{n} {cause.replace('_', ' ')} {name}".rstrip()
                for name, n in by_name
                if type(n) is int and n and cause != "messages"
            ]
        silent = ", SILENT" if counts.get("silent") else ""
        if words or silent:
            yield topic, "; ".join([f"{counts['messages']} messages{silent}", *words])


def _on(lane: RecordLane | LiveLane) -> str:
    return "on" if lane.enabled else "off"


def _clock(at_s: float) -> str:
    return time.strftime("%H:%M:%SZ", time.gmtime(at_s))


def _duration(seconds: float) -> str:
    whole = int(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
