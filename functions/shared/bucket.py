"""The adapter to S3: finds a robot's files in the bucket, and signs addresses for missing ones."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from botocore.exceptions import ClientError

from iort_contract.messages.requests.files import UPLOAD_URL_S, Address, File, part_range

if TYPE_CHECKING:
    from types_boto3_s3 import S3Client


class Part(NamedTuple):
    """A part in S3, which has computed the SHA-256 and compared it with the signed one."""

    size: int
    etag: str
    sha256: str


class Bucket:
    """The files' bucket. ``signer`` signs robots' addresses, unless ``client`` does."""

    def __init__(self, client: S3Client, name: str, signer: S3Client | None = None) -> None:
        self._client, self._name, self._signer = client, name, signer or client

    def has(self, key: str) -> bool:
        """Whether an object with the key exists."""
        found = self._client.list_objects_v2(Bucket=self._name, Prefix=key, MaxKeys=1)
        # A key sorts before its own extensions.
        return any(one["Key"] == key for one in found.get("Contents", ()))

    def upload_of(self, key: str) -> str | None:
        """The id of an unfinished upload of the key; the oldest if there are several."""
        pages = self._client.get_paginator("list_multipart_uploads")
        uploads = [
            (one["Initiated"], one["UploadId"])
            for page in pages.paginate(Bucket=self._name, Prefix=key)
            for one in page.get("Uploads", ())
            if one["Key"] == key
        ]
        return min(uploads)[1] if uploads else None

    def begin(self, key: str, file: File) -> str:
        """Begin a multipart upload; return its id."""
        begun = self._client.create_multipart_upload(
            Bucket=self._name,
            Key=key,
            ContentType=file.content_type,
            Metadata=metadata(file),
            ChecksumAlgorithm="SHA256",
        )
        return str(begun["UploadId"])

    def parts(self, key: str, upload_id: str) -> dict[int, Part]:
        """The uploaded parts by number."""
        return dict(self._listed(key, upload_id))

    def _listed(self, key: str, upload_id: str) -> Iterator[tuple[int, Part]]:
        pages = self._client.get_paginator("list_parts")
        for page in pages.paginate(Bucket=self._name, Key=key, UploadId=upload_id):
            for one in page.get("Parts", ()):
                sha256 = base64.b64decode(one["ChecksumSHA256"]).hex()
                yield int(one["PartNumber"]), Part(one["Size"], one["ETag"], sha256)

    def address(self, key: str, file: File) -> Address:
        """The address to upload a whole file: fixed content, size and key, usable once."""
        checksum = _base64(file.sha256)
        url = self._sign(
            "put_object",
            Key=key,
            ContentType=file.content_type,
            ContentLength=file.size,
            ChecksumSHA256=checksum,
            IfNoneMatch="*",
            Metadata=metadata(file),
        )
        headers = {
            "content-type": file.content_type,
            "content-length": str(file.size),
            "x-amz-checksum-sha256": checksum,
            "if-none-match": "*",
            **{f"x-amz-meta-{name}": value for name, value in metadata(file).items()},
        }
        return Address(1, url, headers)

    def part_address(self, key: str, file: File, upload_id: str, part: int, sha256: str) -> Address:
        """The address to upload one part: fixed content and size."""
        _, size = part_range(file, part)
        checksum = _base64(sha256)
        url = self._sign(
            "upload_part",
            Key=key,
            UploadId=upload_id,
            PartNumber=part,
            ContentLength=size,
            ChecksumSHA256=checksum,
        )
        return Address(part, url, {"content-length": str(size), "x-amz-checksum-sha256": checksum})

    def complete(self, key: str, upload_id: str, parts: Mapping[int, Part], size: int) -> None:
        """Join the parts to one object. If another call has just done so, this does nothing."""
        named: list[Any] = [
            {"PartNumber": n, "ETag": part.etag, "ChecksumSHA256": _base64(part.sha256)}
            for n, part in sorted(parts.items())
        ]
        try:
            self._client.complete_multipart_upload(
                Bucket=self._name,
                Key=key,
                UploadId=upload_id,
                MultipartUpload={"Parts": named},
                MpuObjectSize=size,
                IfNoneMatch="*",
            )
        except ClientError as error:
            ended = error.response["Error"]["Code"] in {"NoSuchUpload", "PreconditionFailed"}
            if not ended or not self.has(key):
                raise

    def abort(self, key: str, upload_id: str) -> None:
        """Delete the parts of an upload."""
        self._client.abort_multipart_upload(Bucket=self._name, Key=key, UploadId=upload_id)

    def _sign(self, operation: str, **parameters: Any) -> str:
        url: str = self._signer.generate_presigned_url(
            operation, Params={"Bucket": self._name, **parameters}, ExpiresIn=UPLOAD_URL_S
        )
        return url


def metadata(file: File) -> dict[str, str]:
    """An object's metadata; `iort files get` checks the SHA-256 of the whole."""
    return {"sha256": file.sha256, "kind": file.kind, "t": str(file.t_us)}


def parts_sha256(parts: Mapping[int, Part]) -> str:
    """The SHA-256 of the parts' SHA-256, in order."""
    return hashlib.sha256(b"".join(bytes.fromhex(parts[n].sha256) for n in sorted(parts))).hexdigest()


def _base64(sha256: str) -> str:
    return base64.b64encode(bytes.fromhex(sha256)).decode()
