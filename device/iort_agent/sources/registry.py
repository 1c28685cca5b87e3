"""The kinds of source that a configuration may name: a new one is one more line here."""

from __future__ import annotations

from typing import Mapping

from iort_agent.sources import SourceConfig
from iort_agent.sources.recording.bag import BagConfig
from iort_agent.sources.ros1 import Ros1Config
from iort_agent.sources.rosbridge.source import RosbridgeConfig
from iort_agent.sources.sim.source import SimConfig
from iort_agent.sources.vesc.serial_line import VescConfig

SOURCES: Mapping[str, type[SourceConfig]] = {
    "bag": BagConfig,
    "ros1": Ros1Config,
    "rosbridge": RosbridgeConfig,
    "sim": SimConfig,
    "vesc": VescConfig,
}
