"""The agent's configuration: one YAML file, read once into frozen dataclasses. It collects the rooms'
sections."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from iort_agent.common.schema import (
    FILE,
    Place,
    allowed,
    items,
    load,
    number,
    path,
    read_yaml,
    section,
    setting,
    text,
    variant,
)
from iort_agent.control.config import DownlinkConfig, MotionState, ShareConfig, share_rule
from iort_agent.errors import ConfigError
from iort_agent.files.folder import FilesConfig
from iort_agent.lanes import LiveConfig, PingConfig, RecordConfig
from iort_agent.metrics import MetricsConfig
from iort_agent.recorder.config import RecorderConfig
from iort_agent.sources import SourceConfig
from iort_agent.sources.registry import SOURCES
from iort_agent.sources.ros import RosConfig
from iort_agent.sources.sim import SimConfig
from iort_agent.spool import QueueConfig, default_path
from iort_agent.video.config import SIM, TOPIC, V4L2, VideoConfig, video_rule
from iort_contract.catalog.streams import DRIVE_STREAM, OWN_STREAMS
from iort_contract.limits import DEFAULT_NAMESPACE, ContractError
from iort_contract.messages.shadow import SETTINGS
from iort_contract.topics import check_namespace, check_robot


@dataclass(frozen=True)
class Config:
    """The whole configuration. Paths in the file are relative to the file.

    Without ``root_ca``, the system's trust store must contain the broker's authority, as it does AWS'. The
    default ``status_socket`` is agent.sock beside the file.
    """

    robot: str = setting(text(check_robot))
    endpoint: str = setting(text())
    certificate: Path = setting(FILE)
    private_key: Path = setting(FILE)
    sources: tuple[SourceConfig, ...] = setting(
        items(variant("type", SOURCES), at_least=1, what="a list of at least one source")
    )
    root_ca: Path | None = setting(FILE, None)
    namespace: str = setting(text(check_namespace), DEFAULT_NAMESPACE)
    port: int = setting(number(1, 65535, whole=True), 8883)
    record: RecordConfig = setting(section(RecordConfig), RecordConfig())
    live: LiveConfig = setting(section(LiveConfig), LiveConfig())
    ping: PingConfig = setting(section(PingConfig), PingConfig())
    queue: QueueConfig = setting(section(QueueConfig), QueueConfig())
    files: FilesConfig = setting(section(FilesConfig), FilesConfig())
    recorder: RecorderConfig | None = setting(section(RecorderConfig), None)
    video: VideoConfig | None = setting(video_rule(), None)
    metrics: MetricsConfig = setting(section(MetricsConfig), MetricsConfig())
    downlink: DownlinkConfig = setting(section(DownlinkConfig), DownlinkConfig())
    motion: MotionState = setting(section(MotionState), MotionState())
    share: tuple[tuple[str, ShareConfig], ...] = setting(share_rule(), ())
    status_socket: Path | None = setting(path(), None)
    log_level: str = setting(allowed(SETTINGS["log_level"]), "info")


def load_config(file: Path) -> Config:
    """Read a configuration file. Raises `ConfigError`, which names file, key, value and what is allowed."""
    place = Place(file)
    content = read_yaml(file)
    if content is None:
        raise ConfigError(f"{file}: is empty")
    config = load(Config, content, place)
    if config.queue.path is None:
        config = replace(config, queue=replace(config.queue, path=default_path(file, config.robot)))
    if config.recorder is not None and config.recorder.folder is None:
        assert config.queue.path is not None, "as above"
        folder = config.queue.path.with_suffix(".ring")
        config = replace(config, recorder=replace(config.recorder, folder=folder))
    try:
        config.downlink.check_topics()
        config.downlink.graph(config.sources)
    except ContractError as error:
        raise place.child("downlink").problem(str(error)) from error
    try:
        config.downlink.drive_limits()
    except ContractError as error:
        raise place.child("downlink.drive").problem(str(error)) from error
    _check_streams(config, place.child("sources"))
    _check_video(config, place.child("video"))
    for i, source in enumerate(config.sources):
        if config.recorder is None and isinstance(source, RosConfig) and source.has_ring():
            raise (
                place.child("sources")
                .item(i)
                .problem("`only: ring` needs the section recorder, whose ring it means")
            )
    if config.files.large_folder is None and any(source.uploads_large() for source in config.sources):
        raise place.child("files.large_folder").problem(
            "required, and missing: a source says `large: upload`, and its contents wait in this folder"
        )
    if "://" in config.endpoint or "/" in config.endpoint:
        raise place.child("endpoint").error(config.endpoint, "a host name, without scheme or path")
    return config


def without_sources(config: Config) -> Config:
    """The configuration of a run that only delivers what the runs before it have left, incidents too."""
    recorder = config.recorder
    return replace(
        config,
        sources=(),
        recorder=None if recorder is None else replace(recorder, service=None, topic=None),
        video=None,
        share=(),
        downlink=DownlinkConfig(),
        ping=PingConfig(),
        metrics=MetricsConfig(enabled=False),
    )


def _check_video(config: Config, place: Place) -> None:
    """The camera must be that of a source, if it is one's."""
    if config.video is None:
        return
    kind, place = config.video.source.kind, place.child("source")
    if kind == TOPIC and config.downlink.graph(config.sources).node is None:
        raise place.problem(
            "the topic is heard by the node of the sources, and none of them is a ros1 or ros2: "
            f"add one to sources, or take the camera itself (type: {V4L2})"
        )
    if kind == SIM and not any(isinstance(source, SimConfig) for source in config.sources):
        raise place.problem("needs a simulated car: a source of the type sim")


def _check_streams(config: Config, place: Place) -> None:
    """Two sources must not write one stream: their samples would mix into one time series."""
    # A car whose commands no stick drives may record another stream of this name.
    taken: list[str] = sorted(OWN_STREAMS - ({DRIVE_STREAM} if config.downlink.drive is None else set()))
    for i, source in enumerate(config.sources):
        both = sorted({*source.streams()} & {*source.only_ring()})
        if both:
            raise place.item(i).problem(f"the stream {both[0]} is recorded, and for the ring alone")
        streams = [*source.streams(), *source.only_ring()]
        for stream in streams:
            if stream in taken:
                raise place.item(i).problem(f"the stream {stream} is taken: {', '.join(taken)} are in use")
        taken += streams
