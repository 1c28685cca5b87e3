"""Where samples come from. Each kind of source is one file here and one line in `registry`."""

from __future__ import annotations

import threading
from typing import Any, Callable, Mapping, Protocol, Sequence

from iort_agent.clock import Clock
from iort_contract.limits import Value

# What becomes of bytes in a message, such as an image: nothing, or a file with a claim in the sample.
REFUSE, UPLOAD = "refuse", "upload"

# Takes a sample: stream, microseconds since the epoch, field -> value. The mapping is handed over:
# the source must not change it afterwards. A value may be bytes where the source's configuration says
# `UPLOAD`. Never blocks, never raises.
Emit = Callable[[str, int, Mapping[str, Value]], None]


class Source(Protocol):
    """Gives samples, in a thread of its own."""

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Emit samples until there are no more or ``stop`` is set.

        Raises `SourceError` when it cannot give samples and trying again would not help.
        """

    def report(self) -> Mapping[str, Any]:
        """What became of what it read, in counts of its own; for the status and the report."""


class SourceConfig(Protocol):
    """The settings of one source."""

    def streams(self) -> Sequence[str]:
        """The streams it will write, as far as known beforehand; no other source may."""

    def build(self, clock: Clock) -> Source:
        """Make the source; touches neither files nor devices yet."""

    def describe(self) -> str:
        """The source in a few words, for the log."""
