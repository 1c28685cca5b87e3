"""Builds the agent's parts around one connection, and tells their status. `iort_agent.runtime` runs them."""

from __future__ import annotations

import dataclasses
import logging
import os
import uuid
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Callable, Mapping

from iort_agent.common.logs import Troubles, set_level
from iort_agent.common.state import (
    Files,
    Lanes,
    LiveState,
    PingState,
    Queue,
    RecordState,
    Status,
    StreamState,
)
from iort_agent.common.threads import WATCH, Clock
from iort_agent.config import Config
from iort_agent.control.commands import Operator, Sight, refuse_commands
from iort_agent.control.downlink import make_downlink
from iort_agent.control.guard import NODES, StopFile
from iort_agent.control.shadow import NO_RECORDER, Shadow
from iort_agent.errors import AgentError, SourceError
from iort_agent.files.folder import make_uploads
from iort_agent.files.upload import make_uploader
from iort_agent.lanes import RuntimeSettings
from iort_agent.lanes.attachment import make_attachments
from iort_agent.lanes.live import LiveLane
from iort_agent.lanes.pings import OffsetEstimator, Pings
from iort_agent.lanes.record import RecordLane
from iort_agent.lanes.streams import Streams
from iort_agent.lanes.viewers import Viewers
from iort_agent.metrics import Accounts, AgentMetrics, Rates
from iort_agent.mqtt.rate_limiter import RateLimiter
from iort_agent.mqtt.uplink import Link, Uplink
from iort_agent.recorder.recorder import Recorder
from iort_agent.recorder.segment import require_mcap
from iort_agent.ros import Graph
from iort_agent.ros.ros1_node import DEFAULT_NODE
from iort_agent.sources.registry import SourceRun
from iort_agent.sources.ros import RosConfig
from iort_agent.sources.sim import SimSource
from iort_agent.spool import Spool
from iort_agent.video import Pictures, first_number
from iort_agent.video.capture import make_camera
from iort_agent.video.config import TopicCamera, VideoConfig
from iort_agent.video.kept import keeper
from iort_agent.video.video import Video
from iort_contract.catalog.streams import DRIVE_STREAM, OWN_STREAMS
from iort_contract.cloud import IOT
from iort_contract.limits import Value

_log = logging.getLogger(__name__)


def agent_version() -> str:
    """The version of the distribution iort-agent; a text that says so if it is not installed."""
    try:
        return version("iort-agent")
    except PackageNotFoundError:
        return "run from a checkout"


