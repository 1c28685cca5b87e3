"""The preflight: every verdict of every item, with a fake account that answers like AWS."""

from __future__ import annotations

import json
import sys
from types import SimpleNamespace

import boto3
import pytest
from botocore.config import Config
from botocore.exceptions import NoCredentialsError

from iort_station.cli.console import Console
from iort_station.errors import StationError
from stacks.settings import Settings, SettingsError
from verify.preflight import account, deployed
from verify.preflight import command as preflight
from verify.preflight.finding import Verdict

FINE, WARNING, STOPS = Verdict.FINE, Verdict.WARNING, Verdict.STOPS
ROLE = "arn:aws:iam::123456789012:role/somebody"


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
    "GetParameter": {"Parameter": {"Value": "21"}},
    "GetV2LoggingOptions": Refused("NotConfiguredException", "not configured", 404),
    "DescribeAccountAuditConfiguration": {
        "auditCheckConfigurations": {"LOGGING_DISABLED_CHECK": {"enabled": False}}
    },
    "GetAccountSettings": limits(),
    "ListDistributions": {"DistributionList": {"Quantity": 0}},
    "ListServiceQuotas": {"Quotas": []},
    "ListAWSDefaultServiceQuotas": {"Quotas": QUOTAS},
    "ListTopicRules": {"rules": []},
    "DescribeStacks": no_stack,
    "ListStackResources": no_stack,
    "DescribeThingType": absent,
    "DescribeThingGroup": absent,
    "GetPolicy": absent,
    "DescribeProvisioningTemplate": absent,
    "ListDashboards": {"DashboardEntries": []},
    "ListTables": {"TableNames": []},
    "ListBuckets": {"Buckets": []},
    "ListQueues": {},
    "DescribeLogGroups": {"logGroups": []},
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


def stack_answers(states, *, tags=(), resources=None):
    """DescribeStacks and ListStackResources of these stacks, by noun."""

    def describe(**asked):
        noun = asked["StackName"].removeprefix("iort-")
        if noun not in states:
            return no_stack(**asked)
        given = [{"Key": key, "Value": value} for key, value in tags]
        return {"Stacks": [{"StackName": asked["StackName"], "StackStatus": states[noun], "Tags": given}]}

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


ALL = dict.fromkeys(deployed.STACKS, "UPDATE_COMPLETE")
LIVE = ("AWS::Lambda::Function", "Live848578DF", "iort-processing-Live")
LOG = {"roleArn": ROLE, "defaultLogLevel": "ERROR", "disableAllLogs": False}
KEY = "iort-storage:ExportsOutputFnGetAttKey961B73FDArn5A860C43"
OLD = "iort-storage:ExportsOutputRefTelemetryE3B0C442ABCDEF01"


def exported(name, *importers):
    answers = {"ListExports": {"Exports": [{"Name": name}, {"Name": "another-storage:ExportsOutputRefKey"}]}}
    return {**answers, **({"ListImports": {"Imports": list(importers)}} if importers else {})}


