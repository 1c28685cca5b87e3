"""Who may do what: every IoT and IAM statement, by name. A grant that is not listed here fails."""

from __future__ import annotations

import fnmatch
import json
import re

import pytest
from aws_cdk import Stack

import contract
from contract import (
    BROKER,
    CMD,
    FLEET,
    LIVE,
    PING,
    PONG,
    RULES,
    build_topic,
    live_topic,
    record_topic,
    rule_name,
)
from functions.alert import Notices, causes
from functions.allotment import Allotment
from functions.presence import change
from stacks.fleet import claim_policy
from stacks.fleet import robot_policy as robots_policy

ME = "${iot:Connection.Thing.ThingName}"
IOT = "arn:${AWS::Partition}:iot:${AWS::Region}:${AWS::AccountId}"
SHADOW = f"$aws/things/{ME}/shadow/name/agent/*"
LISTEN = (f"cmd/iort/{ME}/*", f"p?ng/iort/{ME}/*", "fleet/iort/*", SHADOW)
ROBOT_POLICY = [
    {
        "Effect": "Allow",
        "Action": "iot:Connect",
        "Resource": [f"{IOT}:client/{ME}"],
        "Condition": {"Bool": {"iot:Connection.Thing.IsAttached": ["true"]}},
    },
    {
        "Effect": "Allow",
        "Action": "iot:Publish",
        "Resource": [
            f"{IOT}:topic/$aws/rules/iort_record/dt/iort/{ME}/*",
            f"{IOT}:topic/$aws/rules/iort_live/live/iort/{ME}/*",
            f"{IOT}:topic/live/iort/{ME}/*",
            f"{IOT}:topic/fleet/iort/{ME}/*",
            f"{IOT}:topic/ping/iort/{ME}/*",
            f"{IOT}:topic/{SHADOW}",
        ],
    },
    {"Effect": "Allow", "Action": "iot:Subscribe", "Resource": [f"{IOT}:topicfilter/{t}" for t in LISTEN]},
    {"Effect": "Allow", "Action": "iot:Receive", "Resource": [f"{IOT}:topic/{t}" for t in LISTEN]},
]

# Provisioning with this fleet's template, and hearing what becomes of it.
ASKED = ("$aws/certificates/create-from-csr/json", "$aws/provisioning-templates/iort-robot/provision/json")
ANSWERED = [f"{topic}/{answer}" for topic in ASKED for answer in ("accepted", "rejected")]
CLAIM_POLICY = [
    {"Effect": "Allow", "Action": "iot:Connect", "Resource": [f"{IOT}:client/iort-claim-*"]},
    {"Effect": "Allow", "Action": "iot:Publish", "Resource": [f"{IOT}:topic/{topic}" for topic in ASKED]},
    {"Effect": "Allow", "Action": "iot:Subscribe", "Resource": [f"{IOT}:topicfilter/{t}" for t in ANSWERED]},
    {"Effect": "Allow", "Action": "iot:Receive", "Resource": [f"{IOT}:topic/{t}" for t in ANSWERED]},
]
THINGS, CERTIFICATES = f"{IOT}:thing/*", f"{IOT}:cert/*"
GROUP, KIND = f"{IOT}:thinggroup/iort-robot", f"{IOT}:thingtype/iort-robot"
PROVISIONING = (
    {
        (f"iot:{action}", resource)
        for action in ("CreateThing", "DescribeThing", "ListThingGroupsForThing", "ListThingPrincipals")
        for resource in (THINGS, KIND)
    }
    | {
        (f"iot:{action}", CERTIFICATES)
        for action in ("AttachPolicy", "DescribeCertificate", "UpdateCertificate")
    }
    | {("iot:AddThingToThingGroup", THINGS), ("iot:AddThingToThingGroup", GROUP)}
    | {("iot:AttachThingPrincipal", THINGS), ("iot:AttachThingPrincipal", CERTIFICATES)}
    | {("iot:DescribeThingType", KIND), ("iot:DescribeThingGroup", GROUP)}
    | {("iot:GetPolicy", f"{IOT}:policy/iort-robot")}
    | {(f"iot:{action}", "*") for action in ("ListAttachedPolicies", "ListPrincipalThings", "RegisterThing")}
)

