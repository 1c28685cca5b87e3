"""The synthesized policies keep the isolation table, by our own evaluator."""

from __future__ import annotations

import fnmatch
import json
import re
from typing import Any

import pytest
from aws_cdk import Stack

from iort_contract.cloud import claim_name, fleet_name
from iort_contract.topics import FLEET, check_namespace
from stacks.fleet import claim_policy
from stacks.fleet import robot_policy as robots_policy
from tests import isolation
from tests.isolation import CLAIM, CONNECT, DRIVER, EVERYBODY, ROWS, SUBSCRIBE, VIEWER, A, B, Row
from tests.policy import allows
from tests.stacks.roles import IOT, ROLES
from tests.stacks.templates import qualified

PEOPLE = {VIEWER, DRIVER, EVERYBODY}
ACCOUNT = "arn:aws:iot:eu-west-1:123456789012"


@pytest.fixture(scope="module")
def policies(synthesized: Any, reader: Any) -> dict[str, list[dict[str, Any]]]:
    """The IoT policies' statements, with ARNs of one account."""
    return {
        policy["PolicyName"]: [
            {**s, "Resource": [arn.replace(IOT, ACCOUNT) for arn in reader.texts(s["Resource"])]}
            for s in policy["PolicyDocument"]["Statement"]
        ]
        for policy in synthesized.resources("AWS::IoT::Policy").values()
    }


def test_the_isolation_table_is_large_and_has_no_duplicates():
    assert len(ROWS) == len({row[:3] for row in ROWS}) >= 60
    assert {row.who for row in ROWS if row.allowed} == {row.who for row in ROWS if not row.allowed}


@pytest.fixture(scope="module")
def roles(deployment: Any, reader: Any) -> dict[str, list[dict[str, Any]]]:
    """The statements of the roles of whoever watches or drives, with ARNs of one account."""
    template = deployment(drivers=True, site=True, site_robots=["*"]).templates["fleet"]
    policies = [r["Properties"] for r in template["Resources"].values() if r["Type"] == "AWS::IAM::Policy"]
    names = {"Viewer": VIEWER, "Driver": DRIVER, "PublicRole": EVERYBODY}
    return {
        names[role]: [
            {**s, "Resource": [arn.replace(IOT, ACCOUNT) for arn in reader.texts(s["Resource"])]}
            for s in policy["PolicyDocument"]["Statement"]
        ]
        for policy in policies
        if (role := reader.text(policy["Roles"][0])) in names
    }


@pytest.mark.parametrize(
    "row", [row for row in ROWS if row.who in PEOPLE], ids=lambda row: f"{row.who}-{row.does}-{row.what}"
)
def test_the_roles_agree_with_the_isolation_table(roles, row):
    kind = {CONNECT: "client", SUBSCRIBE: "topicfilter"}.get(row.does, "topic")
    arn = f"{ACCOUNT}:{kind}/{row.what}"
    assert allows(roles[row.who], f"iot:{row.does}", arn) == row.allowed
    assert not allows(roles[row.who], f"iot:{row.does}", arn.replace("eu-west-1", "eu-west-2"))


def test_everybody_hears_only_the_robots_of_the_site(deployment, reader):
    template = deployment(site=True, site_robots=[A]).templates["fleet"]
    (policy,) = (
        resource["Properties"]["PolicyDocument"]
        for logical_id, resource in template["Resources"].items()
        if logical_id.startswith("PublicRoleDefaultPolicy")
    )
    statements = [
        {**s, "Resource": [arn.replace(IOT, ACCOUNT) for arn in reader.texts(s["Resource"])]}
        for s in policy["Statement"]
    ]
    for robot, heard in ((A, True), (B, False), ("+", False), (f"{A}-2", False)):
        assert allows(statements, "iot:Subscribe", f"{ACCOUNT}:topicfilter/live/iort/{robot}/+") == heard
        assert allows(statements, "iot:Receive", f"{ACCOUNT}:topic/live/iort/{robot}/vesc") == heard


