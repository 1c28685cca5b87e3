"""Where samples come from: each kind of source is one file or folder here, and one line in `registry`. A
source may use the ROS 1 node and the tools of all rooms; it knows no other room of the agent."""

from __future__ import annotations

import threading
from typing import Any, Iterator, Mapping, NamedTuple, Protocol, Sequence

from iort_agent.common.threads import Clock
from iort_contract.limits import Value

# Bytes in a message, such as an image: left out, or uploaded as a file with an attachment in the sample.
REFUSE, UPLOAD = "refuse", "upload"
# A topic that is heard for the event recorder's ring, and not recorded.
RING = "ring"


class Emit(Protocol):
    """Takes a sample: stream, microseconds since the epoch, field -> value. The source must not change the
    mapping afterwards. A value may be bytes if the source's configuration says `UPLOAD`. Never blocks, never
    raises.

    ``more`` tells that newer samples follow at once. Until the monotonic time that is returned, nobody misses
    the stream's next samples.
    """

    def __call__(
        self, stream: str, t_us: int, values: Mapping[str, Value], *, more: bool = False
    ) -> float: ...


OK, WARN, FAIL = "ok", "warn", "fail"


class Finding(NamedTuple):
    """One line of `iort-agent check`; ``todo`` says what to do unless all is well."""

    what: str
    level: str
    text: str
    todo: str = ""


class Source(Protocol):
    """Gives samples, in a thread of its own."""

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Emit samples until there are no more or ``stop`` is set.

        Raises `SourceError` when it cannot give samples and trying again would not help. After any other
        error it is called again, unless its samples would come twice (`SourceConfig.recorded`).
        """

    def report(self) -> Mapping[str, Any]:
        """The source's own counts, for the status and the report; ``waits`` says what it waits for."""
        return {}


class SourceConfig(Protocol):
    """The section of car.yaml for one source."""

    def streams(self) -> Sequence[str]:
        """The streams that it will write, as far as known beforehand; no other source may."""

    def only_ring(self) -> Sequence[str]:
        """The streams that it will give to the event recorder's ring alone, as far as known beforehand."""
        return ()

    def build(self, clock: Clock) -> Source:
        """Make the source; touches neither files nor devices yet."""

    def describe(self) -> str:
        """The source in a few words, for the log."""

    def check(self, title: str) -> Iterator[Finding]:
        """Whether the source would give samples, for `iort-agent check`."""
        yield Finding(title, OK, "needs nothing")

    def uploads_large(self) -> bool:
        """Whether the source sends large values as files."""
        return False

    def recorded(self) -> bool:
        """Whether the samples come from a recording, so that another run would give them twice."""
        return False

    def replayed(self) -> bool:
        """Whether the samples' times pass faster or slower than the clock."""
        return False
