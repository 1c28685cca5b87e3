"""The claim check: what is too large for a message becomes a file, and the sample says which.

A source hands such a field over with the message. Its bytes are written into a folder that
`iort_agent.files.folder` empties into the bucket, under a key that is known before anything is sent, so that
the sample need not wait for the upload.
"""

from __future__ import annotations

import hashlib
import logging
import threading
from pathlib import Path, PurePath
from typing import Any, Callable, Mapping

from iort_agent.clock import Clock
from iort_agent.files.file import kind_of, wire_name
from iort_agent.files.folder import FilesConfig, Uploads
from iort_agent.lanes.thumbnail import thumbnail
from iort_agent.private_files import write_below
from iort_agent.sources import Emit
from iort_agent.throttled_log import Seldom
from iort_contract.limits import Value
from iort_contract.messages.files import CLAIM_AT, CLAIM_FIELDS, File, file_key
from iort_contract.ros1.message import RosMessage, cut

_log = logging.getLogger(__name__)

# How files begin that people want to open by themselves. Other bytes are for who knows the message.
_BEGINNINGS = ((b"\xff\xd8\xff", ".jpg"), (b"\x89PNG\r\n\x1a\n", ".png"))
_LOOK_S = 0.1

Thumbnail = Callable[[bytes, str], "str | None"]


class ClaimCheck:
    """Takes bytes out of samples and puts claims in. Safe to use from several threads.

    Of each stream, at most one content every ``every_s`` of the samples' own time is kept, and no more
    than ``max_bytes`` wait in the folder; what is not kept is counted, and its claim is null: what was not
    due, and what there was no room for.
    """

    def __init__(
        self,
        *,
        robot: str,
        folder: Path,
        every_s: float,
        max_bytes: int,
        clock: Clock,
        thumbnail: Thumbnail,
        stored: Callable[[], None],
    ) -> None:
        self._robot, self._folder, self._max_bytes = robot, folder, max_bytes
        self._every_us = round(every_s * 1_000_000)
        self._clock, self._thumbnail, self._stored = clock, thumbnail, stored
        self._seldom = Seldom(_log, clock)
        self._lock = threading.Lock()
        self._last_us: dict[str, int] = {}
        self._bytes = self._measure()
        self.kept = self.left_out = self.not_due = 0

    def around(self, emit: Emit) -> Emit:
        """An `Emit` that puts claims in before the sample goes on."""

        def emit_claims(stream: str, t_us: int, values: Mapping[str, Any]) -> None:
            if isinstance(values, RosMessage):
                if values.large:
                    values = self.claim(stream, t_us, values)
            elif any(type(value) is bytes for value in values.values()):
                values = self.claim_fields(stream, t_us, values)
            emit(stream, t_us, values)

        return emit_claims

    def claim(self, stream: str, t_us: int, message: RosMessage) -> RosMessage:
        """The message with an empty array for each of its large ones, and a claim beside it, which says where
        the content is kept and where in the message it was."""
        keep = self._is_due(stream, t_us)
        raw = message.raw
        beside: dict[str, Value] = {}
        for field, content in message.large.items():
            raw, at = cut(raw, content)
            beside.update(self._claim(stream, t_us, field, content, keep=keep))
            beside[f"{field}.{CLAIM_AT}"] = at
        return RosMessage(raw, message.kind, beside=beside)

    def claim_fields(self, stream: str, t_us: int, values: Mapping[str, Any]) -> dict[str, Value]:
        """Selected fields with a claim for each of bytes; the others as they are."""
        keep = self._is_due(stream, t_us)
        sample: dict[str, Value] = {}
        for field, value in values.items():
            if type(value) is bytes:
                sample.update(self._claim(stream, t_us, field, value, keep=keep))
            else:
                sample[field] = value
        return sample

    def _claim(self, stream: str, t_us: int, field: str, content: bytes, *, keep: bool) -> dict[str, Value]:
        claim = self._keep(stream, t_us, field, content) if keep else None
        if claim is None:
            self.left_out += keep
            self.not_due += not keep
            claim = dict.fromkeys(CLAIM_FIELDS)
        return {f"{field}.{name}": one for name, one in claim.items()}

    def wait_empty(self, timeout_s: float) -> bool:
        """Wait until the folder is uploaded; whether it is."""
        until, never = self._clock.monotonic() + timeout_s, threading.Event()
        while self._measure():
            if self._clock.monotonic() >= until:
                return False
            # The folder is emptied file by file, and tells nobody.
            self._clock.wait(never, _LOOK_S)
        return True

    def report(self) -> dict[str, Any]:
        """What became of the contents."""
        counts = {"kept": self.kept, "not_due": self.not_due, "left_out": self.left_out}
        return {**counts, **self._seldom.counts()}

    def _is_due(self, stream: str, t_us: int) -> bool:
        with self._lock:
            last = self._last_us.get(stream)
            # A recording that begins anew steps back.
            if last is not None and last <= t_us < last + self._every_us:
                return False
            self._last_us[stream] = t_us
            return True

    def _keep(self, stream: str, t_us: int, field: str, content: bytes) -> dict[str, Value] | None:
        suffix = next((end for begin, end in _BEGINNINGS if content.startswith(begin)), ".bin")
        name = PurePath(stream) / f"{t_us}-{field}{suffix}"
        if not self._has_room(len(content)):
            self._seldom.warn("full", f"{self._folder} is full: contents of {stream} are not kept")
            return None
        try:
            written_ns = write_below(self._folder, name, content, mtime_ns=max(0, t_us) * 1000)
        except OSError as error:
            self._seldom.warn("disk", f"{self._folder}: {error.strerror or error}")
            return None
        kind, content_type = kind_of(name)
        sha256 = hashlib.sha256(content).hexdigest()
        file = File(wire_name(name), kind, content_type, len(content), sha256, written_ns // 1000)
        self.kept += 1
        self._stored()
        return {
            "key": file_key(self._robot, file),
            "sha256": sha256,
            "size": len(content),
            "content_type": content_type,
            "thumbnail": self._thumbnail(content, content_type),
        }

    def _has_room(self, size: int) -> bool:
        with self._lock:
            if self._bytes + size > self._max_bytes:
                # Uploads make room, and do not say so.
                self._bytes = self._measure()
            if self._bytes + size > self._max_bytes:
                return False
            self._bytes += size
            return True

    def _measure(self) -> int:
        """Bytes that wait in the folder."""
        return sum(map(_size, self._folder.glob("*/[!.]*")))


def make_claims(
    files: FilesConfig, *, robot: str, clock: Clock, uploads: Uploads | None
) -> ClaimCheck | None:
    """The claim check that the configuration asks for; None where it asks for none."""
    if files.large_folder is None or uploads is None:
        return None
    return ClaimCheck(
        robot=robot,
        folder=files.large_folder,
        every_s=files.large_every_s,
        max_bytes=round(files.large_max_mb * 1e6),
        clock=clock,
        thumbnail=thumbnail,
        stored=uploads.wake,
    )


def _size(path: Path) -> int:
    try:
        return path.stat().st_size or 1
    except OSError:
        return 0  # just uploaded
