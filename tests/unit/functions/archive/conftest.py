"""An empty deployment for the archive's function."""

from __future__ import annotations

import boto3
import pytest

from iort_contract.catalog.environments import ArchiveEnvironment
from testkit.dynamodb import FILES, ROBOTS, TELEMETRY
from tests.unit.functions.archive.archiving import RETENTION_S, Cloud


@pytest.fixture
def cloud(dynamodb, s3, monkeypatch):
    """An empty deployment."""
    url = boto3.client("sqs").create_queue(QueueName="tasks")["QueueUrl"]
    given = ArchiveEnvironment("iort", TELEMETRY, "archive", ROBOTS, FILES, url, RETENTION_S)
    for name, value in given.variables().items():
        monkeypatch.setenv(name, value)
    return Cloud(dynamodb, s3)
