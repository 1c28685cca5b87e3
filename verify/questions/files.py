"""The files' bucket: the limits of a signed address, and no access without one."""

from __future__ import annotations

import hashlib
import http.client
import json
import time

from iort_contract.messages.files import FILES_PREFIX, PART_BYTES, File, part_range
from testkit.target import Target, temporary_function
from testkit.waiting import until
from verify.question import Seen, question
from verify.tools import asking, sent, trust

_GUIDE = "https://docs.aws.amazon.com/AmazonS3/latest/userguide"
_API = "https://docs.aws.amazon.com/AmazonS3/latest/API"
_SMALL = b"a small file"
_REST = b"the rest"
# As functions/upload.py signs.
_SIGNING = """
import boto3
from botocore.config import Config

def handler(event, context):
    config = Config(signature_version="s3v4", s3={"addressing_style": "virtual"})
    return boto3.client("s3", config=config).generate_presigned_url("put_object", Params=event, ExpiresIn=1)
"""


_MISMATCH = [403, "SignatureDoesNotMatch"]


def _file(content: bytes, name: str) -> File:
    digest = hashlib.sha256(content).hexdigest()
    return File(name, "log", "text/plain", len(content), digest, int(time.time()) * 1_000_000)


@question(
    "files.in_one",
    expected={
        "other_bytes": 400,
        "other_bytes_told": True,
        "other_length": _MISMATCH,
        "without_condition": _MISMATCH,
        "other_key": _MISMATCH,
        "stored": [200, ""],
        "again": [412, "PreconditionFailed"],
        "metadata": True,
        "known": True,
    },
    source=f"{_GUIDE}/using-presigned-url.html, {_GUIDE}/conditional-requests.html and "
    "https://repost.aws/knowledge-center/s3-presigned-url-signature-mismatch",
    relied_on_by=("functions/upload.py", "functions/upload.py", "device/iort_agent/files/upload.py"),
)
def in_one(target: Target) -> Seen:
    """A signed address accepts this content, of this length, under this key, once. Other bytes are refused
    with 400 and a code that the agent knows, all other changes with 403, and a second upload with 412."""
    file = _file(_SMALL, "verify.txt")
    with asking(target, "verify-file", file) as (robot, key):
        (address,) = robot.ask(file, {1: _SMALL}).addresses
        longer = {**address.headers, "content-length": str(file.size + 1)}
        twice = {name: value for name, value in address.headers.items() if name != "if-none-match"}
        other_bytes, code = robot.put(address, _SMALL[::-1])
        seen = {
            "other_bytes": other_bytes,
            "other_bytes_told": code in ("BadDigest", "XAmzContentChecksumMismatch"),
            "other_length": robot.put(address._replace(headers=longer), _SMALL + b"x"),
            "without_condition": robot.put(address._replace(headers=twice), _SMALL),
            "other_key": robot.put(address._replace(url=address.url.replace(".txt", ".bin")), _SMALL),
            "stored": robot.put(address, _SMALL),
            "again": robot.put(address, _SMALL),
            "note_other_bytes": code,
        }
        bucket = target.cloud.output("storage", "FilesBucket")
        head = target.cloud.client("s3").head_object(Bucket=bucket, Key=key)
        metadata = {"sha256": file.sha256, "kind": file.kind, "t": str(file.t_us)}
        return {**seen, "metadata": head["Metadata"] == metadata, "known": robot.ask(file, {}).stored}


@question(
    "files.in_parts",
    expected={
        "other_bytes": 400,
        "parts": [[200, ""], [200, ""]],
        "have_after_the_second": [[2, 2]],
        "asked_for_then": [1],
        "stored": True,
        "size": True,
        "metadata": True,
    },
    source=f"{_API}/API_CompletedPart.html and {_GUIDE}/checking-object-integrity.html",
    relied_on_by=("functions/upload.py", "functions/upload.py"),
)
def in_parts(target: Target) -> Seen:
    """A part is accepted with its SHA-256 alone; the list of parts has the SHA-256 of each, so the function
    completes the upload without reading it."""
    content = bytes(PART_BYTES) + _REST
    file = _file(content, "verify.bag")
    ranges = {number: part_range(file, number) for number in (1, 2)}
    parts = {number: content[first : first + size] for number, (first, size) in ranges.items()}
    together = hashlib.sha256(b"".join(hashlib.sha256(body).digest() for body in parts.values())).hexdigest()
    with asking(target, "verify-parts", file) as (robot, key):
        addresses = {address.part: address for address in robot.ask(file, parts).addresses}
        other_bytes, _ = robot.put(addresses[2], _REST[::-1])
        second = robot.put(addresses[2], _REST)
        there = robot.ask(file, parts)
        first = robot.put(addresses[1], parts[1])
        done = robot.ask(file, {}, together)
        bucket = target.cloud.output("storage", "FilesBucket")
        head = target.cloud.client("s3").head_object(Bucket=bucket, Key=key)
        return {
            "other_bytes": other_bytes,
            "parts": [first, second],
            "have_after_the_second": there.have,
            "asked_for_then": [address.part for address in there.addresses],
            "stored": done.stored,
            "size": head["ContentLength"] == file.size,
            "metadata": head["Metadata"]["sha256"] == file.sha256,
        }


@question(
    "files.closed",
    expected={
        "expired": 403,
        "unsigned": {"GET": 403, "PUT": 403},
        "blocked": ["BlockPublicAcls", "BlockPublicPolicy", "IgnorePublicAcls", "RestrictPublicBuckets"],
    },
    source=f"{_GUIDE}/using-presigned-url.html and {_GUIDE}/access-control-block-public-access.html",
    relied_on_by=("stacks/storage.py", "device/iort_agent/files/upload.py"),
)
def closed(target: Target) -> Seen:
    """An expired address is refused with 403, and so is a request without signature."""
    # Signed for a second, with the upload function's role: robots' addresses are valid for 15 minutes.
    cloud, context = target.cloud, trust(target)
    s3, client = cloud.client("s3"), cloud.client("lambda")
    place = {"Bucket": cloud.output("storage", "FilesBucket"), "Key": f"{FILES_PREFIX}verify/expired"}
    with temporary_function(target, "signing", _SIGNING, memory_mb=256, timeout_s=30, like="Upload") as name:
        url = json.loads(client.invoke(FunctionName=name, Payload=json.dumps(place))["Payload"].read())
    try:

        def refused() -> tuple[int, str] | None:
            answer = sent(context, "PUT", url, _SMALL)
            return None if answer[0] == http.client.OK else answer

        expired, code = until(refused, "the expiry of an address that was signed for a second")
        unsigned = {method: sent(context, method, url.split("?")[0])[0] for method in ("GET", "PUT")}
    finally:
        s3.delete_object(Bucket=place["Bucket"], Key=place["Key"])
    blocked = s3.get_public_access_block(Bucket=place["Bucket"])["PublicAccessBlockConfiguration"]
    return {
        "expired": expired,
        "unsigned": unsigned,
        "blocked": sorted(name for name, value in blocked.items() if value),
        "note_expired": code,
    }
