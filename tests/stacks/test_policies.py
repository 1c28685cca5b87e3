"""Every IAM statement, by role. A grant that tests/stacks/roles.py does not list is an error."""

from __future__ import annotations

import fnmatch
import json
import re

from functions.alert import Notices, causes
from functions.presence import change
from functions.shared.quotas import DAY, Quota
from iort_contract.tables import ADMISSION, FILES_BYTES, FILES_DAY
from tests.stacks.roles import (
    CHANGES,
    KEEPS,
    PEOPLE,
    ROLES,
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


def test_a_function_may_be_called_only_by_a_rule_or_template_of_this_account(synthesized):
    permissions = synthesized.resources("AWS::Lambda::Permission").values()
    assert len(permissions) == 9
    for permission in permissions:
        assert permission["Action"] == "lambda:InvokeFunction"
        assert permission["Principal"] == "iot.amazonaws.com"
        assert permission["SourceAccount"] == {"Ref": "AWS::AccountId"}
        assert permission["SourceArn"]


def test_no_template_holds_a_password_an_account_or_a_path_of_this_machine(synthesized):
    text = json.dumps(dict(synthesized.templates))
    from stacks.settings import ROOT

    # An account id has twelve digits; a retention in seconds or a queue's name does not.
    assert not re.search(r"(?<![0-9a-f])\d{12}(?![0-9a-f])", text)
    assert str(ROOT) not in text
    assert str(synthesized.folder) not in text
    assert not re.search(r"aws_secret|password", text)
