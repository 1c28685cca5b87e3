"""The preflight: every verdict of every item, with a fake account that answers like AWS."""

from __future__ import annotations

import pytest

from tests.unit.verify.account import QUOTAS, Account, Refused, limits, quota, settings, stack_answers
from verify.preflight import account, deployed
from verify.preflight.finding import Verdict

FINE, WARNING, STOPS = Verdict.FINE, Verdict.WARNING, Verdict.STOPS
ROLE = "arn:aws:iam::123456789012:role/somebody"


ALL = dict.fromkeys(deployed.STACKS, "UPDATE_COMPLETE")
PUBLISHES = "Inbound publish requests per second per account"
LIVE = ("AWS::Lambda::Function", "Live848578DF", "iort-processing-Live")
LOG = {"roleArn": ROLE, "defaultLogLevel": "ERROR", "disableAllLogs": False}
KEY = "iort-storage:ExportsOutputFnGetAttKey961B73FDArn5A860C43"


def exported(name, *importers):
    answers = {"ListExports": {"Exports": [{"Name": name}, {"Name": "another-storage:ExportsOutputRefKey"}]}}
    return {**answers, **({"ListImports": {"Imports": list(importers)}} if importers else {})}


STORED, BY_PUBNUB = {"GetParameter": {"Parameter": {"Value": "x"}}}, {"live_transport": "pubnub"}


def versions(count):
    return {"ListPolicyVersions": {"policyVersions": [{"versionId": str(i)} for i in range(count)]}}


def executions(*of, **more):
    return {"GetAccountSettings": limits(*of), **more}


def holding(noun, *resource):
    """All stacks, one of which has this resource."""
    return stack_answers(ALL, resources={noun: [resource]})


def rules(*names):
    return {"ListTopicRules": {"rules": [{"ruleName": name} for name in names]}}


MAIL, SITE, LOGGED = {"alarm_email": "a@b.org"}, {"site": True}, {"iot_log_level": "error"}
DEFENDER, AUDITED = {"device_defender": True}, {"DescribeAccountAuditConfiguration": {"roleArn": ROLE}}
PROD = {"stage": "prod", "account_concurrency": 105, **BY_PUBNUB}
RESERVED = {"GetFunctionConcurrency": {"ReservedConcurrentExecutions": 5}}
STORAGE = stack_answers({"storage": "UPDATE_COMPLETE"})
OF_PROD = stack_answers({"storage": "UPDATE_COMPLETE"}, tags=[("stage", "prod")])
STUCK = (
    *("ROLLBACK_COMPLETE", "ROLLBACK_FAILED", "CREATE_FAILED", "DELETE_FAILED", "REVIEW_IN_PROGRESS"),
    *("UPDATE_ROLLBACK_FAILED", "UPDATE_IN_PROGRESS"),
)

NO_VIDEO = {"DescribeType": Refused("TypeNotFoundException", "The type does not exist.", 404)}


