"""What an environment of a function has: its variables, AWS' clients, and the topic of mails.

A client is made once, when it is first needed: that takes a tenth of a second.
"""

from __future__ import annotations

import os
from functools import cache
from typing import TYPE_CHECKING, Any

import botocore.session
from botocore.config import Config
from botocore.credentials import Credentials

from iort_contract.catalog.environments import E

if TYPE_CHECKING:
    import boto3
    from types_boto3_dynamodb import DynamoDBClient
    from types_boto3_iot_data import IoTDataPlaneClient
    from types_boto3_s3 import S3Client
    from types_boto3_sns import SNSClient
    from types_boto3_sqs import SQSClient

    # Its overloads know each service's own type.
    connect = boto3.client
else:

    def connect(service: str, **options: Any) -> Any:
        """Make a client. boto3 would add S3 transfers, a fifth of the time until the first answer."""
        return _session().create_client(service, **options)


@cache
def _session() -> botocore.session.Session:
    return botocore.session.get_session()


def credentials() -> Credentials:
    """The function's own credentials."""
    given: Credentials | None = _session().get_credentials()
    assert given is not None
    return given


def authorities() -> str | None:
    """The file of the authorities that botocore trusts, too; None for the system's."""
    return os.environ.get("AWS_CA_BUNDLE")


@cache
def dynamodb() -> DynamoDBClient:
    """A client for the tables."""
    return connect("dynamodb")


@cache
def iot_data() -> IoTDataPlaneClient:
    """A client that publishes to robots."""
    return connect("iot-data")


@cache
def sns() -> SNSClient:
    """A client that mails."""
    return connect("sns")


@cache
def sqs(*, at_once: bool = False) -> SQSClient:
    """A client for the queues. One that answers ``at_once`` gives up quickly: if a function fails, Lambda
    sends the event to the queue itself."""
    quickly = Config(connect_timeout=2, read_timeout=5, retries={"total_max_attempts": 1})
    return connect("sqs", config=quickly if at_once else None)


@cache
def s3() -> S3Client:
    """A client that signs addresses. Virtual addressing gives the region's own host: the global one
    redirects, which invalidates a signature."""
    config = Config(signature_version="s3v4", s3={"addressing_style": "virtual"})
    return connect("s3", config=config)


@cache
def s3_for_robots() -> S3Client:
    """A client that signs addresses for robots. In a laboratory's own cloud they reach the files at another
    address than the functions do."""
    endpoint = os.environ.get("ROBOTS_S3_ENDPOINT")
    if endpoint is None:
        return s3()
    config = Config(signature_version="s3v4", s3={"addressing_style": "path"})
    return connect("s3", config=config, endpoint_url=endpoint)


@cache
def variables(kind: type[E]) -> E:
    """The variables of a function, read once, by the class with which the stacks write them."""
    return kind.read(os.environ)


# "Publish", SNS API: "UTF-8 text with no line breaks or control characters, and less than 100 characters".
SUBJECT_CHARACTERS = 99


def subject_line(text: str) -> str:
    """The text as a subject that SNS takes; its end is left out where it is too long."""
    line = "".join(one if one.isprintable() else " " for one in text)
    return line if len(line) <= SUBJECT_CHARACTERS else f"{line[: SUBJECT_CHARACTERS - 3]}..."


def send(topic: str, subject: str, text: str) -> None:
    """Publish to the topic of that ARN."""
    sns().publish(TopicArn=topic, Subject=subject_line(subject), Message=text)
