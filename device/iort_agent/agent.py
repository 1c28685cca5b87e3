"""Composes the agent: builds its parts around one uplink and hands them to the runtime."""

from __future__ import annotations

import uuid
from typing import Any

from iort_agent.account import Accounts
from iort_agent.clock import Clock
from iort_agent.config.file import Config
from iort_agent.control.downlink import make_downlink
from iort_agent.control.runtime_settings import Tuning, configured
from iort_agent.control.shadow import Remote
from iort_agent.files.folder import make_uploads
from iort_agent.lanes.attachment import make_claims
from iort_agent.lanes.clock_offset import ClockOffset
from iort_agent.lanes.live import LiveLane
from iort_agent.lanes.pings import Pings
from iort_agent.lanes.record import RecordLane
from iort_agent.logs import Troubles, set_level
from iort_agent.metrics import AgentMetrics, Rates
from iort_agent.mqtt.uplink import Uplink
from iort_agent.rate_limiter import Allowance
from iort_agent.runtime import Parts, Runtime
from iort_agent.sources.run import SourceRun
from iort_agent.spool.interface import Spool
from iort_agent.streams import Streams
from iort_agent.version import agent_version


def make_agent(
    config: Config, *, uplink: Uplink, spool: Spool, clock: Clock, troubles: Troubles | None = None
) -> Runtime:
    """The agent of a configuration, ready to run once."""
    boot, began = uuid.uuid4().hex[:16], clock.monotonic()
    limiter = Allowance(clock)
    names = {"robot": config.robot, "namespace": config.namespace}
    shared: dict[str, Any] = {**names, "uplink": uplink, "clock": clock, "allowance": limiter}
    base = configured(record=config.record, live=config.live, ping=config.ping, log_level=config.log_level)

    record = RecordLane(spool=spool, **shared)
    offset = ClockOffset(clock)
    live = LiveLane(boot=boot, rate_hz=config.live.rate_hz, offset_us=offset.known_us, **shared)
    streams = Streams(
        boot=boot, batch_s=config.record.batch_s, tuning=base, live=live, spool=spool, clock=clock
    )
    pings = Pings(
        paths=config.ping.paths,
        rate_hz=config.ping.rate_hz,
        padding_bytes=config.ping.padding_bytes,
        emit=streams.record,
        on_stamp=offset.add,
        **shared,
    )

    def tune(tuning: Tuning) -> None:
        if tuning.log_level != streams.tuning.log_level:
            set_level(tuning.log_level)
        live.enabled = tuning.live_enabled
        live.set_rate(tuning.live_rate_hz)
        pings.set_rate(tuning.ping_rate_hz)
        streams.tune(tuning)

    shadow = Remote(
        robot=config.robot,
        base=base,
        apply=tune,
        known_fields=streams.known_fields,
        version=agent_version(),
        uplink=uplink,
        clock=clock,
        allowance=limiter,
    )
    downlink = make_downlink(
        config.downlink,
        config.share,
        sources=config.sources,
        boot=boot,
        offset=offset.known,
        answer=shadow.answer,
        **shared,
    )
    uploads = make_uploads(config.files, root_ca=config.root_ca, **shared)
    attachments = make_claims(config.files, robot=config.robot, clock=clock, uploads=uploads)
    sources = [SourceRun(source, clock) for source in config.sources]
    accounts = Accounts(
        clock=clock,
        spool=spool,
        streams=[stream for source in sources for stream in source.streams],
        counts=streams.counts,
        refused=streams.refused,
        reports=[
            # Two sources may have the same description.
            *((f"{i}: {source.description}", source.report) for i, source in enumerate(sources)),
            *([("contents", attachments.report)] if attachments is not None else []),
        ],
        emit=streams.record,
    )
    tune(base)
    return Runtime(
        Parts(
            config=config,
            boot=boot,
            began=began,
            clock=clock,
            uplink=uplink,
            spool=spool,
            streams=streams,
            record=record,
            live=live,
            pings=pings,
            offset=offset,
            shadow=shadow,
            tune=tune,
            sources=sources,
            accounts=accounts,
            metrics=AgentMetrics(clock=clock, spool=spool, uplink=uplink, offset=offset, uploads=uploads),
            rates=Rates(clock),
            downlink=downlink,
            uploads=uploads,
            attachments=attachments,
            troubles=troubles,
        )
    )