# What the checks of the audit read: certificates and policies, whoever's they are.
AUDIT_READS = (
    *(
        "DescribeCACertificate",
        "DescribeCertificate",
        "GetEffectivePolicies",
        "GetLoggingOptions",
        "GetPolicy",
    ),
    *("GetV2LoggingOptions", "ListCACertificates", "ListCertificates", "ListPolicies"),
)
LOG_OF_IOT = "arn:${AWS::Partition}:logs:${AWS::Region}:${AWS::AccountId}:log-group:AWSIotLogsV2:*"

LOG = {"logs:CreateLogStream", "logs:PutLogEvents"}
REJECT = ("sqs:SendMessage", "Rejected.Arn")
# What the CDK gives whoever may send to a queue as a destination.
DESTINATION = {REJECT, ("sqs:GetQueueAttributes", "Rejected.Arn"), ("sqs:GetQueueUrl", "Rejected.Arn")}
# Of every role, each action on each resource, and who may take the role.
ROLES = {
    "LiveRole": (
        "lambda.amazonaws.com",
        {(action, "LiveLog.Arn") for action in LOG}
        | DESTINATION
        | {
            (
                "ssm:GetParameter",
                "arn:${AWS::Partition}:ssm:${AWS::Region}:${AWS::AccountId}:parameter/iort/pubnub",
            )
        },
    ),
    "SummarizeRole": (
        "lambda.amazonaws.com",
        {(action, "SummarizeLog.Arn") for action in LOG}
        | {
            ("dynamodb:Query", "Telemetry.Arn"),
            ("dynamodb:BatchWriteItem", "Summary.Arn"),
            ("dynamodb:GetItem", "Robots.Arn"),
            ("dynamodb:DescribeStream", "Telemetry.StreamArn"),
            ("dynamodb:GetRecords", "Telemetry.StreamArn"),
            ("dynamodb:GetShardIterator", "Telemetry.StreamArn"),
            ("dynamodb:ListStreams", "*"),
        }
        | DESTINATION,
    ),
    "EchoRole": (
        "lambda.amazonaws.com",
        {(action, "EchoLog.Arn") for action in LOG}
        | DESTINATION
        | {("iot:Publish", f"{IOT}:topic/pong/iort/*/lambda")},
    ),
    "QuarantineRole": (
        "lambda.amazonaws.com",
        {(action, "QuarantineLog.Arn") for action in LOG}
        | {
            ("dynamodb:UpdateItem", "Quarantine.Arn"),
            ("dynamodb:GetRecords", "Telemetry.StreamArn"),
            ("dynamodb:GetShardIterator", "Telemetry.StreamArn"),
            ("sqs:ReceiveMessage", "Rejected.Arn"),
            ("sqs:DeleteMessage", "Rejected.Arn"),
            ("sqs:ChangeMessageVisibility", "Rejected.Arn"),
            ("sqs:GetQueueAttributes", "Rejected.Arn"),
            ("sqs:GetQueueUrl", "Rejected.Arn"),
        },
    ),
    "QueryRole": (
        "lambda.amazonaws.com",
        {(action, "QueryLog.Arn") for action in LOG}
        | {("dynamodb:Query", "Telemetry.Arn"), ("dynamodb:Scan", "Telemetry.Arn")}
        | {("dynamodb:GetItem", "Robots.Arn")}
        | {
            (f"s3:{action}", f"Files.Arn/{contract.RESULTS_PREFIX}*") for action in ("GetObject", "PutObject")
        },
    ),
    "UploadRole": (
        "lambda.amazonaws.com",
        {(action, "UploadLog.Arn") for action in LOG}
        | DESTINATION
        | {
            (f"s3:{action}", f"Files.Arn/{contract.FILES_PREFIX}*")
            for action in ("AbortMultipartUpload", "ListMultipartUploadParts", "PutObject")
        }
        | {(f"s3:{action}", "Files.Arn") for action in ("ListBucket", "ListBucketMultipartUploads")}
        | {("dynamodb:UpdateItem", "Robots.Arn"), ("iot:Publish", f"{IOT}:topic/pong/iort/*/file")},
    ),
    "AdmitRole": (
        "lambda.amazonaws.com",
        {(action, "AdmitLog.Arn") for action in LOG} | {("dynamodb:UpdateItem", "Robots.Arn")},
    ),
    "PresenceRole": (
        "lambda.amazonaws.com",
        {(action, "PresenceLog.Arn") for action in LOG}
        | DESTINATION
        | {("dynamodb:UpdateItem", "Robots.Arn")},
    ),
    "AlertRole": (
        "lambda.amazonaws.com",
        {(action, "AlertLog.Arn") for action in LOG}
        | DESTINATION
        | {("dynamodb:UpdateItem", "Robots.Arn"), ("sns:Publish", "Alarms")},
    ),
    "ProvisioningRole": ("iot.amazonaws.com", PROVISIONING),
    "AuditRole": ("iot.amazonaws.com", {(f"iot:{action}", "*") for action in AUDIT_READS}),
    "LogRole": (
        "iot.amazonaws.com",
        {(f"logs:{action}", LOG_OF_IOT) for action in ("CreateLogGroup", "CreateLogStream", "PutLogEvents")},
    ),
    "ingest/RecordRole": ("iot.amazonaws.com", {REJECT, ("dynamodb:PutItem", "Telemetry.Arn")}),
    "ingest/LiveRole": ("iot.amazonaws.com", {REJECT}),
    "ingest/PongRole": ("iot.amazonaws.com", {REJECT, ("iot:Publish", f"{IOT}:topic/pong/iort/*/rule")}),
    "ingest/EchoRole": ("iot.amazonaws.com", {REJECT}),
    "ingest/UploadRole": ("iot.amazonaws.com", {REJECT}),
    "ingest/FaultRole": ("iot.amazonaws.com", {REJECT}),
    "ingest/BatteryRole": ("iot.amazonaws.com", {REJECT}),
    "ingest/PresenceRole": ("iot.amazonaws.com", {REJECT}),
    "ingest/VersionRole": ("iot.amazonaws.com", {REJECT}),
}
# Of the functions that keep something in a robot's row: which attributes.
KEEPS = {
    "AlertRole": ("alert_*",),
    "PresenceRole": contract.PRESENCE,
    "UploadRole": ("files_bytes", "files_day"),
}
# The only statements about every resource, each with why it cannot name one.
EVERY_RESOURCE = {
    # "Actions, resources, and condition keys for Amazon DynamoDB": ListStreams has no resource type.
    ("SummarizeRole", "dynamodb:ListStreams"),
    # "Actions defined by AWS IoT": these have no resource type.
    *(
        ("ProvisioningRole", f"iot:{a}")
        for a in ("ListAttachedPolicies", "ListPrincipalThings", "RegisterThing")
    ),
    # An audit is of everything.
    *(("AuditRole", f"iot:{a}") for a in AUDIT_READS),
}


