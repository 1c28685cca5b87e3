"""Attachments: a field too large for a message becomes a file, and the sample says which.

A source gives the field's bytes with the sample. They are written into a folder, which
`iort_agent.files.folder` uploads. The file's key is known beforehand, so the sample does not wait for the
upload.
"""

from __future__ import annotations

import base64
import hashlib
import io
import logging
import threading
from pathlib import Path, PurePath
from typing import Any, Callable, Mapping

from iort_agent.common.logs import ThrottledLog
from iort_agent.common.private_files import write_below
from iort_agent.common.threads import Clock
from iort_agent.files.file import kind_of, wire_name
from iort_agent.files.folder import FilesConfig, Uploads
from iort_agent.sources import Emit
from iort_contract.limits import Value
from iort_contract.messages.files import ATTACHMENT_AT, ATTACHMENT_FIELDS, File, file_key
from iort_contract.ros.message import RosMessage, cut

_log = logging.getLogger(__name__)

_SIZE = (96, 96)
_QUALITIES = (50, 30, 15)
# In base64 it must fit into a text of a sample.
_MAX_BYTES = 3072
_KINDS = ("image/jpeg", "image/png")


def thumbnail(content: bytes, content_type: str) -> str | None:
    """A JPEG of at most 96 x 96 pixels in base64; None if the content is no picture, or without Pillow, which
    `pip install 'iort-agent[thumbnail]'` brings."""
    if content_type not in _KINDS:
        return None
    try:
        from PIL import Image  # noqa: PLC0415 - optional
    except ImportError:
        _log.debug("no thumbnails: pip install 'iort-agent[thumbnail]'")
        return None
    try:
        with Image.open(io.BytesIO(content), formats=("JPEG", "PNG")) as picture:
            # Decoding a JPEG at a fraction of its size saves most of the time.
            picture.draft("RGB", _SIZE)
            small = picture.convert("RGB")
            small.thumbnail(_SIZE)
            for quality in _QUALITIES:
                out = io.BytesIO()
                small.save(out, "JPEG", quality=quality)
                if out.tell() <= _MAX_BYTES:
                    return base64.b64encode(out.getvalue()).decode()
    except Exception as error:  # noqa: BLE001 - a damaged picture raises about anything
        _log.debug("no thumbnail: %s", error)
    return None


# First bytes of the files that people want to open. Other bytes are for programs that know the message.
_BEGINNINGS = ((b"\xff\xd8\xff", ".jpg"), (b"\x89PNG\r\n\x1a\n", ".png"))
_LOOK_S = 0.1

Thumbnail = Callable[[bytes, str], "str | None"]


