"""Plays a recording: ROS 1 ``.bag``, ROS 2 folders of ``.db3`` or ``.mcap``, VESC Tool's ``.csv``. Needs no
ROS."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Iterator, Mapping, NamedTuple, Optional, Sequence

from iort_agent.common.schema import choice, flag, number, pairs, path, setting, text
from iort_agent.common.threads import Clock, Pace, SystemClock
from iort_agent.errors import SourceError
from iort_agent.sources import FAIL, OK, REFUSE, UPLOAD, Emit, Finding, SourceConfig
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.recordings import Message, Open, RecordingError
from iort_contract.recordings.rosbag import Recording, Unread
from iort_contract.recordings.tool_csv import VescLog
from iort_contract.topics import check_stream

NOW, ORIGINAL = "now", "original"
# The time between the rounds of a recording with a single message.
_LONE_NS = 1_000_000_000


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
        self._log = (
            VescLog(config.path, config.stream, original=config.stamps == ORIGINAL) if is_log else None
        )
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
        with _as_source_errors():
            play(self._recording(), how, self._clock, emit, stop)
        if self.unread.lines:
            raise SourceError("; ".join(self.unread.lines.values()))

    @contextmanager
    def open(self) -> Iterator[Iterator[Message]]:
        """The recording's messages, in the order of recording, for a ``with`` block. Raises `SourceError`."""
        with _as_source_errors(), self._recording()() as messages:
            yield messages

    def _recording(self) -> Open:
        config = self._config
        if self._log is None:
            try:
                # Only a robot that plays bags needs them.
                import lz4.frame  # type: ignore[import-untyped]  # noqa: F401, PLC0415 - see above; it has no types
                import rosbags.rosbag1  # noqa: F401, PLC0415 - as above
            except ImportError as error:
                raise SourceError(
                    "playing a bag needs the package rosbags: pip install 'iort-agent[bag]'"
                ) from error
            large = config.large == UPLOAD
            return lambda: Recording(config.path, config.topics, config.stream, self.unread, large=large)
        if config.topics is not None:
            raise SourceError(f"{config.path}: a VESC Tool log has no topics; `stream` names its stream")
        return self._log


@contextmanager
def _as_source_errors() -> Iterator[None]:
    try:
        yield
    except RecordingError as error:
        raise SourceError(str(error)) from error


class Playback(NamedTuple):
    """How to play: see `BagConfig`."""

    speed: float
    stamps: str
    loop: bool
    duration_s: Optional[float]  # noqa: UP045 - a NamedTuple's types are evaluated, on Python 3.8 too


def play(recording: Open, how: Playback, clock: Clock, emit: Emit, stop: threading.Event) -> None:
    """Emit the messages until the end, or for ever with ``loop``. Raises the recording's errors."""
    pace = Pace(clock, stop)
    passed_ns = 0  # recorded time of the rounds before this one
    limit_ns = None if how.duration_s is None else round(how.duration_s * 1e9)
    base_us = clock.now_us()
    while True:
        with recording() as messages:
            played, at_ns = 0, passed_ns
            for message in messages:
                at_ns = passed_ns + message.at_ns
                if limit_ns is not None and at_ns >= limit_ns:
                    return
                if not pace.until(at_ns / 1e9 / how.speed if how.speed else 0.0):
                    return
                if how.stamps == ORIGINAL:
                    t_us = (message.stamp_ns + passed_ns) // 1000
                elif how.speed:
                    t_us = base_us + round(at_ns / 1000 / how.speed)
                else:
                    t_us = clock.now_us()
                emit(message.stream, t_us, message.values)
                # A type comes with its first message, and is not a message.
                played += message.stream != TYPES_STREAM
        if not how.loop or not played:
            return
        # The next round begins one mean interval later, so that no two samples have one time.
        passed_ns = at_ns + ((at_ns - passed_ns) // (played - 1) if played > 1 else _LONE_NS)
