"""The kinds of source that a configuration may name: a new one is one more line here."""

from __future__ import annotations

import logging
import threading
from pathlib import Path
from typing import Any, Container, Mapping, Sequence

from iort_agent.common.threads import Clock
from iort_agent.errors import SourceError
from iort_agent.sources import Emit, SourceConfig
from iort_agent.sources.recording import BagConfig
from iort_agent.sources.ros import RosSource
from iort_agent.sources.ros1 import Ros1Config
from iort_agent.sources.ros2 import Ros2Config
from iort_agent.sources.rosbridge import RosbridgeConfig, RosbridgeSource
from iort_agent.sources.sim import SimConfig
from iort_agent.sources.vesc import VescConfig

SOURCES: Mapping[str, type[SourceConfig]] = {
    "bag": BagConfig,
    "ros1": Ros1Config,
    "ros2": Ros2Config,
    "rosbridge": RosbridgeConfig,
    "sim": SimConfig,
    "vesc": VescConfig,
}


_log = logging.getLogger(__name__)


class SourceRun:
    """Builds the source of a configuration and runs it once."""

    def __init__(
        self,
        config: SourceConfig,
        clock: Clock,
        *,
        queue: Path | None = None,
        taken: Sequence[str] = (),
        whole: bool = False,
    ) -> None:
        """``queue`` is the file beside which a source may keep what it must know after a restart; ``taken``
        are the streams of the other sources; ``whole`` says that somebody takes whole messages."""
        self.description, self.streams = config.describe(), config.streams()
        self.recorded, self.replayed = config.recorded(), config.replayed()
        self.source = config.build(clock)
        # The streams that are for the event recorder's ring alone.
        self.only_ring: Container[str] = ()
        if isinstance(self.source, (RosSource, RosbridgeSource)):
            self.source.whole = whole
        if isinstance(self.source, RosSource):
            self.source.remember(queue, taken)
            self.only_ring = self.source.only_ring
        self.failed = False
        self._ended = False

    def without_recorder(self) -> None:
        """Nobody takes whole messages after all; called before `run`."""
        if isinstance(self.source, (RosSource, RosbridgeSource)):
            self.source.whole = False

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Run until the source ends, fails or is stopped. Raises what is no `SourceError`, unless the source
        plays a recording: run again, it would give its samples twice."""
        _log.info("source started: %s", self.description)
        try:
            self.source.run(emit, stop)
        except SourceError as error:
            _log.error("source failed: %s: %s", self.description, error)
            self.failed = True
        except Exception:
            if not self.recorded:
                raise
            _log.exception("source failed: %s", self.description)
            self.failed = True
        else:
            _log.info("source ended: %s", self.description)
            self._ended = not stop.is_set()

    def check_stored(self, streams: Sequence[tuple[int, int]]) -> None:
        """Set `failed` if the source ended by itself and none of its samples could be stored.

        ``streams`` are the counts of accepted and rejected samples of each of its streams.
        """
        if not self._ended:
            return
        samples, refused = sum(one[0] for one in streams), sum(one[1] for one in streams)
        if not streams:
            _log.error("source failed: %s: it gave no sample", self.description)
            self.failed = True
        elif samples and samples == refused:
            _log.error("source failed: %s: none of its %d samples could be stored", self.description, samples)
            self.failed = True

    def waits(self) -> str | None:
        """The reason why the source waits; None if it does not wait."""
        why = self.source.report().get("waits")
        return str(why) if why else None

    def report(self) -> Mapping[str, Any]:
        """The source's own counts."""
        return self.source.report()

    def account(self) -> Mapping[str, Any]:
        """The counts of what is recorded: a topic for the ring alone lacks nothing there."""
        left_out = self.source.ring_topics if isinstance(self.source, RosSource) else ()
        return {name: counts for name, counts in self.report().items() if name not in left_out}