@pytest.fixture(scope="module")
def iot_policies(synthesized, reader):
    return {
        policy["PolicyName"]: [
            {**statement, "Resource": reader.texts(statement["Resource"])}
            for statement in policy["PolicyDocument"]["Statement"]
        ]
        for policy in synthesized.resources("AWS::IoT::Policy").values()
    }


@pytest.fixture(scope="module")
def robot_policy(iot_policies):
    return iot_policies[contract.fleet_name()]


def qualified(synthesized, kind):
    """Resources by name, those of ingest with the stack's, because two stacks have a LiveRole."""
    from tests.stacks.templates import name

    for stack in synthesized.templates:
        for logical_id, properties in synthesized.resources(kind, stack).items():
            yield ("ingest/" if stack == "ingest" else "") + name(logical_id), stack, logical_id, properties


# --- robots -----------------------------------------------------------------------------------------


def test_the_iot_policies_statement_by_statement(iot_policies):
    assert iot_policies == {contract.fleet_name(): ROBOT_POLICY, contract.claim_name(): CLAIM_POLICY}


def test_the_policies_fit_whatever_the_namespace_and_the_region():
    """ "Policy document size" of AWS IoT Core's quotas: 2048 characters, white space not counted."""
    stack, longest = Stack(), "n" * 16
    real = {"AWS::Partition": "aws-us-gov", "AWS::Region": "ap-southeast-2", "AWS::AccountId": "0" * 12}
    for policy in (robots_policy, claim_policy):
        text = json.dumps(stack.resolve(policy(stack, namespace=contract.check_namespace(longest))))
        joined = json.dumps(_joined(json.loads(text), real), separators=(",", ":"))
        assert longest in joined
        assert len(joined) <= 2048


def _joined(value, real):
    if isinstance(value, list):
        return [_joined(one, real) for one in value]
    if not isinstance(value, dict):
        return value
    if "Ref" in value:
        return real[value["Ref"]]
    if "Fn::Join" in value:
        separator, parts = value["Fn::Join"]
        return separator.join(_joined(parts, real))
    return {key: _joined(one, real) for key, one in value.items()}


