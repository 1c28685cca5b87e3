"""Least privilege of the stacks' roles: each role's credentials try every table, queue, bucket, parameter,
function, log and topic. Undeclared access is denied.
"""

from __future__ import annotations

import fnmatch
import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import boto3
import botocore.loaders
import botocore.session
import pytest
from botocore.config import Config
from botocore.exceptions import ClientError

from iort_contract.cloud import pubnub_parameter
from iort_contract.webhook import webhook_parameter
from iort_station.fleet.roles import role_arn
from tests import isolation
from tests.stacks.roles import IOT, PUBLIC, SSM
from tests.stacks.roles import ROLES as OF_AWS
from tests.stacks.templates import name

ACCOUNT = "000000000000"
# The embedded cloud has everybody's identity, too.
ROLES = {**OF_AWS, "PublicRole": ("cognito-identity.amazonaws.com", PUBLIC)}
DENIED = {"AccessDenied", "AccessDeniedException", "ForbiddenException", "UnauthorizedOperation", "403"}
# What services say of a wrong signature.
FORGED = {"ForbiddenException", "InvalidSignatureException", "SignatureDoesNotMatch"}
SERVICES = ("dynamodb", "sqs", "s3", "ssm", "lambda", "logs", "iot-data", "iam", "sts", "iot")


class Resource(NamedTuple):
    """``arn`` is the declared name, ``physical`` the deployed name."""

    kind: str
    arn: str
    physical: str


@pytest.fixture(scope="module")
def deployed(embedded):
    """Return every resource of the stacks, as CloudFormation lists them."""
    found = []
    cloudformation = embedded.cloud.client("cloudformation")
    for page in cloudformation.get_paginator("describe_stacks").paginate():
        for stack in page["Stacks"]:
            noun = stack["StackName"].removeprefix("iort-")
            if noun == stack["StackName"]:
                continue  # the CDK's own
            pages = cloudformation.get_paginator("list_stack_resources")
            for resources in pages.paginate(StackName=stack["StackName"]):
                for one in resources["StackResourceSummaries"]:
                    logical = name(one["LogicalResourceId"])
                    if one["ResourceType"] == "AWS::IAM::Role" and noun == "ingest":
                        logical = f"ingest/{logical}"
                    found.append(Resource(one["ResourceType"], logical, one["PhysicalResourceId"]))
    return found


@pytest.fixture(scope="module")
def role_clients(embedded, deployed):
    """Return the clients of each role."""
    return {role.arn: as_role(embedded, role.physical) for role in of(deployed, "AWS::IAM::Role")}


def of(deployed: list[Resource], kind: str) -> list[Resource]:
    return [one for one in deployed if one.kind == kind]


# Share the service descriptions: each role would spend more time on reading them than on its calls.
_LOADER = botocore.loaders.create_loader()


def as_role(embedded: Any, role: str) -> dict[str, Any]:
    """Return clients with the role's credentials. The role trusts only its service, and
    tests/stacks/test_policies.py checks this; the operator may change the trust, and lets the
    account assume the role for a moment.
    """
    cloud = embedded.cloud
    iam = cloud.client("iam")
    described = iam.get_role(RoleName=role)["Role"]
    account = {"AWS": f"arn:aws:iam::{ACCOUNT}:root"}
    trust = [{"Effect": "Allow", "Action": "sts:AssumeRole", "Principal": account}]
    _trust(iam, role, {"Version": "2012-10-17", "Statement": trust})
    try:
        assumed = cloud.client("sts").assume_role(RoleArn=described["Arn"], RoleSessionName="test")
    finally:
        _trust(iam, role, described["AssumeRolePolicyDocument"])
    core = botocore.session.Session()
    core.register_component("data_loader", _LOADER)
    session = boto3.Session(
        botocore_session=core,
        aws_access_key_id=assumed["Credentials"]["AccessKeyId"],
        aws_secret_access_key=assumed["Credentials"]["SecretAccessKey"],
        aws_session_token=assumed["Credentials"]["SessionToken"],
        region_name=cloud.region,
    )
    config = Config(retries={"total_max_attempts": 1}, s3={"addressing_style": "path"})
    at = {"endpoint_url": cloud.endpoint_url, "verify": cloud.ca_bundle, "config": config}
    return {service: session.client(service, **at) for service in SERVICES}


def _trust(iam: Any, role: str, document: Any) -> None:
    iam.update_assume_role_policy(RoleName=role, PolicyDocument=json.dumps(document))


