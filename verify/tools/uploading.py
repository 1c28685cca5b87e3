"""A robot that requests signed addresses over MQTT, and uploads bodies there."""

from __future__ import annotations

import hashlib
import http.client
import re
import ssl
import uuid
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from urllib.parse import urlsplit

from iort_agent.files.upload import trusting
from iort_contract.messages.files import (
    Address,
    File,
    FileAnswer,
    FileRequest,
    decode_file_answer,
    encode_file_request,
    file_key,
)
from iort_contract.topics import FILE, PING, PONG, build_topic
from testkit.mqtt import Robot
from testkit.target import Target

_CODE = re.compile(r"<Code>([^<]+)</Code>")


class Asking:
    """A robot that requests addresses and uploads bodies there."""

    def __init__(self, target: Target, robot: Robot) -> None:
        self._robot, self._namespace = robot, target.cloud.namespace
        self._trust = trust(target)
        robot.subscribe(build_topic(PONG, robot.name, FILE, self._namespace))

    def ask(self, file: File, parts: Mapping[int, bytes], parts_sha256: str | None = None) -> FileAnswer:
        """The answer to a request for these parts."""
        digests = {number: hashlib.sha256(body).hexdigest() for number, body in parts.items()}
        request = FileRequest(uuid.uuid4().hex, file, digests, parts_sha256)
        topic = build_topic(PING, self._robot.name, FILE, self._namespace)
        self._robot.publish(topic, encode_file_request(request))
        while (answer := decode_file_answer(self._robot.next_message()[1])).id != request.id:
            pass
        return answer

    def put(self, address: Address, body: bytes) -> tuple[int, str]:
        """The status, and the code of S3's error."""
        return sent(self._trust, "PUT", address.url, body, address.headers)


def trust(target: Target) -> ssl.SSLContext:
    """The system's authorities, and the embedded cloud's."""
    bundle = target.cloud.ca_bundle
    return trusting(Path(bundle) if bundle else None)


def sent(
    context: ssl.SSLContext,
    method: str,
    url: str,
    body: bytes = b"",
    headers: Mapping[str, str] | None = None,
) -> tuple[int, str]:
    """Send a body unchanged to an address; return the status, and the code of S3's error."""
    parts = urlsplit(url)
    with closing(http.client.HTTPSConnection(parts.netloc, context=context, timeout=60)) as connection:
        connection.request(method, f"{parts.path}?{parts.query}", body, dict(headers or {}))
        answer = connection.getresponse()
        found = _CODE.search(answer.read().decode(errors="replace"))
    return answer.status, found[1] if found else ""


@contextmanager
def asking(target: Target, base: str, file: File) -> Iterator[tuple[Asking, str]]:
    """A new robot and the key of its file; the file is deleted at the end."""
    bundle, bucket = target.robot(base), target.cloud.output("storage", "FilesBucket")
    key = file_key(bundle.robot, file)
    with Robot(bundle.folder) as robot:
        try:
            yield Asking(target, robot.online()), key
        finally:
            target.cloud.client("s3").delete_object(Bucket=bucket, Key=key)
