"""The questions of `make verify-aws` detect a cloud that differs from the assumption: a changed embedded
cloud.
"""

from __future__ import annotations

import json
import time

import pytest

from iort_contract.cloud import fleet_name
from iort_contract.tables import TOPIC
from iort_contract.topics import RECORD, rule_name
from testkit.target import EMBEDDED, Target
from verify.question import Verdict, ask
from verify.questions import ALL


@pytest.fixture(scope="module")
def target(embedded, tmp_path_factory):
    return Target(EMBEDDED, embedded.cloud, tmp_path_factory.mktemp("differs"), embedded, run="differs")


@pytest.fixture(scope="module")
def iot(embedded):
    return embedded.cloud.client("iot")


@pytest.fixture
def asked(target):
    """Return the answer to the question of that name."""
    questions = {question.name: question for question in ALL}
    return lambda name: ask(questions[name], target, time.monotonic)


@pytest.fixture
def rule_with_a_star(iot):
    """Let the rule record store every attribute of a message beside the cloud's keys."""
    name = rule_name("record")
    rule = iot.get_topic_rule(ruleName=name)["rule"]
    names = ("sql", "awsIotSqlVersion", "actions", "errorAction")
    before = {key: rule[key] for key in names if key in rule}
    added = before["sql"].partition(f"topic() AS {TOPIC}")
    with_star = {**before, "sql": f"SELECT *, {added[1]}{added[2]}"}
    assert f"FROM '{RECORD}/" in with_star["sql"]
    iot.replace_topic_rule(ruleName=name, topicRulePayload=with_star)
    yield
    iot.replace_topic_rule(ruleName=name, topicRulePayload=before)


@pytest.fixture
def policy_that_allows_all(iot):
    name = fleet_name()
    before = iot.get_policy(policyName=name)["defaultVersionId"]
    statement = {"Effect": "Allow", "Action": "iot:*", "Resource": "*"}
    document = json.dumps({"Version": "2012-10-17", "Statement": [statement]})
    made = iot.create_policy_version(policyName=name, policyDocument=document, setAsDefault=True)
    yield
    iot.set_default_policy_version(policyName=name, policyVersionId=before)
    iot.delete_policy_version(policyName=name, policyVersionId=made["policyVersionId"])


@pytest.fixture
def template_without_hook(iot):
    name = fleet_name()
    before = iot.describe_provisioning_template(templateName=name)["preProvisioningHook"]
    iot.update_provisioning_template(templateName=name, removePreProvisioningHook=True)
    yield
    iot.update_provisioning_template(templateName=name, preProvisioningHook=before)


@pytest.mark.usefixtures("rule_with_a_star")
def test_a_rule_that_stores_unnamed_attributes_is_detected(asked):
    answer = asked("rules.record_spoofed")
    assert answer.verdict is Verdict.DIFFERS, answer.reason
    assert "unknown" in answer.seen["keys"]


@pytest.mark.usefixtures("policy_that_allows_all")
def test_a_policy_that_allows_everything_is_detected(asked):
    answer = asked("broker.foreign_topic")
    assert answer.verdict is Verdict.DIFFERS, answer.reason
    assert answer.seen["neighbour_heard"] == 1
    answer = asked("broker.another_client_id")
    assert answer.verdict is Verdict.DIFFERS, answer.reason


@pytest.mark.usefixtures("template_without_hook")
def test_a_template_without_its_hook_is_detected(asked):
    answer = asked("provisioning.name_taken")
    assert answer.verdict is Verdict.DIFFERS, answer.reason
    assert answer.seen["certificates"] == 2
