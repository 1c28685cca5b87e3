"""Publishes the page on the web: uploads its files to the site's bucket, and renews CloudFront's copies."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from botocore.exceptions import ClientError

from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.page.page import BUILT, TYPES, built_files

if TYPE_CHECKING:
    from types_boto3_s3 import S3Client
    from types_boto3_s3.type_defs import ObjectIdentifierTypeDef

# Names do not change with their content, so a browser must ask each time if a file is still the same.
_CACHE = "no-cache"
_MANY = 1_000


def files(told: Mapping[str, Any], built: Path = BUILT) -> dict[str, bytes]:
    """Every file of the static page by its key; ``told`` is `iort_station.page.page.config`'s.

    Raises `StationError` if the page is not built.
    """
    tables = {"config.json": told}
    return built_files(built) | {
        name: json.dumps(value, allow_nan=False).encode() for name, value in tables.items()
    }


def upload(s3: S3Client, bucket: str, content: Mapping[str, bytes]) -> list[str]:
    """Make the bucket hold exactly ``content``; returns the other keys, which are deleted.

    The page itself comes last, after the files that it needs.
    """
    for key in sorted(content, key=lambda key: key == "index.html"):
        kind = TYPES[Path(key).suffix]
        s3.put_object(Bucket=bucket, Key=key, Body=content[key], ContentType=kind, CacheControl=_CACHE)
    pages = s3.get_paginator("list_objects_v2").paginate(Bucket=bucket)
    old = [
        entry["Key"] for page in pages for entry in page.get("Contents", []) if entry["Key"] not in content
    ]
    for at in range(0, len(old), _MANY):
        gone: list[ObjectIdentifierTypeDef] = [{"Key": key} for key in old[at : at + _MANY]]
        s3.delete_objects(Bucket=bucket, Delete={"Objects": gone, "Quiet": True})
    return old


def publish(cloud: Cloud, told: Mapping[str, Any]) -> str:
    """Upload the page, renew CloudFront's copies, and return the page's address.

    Raises `StationError` if the stack is not deployed.
    """
    content = files(told)
    bucket, distribution = cloud.output("site", "PageBucket"), cloud.output("site", "PageDistribution")
    try:
        upload(cloud.client("s3"), bucket, content)
        cloud.client("cloudfront").create_invalidation(
            DistributionId=distribution,
            InvalidationBatch={
                "Paths": {"Quantity": 1, "Items": ["/*"]},
                "CallerReference": str(time.time_ns()),
            },
        )
    except ClientError as error:
        raise StationError(f"the page could not be uploaded: {error}") from error
    return cloud.output("site", "PageUrl")