def test_every_resource_of_the_robots_policy_is_bound_to_its_thing(robot_policy):
    for statement in robot_policy:
        assert statement["Effect"] == "Allow"
        assert statement["Action"] in {"iot:Connect", "iot:Publish", "iot:Subscribe", "iot:Receive"}
        for resource in statement["Resource"]:
            if ME not in resource:
                assert statement["Action"] in {"iot:Subscribe", "iot:Receive"}
                assert resource.endswith("/fleet/iort/*")
            # A wildcard stands only below the thing's own level, and no other variable is trusted.
            assert "*" not in resource.removesuffix("/*")
            assert set(re.findall(r"\$\{iot:[^}]*\}", resource)) <= {ME}


def allows(policy, action, kind, topic, thing="car"):
    """IoT Core's rule: * and ? are wildcards in the policy, + and # are characters like any other."""
    for statement in policy:
        if statement["Action"] != f"iot:{action}":
            continue
        for resource in statement["Resource"]:
            pattern = re.escape(resource.removeprefix(f"{IOT}:").replace(ME, thing))
            if re.fullmatch(pattern.replace(r"\*", ".*").replace(r"\?", "."), f"{kind}/{topic}"):
                return True
    return False


def test_a_robot_may_publish_what_the_agent_builds_and_only_under_its_own_name(robot_policy):
    own = [
        record_topic("car", "vesc"),
        live_topic("car", "vesc"),
        build_topic(LIVE, "car", "vesc"),
        build_topic(FLEET, "car", "pose"),
        *(build_topic(PING, "car", path) for path in (*contract.PING_PATHS, contract.FILE)),
    ]
    for topic in own:
        assert allows(robot_policy, "Publish", "topic", topic), topic
        for other in ("car2", "ca", "Car", "*", "+", "other/car"):
            assert not allows(robot_policy, "Publish", "topic", topic.replace("/car/", f"/{other}/")), other
        assert not allows(robot_policy, "Publish", "topic", topic, "car2"), topic
        assert not allows(robot_policy, "Publish", "topic", topic.replace("iort", "lab2"))


def test_a_robot_may_not_publish_what_is_for_others_to_say(robot_policy):
    for topic in (
        build_topic(CMD, "car", "stop"),
        build_topic(PONG, "car", "rule"),
        # The record lane costs messaging unless it is sent by Basic Ingest.
        build_topic(contract.RECORD, "car", "vesc"),
        "$aws/things/car/shadow/update",
        "$aws/things/car/shadow/name/other/update",
        "$aws/things/car2/shadow/name/agent/update",
        *(f"$aws/rules/{rule_name(rule)}/dt/iort/car/vesc" for rule in RULES if rule != "record"),
        *(f"$aws/rules/{rule_name(rule)}/live/iort/car/vesc" for rule in RULES if rule != "live"),
    ):
        assert not allows(robot_policy, "Publish", "topic", topic), topic


def test_a_robot_hears_its_own_topics_and_the_fleet(robot_policy):
    for topic_filter in (
        "cmd/iort/car/#",
        "cmd/iort/car/+",
        "pong/iort/car/+",
        "fleet/iort/+/#",
        "fleet/iort/car2/pose",
    ):
        assert allows(robot_policy, "Subscribe", "topicfilter", topic_filter), topic_filter
    assert allows(robot_policy, "Subscribe", "topicfilter", build_topic(PING, "car", BROKER))
    for topic_filter in (
        "#",
        "+/iort/car/#",
        "cmd/iort/+/#",
        "cmd/iort/car2/#",
        "pong/iort/+/rule",
        "ping/iort/+/broker",
        "dt/iort/car/#",
        "live/iort/car/#",
        "$aws/#",
        "fleet/lab2/+/#",
        "fleet/#",
    ):
        assert not allows(robot_policy, "Subscribe", "topicfilter", topic_filter), topic_filter
    for topic in (
        build_topic(CMD, "car", "stop"),
        build_topic(FLEET, "car2", "pose"),
        build_topic(PONG, "car", "rule"),
    ):
        assert allows(robot_policy, "Receive", "topic", topic), topic
    for topic in (
        build_topic(CMD, "car2", "stop"),
        build_topic(LIVE, "car", "vesc"),
        build_topic(PONG, "car2", "rule"),
    ):
        assert not allows(robot_policy, "Receive", "topic", topic), topic


