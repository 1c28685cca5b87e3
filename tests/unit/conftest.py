"""Unit tests touch no network: a socket is an error.

What the cloud's tests need is imported by their fixtures: the robot's run on the oldest Python, where
neither boto3 nor moto is installed.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from functools import lru_cache
from types import ModuleType

import pytest
from pytest_socket import disable_socket, enable_socket


@pytest.fixture(autouse=True)
def no_network():
    # A pair of Unix sockets is how asyncio wakes itself, and reaches nobody.
    disable_socket(allow_unix_socket=True)
    yield
    enable_socket()


@lru_cache
def kept_by(module: ModuleType) -> list[Callable[[], None]]:
    """What clears the caches of a function's module."""
    return [value.cache_clear for value in vars(module).values() if hasattr(value, "cache_clear")]


@pytest.fixture(autouse=True)
def new_environment():
    """Every test is a new environment of the functions: they have read no variable and made no client."""
    yield
    for name, module in list(sys.modules.items()):
        if name.startswith("functions."):
            for clear in kept_by(module):
                clear()


@pytest.fixture(autouse=True)
def deployment(monkeypatch):
    """What every function's environment says, and its metrics are counted under."""
    monkeypatch.setenv("NAMESPACE", "iort")


@pytest.fixture
def aws(monkeypatch):
    """AWS in this process, with nothing in it; the machine's own settings and keys are out of reach."""
    from moto import mock_aws

    for name in [name for name in os.environ if name.startswith("AWS_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_DEFAULT_REGION", "eu-west-1")
    with mock_aws():
        yield


@pytest.fixture(scope="session")
def tables():
    """The properties of the storage stack's tables, by logical id.

    One stack is synthesized, not the app, and only if its sources have changed since the last time.
    """
    from local.deployment import ROOT, sources
    from local.emulator.package import artifact

    def synthesize(folder):
        from aws_cdk import App, assertions

        from stacks.settings import Settings
        from stacks.storage import Storage

        template = assertions.Template.from_stack(Storage(App(), Settings()))
        folder.mkdir()
        (folder / "tables.json").write_text(json.dumps(template.find_resources("AWS::DynamoDB::Table")))

    found = json.loads(
        (artifact(ROOT / "build" / "tables", "tables", sources(ROOT), synthesize) / "tables.json").read_text()
    )
    return {logical: resource["Properties"] for logical, resource in found.items()}


@pytest.fixture
def dynamodb(aws, tables):
    """moto's DynamoDB with the tables as the template declares them."""
    import boto3

    from testkit.dynamodb import NAMES, QUARANTINE

    client = boto3.client("dynamodb")
    nouns = {**NAMES, QUARANTINE: QUARANTINE, "batches": NAMES["telemetry"]}
    for logical, properties in tables.items():
        client.create_table(
            TableName=next(
                (name for noun, name in nouns.items() if logical.lower().startswith(noun)),
                logical[:-8].lower(),  # without the CDK's hash
            ),
            KeySchema=properties["KeySchema"],
            AttributeDefinitions=properties["AttributeDefinitions"],
            BillingMode=properties["BillingMode"],
        )
    return client


@pytest.fixture
def s3(aws):
    """moto's S3 with the files' bucket; its addresses are the region's own, as the functions sign them."""
    import boto3
    from botocore.config import Config

    from testkit.dynamodb import FILES

    client = boto3.client("s3", config=Config(signature_version="s3v4", s3={"addressing_style": "virtual"}))
    client.create_bucket(Bucket=FILES, CreateBucketConfiguration={"LocationConstraint": "eu-west-1"})
    return client


@pytest.fixture
def stream():
    """An empty telemetry table and the stream that Lambda 2 reads."""
    from tests.unit.functions.summarizing import Stream

    return Stream()