class Probe(NamedTuple):
    """One call: its action and declared ARN, the service, and the arguments."""

    action: str
    arn: str
    service: str
    call: str
    arguments: dict[str, Any]


def probes(deployed: list[Resource]) -> Iterator[Probe]:
    yield from _tables(deployed)
    for queue in of(deployed, "AWS::SQS::Queue"):
        at: dict[str, Any] = {"QueueUrl": queue.physical}
        each: dict[str, tuple[str, dict[str, Any]]] = {
            "SendMessage": ("send_message", {**at, "MessageBody": "x"}),
            "ReceiveMessage": ("receive_message", {**at, "VisibilityTimeout": 0}),
            "DeleteMessage": ("delete_message", {**at, "ReceiptHandle": "x"}),
            "PurgeQueue": ("purge_queue", at),
            "GetQueueAttributes": ("get_queue_attributes", {**at, "AttributeNames": ["All"]}),
        }
        for action in isolation.QUEUE_ACTIONS:
            yield Probe(f"sqs:{action}", f"{queue.arn}.Arn", "sqs", *each[action])
    for bucket in of(deployed, "AWS::S3::Bucket"):
        at = {"Bucket": bucket.physical}
        each = {"ListBucket": ("list_objects_v2", at), "DeleteBucket": ("delete_bucket", at)}
        for action in isolation.BUCKET_ACTIONS:
            yield Probe(f"s3:{action}", f"{bucket.arn}.Arn", "s3", *each[action])
        for action in isolation.OBJECT_ACTIONS:
            for key in isolation.OBJECTS:
                call = {"GetObject": "get_object", "PutObject": "put_object", "DeleteObject": "delete_object"}
                yield Probe(f"s3:{action}", f"{bucket.arn}.Arn/{key}", "s3", call[action], {**at, "Key": key})
    for name_ in (pubnub_parameter(), webhook_parameter()):
        parameter = {"Name": name_}
        each = {
            "GetParameter": ("get_parameter", parameter),
            "PutParameter": ("put_parameter", {**parameter, "Value": "x", "Overwrite": True}),
            "DeleteParameter": ("delete_parameter", parameter),
        }
        for action in isolation.PARAMETER_ACTIONS:
            yield Probe(f"ssm:{action}", f"{SSM}:parameter{name_}", "ssm", *each[action])
    for function in of(deployed, "AWS::Lambda::Function"):
        at = {"FunctionName": function.physical}
        each = {
            "InvokeFunction": ("invoke", at),
            "UpdateFunctionConfiguration": ("update_function_configuration", {**at, "Timeout": 3}),
        }
        for action in isolation.FUNCTION_ACTIONS:
            yield Probe(f"lambda:{action}", f"{function.arn}.Arn", "lambda", *each[action])
    for log in of(deployed, "AWS::Logs::LogGroup"):
        at = {"logGroupName": log.physical, "logStreamName": "isolation"}
        each = {
            "CreateLogStream": ("create_log_stream", at),
            "PutLogEvents": ("put_log_events", {**at, "logEvents": [{"timestamp": 1, "message": "x"}]}),
            "GetLogEvents": ("get_log_events", at),
        }
        for action in isolation.LOG_ACTIONS:
            yield Probe(f"logs:{action}", f"{log.arn}.Arn", "logs", *each[action])
    for topic in isolation.TOPICS:
        yield Probe("iot:Publish", f"{IOT}:topic/{topic}", "iot-data", "publish", {"topic": topic})
    for resource, shadow in isolation.SHADOWS.items():
        said: dict[str, Any] = {"thingName": isolation.A, "payload": b'{"state": {}}'}
        said |= {"shadowName": shadow} if shadow else {}
        yield Probe(
            "iot:UpdateThingShadow", f"{IOT}:thing/{resource}", "iot-data", "update_thing_shadow", said
        )
    # Requests to resources that no role uses.
    yield Probe("iam:ListRoles", "none", "iam", "list_roles", {})
    yield Probe("iot:ListCertificates", "none", "iot", "list_certificates", {})
    yield Probe(
        "iot:CreateKeysAndCertificate", "none", "iot", "create_keys_and_certificate", {"setAsActive": False}
    )
    for role in of(deployed, "AWS::IAM::Role"):
        arn = f"arn:aws:iam::{ACCOUNT}:role/{role.physical}"
        assume_role = {"RoleArn": arn, "RoleSessionName": "probe"}
        yield Probe("sts:AssumeRole", role.arn, "sts", "assume_role", assume_role)


