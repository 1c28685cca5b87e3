"""What every spool does: it keeps batches in order until the broker has acknowledged them."""

from __future__ import annotations

from typing import Callable, NamedTuple, Protocol

from iort_contract.messages.batch import RunEnd

OVERWRITE_OLDEST, REJECT_NEW = "OverwriteOldestData", "RejectNewData"
# What a batch survives once it may be published: the end of the process, or a power cut too.
PROCESS, FULL = "process", "full"

OnStored = Callable[[], None]


class Entry(NamedTuple):
    """A batch in the spool. ``id`` grows in the order of the puts and is the spool's own."""

    id: int
    stream: str
    seq: int
    payload: bytes
    samples: int


class Backlog(NamedTuple):
    """What is not acknowledged yet."""

    batches: int
    samples: int
    payload_bytes: int


class Dropped(NamedTuple):
    """What was dropped; a batch that was being published at that moment may have arrived all the same."""

    batches: int
    samples: int


class Spool(Protocol):
    """Keeps batches in order from `put` to `ack`. Safe to use from several threads."""

    @property
    def alarm(self) -> str | None:
        """What the operator should know and mend, in a line; None while all is well."""

    @property
    def damaged(self) -> int:
        """The queue files found damaged or removed since the start, with batches that nobody could count."""

    @property
    def durable(self) -> bool:
        """Whether the next process sends what is left at the end of this one."""

    def on_stored(self, handler: OnStored) -> None:
        """Call the handler, in any thread, whenever `next` may have a batch that it had not before."""

    def previous(self, stream: str) -> tuple[RunEnd, ...] | None:
        """The runs that a batch of the stream must name as the ones before; None once a batch of this run
        was acknowledged, and so has told the cloud."""

    def put(self, stream: str, boot: str, seq: int, payload: bytes, *, samples: int) -> None:
        """Keep batch ``seq`` of the run ``boot``, or drop a batch as the policy says. Never waits for a
        disk."""

    def next(self, after: int) -> Entry | None:
        """The oldest batch with an ``id`` greater than ``after``; it stays until it is acknowledged. None if
        there is no such batch, or it is still being read: then `on_stored` tells. The caller bounds how many
        batches it has without an `ack`, since the spool holds these in memory."""

    def ack(self, entry_id: int) -> None:
        """Forget a batch that has arrived. Does nothing if it was acknowledged or dropped before."""

    def backlog(self) -> Backlog:
        """What is kept now."""

    def dropped(self) -> Dropped:
        """What was dropped since the start of this process."""

    def close(self) -> None:
        """End in good order. The next run finds what is kept, if the spool is durable."""
