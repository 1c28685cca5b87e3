"""`iort site` uploads the page and its configuration."""

from __future__ import annotations

import json

import boto3
import pytest
from moto import mock_aws

from iort_station.errors import StationError
from iort_station.page.page import config, site_files, upload

TOLD = config(namespace="iort", subscribe_key="sub-c-1", token="abc_DEF-1=")


@pytest.fixture
def built(tmp_path):
    (tmp_path / "index.html").write_text("<!doctype html>")
    (tmp_path / "page.js").write_text("1")
    (tmp_path / "secret.pem").write_text("a key")
    return tmp_path


def test_only_the_build_and_the_configuration_are_uploaded(built):
    content = site_files(TOLD, built)
    assert content.keys() == {"index.html", "page.js", "config.json"}
    told = json.loads(content["config.json"])
    assert told["answers"] is False
    assert told["token"] == "abc_DEF-1="
    assert not any(b"pub-c-" in body or b"sec-c-" in body for body in content.values())


def test_a_page_without_a_build_is_an_error(tmp_path):
    with pytest.raises(StationError, match="not built"):
        site_files(TOLD, tmp_path)


@mock_aws
def test_the_bucket_holds_exactly_the_uploaded_files(built):
    s3 = boto3.client("s3", region_name="us-east-1", aws_access_key_id="x", aws_secret_access_key="x")
    s3.create_bucket(Bucket="page")
    s3.put_object(Bucket="page", Key="old.js", Body=b"old")
    content = site_files(TOLD, built)
    assert upload(s3, "page", content) == ["old.js"]
    assert upload(s3, "page", content) == []
    held = {entry["Key"] for entry in s3.list_objects_v2(Bucket="page")["Contents"]}
    assert held == content.keys()
    page = s3.get_object(Bucket="page", Key="page.js")
    assert page["ContentType"].startswith("text/javascript")
    assert page["CacheControl"] == "no-cache"
    assert page["Body"].read() == b"1"