class Agent:
    """The parts of one run."""

    def __init__(
        self, config: Config, *, uplink: Uplink, spool: Spool, clock: Clock, troubles: Troubles | None = None
    ) -> None:
        self.config, self.uplink, self.spool, self.clock = config, uplink, spool, clock
        self.troubles = troubles
        self.boot, self.began = uuid.uuid4().hex[:16], clock.monotonic()
        link = Link(config.robot, config.namespace, uplink, clock, RateLimiter(clock))
        base = RuntimeSettings(
            record_enabled=config.record.enabled,
            live_enabled=config.live.enabled,
            live_rate_hz=config.live.rate_hz,
            ping_rate_hz=config.ping.rate_hz,
            log_level=config.log_level,
            live_when=config.live.when,
            motion_stopped=config.motion.stopped,
        )
        self.stop_file = StopFile(config.queue.path if config.downlink.moves() else None)
        in_force = replace(base, motion_stopped=base.motion_stopped or self.stop_file.stopped)
        self.record = RecordLane(
            robot=config.robot,
            namespace=config.namespace,
            spool=spool,
            uplink=uplink,
            clock=clock,
            rate_limiter=link.rate_limiter,
        )
        self.offset = OffsetEstimator(clock)
        self.live = LiveLane(
            link, boot=self.boot, rate_hz=config.live.rate_hz, offset_us=self.offset.known_us
        )
        self.viewers = Viewers(link, self.live, base, to_broker=config.live.transport == IOT)
        self.streams = Streams(
            boot=self.boot,
            batch_s=config.record.batch_s,
            settings=base,
            live=self.live,
            spool=spool,
            clock=clock,
        )
        self.pings = Pings(link, config.ping, emit=self.streams.record, on_stamp=self.offset.add)
        self.sources = [
            SourceRun(
                source,
                clock,
                queue=config.queue.path,
                taken=[
                    name
                    for other in config.sources
                    if other is not source
                    for name in (*other.streams(), *other.only_ring())
                ],
                whole=config.recorder is not None,
            )
            for source in config.sources
        ]
        graph = next((run.source.graph for run in self.sources if isinstance(run.source, SimSource)), None)
        # Why the recorder does not work, although the configuration has one.
        self.no_recorder: str | None = None
        self.recorder = self._make_recorder(graph)
        for run in self.sources if self.recorder is None else ():
            run.without_recorder()
        # Motion is bound to them also if the camera does not work.
        self.pictures = Pictures()
        self.video = self._make_video(link)
        self.shadow = Shadow(
            link,
            base=base,
            in_force=in_force,
            apply=self.apply,
            known_fields=self.streams.known_fields,
            version=agent_version(),
            drive=config.downlink.drive_limits(),
            moves=config.downlink.moves(),
            recorder=self.recorder,
            no_recorder=self.no_recorder or NO_RECORDER,
            video=config.video.terms() if config.video is not None else None,
        )
        if self.recorder is not None:
            self.recorder.on_answers = self.shadow.tell
        # Folders and questions share it: the broker's answers have one handler.
        uploader = None
        if config.files.folder or config.files.large_folder or config.downlink.ask or self.recorder:
            uploader = make_uploader(link, root_ca=config.root_ca, rate_kb_s=config.files.rate_kb_s)
        video = config.video
        self.downlink = make_downlink(
            config.downlink,
            config.share,
            link=link,
            boot=self.boot,
            sources=config.sources,
            graph=graph,
            offset=self.offset.known,
            operator=Operator(self.shadow.answer, self._drove(config), self.shadow.known),
            uploader=uploader,
            root_ca=config.root_ca,
            queue=config.queue.path,
            sight=Sight(video.max_age_ms, self.pictures.age_ms) if video is not None else None,
        )
        if self.downlink is None:
            refuse_commands(link, self.shadow.answer)
        incidents = self.recorder.uploads() if self.recorder is not None else None
        self.uploads = make_uploads(config.files, uploader, clock, incidents)
        if self.recorder is not None and self.uploads is not None:
            self.recorder.incidents.on_file = self.uploads.wake
        self.attachments = make_attachments(
            config.files, robot=config.robot, clock=clock, uploads=self.uploads
        )
        self.accounts = Accounts(
            clock=clock,
            spool=spool,
            streams=self.streams,
            expected=[stream for source in self.sources for stream in source.streams],
            replayed=self._replayed,
            reports=[
                # With a number, because two sources may have the same description.
                *((f"{i}: {source.description}", source.account) for i, source in enumerate(self.sources)),
                *([("contents", self.attachments.report)] if self.attachments is not None else []),
            ],
        )
        self.metrics = AgentMetrics(
            clock=clock, spool=spool, uplink=uplink, offset=self.offset, uploads=self.uploads
        )
        self.rates = Rates(clock)
        self.apply(in_force)

    def apply(self, settings: RuntimeSettings) -> None:
        """Apply other settings to all parts, at once and from any thread."""
        # First, because nothing may delay or prevent it.
        if self.downlink is not None:
            self.downlink.set_stopped(settings.motion_stopped)
            self.stop_file.write(stopped=settings.motion_stopped)
        if settings.log_level != self.streams.settings.log_level:
            set_level(settings.log_level)
        self.live.enabled = settings.live_enabled
        self.viewers.apply(settings)
        self.pings.set_rate(settings.ping_rate_hz)
        self.streams.apply(settings)
        if self.recorder is not None:
            self.recorder.stopped(settings.motion_stopped)

    def _make_recorder(self, graph: Graph | None) -> Recorder | None:
        """The recorder of a configuration that has one. A program's service and topic are in the ROS node of
        the sources, or in a ``graph`` that is no ROS graph. Raises `AgentError` without the package mcap,
        and `SourceError` without ROS for them."""
        config = self.config
        if config.recorder is None:
            return None
        ros = config.downlink.graph(config.sources)
        if config.recorder.service is None and config.recorder.topic is None:
            graph = None
        elif graph is None or ros.node is not None:
            try:
                graph = NODES[ros.version](ros.node or DEFAULT_NODE, self.clock)
            except SourceError as error:
                raise SourceError(
                    f"recorder.service and recorder.topic need ROS {ros.version}; without it remove them "
                    f"from car.yaml: {error}"
                ) from error
        require_mcap()
        try:
            return Recorder(
                config.recorder,
                self.clock,
                robot=config.robot,
                run=self.boot,
                reserve=config.queue.max_bytes,
                tell=lambda stream, t_us, values: self.streams.emit(stream, t_us, values, urgent=True),
                connection=self.uplink.status,
                reports=[(source.description, source.report) for source in self.sources],
                replayed=self._replayed,
                agent=self._state,
                graph=graph,
                fires=bool(config.sources),
            )
        except AgentError as error:
            # A disk that fails costs the incidents, and neither samples nor stops.
            self.no_recorder = f"the recorder does not work: {error}"
            _log.error("%s", self.no_recorder)
            return None

    def _make_video(self, link: Link) -> Video | None:
        """The video of a configuration that has some. Raises `SourceError` without ROS for a topic."""
        config, recorder, video = self.config, self.recorder, self.config.video
        if video is None:
            return None
        car = next((run.source for run in self.sources if isinstance(run.source, SimSource)), None)
        ros = config.downlink.graph(config.sources)
        graph = None
        if isinstance(video.source, TopicCamera):
            graph = NODES[ros.version](ros.node or DEFAULT_NODE, self.clock)
        keep = None
        if recorder is not None and not self._in_ring(video):
            keep = keeper(recorder.ring.take, ros.version)
        return Video(
            video,
            link,
            self.pictures,
            camera=lambda: make_camera(video, self.clock, graph=graph, car=car),
            record=self.streams.record,
            keep=keep,
            graph=graph,
            offset_us=self.offset.known_us,
            first=first_number(self.boot),
        )

    def _in_ring(self, video: VideoConfig) -> bool:
        """Whether the ring has the camera's pictures as a topic's messages."""
        source = video.source
        return isinstance(source, TopicCamera) and any(
            source.topic == name
            for config in self.config.sources
            if isinstance(config, RosConfig)
            for name, _ in config.topics
        )

    def _state(self) -> dict[str, Any]:
        """The agent at an edge, for the incident's file."""
        connection, offset = self.uplink.status(), self.offset.estimate()
        return {
            "robot": self.config.robot,
            "version": agent_version(),
            "boot": self.boot,
            "uptime_s": round(self.clock.monotonic() - self.began, 1),
            "connected": connection.connected,
            "clock_offset_ms": offset.offset_ms if offset is not None else None,
            "clock_uncertainty_ms": offset.uncertainty_ms if offset is not None else None,
            "backlog_batches": self.spool.backlog().batches,
            "settings": self.shadow.settings.by_name(),
            "alarms": _alarms(self),
        }

    def _replayed(self, stream: str) -> bool:
        """Whether a stream comes from a source whose times are not now's; a recording may name no streams."""
        timed = [name for source in self.sources if not source.replayed for name in source.streams]
        return stream not in OWN_STREAMS and stream not in timed and any(s.replayed for s in self.sources)

    def _drove(self, config: Config) -> Callable[[Mapping[str, Value]], object]:
        """Takes the samples of who drove; a source with a stream of this name goes first."""
        if any(DRIVE_STREAM in source.streams() for source in config.sources):
            return lambda _: None
        return lambda values: self.streams.emit(DRIVE_STREAM, self.clock.now_us(), values, urgent=True)


