"""The files' bucket: the limits of a signed address, and no access without one."""

from __future__ import annotations

import hashlib
import time
from dataclasses import replace

from iort_contract.messages.files import FILES_PREFIX, PART_BYTES, File, part_range
from testkit.waiting import until
from verify.lab import Lab
from verify.question import Seen, question

_SMALL, _REST = b"a small file", b"the rest"
_STORED, _MISMATCH = [200, ""], [403, "SignatureDoesNotMatch"]
# As functions/upload.py signs.
_SIGNING = """
import boto3
from botocore.config import Config

def handler(event, context):
    config = Config(signature_version="s3v4", s3={"addressing_style": "virtual"})
    return boto3.client("s3", config=config).generate_presigned_url("put_object", Params=event, ExpiresIn=1)
"""


def _file(content: bytes, name: str) -> File:
    digest = hashlib.sha256(content).hexdigest()
    return File(name, "log", "text/plain", len(content), digest, int(time.time()) * 1_000_000)


@question(
    "files.in_one",
    aws="""s3:using-presigned-url s3:conditional-requests
    https://repost.aws/knowledge-center/s3-presigned-url-signature-mismatch""",
    expected={
        "other_bytes": 400,
        "other_bytes_told": True,
        "other_length": _MISMATCH,
        "without_condition": _MISMATCH,
        "other_key": _MISMATCH,
        "stored": _STORED,
        "again": [412, "PreconditionFailed"],
        "metadata": True,
        "known": True,
    },
)
def in_one(lab: Lab) -> Seen:
    """A signed address accepts this content, of this length, under this key, once. Other bytes are refused
    with 400 and a code that the agent knows, all other changes with 403, and a second upload with 412."""
    file = _file(_SMALL, "verify.txt")
    robot = lab.uploader("verify-file", file)
    (address,) = robot.ask(file, {1: _SMALL}).addresses
    longer = {**address.headers, "content-length": str(file.size + 1)}
    twice = {name: value for name, value in address.headers.items() if name != "if-none-match"}
    other_bytes, code = robot.put(address, _SMALL[::-1])
    seen = {
        "other_bytes": other_bytes,
        "other_bytes_told": code in ("BadDigest", "XAmzContentChecksumMismatch"),
        "other_length": robot.put(replace(address, headers=longer), _SMALL + b"x"),
        "without_condition": robot.put(replace(address, headers=twice), _SMALL),
        "other_key": robot.put(replace(address, url=address.url.replace(".txt", ".bin")), _SMALL),
        "stored": robot.put(address, _SMALL),
        "again": robot.put(address, _SMALL),
        "note_other_bytes": code,
    }
    metadata = {"sha256": file.sha256, "kind": file.kind, "t": str(file.t_us)}
    return {**seen, "metadata": robot.head()["Metadata"] == metadata, "known": robot.ask(file, {}).stored}


@question(
    "files.in_parts",
    aws="s3-api:API_CompletedPart s3:checking-object-integrity",
    expected={
        "other_bytes": 400,
        "parts": [_STORED, _STORED],
        "have_after_the_second": [[2, 2]],
        "asked_for_then": [1],
        "stored": True,
        "size": True,
        "metadata": True,
    },
)
def in_parts(lab: Lab) -> Seen:
    """A part is accepted with its SHA-256 alone; the list of parts has the SHA-256 of each, so the function
    completes the upload without reading it."""
    content = bytes(PART_BYTES) + _REST
    file = _file(content, "verify.bag")
    ranges = {number: part_range(file, number) for number in (1, 2)}
    parts = {number: content[first : first + size] for number, (first, size) in ranges.items()}
    together = hashlib.sha256(b"".join(hashlib.sha256(body).digest() for body in parts.values())).hexdigest()
    robot = lab.uploader("verify-parts", file)
    addresses = {address.part: address for address in robot.ask(file, parts).addresses}
    other_bytes, _ = robot.put(addresses[2], _REST[::-1])
    second = robot.put(addresses[2], _REST)
    midway = robot.ask(file, parts)
    first = robot.put(addresses[1], parts[1])
    done, head = robot.ask(file, {}, together), robot.head()
    return {
        "other_bytes": other_bytes,
        "parts": [first, second],
        "have_after_the_second": midway.have,
        "asked_for_then": [address.part for address in midway.addresses],
        "stored": done.stored,
        "size": head["ContentLength"] == file.size,
        "metadata": head["Metadata"]["sha256"] == file.sha256,
    }


@question(
    "files.closed",
    aws="s3:using-presigned-url s3:access-control-block-public-access",
    expected={
        "expired": 403,
        "unsigned": {"GET": 403, "PUT": 403},
        "blocked": ["BlockPublicAcls", "BlockPublicPolicy", "IgnorePublicAcls", "RestrictPublicBuckets"],
    },
)
def closed(lab: Lab) -> Seen:
    """An expired address is refused with 403, and so is a request without signature."""
    # Signed for a second, with the upload function's role: robots' addresses are valid for 15 minutes.
    bucket, key = lab.cloud.output("storage", "FilesBucket"), f"{FILES_PREFIX}verify/expired"
    signing = lab.function("signing", _SIGNING, memory_mb=256, timeout_s=30, like="Upload")
    url = lab.invoke(signing, {"Bucket": bucket, "Key": key})
    lab.undo(lab.client("s3").delete_object, Bucket=bucket, Key=key)

    def refused() -> tuple[int, str] | None:
        status, code = lab.sent("PUT", url, _SMALL)
        return (status, code) if status != 200 else None

    expired, code = until(refused, "the expiry of an address that was signed for a second")
    unsigned = {method: lab.sent(method, url.split("?")[0])[0] for method in ("GET", "PUT")}
    block = lab.client("s3").get_public_access_block(Bucket=bucket)["PublicAccessBlockConfiguration"]
    blocked = sorted(name for name, value in block.items() if value)
    return {"expired": expired, "unsigned": unsigned, "blocked": blocked, "note_expired": code}