CASES = [
    ("bootstrap", {}, {}, FINE, "version 21, needed is 6"),
    ("bootstrap", {}, {"GetParameter": Refused("ParameterNotFound")}, STOPS, "not bootstrapped"),
    (
        "bootstrap",
        {},
        {"GetParameter": {"Parameter": {"Value": "5"}}},
        STOPS,
        "version must be 6 or newer, got 5",
    ),
    ("iot_log", {}, {}, FINE, "not configured; iot_log_level is off"),
    ("iot_log", {"iot_log_level": "error"}, {}, FINE, "not configured; iot_log_level is error"),
    ("iot_log", {}, {"GetV2LoggingOptions": LOG}, FINE, "configured (ERROR); iot_log_level is off"),
    ("iot_log", {"iot_log_level": "error"}, {"GetV2LoggingOptions": LOG}, STOPS, "already exists"),
    (
        "iot_log",
        {"iot_log_level": "error"},
        {"GetV2LoggingOptions": {**LOG, "disableAllLogs": True}},
        FINE,
        "not configured",
    ),
    (
        "iot_log",
        {"iot_log_level": "error"},
        {"GetV2LoggingOptions": LOG}
        | stack_answers(ALL, resources={"account": [("AWS::IoT::Logging", "Log", "123456789012")]}),
        FINE,
        "by this deployment",
    ),
    ("audit", {"device_defender": True}, {}, FINE, "not configured; wanted"),
    ("audit", {}, {"DescribeAccountAuditConfiguration": {"roleArn": ROLE}}, FINE, "configured; not wanted"),
    (
        "audit",
        {"device_defender": True},
        {"DescribeAccountAuditConfiguration": {"roleArn": ROLE}},
        STOPS,
        "already exists",
    ),
    (
        "audit",
        {"device_defender": True},
        {"DescribeAccountAuditConfiguration": {"roleArn": ROLE}}
        | stack_answers(ALL, resources={"account": [("AWS::IoT::AccountAuditConfiguration", "Audit", "1")]}),
        FINE,
        "by this deployment",
    ),
    ("concurrency", {}, {}, FINE, "0 are to be reserved"),
    ("concurrency", {}, {"GetAccountSettings": limits(10, 10)}, WARNING, "10 concurrent executions"),
    (
        "concurrency",
        {"stage": "prod"},
        {"GetAccountSettings": limits(105, 105)},
        FINE,
        "5 are to be reserved",
    ),
    (
        "concurrency",
        {"stage": "prod"},
        {"GetAccountSettings": limits(104, 104)},
        STOPS,
        "requires 100 unreserved",
    ),
    (
        "concurrency",
        {"stage": "prod"},
        {
            "GetAccountSettings": limits(105, 100),
            "GetFunctionConcurrency": {"ReservedConcurrentExecutions": 5},
        }
        | stack_answers(ALL, resources={"processing": [LIVE]}),
        FINE,
        "100 of them unreserved",
    ),
    ("cloudfront", {}, {"ListDistributions": denied("cloudfront:ListDistributions")}, FINE, "not wanted"),
    ("cloudfront", {"site": True}, {}, WARNING, "cannot be read"),
    (
        "cloudfront",
        {"site": True},
        stack_answers(ALL, resources={"site": [("AWS::S3::Bucket", "Page", "iort-site-page")]}),
        FINE,
        "deployed",
    ),
    ("quotas", {}, {}, FINE, "first limit: "),
    (
        "quotas",
        {},
        {"ListServiceQuotas": {"Quotas": [quota("Inbound publish requests per second per account", 500)]}},
        WARNING,
        "Inbound publish requests per second per account, 500",
    ),
    (
        "quotas",
        {},
        {"ListAWSDefaultServiceQuotas": {"Quotas": QUOTAS[:1]}},
        FINE,
        "unknown: Connect requests",
    ),
    ("quotas", {}, {"ListAWSDefaultServiceQuotas": {"Quotas": []}}, WARNING, "none of the quotas"),
    (
        "quotas",
        {},
        {"ListTopicRules": {"rules": [{"ruleName": f"other{n}"} for n in range(992)]}},
        STOPS,
        "992 rules of others and 10 of ours exceed the limit 1000",
    ),
    (
        "quotas",
        {},
        {"ListTopicRules": {"rules": [{"ruleName": f"iort_{n}"} for n in ("live", "record")]}},
        FINE,
        "robots",
    ),
    ("stacks", {}, {}, FINE, "none: a first one"),
    ("stacks", {}, stack_answers(ALL), FINE, "10 of 10"),
    *(
        ("stacks", {}, stack_answers({**ALL, "fleet": state}), STOPS, f"iort-fleet is {state}")
        for state in (
            "ROLLBACK_COMPLETE",
            "ROLLBACK_FAILED",
            "CREATE_FAILED",
            "DELETE_FAILED",
            "REVIEW_IN_PROGRESS",
            "UPDATE_ROLLBACK_FAILED",
            "UPDATE_IN_PROGRESS",
        )
    ),
    ("stacks", {}, stack_answers({"storage": "UPDATE_ROLLBACK_COMPLETE"}), FINE, "1 of 10"),
    ("names", {}, {}, FINE, "free"),
    ("names", {}, {"GetPolicy": {"policyName": "a"}}, STOPS, "policy iort-robot, policy iort-claim"),
    ("names", {}, {"DescribeThingType": {"thingTypeName": "a"}}, STOPS, "thing type iort-robot"),
    ("names", {}, {"ListTopicRules": {"rules": [{"ruleName": "iort_live"}]}}, STOPS, "rule iort_live"),
    (
        "names",
        {},
        {
            "ListDashboards": {
                "DashboardEntries": [{"DashboardName": "iort-platform"}, {"DashboardName": "iort-x"}]
            }
        },
        STOPS,
        "without their stack: dashboard iort-platform",
    ),
    ("names", {}, {"GetPolicy": {"policyName": "a"}} | stack_answers(ALL), FINE, "used by this deployment"),
    ("kept", {}, {}, FINE, "no leftovers"),
    (
        "kept",
        {},
        {
            "ListTables": {"TableNames": ["iort-storage-Batches-A", "another-storage-Batches"]},
            "ListBuckets": {"Buckets": [{"Name": "iort-storage-files-a"}]},
            "ListQueues": {"QueueUrls": ["https://sqs.eu-west-1.amazonaws.com/1/iort-quarantine-Last-A"]},
            "DescribeLogGroups": {"logGroups": [{"logGroupName": "iort-fleet-AdmitLog-A"}]},
        },
        WARNING,
        "iort-fleet-AdmitLog-A, iort-quarantine-Last-A, iort-storage-Batches-A, iort-storage-files-a",
    ),
    (
        "kept",
        {},
        {
            "ListTables": {"TableNames": ["iort-storage-Batches-A"]},
            "ListQueues": {"QueueUrls": ["https://sqs.eu-west-1.amazonaws.com/1/iort-quarantine-Last-A"]},
        }
        | stack_answers(
            ALL,
            resources={
                "storage": [("AWS::DynamoDB::Table", "Batches", "iort-storage-Batches-A")],
                "quarantine": [
                    ("AWS::SQS::Queue", "L", "https://sqs.eu-west-1.amazonaws.com/1/iort-quarantine-Last-A")
                ],
            },
        ),
        FINE,
        "no leftovers",
    ),
    ("changes", {}, {}, FINE, "nothing is deployed"),
    ("changes", {"site": True, "device_defender": True}, stack_answers(ALL), FINE, "none that must not be"),
    (
        "changes",
        {},
        stack_answers(ALL) | exported(KEY, "iort-fleet", "iort-ingest"),
        STOPS,
        "iort-fleet, iort-ingest import the key",
    ),
    ("changes", {}, stack_answers({"storage": "UPDATE_COMPLETE"}) | exported(KEY), FINE, "none that must"),
    *(
        (
            "changes",
            {key: True},
            stack_answers({"storage": "UPDATE_COMPLETE"}) | exported(KEY, "iort-fleet"),
            FINE,
            "none that must",
        )
        for key in ("customer_key", "keep_customer_key")
    ),
    (
        "changes",
        {},
        stack_answers(ALL) | exported(OLD, "iort-processing"),
        STOPS,
        "iort-processing imports it",
    ),
    (
        "changes",
        {"old_telemetry": True},
        stack_answers({"storage": "UPDATE_COMPLETE"}) | exported(OLD, "iort-processing"),
        FINE,
        "none that must",
    ),
    (
        "changes",
        {},
        stack_answers({"storage": "UPDATE_COMPLETE"}, tags=[("stage", "prod")]),
        WARNING,
        "protected",
    ),
    (
        "changes",
        {"stage": "prod"},
        stack_answers({"storage": "UPDATE_COMPLETE"}, tags=[("stage", "prod")]),
        FINE,
        "none that must",
    ),
    ("changes", {}, stack_answers(ALL), WARNING, "iort-site, iort-account (stays as it is)"),
]


