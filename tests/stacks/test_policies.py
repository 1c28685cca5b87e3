"""Every IAM statement, by role. A grant that tests/stacks/roles.py does not list is an error."""

from __future__ import annotations

import fnmatch
import json
import re

from functions.alert import Notices, causes
from functions.presence import change
from functions.shared.quotas import DAY, Quota
from iort_contract.tables import ADMISSION, FILES_BYTES, FILES_DAY
from stacks.checks import EVERY_RESOURCE
from stacks.fleet import provisioning_template
from tests.stacks.roles import (
    CERTIFICATES,
    CHANGES,
    IOT,
    KEEPS,
    NOT_REGISTERED,
    PEOPLE,
    PROVISIONING,
    ROLES,
    THINGS,
    THINGS_REGISTRATION,
)
from tests.stacks.templates import qualified


def test_every_role_has_exactly_its_listed_permissions(synthesized, reader):
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
                table = reader.text(statement["Resource"])
                of_robots = table == "Robots.Arn"
                attributes = {"robot", *KEEPS[role]} if of_robots else CHANGES[role, table]
                assert statement["Condition"] == {
                    "ForAllValues:StringLike": {"dynamodb:Attributes": sorted(attributes)},
                    "StringEqualsIfExists": {"dynamodb:ReturnValues": ["NONE", "UPDATED_NEW", "UPDATED_OLD"]},
                }
                conditional |= {role} if of_robots else set()
            for action in reader.texts(statement["Action"]):
                granted[role] |= {(action, resource) for resource in reader.texts(statement["Resource"])}
    assert granted == {role: actions for role, (_, actions) in ROLES.items()}
    # Any other writer of the registry's rows could decide which robots may join.
    others = {role for role, actions in granted.items() if ("dynamodb:UpdateItem", "Robots.Arn") in actions}
    assert conditional == KEEPS.keys() == others - {"AdmitRole"}


def test_provisioning_has_awss_managed_permissions_with_listed_exceptions():
    granted = {action.split(":")[1] for action, _ in PROVISIONING}
    template = json.dumps(provisioning_template("iort"))
    assert "BillingGroup" not in template
    assert "PolicyDocument" not in template
    assert granted <= THINGS_REGISTRATION
    assert THINGS_REGISTRATION - granted == NOT_REGISTERED.keys()
    assert all(NOT_REGISTERED.values())


def test_a_function_that_changes_a_robots_row_cannot_open_its_name():
    for names in KEEPS.values():
        for name in (*ADMISSION, "speed_to_erpm_gain", "vehicle"):
            assert not any(fnmatch.fnmatchcase(name, pattern) for pattern in names), name


class Recorder:
    """A fake DynamoDB client that records the requested attributes."""

    class exceptions:
        class ConditionalCheckFailedException(Exception):
            pass

    def __init__(self):
        self.attributes = set()

    def update_item(self, **asked):
        names = asked.get("ExpressionAttributeNames", {})
        text = f"{asked['UpdateExpression']} {asked.get('ConditionExpression', '')}"
        words = re.findall(r"(?<![:\w])#?[a-z]\w*(?!\w*\()", text)
        self.attributes |= asked["Key"].keys() | {names.get(word, word) for word in words}
        return {"Attributes": {FILES_BYTES: {"N": "1"}}}


def test_each_function_changes_exactly_its_allowed_attributes():
    upload, alert, presence = Recorder(), Recorder(), Recorder()
    Quota(upload, table="robots", named=(FILES_DAY, FILES_BYTES), period=DAY, most=9).take("car", 1, 0)
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


def test_every_role_can_be_assumed_by_this_account_or_one_service_for_it(synthesized, reader):
    for role, _, _, properties in qualified(synthesized, "AWS::IAM::Role"):
        (statement,) = properties["AssumeRolePolicyDocument"]["Statement"]
        service, _ = ROLES[role]
        assert (statement["Effect"], statement["Action"]) == ("Allow", "sts:AssumeRole")
        assert properties.keys() <= {"AssumeRolePolicyDocument", "Tags"}, "no managed or inline policies"
        if service == PEOPLE:
            assert reader.text(statement["Principal"]["AWS"]) == PEOPLE
            continue
        assert statement["Principal"] == {"Service": service}
        if service != "lambda.amazonaws.com":
            # The service acts for every account; only for ours may it take our role.
            condition = statement["Condition"]
            assert condition == {"StringEquals": {"aws:SourceAccount": {"Ref": "AWS::AccountId"}}}