@pytest.mark.parametrize(
    "row", [row for row in ROWS if row.who not in PEOPLE], ids=lambda row: f"{row.who}-{row.does}-{row.what}"
)
def test_the_policies_agree_with_the_isolation_table(policies, row):
    kind = {CONNECT: "client", SUBSCRIBE: "topicfilter"}.get(row.does, "topic")
    variables = {}
    if row.who != CLAIM and (row.does != CONNECT or row.what == A):
        # A certificate is attached to the thing with the client's id, or to no thing.
        variables = {
            "iot:Connection.Thing.ThingName": A,
            "iot:Connection.Thing.IsAttached": "true",
            "iot:ClientId": A,
        }
    policy = claim_name() if row.who == CLAIM else fleet_name()
    arn = f"{ACCOUNT}:{kind}/{row.what}"
    assert allows(policies[policy], f"iot:{row.does}", arn, variables) == row.allowed
    # Refused without an attached thing, and for the topics of another account or region.
    if row.who != CLAIM:
        assert not allows(policies[policy], f"iot:{row.does}", arn, {}) or not _is_of_a_thing(row)
    assert not allows(policies[policy], f"iot:{row.does}", arn.replace("eu-west-1", "eu-west-2"), variables)


def _is_of_a_thing(row: Row) -> bool:
    """Every robot hears every fleet message; a client that is no robot cannot connect."""
    return not row.what.startswith(f"{FLEET}/")


@pytest.mark.parametrize(
    "action", ["RetainPublish", "UpdateThingShadow", "GetThingShadow", "StartNextPendingJobExecution"]
)
def test_a_robot_may_do_no_other_action(policies, action):
    for statements in policies.values():
        for kind in ("topic", "thing", "client"):
            variables = {"iot:Connection.Thing.ThingName": A, "iot:Connection.Thing.IsAttached": "true"}
            assert not allows(statements, f"iot:{action}", f"{ACCOUNT}:{kind}/{A}", variables)


# --- roles ------------------------------------------------------------------------------------------

ASKED = {
    "AWS::DynamoDB::Table": [(f"dynamodb:{a}", "{}.Arn") for a in isolation.TABLE_ACTIONS],
    "AWS::SQS::Queue": [(f"sqs:{a}", "{}.Arn") for a in isolation.QUEUE_ACTIONS],
    "AWS::S3::Bucket": [(f"s3:{a}", "{}.Arn") for a in isolation.BUCKET_ACTIONS]
    + [(f"s3:{a}", "{}.Arn/" + key) for a in isolation.OBJECT_ACTIONS for key in isolation.OBJECTS],
    "AWS::Lambda::Function": [(f"lambda:{a}", "{}.Arn") for a in isolation.FUNCTION_ACTIONS],
    "AWS::Logs::LogGroup": [(f"logs:{a}", "{}.Arn") for a in isolation.LOG_ACTIONS],
}


def test_every_role_on_every_resource_is_declared_or_refused(synthesized, reader):
    statements: dict[str, list[dict[str, Any]]] = {
        role: [] for role, *_ in qualified(synthesized, "AWS::IAM::Role")
    }
    for _, stack, _, policy in qualified(synthesized, "AWS::IAM::Policy"):
        role = ("ingest/" if stack == "ingest" else "") + reader.text(policy["Roles"][0])
        statements[role] += [
            {**s, "Resource": reader.texts(s["Resource"])} for s in policy["PolicyDocument"]["Statement"]
        ]
    assert statements.keys() == ROLES.keys(), "declare what a new role may do in tests/stacks/roles.py"
    wanted = [
        (f"ssm:{a}", f"{IOT.replace(':iot:', ':ssm:')}:parameter/iort/pubnub")
        for a in isolation.PARAMETER_ACTIONS
    ]
    wanted += [("iot:Publish", f"{IOT}:topic/{topic}") for topic in isolation.TOPICS]
    wanted += [("iot:UpdateThingShadow", f"{IOT}:thing/{shadow}") for shadow in isolation.SHADOWS]
    for kind, asked in ASKED.items():
        for name, *_ in qualified(synthesized, kind):
            wanted += [(action, arn.format(name.removeprefix("ingest/"))) for action, arn in asked]
    wrong, refused = [], 0
    for role, granted in statements.items():
        for action, arn in wanted:
            declared = any(action == a and fnmatch.fnmatchcase(arn, r) for a, r in ROLES[role][1])
            refused += not declared
            # These policies contain no variables of the request.
            if allows(_plain(granted), action, arn.replace("${", "{")) != declared:
                wrong.append((role, action, arn, declared))
    assert not wrong
    assert refused > 1000


