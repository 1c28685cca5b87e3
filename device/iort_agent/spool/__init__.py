"""Where batches wait until the broker has acknowledged them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, NamedTuple, Protocol

from iort_agent.common.schema import Place, choice, number, setting
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


def default_path(file: Path, robot: str) -> Path:
    """The queue's file if the configuration names none: beside it, or, if that folder may not be written, in
    the service's or the user's folder of state. Each robot has its own."""
    name, folder = f"{robot}.queue.db", file.absolute().parent
    if os.access(folder, os.W_OK):
        return folder / name
    # systemd makes the folder of `StateDirectory`, and may name several.
    service = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    state = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
    return (Path(service) if service else Path(state).expanduser() / "iort") / name


def _queue_file(value: Any, where: Place) -> Path | None:
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

    ``path``: the queue's file, which need not exist. Without it, it is ``<robot>.queue.db`` beside the
    configuration.
    ``max_bytes`` bounds the batches in it, and the file is a little larger. ``durability``: what the
    file survives, the end of the process or a power cut (``full``) too.
    """

    path: Path | None = setting(_queue_file, None)
    max_bytes: int = setting(number(200_000, 2**40, whole=True, unit="bytes"), 64 * 1024 * 1024)
    policy: str = setting(choice(OVERWRITE_OLDEST, REJECT_NEW), OVERWRITE_OLDEST)
    durability: str = setting(choice(PROCESS, FULL), PROCESS)