def function(name):
    return getattr(account, name, None) or getattr(deployed, name)


@pytest.mark.parametrize(("name", "given", "answers", "verdict", "text"), CASES)
def test_an_item_reports_its_finding(name, given, answers, verdict, text):
    finding = function(name)(Account(**answers), settings(**given))
    assert (finding.verdict, text in finding.found) == (verdict, True), finding
    assert bool(finding.do) == (verdict is not FINE)


def test_every_item_is_tested_with_each_of_its_verdicts():
    verdicts = {}
    for name, _, _, verdict, _ in CASES:
        verdicts.setdefault(name, set()).add(verdict)
    items = {*account.ITEMS, *deployed.ITEMS}
    assert {function(name) for name in verdicts} == items
    assert all(FINE in seen and len(seen) > 1 for seen in verdicts.values())


@pytest.mark.parametrize(
    "error",
    [
        Refused("InvalidClientTokenId", "The security token included in the request is invalid", 403),
        Refused("ExpiredToken", "The security token included in the request is expired", 403),
    ],
)
def test_only_the_credentials_are_asked_for_if_they_are_missing(error):
    account = Account(GetCallerIdentity=error)
    (finding,) = preflight.look(account, settings())
    assert (finding.item, finding.verdict) == ("credentials", STOPS)
    assert account.asked == ["GetCallerIdentity"]


