"""JSON and other content in the files' bucket, by key."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from botocore.exceptions import ClientError

if TYPE_CHECKING:
    from types_boto3_s3 import S3Client


class Kept:
    """Objects of the files' bucket."""

    def __init__(self, client: S3Client, bucket: str) -> None:
        self._client, self._bucket = client, bucket

    def put(self, key: str, content: bytes, content_type: str) -> None:
        """Write an object; an earlier one is replaced."""
        self._client.put_object(Bucket=self._bucket, Key=key, Body=content, ContentType=content_type)

    def put_json(self, key: str, content: Any) -> None:
        """Write an object of JSON."""
        text = json.dumps(content, separators=(",", ":"), allow_nan=False)
        self.put(key, text.encode(), "application/json")

    def remove(self, prefix: str) -> None:
        """Remove all objects whose keys begin so."""
        for page in self._client.get_paginator("list_objects_v2").paginate(
            Bucket=self._bucket, Prefix=prefix
        ):
            for found in page.get("Contents", ()):
                self._client.delete_object(Bucket=self._bucket, Key=found["Key"])

    def json(self, key: str) -> Any:
        """Read an object of JSON; None if there is none."""
        try:
            answer = self._client.get_object(Bucket=self._bucket, Key=key)
        except ClientError as error:
            if error.response["Error"]["Code"] in {"NoSuchKey", "404"}:
                return None
            raise
        return json.loads(answer["Body"].read())