CASES = [
    ("spending", {}, {}, WARNING, "alarm_email: nobody hears of an alarm; budget_usd: nobody hears"),
    ("spending", MAIL, {}, WARNING, "not set: budget_usd"),
    ("spending", MAIL | {"budget_usd": 50}, {}, FINE, "at most 1,612 write units"),
    (
        "spending",
        MAIL | {"budget_usd": 50, "files_days": 0},
        {},
        WARNING,
        "files_days: uploaded files are kept",
    ),
    ("policy_versions", {}, {}, FINE, "no policy yet"),
    ("policy_versions", {}, versions(4), FINE, "iort-robot has 4 of 5, iort-claim has 4 of 5"),
    ("policy_versions", {}, versions(5), WARNING, "takes no other version"),
    ("bootstrap", {}, {}, FINE, "version 21, needed is 6"),
    ("bootstrap", {}, {"GetParameter": Refused("ParameterNotFound")}, STOPS, "not bootstrapped"),
    ("bootstrap", {}, {"GetParameter": {"Parameter": {"Value": "5"}}}, STOPS, "must be 6 or newer, got 5"),
    ("iot_log", {}, {}, FINE, "not configured; iot_log_level is off"),
    ("iot_log", LOGGED, {}, FINE, "not configured; iot_log_level is error"),
    ("iot_log", {}, {"GetV2LoggingOptions": LOG}, FINE, "configured (ERROR); iot_log_level is off"),
    ("iot_log", LOGGED, {"GetV2LoggingOptions": LOG}, STOPS, "already exists"),
    ("iot_log", LOGGED, {"GetV2LoggingOptions": {**LOG, "disableAllLogs": True}}, FINE, "not configured"),
    (
        "iot_log",
        LOGGED,
        {"GetV2LoggingOptions": LOG, **holding("account", "AWS::IoT::Logging", "Log", "1")},
        FINE,
        "by this deployment",
    ),
    ("audit", DEFENDER, {}, FINE, "not configured; wanted"),
    ("audit", {}, AUDITED, FINE, "configured; not wanted"),
    ("audit", DEFENDER, AUDITED, STOPS, "already exists"),
    (
        "audit",
        DEFENDER,
        AUDITED | holding("account", "AWS::IoT::AccountAuditConfiguration", "Audit", "1"),
        FINE,
        "by this deployment",
    ),
    ("concurrency", {}, {}, FINE, "0 are to be reserved"),
    ("concurrency", {}, executions(10, 10), WARNING, "10 concurrent executions"),
    ("concurrency", PROD, executions(105, 105), FINE, "5 are to be reserved"),
    ("concurrency", PROD, executions(104, 104), STOPS, "requires 100 unreserved"),
    (
        "concurrency",
        PROD,
        executions(105, 100, **RESERVED) | holding("processing", *LIVE),
        FINE,
        "100 of them unreserved",
    ),
    ("concurrency", PROD | {"account_concurrency": 104}, executions(104, 104), FINE, "0 are to be reserved"),
    ("quotas", {}, {}, FINE, "first limit: "),
    ("quotas", {}, {"ListServiceQuotas": {"Quotas": [quota(PUBLISHES, 500)]}}, WARNING, f"{PUBLISHES}, 500"),
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
        rules(*(f"other{number}" for number in range(992))),
        STOPS,
        "992 rules of others and 10 of ours exceed the limit 1000",
    ),
    ("quotas", {}, rules("iort_live", "iort_record"), FINE, "robots"),
    ("relays", {}, NO_VIDEO, FINE, "not wanted (turn=false)"),
    ("relays", {"turn": True}, {}, FINE, "this region has Kinesis Video Streams"),
    (
        "relays",
        {"turn": True},
        NO_VIDEO,
        STOPS,
        "CloudFormation does not know AWS::KinesisVideo::SignalingChannel",
    ),
    ("stacks", {}, {}, FINE, "none: a first one"),
    ("stacks", {}, stack_answers(ALL), FINE, "10 of 10"),
    *(
        ("stacks", {}, stack_answers({**ALL, "fleet": state}), STOPS, f"iort-fleet is {state}")
        for state in STUCK
    ),
    ("stacks", {}, stack_answers({"storage": "UPDATE_ROLLBACK_COMPLETE"}), FINE, "1 of 10"),
    ("names", {}, {}, FINE, "free"),
    ("names", {}, {"GetPolicy": {"policyName": "a"}}, STOPS, "policy iort-robot, policy iort-claim"),
    ("names", {}, {"DescribeThingType": {"thingTypeName": "a"}}, STOPS, "thing type iort-robot"),
    ("names", {}, rules("iort_live"), STOPS, "rule iort_live"),
    (
        "names",
        {},
        {"ListDashboards": {"DashboardEntries": [{"DashboardName": f"iort-{n}"} for n in ("platform", "x")]}},
        STOPS,
        "without their stack: dashboard iort-platform",
    ),
    ("names", {}, {"GetPolicy": {"policyName": "a"}} | stack_answers(ALL), FINE, "used by this deployment"),
    ("live_messages", {}, {}, FINE, "by AWS IoT (live_transport=iot); PubNub's keys are not stored"),
    ("live_messages", {}, STORED, FINE, "by AWS IoT (live_transport=iot); PubNub's keys are stored"),
    ("live_messages", BY_PUBNUB, STORED, FINE, "by PubNub"),
    ("live_messages", BY_PUBNUB, {}, WARNING, "nobody sees live messages"),
    ("live_messages", {}, stack_answers(ALL, outputs={"LiveTransport": "iot"}), FINE, "by AWS IoT"),
    (
        "live_messages",
        {},
        stack_answers(ALL, outputs={"LiveTransport": "pubnub"}),
        WARNING,
        "deployed is PubNub: pages, site and viewers of that way hear nothing more",
    ),
    # A deployment from before the output.
    ("live_messages", {}, stack_answers(ALL), WARNING, "deployed is PubNub"),
    (
        "live_messages",
        BY_PUBNUB,
        STORED | stack_answers(ALL, outputs={"LiveTransport": "iot"}),
        WARNING,
        "deployed is AWS IoT",
    ),
    ("changes", {}, {}, FINE, "nothing is deployed"),
    ("changes", SITE | DEFENDER, stack_answers(ALL), FINE, "none that must not be"),
    (
        "changes",
        {},
        stack_answers(ALL) | exported(KEY, "iort-fleet", "iort-ingest"),
        STOPS,
        "iort-fleet, iort-ingest import the key",
    ),
    ("changes", {}, STORAGE | exported(KEY), FINE, "none that must"),
    *(
        ("changes", {key: True}, STORAGE | exported(KEY, "iort-fleet"), FINE, "none that must")
        for key in ("customer_key", "keep_customer_key")
    ),
    ("changes", {}, OF_PROD, WARNING, "protected"),
    ("changes", {"stage": "prod"}, OF_PROD, FINE, "none that must"),
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