def make_status(agent: Agent) -> Status:
    """The agent now, and at its end the whole run."""
    settings, live = agent.streams.settings, agent.live
    backlog, dropped = agent.spool.backlog(), agent.spool.dropped()
    return Status(
        robot=agent.config.robot,
        boot=agent.boot,
        pid=os.getpid(),
        uptime_s=round(agent.clock.monotonic() - agent.began, 1),
        connection=agent.uplink.status(),
        lanes=Lanes(
            record=RecordState(settings.record_enabled),
            live=LiveState(
                enabled=settings.live_enabled,
                rate_hz=settings.live_rate_hz,
                asked_hz=live.tempo.asked_hz,
                viewers=agent.viewers.count(),
                effective_hz=live.tempo.effective_hz,
                slowed=live.tempo.slowed,
                published=live.published,
                refused=live.refused,
            ),
            ping=PingState(settings.ping_rate_hz, agent.pings.held_back),
        ),
        sources=[{"source": source.description, **source.report()} for source in agent.sources],
        failed_sources=[source.description for source in agent.sources if source.failed],
        streams=_streams(agent),
        spool=Queue(
            *backlog,
            durable=agent.spool.durable,
            dropped_batches=dropped.batches,
            dropped_samples=dropped.samples,
        ),
        downlink=agent.downlink.report() if agent.downlink is not None else None,
        files=_files(agent),
        recorder=agent.recorder.report() if agent.recorder is not None else None,
        video=agent.video.report() if agent.video is not None else None,
        clock=agent.offset.estimate(),
        pings=agent.pings.report(),
        over_share=agent.shadow.over_share,
        alarms=_alarms(agent),
        troubles=agent.troubles.last() if agent.troubles is not None else [],
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


def _files(agent: Agent) -> Files | None:
    if agent.uploads is None:
        return None
    large = agent.attachments.report() if agent.attachments is not None else None
    return dataclasses.replace(agent.uploads.status(), large=large)


def _alarms(agent: Agent) -> list[str]:
    alarms = [alarm for alarm in (agent.spool.alarm, agent.record.alarm) if alarm] + WATCH.alarms()
    alarms += agent.recorder.alarms() if agent.recorder is not None else []
    alarms += [agent.no_recorder] if agent.no_recorder is not None else []
    alarms += agent.video.alarms() if agent.video is not None else []
    alarms += [f"source failed: {source.description}" for source in agent.sources if source.failed]
    waits = [source.waits() for source in agent.sources]
    if agent.downlink is not None:
        waits.append(agent.downlink.waits())
        alarms += agent.downlink.alarms()
        alarms += [agent.stop_file.alarm] if agent.stop_file.alarm is not None else []
    # Without repetitions: sources and commands may share a ROS node.
    return alarms + [f"source waits: {why}" for why in dict.fromkeys(waits) if why]
