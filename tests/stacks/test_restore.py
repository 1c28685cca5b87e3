"""The commands of docs/how-to/restore.md bring back what was deleted and what was replaced."""

from __future__ import annotations

import re
import shlex
from typing import Any

import boto3
import pytest
from moto import mock_aws

from iort_contract.archive import ARCHIVE_PREFIX
from stacks.settings import ROOT

PAGE = (ROOT / "docs/how-to/restore.md").read_text()
KEY = f"{ARCHIVE_PREFIX}robot=car7/hour.parquet"
BUCKET = "files"


@pytest.fixture
def s3(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    with mock_aws():
        client = boto3.client("s3", region_name="us-east-1")
        client.create_bucket(Bucket=BUCKET)
        client.put_bucket_versioning(Bucket=BUCKET, VersioningConfiguration={"Status": "Enabled"})
        client.put_object(Bucket=BUCKET, Key=KEY, Body=b"an hour")
        yield client


def documented(client: Any, command: str, **values: str) -> Any:
    """Run the page's command of this name, with these words in it replaced."""
    (line,) = re.findall(rf"^aws s3api {command} (.+)$", PAGE, re.MULTILINE)
    for word, value in {"$BUCKET": BUCKET, **values}.items():
        line = line.replace(word, value)
    words = shlex.split(line)
    names = ["".join(part.capitalize() for part in one[2:].split("-")) for one in words[::2]]
    return getattr(client, command.replace("-", "_"))(**dict(zip(names, words[1::2], strict=True)))


def content(client: Any) -> bytes:
    return bytes(client.get_object(Bucket=BUCKET, Key=KEY)["Body"].read())


def test_a_deleted_object_is_restored_without_its_marker(s3):
    s3.delete_object(Bucket=BUCKET, Key=KEY)
    with pytest.raises(s3.exceptions.NoSuchKey):
        content(s3)
    (marker,) = documented(s3, "list-object-versions")["DeleteMarkers"]
    documented(s3, "delete-object", KEY=marker["Key"], MARKER=marker["VersionId"])
    assert content(s3) == b"an hour"


def test_a_replaced_object_is_restored_from_the_version_before(s3):
    s3.put_object(Bucket=BUCKET, Key=KEY, Body=b"")
    (before,) = [one for one in documented(s3, "list-object-versions")["Versions"] if not one["IsLatest"]]
    documented(s3, "copy-object", KEY=KEY, VERSION=before["VersionId"])
    assert content(s3) == b"an hour"