def test_a_robot_connects_as_its_thing_and_nobody_else(robot_policy):
    assert allows(robot_policy, "Connect", "client", "car")
    assert not allows(robot_policy, "Connect", "client", "car2")
    assert not allows(robot_policy, "Connect", "client", "car/2")


# --- roles ------------------------------------------------------------------------------------------


def test_every_role_may_do_exactly_this(synthesized, reader):
    granted = {role: set() for role, *_ in qualified(synthesized, "AWS::IAM::Role")}
    conditional = set()
    for _, stack, _, policy in qualified(synthesized, "AWS::IAM::Policy"):
        (ref,) = policy["Roles"]
        role = ("ingest/" if stack == "ingest" else "") + reader.text(ref)
        for statement in policy["PolicyDocument"]["Statement"]:
            assert statement.keys() <= {"Action", "Effect", "Resource", "Condition"}
            assert statement["Effect"] == "Allow"
            if "Condition" in statement:
                assert statement["Action"] == "dynamodb:UpdateItem"
                assert statement["Condition"] == {
                    "ForAllValues:StringLike": {"dynamodb:Attributes": sorted({"robot", *KEEPS[role]})},
                    "StringEqualsIfExists": {"dynamodb:ReturnValues": ["NONE", "UPDATED_NEW", "UPDATED_OLD"]},
                }
                conditional.add(role)
            for action in reader.texts(statement["Action"]):
                granted[role] |= {(action, resource) for resource in reader.texts(statement["Resource"])}
    assert granted == {role: actions for role, (_, actions) in ROLES.items()}
    # Whoever else changes a row of the registry decides who may join.
    others = {role for role, actions in granted.items() if ("dynamodb:UpdateItem", "Robots.Arn") in actions}
    assert conditional == KEEPS.keys() == others - {"AdmitRole"}


def test_no_function_that_keeps_a_robots_row_can_open_its_name():
    for names in KEEPS.values():
        for name in (*contract.ADMISSION, "speed_to_erpm_gain", "vehicle"):
            assert not any(fnmatch.fnmatchcase(name, pattern) for pattern in names), name


class Recorder:
    """A DynamoDB client that only notes which attributes it was asked for."""

    class exceptions:  # noqa: N801 boto3 calls it that
        class ConditionalCheckFailedException(Exception):  # noqa: N818
            pass

    def __init__(self):
        self.attributes = set()

    def update_item(self, **asked):
        names = asked.get("ExpressionAttributeNames", {})
        text = f"{asked['UpdateExpression']} {asked.get('ConditionExpression', '')}"
        words = re.findall(r"(?<![:\w])#?[a-z]\w*(?!\w*\()", text)
        self.attributes |= asked["Key"].keys() | {names.get(word, word) for word in words}


def test_each_function_changes_what_it_may_and_may_change_what_it_does():
    upload, alert, presence = Recorder(), Recorder(), Recorder()
    Allotment(upload, table="robots", bytes_a_day=9).take("car", 1, 0)
    notices = Notices(alert, "robots")
    for cause in causes({"fault_code": 1, "voltage_input": 1.0}, 10.5) + causes({"fault_code": 99}, 10.5):
        notices.take("car", cause.key, 0)
        notices.give_back("car", cause.key)
    event = {"clientId": "car", "timestamp": 1, "versionNumber": 1, "principalIdentifier": "a"}
    for kind in ("connected", "disconnected"):
        presence.update_item(**change({**event, "eventType": kind}))
    presence.update_item(**change({"agent_version": "1", "robot": "car"}))
    assert upload.attributes == {"robot", *KEEPS["UploadRole"]}
    assert presence.attributes == {"robot", *KEEPS["PresenceRole"]}
    assert alert.attributes - {"robot"} == {"alert_fault_1", "alert_fault_unknown", "alert_low_voltage"}
    assert all(fnmatch.fnmatchcase(name, "alert_*") for name in alert.attributes - {"robot"})


def test_every_role_is_for_one_service_of_this_account(synthesized, reader):
    for role, _, _, properties in qualified(synthesized, "AWS::IAM::Role"):
        (statement,) = properties["AssumeRolePolicyDocument"]["Statement"]
        service, _ = ROLES[role]
        assert (statement["Effect"], statement["Action"]) == ("Allow", "sts:AssumeRole")
        assert statement["Principal"] == {"Service": service}
        if service == "iot.amazonaws.com":
            # The service acts for every account; only for ours may it take our role.
            condition = statement["Condition"]
            assert condition == {"StringEquals": {"aws:SourceAccount": {"Ref": "AWS::AccountId"}}}
        assert properties.keys() <= {"AssumeRolePolicyDocument", "Tags"}, "no managed or inline policies"


