"""The operator's webhook: what is stored, shown and refused."""

from __future__ import annotations

import json
from types import SimpleNamespace

import boto3
import pytest

from iort_contract.webhook import stored_webhook, webhook_parameter
from iort_station.errors import StationError, UsageError
from iort_station.operations.webhook import remove, store, stored

URL = "https://lab.example.org/incidents"


@pytest.fixture
def cloud(aws):
    """A deployment on AWS, with moto's Parameter Store."""
    return SimpleNamespace(namespace="iort", endpoint_url=None, client=boto3.client)


def test_each_webhook_has_a_new_secret_that_is_stored_encrypted(cloud):
    assert stored(cloud) is None
    first, second = store(cloud, URL), store(cloud, URL)
    assert first.secret != second.secret
    assert len(second.secret) >= 43, "32 random bytes"
    assert stored(cloud) == second
    answer = boto3.client("ssm").get_parameter(Name=webhook_parameter(), WithDecryption=True)["Parameter"]
    assert answer["Type"] == "SecureString"
    assert stored_webhook(answer["Value"]) == second
    assert remove(cloud)
    assert not remove(cloud)
    assert stored(cloud) is None


def test_http_is_taken_by_the_embedded_cloud_alone_and_there_for_this_machine_alone(cloud):
    for bad in ("http://127.0.0.1:8000/", "http://lab.example.org/", "lab.example.org"):
        with pytest.raises(UsageError, match="https://"):
            store(cloud, bad)
    assert stored(cloud) is None
    cloud.endpoint_url = "https://127.0.0.1:4566"
    assert store(cloud, "http://127.0.0.1:8000/").url == "http://127.0.0.1:8000/"
    with pytest.raises(UsageError, match="https://"):
        store(cloud, "http://lab.example.org/")


def test_another_parameter_is_an_error_without_its_content(cloud):
    boto3.client("ssm").put_parameter(
        Name=webhook_parameter(), Value=json.dumps({"secret": "s3cret"}), Type="SecureString"
    )
    with pytest.raises(StationError) as failed:
        stored(cloud)
    assert "s3cret" not in str(failed.value)
