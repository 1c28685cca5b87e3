"""Large arrays of imported messages, such as images, as files: where and how a robot's agent uploads them."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from typing import Any

from iort_contract.limits import MessageError, Value
from iort_contract.messages.files import ATTACHMENT_AT, ATTACHMENT_FIELDS, File, file_key
from iort_contract.recordings.rosbag import Kind
from iort_contract.ros.decode import Large
from iort_contract.ros.message import RosMessage, cut
from iort_station.cloud import Cloud

# First bytes of the files that people want to open, and the suffix, the kind and the type of each.
_BEGINNINGS = (
    (b"\xff\xd8\xff", ".jpg", "image", "image/jpeg"),
    (b"\x89PNG\r\n\x1a\n", ".png", "image", "image/png"),
    (b"", ".bin", "message", "application/octet-stream"),
)


class Attachments:
    """Uploads the contents of one import: of each stream one in ``every_s``."""

    def __init__(self, cloud: Cloud, robot: str, every_s: float) -> None:
        self._client, self._bucket = cloud.client("s3"), cloud.output("storage", "FilesBucket")
        self._robot, self._every_us = robot, round(every_s * 1e6)
        self._last_us: dict[str, int] = {}
        self.kept = 0

    def attached(self, kind: Kind, t_us: int, raw: bytes) -> RosMessage:
        """The message with its large arrays emptied, and beside it where their contents are; those that are
        not due are null."""
        assert kind.large is not None
        contents: dict[str, Large] = {}
        with suppress(MessageError):
            values: dict[str, Any] = dict(kind.large.decode(raw))
            contents = {name: value for name, value in values.items() if isinstance(value, Large) and value}
        if not contents:
            return RosMessage(raw, kind.whole)
        last_us = self._last_us.get(kind.stream)
        keep = last_us is None or not last_us <= t_us < last_us + self._every_us
        if keep:
            self._last_us[kind.stream] = t_us
        whole, beside = len(raw), dict[str, Value]()
        for field, content in contents.items():
            raw, at = cut(raw, content, whole - len(raw), ros2=kind.whole.ros2)
            attachment: dict[str, Value] = dict.fromkeys(ATTACHMENT_FIELDS)
            if keep:
                attachment = self._upload(kind.stream, t_us, field, content)
            beside.update({f"{field}.{name}": value for name, value in attachment.items()})
            beside[f"{field}.{ATTACHMENT_AT}"] = at
        return RosMessage(raw, kind.whole, beside=beside)

    def _upload(self, stream: str, t_us: int, field: str, content: bytes) -> dict[str, Value]:
        _, suffix, kind, content_type = next(one for one in _BEGINNINGS if content.startswith(one[0]))
        sha256 = hashlib.sha256(content).hexdigest()
        file = File(f"{stream}/{t_us}-{field}{suffix}", kind, content_type, len(content), sha256, t_us)
        key = file_key(self._robot, file)
        # A key is of one content, so another import writes the same.
        self._client.put_object(
            Bucket=self._bucket,
            Key=key,
            Body=bytes(content),
            ContentType=content_type,
            Metadata={"sha256": sha256, "kind": kind, "t": str(t_us)},
            ChecksumAlgorithm="SHA256",
        )
        self.kept += 1
        return {
            "key": key,
            "sha256": sha256,
            "size": len(content),
            "content_type": content_type,
            "thumbnail": None,
        }
