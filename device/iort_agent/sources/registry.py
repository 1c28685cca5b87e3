"""The kinds of source that a configuration may name."""

from __future__ import annotations

from typing import Any, Mapping

from iort_agent.sources import UPLOAD, SourceConfig
from iort_agent.sources.recording.bag import BagConfig
from iort_agent.sources.ros1 import Ros1Config
from iort_agent.sources.rosbridge.source import RosbridgeConfig
from iort_agent.sources.sim import SimConfig
from iort_agent.sources.vesc.serial_line import VescConfig

# A new kind of source is one more line here.
SOURCES: Mapping[str, type[Any]] = {
    "bag": BagConfig,
    "ros1": Ros1Config,
    "rosbridge": RosbridgeConfig,
    "sim": SimConfig,
    "vesc": VescConfig,
}


def uploads_large(source: SourceConfig) -> bool:
    """Whether the source sends large values as files."""
    if isinstance(source, BagConfig):
        return source.large == UPLOAD
    return isinstance(source, Ros1Config) and any(topic.large == UPLOAD for _, topic in source.topics)
