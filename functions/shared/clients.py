"""AWS' clients, each made once an environment, when it is first needed: that takes a tenth of a second."""

from __future__ import annotations

import os
from functools import cache
from typing import TYPE_CHECKING

import boto3
from botocore.config import Config

if TYPE_CHECKING:
    from types_boto3_dynamodb import DynamoDBClient
    from types_boto3_iot_data import IoTDataPlaneClient
    from types_boto3_s3 import S3Client
    from types_boto3_sns import SNSClient
    from types_boto3_sqs import SQSClient


@cache
def dynamodb() -> DynamoDBClient:
    """A client for the tables."""
    return boto3.client("dynamodb")


@cache
def iot_data() -> IoTDataPlaneClient:
    """A client that publishes to robots."""
    return boto3.client("iot-data")


@cache
def sns() -> SNSClient:
    """A client that mails."""
    return boto3.client("sns")


@cache
def sqs(*, at_once: bool = False) -> SQSClient:
    """A client for the queues. One that answers ``at_once`` gives up quickly: if a function fails, Lambda
    sends the event to the queue itself."""
    quickly = Config(connect_timeout=2, read_timeout=5, retries={"total_max_attempts": 1})
    return boto3.client("sqs", config=quickly if at_once else None)


@cache
def s3() -> S3Client:
    """A client that signs addresses. Virtual addressing gives the region's own host: the global one
    redirects, which invalidates a signature."""
    config = Config(signature_version="s3v4", s3={"addressing_style": "virtual"})
    return boto3.client("s3", config=config)


@cache
def s3_for_robots() -> S3Client:
    """A client that signs addresses for robots. In a laboratory's own cloud they reach the files at another
    address than the functions do."""
    endpoint = os.environ.get("ROBOTS_S3_ENDPOINT")
    if endpoint is None:
        return s3()
    config = Config(signature_version="s3v4", s3={"addressing_style": "path"})
    return boto3.client("s3", config=config, endpoint_url=endpoint)