def test_no_statement_is_about_every_resource_or_action(synthesized, reader):
    wild = set()
    for role, (_, actions) in ROLES.items():
        for action, resource in actions:
            assert "*" not in action
            if resource == "*":
                wild.add((role, action))
            else:
                # A wildcard within an ARN stands for the robot's name, in the bucket for its keys, in a log
                # for its streams.
                # Things and certificates have no names before they are provisioned.
                named = re.sub(r":topic/pong/iort/\*/|/(robots|results)/\*$|:AWSIotLogsV2:\*$", "", resource)
                assert "*" not in named or (role == "ProvisioningRole" and named in {THINGS, CERTIFICATES})
    assert wild == EVERY_RESOURCE
    # And nothing grants that is not a role's policy or a robot's, such as a policy of its own.
    kinds = {r["Type"] for t in synthesized.templates.values() for r in t["Resources"].values()}
    assert {k for k in kinds if k.startswith("AWS::IAM::")} == {"AWS::IAM::Role", "AWS::IAM::Policy"}
    assert {k for k in kinds if k.endswith("Permission")} == {"AWS::Lambda::Permission"}


def test_only_its_rule_or_template_may_call_a_function(synthesized, reader):
    called = set()
    for stack in synthesized.templates:
        for permission in synthesized.resources("AWS::Lambda::Permission", stack).values():
            assert permission["Action"] == "lambda:InvokeFunction"
            assert permission["Principal"] == "iot.amazonaws.com"
            assert permission["SourceAccount"] == {"Ref": "AWS::AccountId"}
            source, function = permission["SourceArn"], reader.text(permission["FunctionName"])
            if "Fn::GetAtt" in source:
                # Rule and function may have one name; this is the rule.
                rule = synthesized.templates[stack]["Resources"][source["Fn::GetAtt"][0]]
                assert rule["Type"] == "AWS::IoT::TopicRule"
            called.add((reader.text(source), function))
    assert called == {
        ("Live.Arn", "Live.Arn"),
        ("Echo.Arn", "Echo.Arn"),
        ("Upload.Arn", "Upload.Arn"),
        ("Presence.Arn", "Presence.Arn"),
        ("Version.Arn", "Presence.Arn"),
        ("Fault.Arn", "Alert.Arn"),
        ("Battery.Arn", "Alert.Arn"),
        (f"{IOT}:provisioningtemplate/iort-robot", "Admit.Arn"),
    }


def test_queues_are_encrypted_and_refuse_what_is_not_tls(synthesized, reader):
    queues = {name: properties for name, _, _, properties in qualified(synthesized, "AWS::SQS::Queue")}
    assert queues.keys() == {"Rejected", "Last"}
    for properties in queues.values():
        assert properties["SqsManagedSseEnabled"] is True
        assert properties["MessageRetentionPeriod"] == 14 * 86_400
    closed = set()
    for _, _, _, policy in qualified(synthesized, "AWS::SQS::QueuePolicy"):
        (statement,) = policy["PolicyDocument"]["Statement"]
        assert (statement["Effect"], statement["Action"]) == ("Deny", "sqs:*")
        assert statement["Condition"] == {"Bool": {"aws:SecureTransport": "false"}}
        assert statement["Principal"] == {"AWS": "*"}
        closed |= {reader.text(statement["Resource"])}
    assert closed == {"Rejected.Arn", "Last.Arn"}


# --- secrets ----------------------------------------------------------------------------------------


def test_no_template_holds_a_secret_an_account_or_a_path_of_this_machine(synthesized):
    text = json.dumps(dict(synthesized.templates))
    from stacks.settings import ROOT

    # A retention in seconds or a queue's name has no twelve digits; an account id has.
    assert not re.search(r"(?<![0-9a-f])\d{12}(?![0-9a-f])", text)
    assert str(ROOT) not in text
    assert str(synthesized.folder) not in text
    assert not re.search(r"AKIA|aws_secret|password|BEGIN [A-Z ]*PRIVATE KEY|(pub|sub|sec)-c-", text)
    for properties in synthesized.resources("AWS::Lambda::Function").values():
        for key, value in properties.get("Environment", {}).get("Variables", {}).items():
            assert not re.search(r"KEY|SECRET|TOKEN|PASSWORD", key), (key, value)