def _plain(statements: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{**s, "Resource": [arn.replace("${", "{") for arn in s["Resource"]]} for s in statements]


# The IoT permissions of a robot and a claim: every statement. test_isolation.py evaluates them.

ME = "${iot:Connection.Thing.ThingName}"
SHADOW = f"$aws/things/{ME}/shadow/name/agent/*"
FILTERS = (f"cmd/iort/{ME}/*", f"p?ng/iort/{ME}/*", f"???w*/iort/{ME}/*", "fleet/iort/*", SHADOW)
RECEIVE = (f"*/iort/{ME}/*", "fleet/iort/*")
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
            f"{IOT}:topic/?i??/iort/{ME}/*",
            f"{IOT}:topic/fleet/iort/{ME}/*",
            f"{IOT}:topic/ask/iort/{ME}/*",
        ],
    },
    {"Effect": "Allow", "Action": ["iot:Publish", "iot:Receive"], "Resource": [f"{IOT}:topic/{SHADOW}"]},
    {
        "Effect": "Allow",
        "Action": "iot:Subscribe",
        "Resource": [f"{IOT}:topicfilter/{t}" for t in FILTERS],
    },
    {"Effect": "Allow", "Action": "iot:Receive", "Resource": [f"{IOT}:topic/{t}" for t in RECEIVE]},
]

# Provisioning with this fleet's template, and receiving the result.
REQUESTS = (
    "$aws/certificates/create-from-csr/json",
    "$aws/provisioning-templates/iort-robot/provision/json",
)
ANSWERED = [f"{topic}/{answer}" for topic in REQUESTS for answer in ("accepted", "rejected")]
CLAIM_POLICY = [
    {"Effect": "Allow", "Action": "iot:Connect", "Resource": [f"{IOT}:client/iort-claim-*"]},
    {
        "Effect": "Allow",
        "Action": "iot:Publish",
        "Resource": [f"{IOT}:topic/{topic}" for topic in REQUESTS],
    },
    {"Effect": "Allow", "Action": "iot:Subscribe", "Resource": [f"{IOT}:topicfilter/{t}" for t in ANSWERED]},
    {"Effect": "Allow", "Action": "iot:Receive", "Resource": [f"{IOT}:topic/{t}" for t in ANSWERED]},
]


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
    return iot_policies[fleet_name()]


def test_the_iot_policies_have_exactly_these_statements(iot_policies):
    assert iot_policies == {
        fleet_name(): ROBOT_POLICY,
        claim_name(): CLAIM_POLICY,
    }


def test_the_policies_are_within_the_size_limit_in_any_namespace_and_region():
    """ "Policy document size" of AWS IoT Core's quotas: 2048 characters, white space not counted."""
    stack, longest = Stack(), "n" * 16
    real = {"AWS::Partition": "aws-us-gov", "AWS::Region": "ap-southeast-2", "AWS::AccountId": "0" * 12}
    for policy in (robots_policy, claim_policy):
        text = json.dumps(stack.resolve(policy(stack, namespace=check_namespace(longest))))
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
        assert actions(statement) <= {"iot:Connect", "iot:Publish", "iot:Subscribe", "iot:Receive"}
        for resource in statement["Resource"]:
            if ME not in resource:
                assert actions(statement) <= {"iot:Subscribe", "iot:Receive"}
                assert resource.endswith("/fleet/iort/*")
            # A wildcard stands only below the thing's own level, or for the lane of what was subscribed to.
            # No other variable is trusted.
            lanes = {
                f"{IOT}:topic/*/iort/{ME}/*": "iot:Receive",
                f"{IOT}:topicfilter/???w*/iort/{ME}/*": "iot:Subscribe",
            }
            if actions(statement) != {lanes.get(resource)}:
                assert "*" not in resource.removesuffix("/*")
            assert set(re.findall(r"\$\{iot:[^}]*\}", resource)) <= {ME}


def actions(statement):
    given = statement["Action"]
    return {given} if isinstance(given, str) else set(given)
