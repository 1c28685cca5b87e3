"""The section `recorder` of car.yaml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from iort_agent.common.schema import choice, items, number, path, setting, text
from iort_agent.sources.ros import ros_name

LZ4, ZSTD, NONE = "lz4", "zstd", "none"


@dataclass(frozen=True)
class RecorderConfig:
    """The event recorder; without this section there is none. It needs `pip install 'iort-agent[recorder]'`.

    The ring of messages in ``folder`` (``<queue>.ring`` beside the queue) keeps at most ``max_mb``, nothing
    older than ``max_age_s``, and takes at most ``max_disk_share`` of the disk. It gives way while less than
    ``keep_free_mb`` of the disk are free, or what the queue may still take. ``topics`` are the ROS topics and
    streams to keep, with ``*`` for any characters. ``memory_mb`` bounds what waits to be written. A power cut
    loses what no closed chunk has, at most the last second, and ``sync_s`` more if that is not 0; a killed
    process, the last second. Incidents that wait for their upload
    take ``max_mb`` more at most. ``service`` and ``topic`` are the
    ROS names by which a program on the robot triggers.
    """

    folder: Path | None = setting(path(), None)
    max_mb: float = setting(number(16, 1_000_000, unit="MB"), 1000.0)
    max_age_s: float = setting(number(10, 604_800, unit="s"), 3600.0)
    max_disk_share: float = setting(number(0.001, 0.9), 0.2)
    keep_free_mb: float = setting(number(0, 1_000_000, unit="MB"), 256.0)
    topics: tuple[str, ...] = setting(
        items(text(), at_least=1, what="a list of at least one topic or stream"), ("*",)
    )
    compression: str = setting(choice(LZ4, ZSTD, NONE), LZ4)
    memory_mb: float = setting(number(1, 1000, unit="MB"), 32.0)
    sync_s: float = setting(number(0, 60, unit="s"), 0.0)
    service: str | None = setting(text(ros_name), None)
    topic: str | None = setting(text(ros_name), None)
