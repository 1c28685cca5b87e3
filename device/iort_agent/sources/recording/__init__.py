"""Plays a recording: ROS 1 ``.bag``, ROS 2 folders of ``.db3`` or ``.mcap``, VESC Tool's ``.csv``. Needs no
ROS."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ContextManager, Iterator, Mapping, Sequence

from iort_agent.common.schema import choice, flag, number, pairs, path, setting, text
from iort_agent.common.threads import Clock, SystemClock
from iort_agent.errors import SourceError
from iort_agent.sources import FAIL, OK, REFUSE, UPLOAD, Emit, Finding, SourceConfig
from iort_agent.sources.recording.player import NOW, ORIGINAL, Message, Open, Playback, play
from iort_agent.sources.recording.rosbag import Recording, Unread
from iort_agent.sources.recording.tool_csv import VescLog
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.topics import check_stream


@dataclass(frozen=True)
class BagConfig(SourceConfig):
    """A recording to play.

    ``topics`` maps ROS topics to streams; without it, every VescStateStamped becomes ``stream``, and so does
    a VESC Tool log, which has no topics. ``speed`` is a factor; 0 is as fast as possible. ``stamps``: ``now``
    moves the recording to the present, ``original`` keeps its own times. ``duration_s`` is counted in the
    recording's time. ``large: upload`` sends bytes (images, point clouds) as files.
    """

    path: Path = setting(path("the path of a file or folder that exists", fits=Path.exists))
    topics: tuple[tuple[str, str], ...] | None = setting(
        pairs(text(check_stream), what="a mapping of ROS topic to stream name, such as {/scan: scan}"),
        default=None,
    )
    speed: float = setting(number(0, 1000), 1.0)
    stamps: str = setting(choice(NOW, ORIGINAL), NOW)
    loop: bool = setting(flag(), default=False)
    duration_s: float | None = setting(number(0.001, 1e9, unit="s"), None)
    stream: str = setting(text(check_stream), VESC_STREAM)
    large: str = setting(choice(REFUSE, UPLOAD), REFUSE)

    def streams(self) -> Sequence[str]:
        return sorted({stream for _, stream in self.topics}) if self.topics else [self.stream]

    def describe(self) -> str:
        return f"bag {self.path}"

    def recorded(self) -> bool:
        return True

    def replayed(self) -> bool:
        """Its own times pass at the clock's pace at speed 1 only."""
        return self.stamps == ORIGINAL and self.speed != 1

    def build(self, clock: Clock) -> BagSource:
        return BagSource(self, clock)

    def uploads_large(self) -> bool:
        return self.large == UPLOAD

    def check(self, title: str) -> Iterator[Finding]:
        """Whether the recording can be opened, has every topic, and has a first message."""
        source = self.build(SystemClock())
        try:
            with source.open() as messages:
                first = next(messages, None)
        except SourceError as error:
            yield Finding(title, FAIL, str(error))
            return
        for line in source.unread.lines.values():
            yield Finding(title, FAIL, line)
        if first is None:
            yield Finding(title, FAIL, f"it has no message of {', '.join(self.streams())}", "see `topics`")
        else:
            yield Finding(title, OK, f"can be opened, for {', '.join(self.streams())}")


class BagSource:
    """Emits the messages of a recording at its own pace."""

    def __init__(self, config: BagConfig, clock: Clock) -> None:
        self._config = config
        self._clock = clock
        is_log = config.path.suffix.lower() == ".csv"
        self._log = VescLog(config.path, config.stream, config.stamps) if is_log else None
        self.unread = Unread()

    def report(self) -> Mapping[str, Any]:
        """The counts of a VESC Tool log's rows; of a bag, by topic, the messages that were not read."""
        if self._log is not None:
            return self._log.report()
        return {topic: {"unread": count} for topic, count in self.unread.counts.copy().items()}

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Play until the end, or for ever with ``loop``. Raises `SourceError`, at the end for messages that
        were not read."""
        config = self._config
        how = Playback(config.speed, config.stamps, config.loop, config.duration_s)
        play(self._recording(), how, self._clock, emit, stop)
        if self.unread.lines:
            raise SourceError("; ".join(self.unread.lines.values()))

    def open(self) -> ContextManager[Iterator[Message]]:
        """The recording's messages, in the order of recording, for a ``with`` block. Raises `SourceError`."""
        return self._recording()()

    def _recording(self) -> Open:
        config = self._config
        if self._log is None:
            large = config.large == UPLOAD
            return lambda: Recording(config.path, config.topics, config.stream, self.unread, large=large)
        if config.topics is not None:
            raise SourceError(f"{config.path}: a VESC Tool log has no topics; `stream` names its stream")
        return self._log