def _tables(deployed: list[Resource]) -> Iterator[Probe]:
    for table in of(deployed, "AWS::DynamoDB::Table"):
        at: dict[str, Any] = {"TableName": table.physical}
        key: dict[str, Any] = {"robot": {"S": "none"}} if table.arn == "Robots" else {"topic": {"S": "none"}}
        sort = {"Batches": ("batch", "S"), "Summary": ("second", "N")}.get(table.arn)
        if sort:
            key[sort[0]] = {sort[1]: "0"}
        query = {"KeyConditionExpression": "#k = :k", "ExpressionAttributeValues": {":k": {"S": "none"}}}
        names = {"ExpressionAttributeNames": {"#k": next(iter(key))}}
        # Allowed calls may happen, to an item that does not exist.
        there = {"ConditionExpression": "attribute_exists(#k)", **names}
        each = {
            "GetItem": ("get_item", {**at, "Key": key}),
            "PutItem": ("put_item", {**at, "Item": key, **there}),
            "UpdateItem": ("update_item", {**at, "Key": key, "UpdateExpression": "REMOVE x", **there}),
            "DeleteItem": ("delete_item", {**at, "Key": key}),
            "Query": ("query", {**at, **query, **names}),
            "Scan": ("scan", {**at, "Limit": 1}),
            "BatchWriteItem": (
                "batch_write_item",
                {"RequestItems": {table.physical: [{"DeleteRequest": {"Key": key}}]}},
            ),
            "DeleteTable": ("delete_table", at),
        }
        for action in isolation.TABLE_ACTIONS:
            yield Probe(f"dynamodb:{action}", f"{table.arn}.Arn", "dynamodb", *each[action])


def declared(role: str, probe: Probe) -> bool:
    return any(
        probe.action == action and fnmatch.fnmatchcase(probe.arn, arn) for action, arn in ROLES[role][1]
    )


def refused(clients: dict[str, Any], probe: Probe) -> bool:
    try:
        getattr(clients[probe.service], probe.call)(**probe.arguments)
    except ClientError as error:
        code = error.response["Error"]["Code"]
        return code in DENIED
    return False


def test_every_role_is_declared(deployed):
    roles = {one.arn for one in of(deployed, "AWS::IAM::Role")}
    # The embedded cloud leaves out other roles, for example those of account-wide settings.
    assert roles <= ROLES.keys(), "declare the permissions of a new role in tests/stacks/roles.py"


def test_every_role_is_denied_undeclared_access(deployed, role_clients):
    asked = list(probes(deployed))
    through, tried = [], 0
    for role, clients in role_clients.items():
        for probe in asked:
            if declared(role, probe):
                continue
            tried += 1
            if not refused(clients, probe):
                through.append((role, probe.action, probe.arn))
    assert through == []
    assert tried > 1000


def test_declared_access_is_allowed(deployed, role_clients):
    """The same calls, only those without side effects, succeed where they are declared. This shows that a
    denial above has the right cause.
    """
    harmless = {
        "dynamodb:GetItem",
        "dynamodb:PutItem",
        "dynamodb:UpdateItem",
        "dynamodb:Query",
        "dynamodb:BatchWriteItem",
        "ssm:GetParameter",
        "s3:ListBucket",
        "iot:Publish",
        "iot:UpdateThingShadow",
        "sqs:GetQueueAttributes",
    }
    asked = [probe for probe in probes(deployed) if probe.action in harmless]
    wrong, tried = [], set()
    for role, clients in role_clients.items():
        for probe in asked:
            if declared(role, probe):
                tried.add(probe.action)
                if refused(clients, probe):
                    wrong.append((role, probe.action, probe.arn))
    assert wrong == []
    assert tried >= harmless


@pytest.mark.parametrize("key", ["test", ACCOUNT, "own"])
def test_nobody_is_the_owner_without_the_owners_secret(embedded, key):
    cloud = embedded.cloud
    assert cloud.client("dynamodb").list_tables()["TableNames"]
    forged = replace(
        cloud, access_key_id=cloud.access_key_id if key == "own" else key, secret_access_key="guess"
    )
    for ask in (
        lambda: forged.client("dynamodb").list_tables(),
        lambda: forged.client("s3").list_buckets(),
        lambda: forged.client("iot-data").publish(topic="cmd/iort/car1/drive", payload=b"{}"),
        lambda: forged.client("sts").assume_role(RoleArn=role_arn(cloud, "driver"), RoleSessionName="forged"),
    ):
        with pytest.raises(ClientError) as refused:
            ask()
        assert refused.value.response["ResponseMetadata"]["HTTPStatusCode"] in {400, 403}
        assert refused.value.response["Error"]["Code"] in FORGED
