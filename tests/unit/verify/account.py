"""A fake AWS account for the preflight: botocore's own clients, with answers by operation."""

from __future__ import annotations

from types import SimpleNamespace

import boto3
from botocore.config import Config

from stacks.settings import Settings


class Refused(Exception):
    """An error as an answer: AWS' code, text and status."""

    def __init__(self, code, text="no", status=400):
        super().__init__(code)
        self.parsed = {
            "Error": {"Code": code, "Message": text},
            "ResponseMetadata": {"HTTPStatusCode": status},
        }
        self.status = status


def denied(action):
    text = f"User: arn:aws:iam::123456789012:user/a is not authorized to perform: {action} on resource: *"
    return Refused("AccessDeniedException", text, 403)


def absent(**_asked):
    return Refused("ResourceNotFoundException", "not there", 404)


def no_stack(**asked):
    return Refused("ValidationError", f"Stack with id {asked['StackName']} does not exist")


def limits(total=1000, unreserved=1000):
    return {"AccountLimit": {"ConcurrentExecutions": total, "UnreservedConcurrentExecutions": unreserved}}


def quota(name, value):
    return {"QuotaName": name, "Value": float(value)}


QUOTAS = [
    quota("Maximum concurrent client connections per account", 500_000),
    quota("Connect requests per second per account", 500),
    quota("Inbound publish requests per second per account", 20_000),
    quota("Rule evaluations per second per AWS account", 20_000),
    quota("Maximum number of rules per AWS account", 1000),
]
# The answers of a new, bootstrapped account.
NEW = {
    "GetCallerIdentity": {
        "Account": "123456789012",
        "Arn": "arn:aws:iam::123456789012:user/a",
        "UserId": "a",
    },
    "GetParameter": lambda **asked: (
        {"Parameter": {"Value": "21"}} if asked["Name"].startswith("/cdk") else Refused("ParameterNotFound")
    ),
    "GetV2LoggingOptions": Refused("NotConfiguredException", "not configured", 404),
    "DescribeAccountAuditConfiguration": {
        "auditCheckConfigurations": {"LOGGING_DISABLED_CHECK": {"enabled": False}}
    },
    "GetAccountSettings": limits(),
    "ListServiceQuotas": {"Quotas": []},
    "ListAWSDefaultServiceQuotas": {"Quotas": QUOTAS},
    "ListTopicRules": {"rules": []},
    "DescribeType": {"TypeName": "AWS::KinesisVideo::SignalingChannel", "Visibility": "PUBLIC"},
    "DescribeStacks": no_stack,
    "ListStackResources": no_stack,
    "DescribeThingType": absent,
    "DescribeThingGroup": absent,
    "GetPolicy": absent,
    "DescribeProvisioningTemplate": absent,
    "ListPolicyVersions": absent,
    "ListDashboards": {"DashboardEntries": []},
    "ListExports": {"Exports": []},
    "ListImports": lambda **asked: Refused(
        "ValidationError", f"Export '{asked['ExportName']}' is not imported by any stack."
    ),
}


class Account:
    """botocore's own clients, which validate each request, with answers by operation."""

    def __init__(self, **answers):
        self.answers = {**NEW, **answers}
        self.asked = []

    def client(self, service):
        client = boto3.client(
            service,
            region_name="eu-west-1",
            aws_access_key_id="a",
            aws_secret_access_key="b",
            config=Config(retries={"total_max_attempts": 1}),
        )
        client.meta.events.register("provide-client-params", self._ask)
        client.meta.events.register("before-call", self._answer)
        return client

    def _ask(self, params, model, **_):
        self.given = params
        self.asked.append(model.name)

    def _answer(self, model, **_):
        answer = self.answers[model.name]
        if callable(answer):
            answer = answer(**self.given)
        if isinstance(answer, Refused):
            return SimpleNamespace(status_code=answer.status), answer.parsed
        return SimpleNamespace(status_code=200), answer


def settings(**given):
    return Settings(**given)


def stack_answers(states, *, tags=(), resources=None, outputs=None):
    """DescribeStacks and ListStackResources of these stacks, by noun; all have the same ``outputs``."""
    told = [{"OutputKey": key, "OutputValue": value} for key, value in (outputs or {}).items()]

    def describe(**asked):
        noun = asked["StackName"].removeprefix("iort-")
        if noun not in states:
            return no_stack(**asked)
        given = [{"Key": key, "Value": value} for key, value in tags]
        found = {"StackName": asked["StackName"], "StackStatus": states[noun], "Tags": given}
        return {"Stacks": [{**found, "Outputs": told}]}

    def listed(**asked):
        noun = asked["StackName"].removeprefix("iort-")
        if noun not in states:
            return no_stack(**asked)
        found = [
            {
                "ResourceType": kind,
                "LogicalResourceId": logical,
                "PhysicalResourceId": physical,
                "ResourceStatus": "CREATE_COMPLETE",
            }
            for kind, logical, physical in (resources or {}).get(noun, [])
        ]
        return {"StackResourceSummaries": found}

    return {"DescribeStacks": describe, "ListStackResources": listed}
