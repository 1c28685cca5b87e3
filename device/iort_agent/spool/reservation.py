"""The file beside the spool that says which numbers may have been used, and whose the spool is.

The database knows the next number of each stream, but it may be damaged, lost or, after a power cut,
a little behind. So numbers are reserved here in blocks before any of them leaves the robot; whoever
cannot trust the database goes on behind the block. The file is small, of fixed size and written in
place, in two slots by turns, each with a checksum: that works on a full disk, and a write cut short
leaves the other slot. Its lock is held while an agent runs, which keeps a second one away.
"""

from __future__ import annotations

import fcntl
import json
import os
import zlib
from pathlib import Path
from typing import Any

from iort_agent.errors import AgentError

# So many numbers are missing downstream, at most, when the database was not to be trusted.
BLOCK = 256
# While the disk does not work, the file is looked after less often.
BLOCK_ADRIFT = 4096
_SLOT_BYTES = 16 * 1024
# Reserved for any stream, where there are more of them than a slot has room for.
_ANY = "*"


class Reservation:
    """The open, locked file, and what it said when it was opened.

    Raises `AgentError` where another agent has it, `OSError` where it cannot be had.
    """

    def __init__(self, path: Path) -> None:
        self._state: dict[str, Any] = {}
        self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        # Whether there has been a spool of ours here, whatever has become of it.
        self.existed = os.fstat(self._fd).st_size > 0
        self._folder = path.parent
        try:
            self._lock(path)
            self._read()
        except BaseException:
            os.close(self._fd)
            raise

    @property
    def state(self) -> dict[str, Any]:
        """What was last written: ``reserved`` and whatever else `write` was given."""
        return self._state

    def reserved(self, stream: str) -> int:
        """The first number of the stream that is not reserved: none from it on was used."""
        reserved = self._state.get("reserved", {})
        return int(reserved.get(stream, reserved.get(_ANY, 0)))

    def streams(self) -> list[str]:
        """The streams of which there are reserved numbers."""
        return [name for name in self._state.get("reserved", {}) if name != _ANY]

    def write(self, *, reserve: dict[str, int] | None = None, **facts: Any) -> None:
        """Note facts and the first numbers not reserved; on the disk when it returns."""
        state = {**self._state, **facts, "turn": self._state.get("turn", 0) + 1, "pid": os.getpid()}
        reserved: dict[str, int] = {**self._state.get("reserved", {}), **(reserve or {})}
        state["reserved"] = reserved
        text = json.dumps(state, separators=(",", ":")).encode()
        if len(text) > _SLOT_BYTES - 16:
            state["reserved"] = {_ANY: max(reserved.values())}
            text = json.dumps(state, separators=(",", ":")).encode()
        slot = (b"%08x " % zlib.crc32(text) + text).ljust(_SLOT_BYTES - 1) + b"\n"
        if os.fstat(self._fd).st_size < 2 * _SLOT_BYTES:
            self._allocate()
        written = os.pwrite(self._fd, slot, state["turn"] % 2 * _SLOT_BYTES)
        if written != len(slot):
            raise OSError(f"{written} of {len(slot)} bytes written")
        os.fsync(self._fd)
        self._state = state

    def close(self) -> None:
        """Give the file, and with it the spool, to whoever comes next."""
        os.close(self._fd)

    def _allocate(self) -> None:
        """Take the room for both slots now, and make the file's name durable."""
        os.pwrite(self._fd, b" " * (2 * _SLOT_BYTES), 0)
        folder = os.open(self._folder, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def _lock(self, path: Path) -> None:
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self._read()
            pid = self._state.get("pid", "unknown")
            raise AgentError(
                f"{path}: the queue is in use by another iort-agent (process {pid}): "
                "end that one, or give this robot a queue.path of its own"
            ) from error

    def _read(self) -> None:
        slots = (os.pread(self._fd, _SLOT_BYTES, turn * _SLOT_BYTES) for turn in (0, 1))
        self._state = max(map(_parse, slots), key=lambda state: state.get("turn", -1))


def _parse(slot: bytes) -> dict[str, Any]:
    """What a slot says; nothing if it was never written, cut short or damaged."""
    text = slot[9:].rstrip()
    if slot[:9] != b"%08x " % zlib.crc32(text):
        return {}
    state: dict[str, Any] = json.loads(text)
    return state