class Attachments:
    """Replaces bytes in samples by attachments. Safe to use from several threads.

    Each stream keeps at most one content every ``large_every_s`` of its samples' own time, and at most
    ``large_max_mb`` wait in the folder. The attachment of a content that is not kept is null; `report` counts
    those that were not due and those without room.
    """

    def __init__(
        self,
        robot: str,
        folder: Path,
        files: FilesConfig,
        clock: Clock,
        *,
        stored: Callable[[], None],
        thumbnail: Thumbnail = thumbnail,
    ) -> None:
        self._robot, self._folder, self._clock = robot, folder, clock
        self._every_us = round(files.large_every_s * 1e6)
        self._max_bytes = round(files.large_max_mb * 1e6)
        self._stored, self._thumbnail = stored, thumbnail
        self._throttled = ThrottledLog(_log, clock)
        self._lock = threading.Lock()
        self._last_us: dict[str, int] = {}
        self._bytes = self._measure()
        self.kept = self.left_out = self.not_due = 0

    def around(self, emit: Emit) -> Emit:
        """An `Emit` that replaces the bytes of each sample first."""

        def emit_attached(stream: str, t_us: int, values: Mapping[str, Any], *, more: bool = False) -> float:
            if isinstance(values, RosMessage):
                if values.large:
                    values = self.attach_to_message(stream, t_us, values)
            elif any(isinstance(value, bytes) for value in values.values()):
                values = self.attach_to_fields(stream, t_us, values)
            return emit(stream, t_us, values, more=more)

        return emit_attached

    def attach_to_message(self, stream: str, t_us: int, message: RosMessage) -> RosMessage:
        """The message with its large arrays emptied. The attachments beside it say where each content is kept
        and where in the message it was."""
        keep = self._is_due(stream, t_us)
        raw = message.raw
        beside: dict[str, Value] = {}
        for field, content in message.large.items():
            raw, at = cut(raw, content, len(message.raw) - len(raw), ros2=message.kind.ros2)
            beside.update(self._attachment(stream, t_us, field, content, keep=keep))
            beside[f"{field}.{ATTACHMENT_AT}"] = at
        return RosMessage(raw, message.kind, beside=beside)

    def attach_to_fields(self, stream: str, t_us: int, values: Mapping[str, Any]) -> dict[str, Value]:
        """The fields with an attachment for each field of bytes."""
        keep = self._is_due(stream, t_us)
        sample: dict[str, Value] = {}
        for field, value in values.items():
            if isinstance(value, bytes):
                sample.update(self._attachment(stream, t_us, field, value, keep=keep))
            else:
                sample[field] = value
        return sample

    def wait_empty(self, timeout_s: float) -> bool:
        """Wait until the folder is uploaded; whether it is."""
        until, never = self._clock.monotonic() + timeout_s, threading.Event()
        while self._measure():
            if self._clock.monotonic() >= until:
                return False
            # Nobody signals that the folder is empty.
            self._clock.wait(never, _LOOK_S)
        return True

    def report(self) -> dict[str, Any]:
        """How many contents were kept, and how many were not, by reason."""
        counts = {"kept": self.kept, "not_due": self.not_due, "left_out": self.left_out}
        return {**counts, **self._throttled.counts()}

    def _is_due(self, stream: str, t_us: int) -> bool:
        with self._lock:
            last = self._last_us.get(stream)
            # The time of a recording that starts again steps back.
            if last is not None and last <= t_us < last + self._every_us:
                return False
            self._last_us[stream] = t_us
            return True

    def _attachment(
        self, stream: str, t_us: int, field: str, content: bytes, *, keep: bool
    ) -> dict[str, Value]:
        attachment = self._keep(stream, t_us, field, content) if keep else None
        if attachment is None:
            self.left_out += keep
            self.not_due += not keep
            attachment = dict.fromkeys(ATTACHMENT_FIELDS)
        return {f"{field}.{name}": one for name, one in attachment.items()}

    def _keep(self, stream: str, t_us: int, field: str, content: bytes) -> dict[str, Value] | None:
        suffix = next((end for begin, end in _BEGINNINGS if content.startswith(begin)), ".bin")
        name = PurePath(stream) / f"{t_us}-{field}{suffix}"
        if not self._has_room(len(content)):
            self._throttled.warn("full", f"{self._folder} is full: contents of {stream} are not kept")
            return None
        try:
            written_ns = write_below(self._folder, name, content, mtime_ns=max(0, t_us) * 1000)
        except OSError as error:
            self._throttled.warn("disk", f"{self._folder}: {error.strerror or error}")
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
                # Uploads have made room since, and do not tell.
                self._bytes = self._measure()
            if self._bytes + size > self._max_bytes:
                return False
            self._bytes += size
            return True

    def _measure(self) -> int:
        """Bytes that wait in the folder."""
        return sum(map(_size, self._folder.glob("*/[!.]*")))


def make_attachments(
    files: FilesConfig, *, robot: str, clock: Clock, uploads: Uploads | None
) -> Attachments | None:
    """The attachments of a configuration that has a ``large_folder``."""
    if files.large_folder is None or uploads is None:
        return None
    return Attachments(robot, files.large_folder, files, clock, stored=uploads.wake)


def _size(path: Path) -> int:
    try:
        return path.stat().st_size or 1
    except OSError:
        return 0  # just uploaded
