"""Makes the status and the report from the agent's parts."""

from __future__ import annotations

import os
from typing import Any

from iort_agent.runtime import Parts
from iort_agent.status.state import (
    ClockOffset,
    Connection,
    Files,
    Lanes,
    LiveLane,
    LiveReport,
    OverShare,
    PingLane,
    Queue,
    QueueReport,
    RecordLane,
    Report,
    RoundTrips,
    Status,
    StreamReport,
    StreamState,
    read,
)


def make_status(parts: Parts) -> Status:
    """The agent now."""
    config, settings, over_share = parts.config, parts.streams.settings, parts.shadow.over_share
    link, backlog, dropped = parts.uplink.status(), parts.spool.backlog(), parts.spool.dropped()
    offset = parts.offset.estimate()
    return Status(
        robot=config.robot,
        boot=parts.boot,
        pid=os.getpid(),
        uptime_s=round(parts.clock.monotonic() - parts.began, 1),
        connection=Connection(*link, endpoint=f"{config.endpoint}:{config.port}"),
        lanes=Lanes(
            record=RecordLane(settings.record_enabled),
            live=LiveLane(
                enabled=settings.live_enabled,
                rate_hz=settings.live_rate_hz,
                effective_hz=parts.live.tempo.effective_hz,
                slowed=parts.live.tempo.slowed,
                published=parts.live.published,
                refused=parts.live.refused,
            ),
            ping=PingLane(settings.ping_rate_hz, parts.pings.held_back),
        ),
        sources=_sources(parts),
        streams=_streams(parts),
        spool=Queue(*backlog, dropped_batches=dropped.batches, dropped_samples=dropped.samples),
        files=_files(parts),
        clock=ClockOffset(*offset) if offset is not None else None,
        pings=_pings(parts),
        over_share=read(OverShare, over_share) if over_share is not None else None,
        alarms=_alarms(parts),
        troubles=parts.troubles.last() if parts.troubles is not None else [],
    )


def make_report(parts: Parts) -> Report:
    """The whole run, at its end."""
    left, dropped = parts.spool.backlog(), parts.spool.dropped()
    return Report(
        robot=parts.config.robot,
        boot=parts.boot,
        streams={
            name: StreamReport(**vars(counts)) for name, counts in sorted(parts.streams.counts().items())
        },
        live_published=parts.live.published,
        live_refused=parts.live.refused,
        live=LiveReport(*parts.live.tempo, streams_hz=parts.live.rates_hz()),
        spool=QueueReport(left.batches, left.samples, dropped.batches, dropped.samples),
        pings=_pings(parts) if parts.streams.settings.ping_rate_hz else {},
        failed_sources=[source.description for source in parts.sources if source.failed],
        sources=_sources(parts),
        downlink=parts.downlink.report() if parts.downlink is not None else None,
        files=_files(parts),
    )


def _streams(parts: Parts) -> dict[str, StreamState]:
    live_hz, fields = parts.live.rates_hz(), parts.streams.settings.fields
    return {
        name: StreamState(
            **vars(counts),
            per_s=parts.rates.per_s.get(name, 0.0),
            live_hz=live_hz.get(name, 0.0),
            silent_s=parts.rates.silent_s(name),
            fields=list(fields.get(name, ())),
        )
        for name, counts in sorted(parts.streams.counts().items())
    }


def _sources(parts: Parts) -> list[dict[str, Any]]:
    return [{"source": source.description, **source.report()} for source in parts.sources]


def _pings(parts: Parts) -> dict[str, RoundTrips]:
    return {path: RoundTrips(*trips) for path, trips in parts.pings.report().items()}


def _files(parts: Parts) -> Files | None:
    if parts.uploads is None:
        return None
    current = parts.uploads.current()
    return Files(
        *parts.uploads.counts(),
        current=current.name,
        current_bytes=current.sent_bytes,
        last_error=current.last_error,
        large=parts.attachments.report() if parts.attachments is not None else None,
    )


def _alarms(parts: Parts) -> list[str]:
    alarms = [alarm for alarm in (parts.spool.alarm, parts.record.alarm) if alarm]
    alarms += [f"source failed: {source.description}" for source in parts.sources if source.failed]
    waits = [source.waits() for source in parts.sources]
    if parts.downlink is not None:
        waits.append(parts.downlink.waits())
    # Each once: sources and commands may share a ROS node.
    return alarms + [f"source waits: {why}" for why in dict.fromkeys(waits) if why]