@pytest.mark.parametrize("error", [NoCredentialsError(), StationError("no AWS client for sts: no region")])
def test_an_error_of_the_client_stops_the_preflight(error):
    class Nothing:
        def client(self, service):
            raise error

    (finding,) = preflight.look(Nothing(), settings())
    assert finding.verdict is STOPS
    assert str(error) in finding.found


EVERYTHING = {"site": True, "device_defender": True, "iot_log_level": "error", "stage": "prod"}


def test_a_new_account_passes_and_is_only_read():
    account = Account()
    findings = preflight.look(account, settings(**EVERYTHING))
    assert len({finding.item for finding in findings}) == len(findings) == 11
    assert not preflight.stopped(findings)
    assert all(name.startswith(("Get", "List", "Describe")) for name in account.asked)


def test_a_missing_permission_is_a_warning_that_names_it():
    answers = {name: denied(f"service:{name}") for name in NEW if name != "GetCallerIdentity"}
    _, *findings = preflight.look(Account(**answers), settings(**EVERYTHING))
    assert len(findings) == 10
    for finding in findings:
        assert finding.verdict is WARNING
        assert finding.found.startswith("not answered: the permission service:")
        assert finding.do.startswith("allow service:")


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (Refused("AccessDenied", "Access Denied", 403), "the permission GetParameter is missing"),
        (Refused("InternalServerError", "try later", 500), "try later"),
    ],
)
def test_an_unanswered_question_is_a_warning(error, text):
    finding = account.bootstrap(Account(GetParameter=error), settings())
    assert finding.verdict is WARNING
    assert text in finding.found


def test_a_report_has_every_finding_with_its_advice(capsys):
    findings = preflight.look(Account(GetParameter=Refused("ParameterNotFound")), settings())
    assert preflight.stopped(findings)
    written = json.loads(json.dumps(preflight.as_json(findings)))
    assert written[1] == {
        "item": "bootstrap",
        "asked": "ssm GetParameter /cdk-bootstrap/hnb659fds/version",
        "found": "this account and region are not bootstrapped",
        "verdict": "stops",
        "do": "`make bootstrap`, once",
    }
    preflight.show(findings, Console(file=sys.stdout, width=200))
    lines = capsys.readouterr().out.splitlines()
    at = lines.index("stops    bootstrap: this account and region are not bootstrapped")
    assert lines[at + 1] == "         -> `make bootstrap`, once"


def test_the_cdks_arguments_are_read_as_app_py_reads_them(tmp_path):
    asked = preflight.options(
        [
            "-c",
            "stage=prod",
            "--context",
            "budget_usd=50",
            "--context=alarm_email=a@b.org",
            "--require-approval",
            "never",
        ]
    )
    read = preflight.context([*asked.context, f"layer={tmp_path}", f"analysis_layer={tmp_path}"])
    made = Settings.read(read.get)
    assert (made.stage, made.budget_usd, made.alarm_email) == ("prod", 50, "a@b.org")
    with pytest.raises(SettingsError, match="stage must be"):
        Settings.read(preflight.context(["stage=test"]).get)