def test_wildcards_in_statements_are_listed_exceptions(synthesized, reader):
    wild = set()
    for role, (service, actions) in ROLES.items():
        for action, resource in actions:
            assert "*" not in action
            if resource == "*":
                wild.add((role, action))
            else:
                # A wildcard within an ARN stands for the robot's name, in the bucket for its keys, in a log
                # for its streams.
                # Things and certificates have no names before they are provisioned; the hook reads
                # whether a certificate was registered.
                known = (
                    r":topic/(pong|answer)/iort/\*/\*?|:thing/\*/agent$"
                    r"|/(archive|robots|results|ask|plans|analysis)/\*$|/analysis/robot=\*$|:AWSIotLogsV2:\*$"
                    r"|:execution:Machine.Name:\*$"
                )
                named = re.sub(known, "", resource).replace("/robots/*", "")
                of_provisioning = role == "ProvisioningRole" and named in {THINGS, CERTIFICATES}
                of_the_hook = (role, action, named) == ("AdmitRole", "iot:DescribeCertificate", CERTIFICATES)
                # Whoever watches or drives may watch or drive every robot, under any name of its own kind.
                of_people = service == PEOPLE and re.search(r"/(live|view|cmd)/iort/\*$|/iort-\w+-\*$", named)
                assert "*" not in named or of_provisioning or of_the_hook or of_people
    assert wild == EVERY_RESOURCE
    # Only roles' and robots' policies grant; no managed policy does.
    kinds = {r["Type"] for t in synthesized.templates.values() for r in t["Resources"].values()}
    assert {k for k in kinds if k.startswith("AWS::IAM::")} == {"AWS::IAM::Role", "AWS::IAM::Policy"}
    assert {k for k in kinds if k.endswith("Permission")} == {"AWS::Lambda::Permission"}


def test_a_function_may_be_called_only_by_its_rule_or_template(synthesized, reader):
    called = set()
    for stack in synthesized.templates:
        for permission in synthesized.resources("AWS::Lambda::Permission", stack).values():
            assert permission["Action"] == "lambda:InvokeFunction"
            assert permission["Principal"] == "iot.amazonaws.com"
            assert permission["SourceAccount"] == {"Ref": "AWS::AccountId"}
            source, function = permission["SourceArn"], reader.text(permission["FunctionName"])
            if "Fn::GetAtt" in source:
                # A rule and a function may share a name; this is the rule.
                rule = synthesized.templates[stack]["Resources"][source["Fn::GetAtt"][0]]
                assert rule["Type"] == "AWS::IoT::TopicRule"
            called.add((reader.text(source), function))
    assert called == {
        ("Live.Arn", "Live.Arn"),
        ("Echo.Arn", "Echo.Arn"),
        ("Upload.Arn", "Upload.Arn"),
        ("Ask.Arn", "Answer.Arn"),
        ("Presence.Arn", "Presence.Arn"),
        ("Version.Arn", "Presence.Arn"),
        ("Fault.Arn", "Alert.Arn"),
        ("Battery.Arn", "Alert.Arn"),
        (f"{IOT}:provisioningtemplate/iort-robot", "Admit.Arn"),
    }


def test_queues_are_encrypted_and_require_tls(synthesized, reader):
    queues = {name: properties for name, _, _, properties in qualified(synthesized, "AWS::SQS::Queue")}
    assert queues.keys() == {"Rejected", "Last", "PutOff", "ArchiveTasks"}
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
    assert closed == {"Rejected.Arn", "Last.Arn", "PutOff.Arn", "ArchiveTasks.Arn"}


def test_no_template_holds_a_password_an_account_or_a_path_of_this_machine(synthesized):
    text = json.dumps(dict(synthesized.templates))
    from stacks.settings import ROOT

    # An account id has twelve digits; a retention in seconds or a queue's name does not.
    assert not re.search(r"(?<![0-9a-f])\d{12}(?![0-9a-f])", text)
    assert str(ROOT) not in text
    assert str(synthesized.folder) not in text
    assert not re.search(r"aws_secret|password", text)
