"""Makes the status and the report from the agent's parts."""

from __future__ import annotations

import dataclasses
import os
from typing import Any

from iort_agent.agent import Agent
from iort_agent.common.state import (
    Files,
    Lanes,
    LiveLane,
    LiveReport,
    PingLane,
    Queue,
    QueueReport,
    RecordLane,
    Report,
    Status,
    StreamReport,
    StreamState,
)
from iort_agent.common.threads import WATCH


def make_status(agent: Agent) -> Status:
    """The agent now."""
    settings, live = agent.streams.settings, agent.live
    backlog, dropped = agent.spool.backlog(), agent.spool.dropped()
    return Status(
        robot=agent.config.robot,
        boot=agent.boot,
        pid=os.getpid(),
        uptime_s=round(agent.clock.monotonic() - agent.began, 1),
        connection=agent.uplink.status(),
        lanes=Lanes(
            record=RecordLane(settings.record_enabled),
            live=LiveLane(
                enabled=settings.live_enabled,
                rate_hz=settings.live_rate_hz,
                asked_hz=live.tempo.asked_hz,
                viewers=agent.viewers.count(),
                effective_hz=live.tempo.effective_hz,
                slowed=live.tempo.slowed,
                published=live.published,
                refused=live.refused,
            ),
            ping=PingLane(settings.ping_rate_hz, agent.pings.held_back),
        ),
        sources=_sources(agent),
        streams=_streams(agent),
        spool=Queue(
            *backlog,
            durable=agent.spool.durable,
            dropped_batches=dropped.batches,
            dropped_samples=dropped.samples,
        ),
        files=_files(agent),
        clock=agent.offset.estimate(),
        pings=agent.pings.report(),
        over_share=agent.shadow.over_share,
        alarms=_alarms(agent),
        troubles=agent.troubles.last() if agent.troubles is not None else [],
    )


def make_report(agent: Agent) -> Report:
    """The whole run, at its end."""
    left, dropped = agent.spool.backlog(), agent.spool.dropped()
    return Report(
        robot=agent.config.robot,
        boot=agent.boot,
        streams={
            name: StreamReport(**vars(counts)) for name, counts in sorted(agent.streams.counts().items())
        },
        live_published=agent.live.published,
        live_refused=agent.live.refused,
        live=LiveReport(*agent.live.tempo, streams_hz=agent.live.rates_hz()),
        spool=QueueReport(left.batches, left.samples, dropped.batches, dropped.samples),
        pings=agent.pings.report() if agent.streams.settings.ping_rate_hz else {},
        failed_sources=[source.description for source in agent.sources if source.failed],
        sources=_sources(agent),
        downlink=agent.downlink.report() if agent.downlink is not None else None,
        files=_files(agent),
    )


def _streams(agent: Agent) -> dict[str, StreamState]:
    live_hz, fields = agent.live.rates_hz(), agent.streams.settings.fields
    return {
        name: StreamState(
            **vars(counts),
            per_s=agent.rates.per_s.get(name, 0.0),
            live_hz=live_hz.get(name, 0.0),
            silent_s=agent.rates.silent_s(name),
            fields=list(fields.get(name, ())),
        )
        for name, counts in sorted(agent.streams.counts().items())
    }


def _sources(agent: Agent) -> list[dict[str, Any]]:
    return [{"source": source.description, **source.report()} for source in agent.sources]


def _files(agent: Agent) -> Files | None:
    if agent.uploads is None:
        return None
    large = agent.attachments.report() if agent.attachments is not None else None
    return dataclasses.replace(agent.uploads.status(), large=large)


def _alarms(agent: Agent) -> list[str]:
    alarms = [alarm for alarm in (agent.spool.alarm, agent.record.alarm) if alarm] + WATCH.alarms()
    alarms += [f"source failed: {source.description}" for source in agent.sources if source.failed]
    waits = [source.waits() for source in agent.sources]
    if agent.downlink is not None:
        waits.append(agent.downlink.waits())
        alarms += agent.downlink.alarms()
        alarms += [agent.kept_stop.alarm] if agent.kept_stop.alarm is not None else []
    # Without repetitions: sources and commands may share a ROS node.
    return alarms + [f"source waits: {why}" for why in dict.fromkeys(waits) if why]
