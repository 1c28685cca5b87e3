"""The agent's configuration: one YAML file, read once, into frozen dataclasses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import iort_contract
from iort_agent.config.downlink import DownlinkConfig, ShareConfig, share_rule
from iort_agent.config.schema import (
    Where,
    any_path,
    choice,
    existing_path,
    flag,
    items,
    load,
    number,
    read_yaml,
    section,
    setting,
    text,
    variant,
)
from iort_agent.errors import ConfigError
from iort_agent.files.folder import FilesConfig
from iort_agent.sources import UPLOAD, SourceConfig
from iort_agent.sources.recording.bag import BagConfig
from iort_agent.sources.ros1 import Ros1Config
from iort_agent.sources.rosbridge.source import RosbridgeConfig
from iort_agent.sources.sim import SimConfig
from iort_agent.sources.vesc.serial_line import VescConfig
from iort_agent.spool.memory import FULL, OVERWRITE_OLDEST, PROCESS, REJECT_NEW

LOG_LEVELS = ("debug", "info", "warning", "error")

# A new kind of source is one more line here.
SOURCES = {
    "bag": BagConfig,
    "ros1": Ros1Config,
    "rosbridge": RosbridgeConfig,
    "sim": SimConfig,
    "vesc": VescConfig,
}


@dataclass(frozen=True)
class RecordConfig:
    """The record lane. ``batch_s``: a batch spans at most this; 0 sends each sample by itself."""

    enabled: bool = setting(flag(), default=True)
    batch_s: float = setting(number(0, 1, unit="s"), default=1.0)


@dataclass(frozen=True)
class LiveConfig:
    """The live lane. ``rate_hz``: at most so many messages a second of each stream."""

    enabled: bool = setting(flag(), default=True)
    rate_hz: float = setting(
        number(iort_contract.LIVE_MIN_RATE_HZ, iort_contract.LIVE_MAX_RATE_HZ, unit="Hz"),
        iort_contract.LIVE_MAX_RATE_HZ,
    )


@dataclass(frozen=True)
class PingConfig:
    """Round trips to measure: so many a second over each path, 0 for none."""

    rate_hz: float = setting(number(0, 20, unit="Hz"), 0.0)
    paths: tuple[str, ...] = setting(
        items(
            choice(*iort_contract.PING_PATHS),
            at_least=1,
            what=f"a list of some of {', '.join(iort_contract.PING_PATHS)}",
        ),
        iort_contract.PING_PATHS,
    )
    padding_bytes: int = setting(number(0, 100_000, whole=True, unit="bytes"), 0)


@dataclass(frozen=True)
class MetricsConfig:
    """The agent's own figures, a sample every ``every_s`` of the stream `iort_contract.AGENT_STREAM`."""

    enabled: bool = setting(flag(), default=True)
    every_s: float = setting(number(1, 3600, unit="s"), 10.0)


def _queue_file(value: Any, where: Where) -> Path | None:
    """The path of a file that may be made: in a folder that exists, and not the configuration's own."""
    allowed = "the path of a file, in a folder that exists"
    if value is None:
        return None
    if not isinstance(value, str) or not value:
        raise where.error(value, allowed)
    path = where.file.parent / Path(value).expanduser()
    if not path.parent.is_dir():
        raise where.error(value, f"{allowed}, and there is no {path.parent}")
    if path.is_dir() or path.resolve() == where.file.resolve():
        raise where.error(value, f"{allowed}, that is nothing else already")
    return path


@dataclass(frozen=True)
class QueueConfig:
    """Where batches wait for the broker, and what to drop when it is full (Greengrass' words).

    ``path``: the queue's file, which need not exist; without it, the queue ends with the agent.
    ``max_bytes`` bounds the batches in it, and the file is a little larger. ``durability``: what the
    file survives, the end of the process or a power cut (``full``) too.
    """

    path: Path | None = setting(_queue_file, None)
    max_bytes: int = setting(number(200_000, 2**40, whole=True, unit="bytes"), 64 * 1024 * 1024)
    policy: str = setting(choice(OVERWRITE_OLDEST, REJECT_NEW), OVERWRITE_OLDEST)
    durability: str = setting(choice(PROCESS, FULL), PROCESS)


@dataclass(frozen=True)
class Config:
    """Everything the agent is told. Paths in the file are relative to the file.

    Without a ``root_ca`` the broker is held against the system's trust store, which knows AWS';
    without a ``status_socket`` it is agent.sock beside the file.
    """

    robot: str = setting(text(iort_contract.check_robot))
    endpoint: str = setting(text())
    certificate: Path = setting(existing_path())
    private_key: Path = setting(existing_path())
    sources: tuple[SourceConfig, ...] = setting(
        items(variant("type", SOURCES), at_least=1, what="a list of at least one source")
    )
    root_ca: Path | None = setting(existing_path(), None)
    namespace: str = setting(text(iort_contract.check_namespace), iort_contract.DEFAULT_NAMESPACE)
    port: int = setting(number(1, 65535, whole=True), 8883)
    record: RecordConfig = setting(section(RecordConfig), RecordConfig())
    live: LiveConfig = setting(section(LiveConfig), LiveConfig())
    ping: PingConfig = setting(section(PingConfig), PingConfig())
    queue: QueueConfig = setting(section(QueueConfig), QueueConfig())
    files: FilesConfig = setting(section(FilesConfig), FilesConfig())
    metrics: MetricsConfig = setting(section(MetricsConfig), MetricsConfig())
    downlink: DownlinkConfig = setting(section(DownlinkConfig), DownlinkConfig())
    share: tuple[tuple[str, ShareConfig], ...] = setting(share_rule(), ())
    status_socket: Path | None = setting(any_path(), None)
    log_level: str = setting(choice(*LOG_LEVELS), "info")


def load_config(file: Path) -> Config:
    """The configuration in a file. Raises `ConfigError`, naming file, key, value and what is allowed."""
    where = Where(file)
    content = read_yaml(file)
    if content is None:
        raise ConfigError(f"{file}: is empty")
    config = load(Config, content, where)
    _check_streams(config, where.child("sources"))
    if config.files.large_folder is None and any(_uploads_large(source) for source in config.sources):
        raise (
            where.child("files")
            .child("large_folder")
            .problem("required, and missing: a source says `large: upload`, and this is where its bytes wait")
        )
    if "://" in config.endpoint or "/" in config.endpoint:
        raise where.child("endpoint").error(config.endpoint, "a host name, without scheme or path")
    return config


def _check_streams(config: Config, where: Where) -> None:
    """Two sources must not write into one stream: their samples would mix into one time series."""
    taken: list[str] = sorted(iort_contract.OWN_STREAMS)
    for i, source in enumerate(config.sources):
        for stream in source.streams():
            if stream in taken:
                raise where.item(i).problem(f"the stream {stream} is taken: {', '.join(taken)} are in use")
        taken += source.streams()


def _uploads_large(source: SourceConfig) -> bool:
    if isinstance(source, BagConfig):
        return source.large == UPLOAD
    return isinstance(source, Ros1Config) and any(topic.large == UPLOAD for _, topic in source.topics)
