"""Who may connect, and how a robot gets its certificate."""

from __future__ import annotations

import json
from typing import Any

from aws_cdk import App, CfnOutput, Duration, Stack
from aws_cdk import aws_cognito as cognito
from aws_cdk import aws_iam as iam
from aws_cdk import aws_iot as iot
from aws_cdk import aws_kinesisvideo as kinesisvideo
from aws_cdk import aws_lambda as lambda_

from iort_contract.catalog.environments import RegistryEnvironment
from iort_contract.catalog.streams import DRIVE_STREAM, LOG_STREAM
from iort_contract.cloud import DRIVER, VIEWER, claim_name, client_prefix, fleet_name
from iort_contract.messages.live import LEASE
from iort_contract.messages.video import PICTURE, TO, VIDEO
from iort_contract.tables import PRESENCE, ROBOT_PARAMETER, SERIAL_PARAMETER
from iort_contract.topics import ASK, CMD, FLEET, LIVE, RECORD, SHADOW, VIEW, rule_name
from stacks import parts
from stacks.parts import PlatformStack, allow, function, invoked_by_rule
from stacks.quarantine import Quarantine
from stacks.settings import ALL_ROBOTS, Settings
from stacks.storage import Storage

_COGNITO = "cognito-identity.amazonaws.com"


def public_identity(stack: PlatformStack) -> None:
    """The identity of the page on the web: anybody gets one, without a password, and it only listens.

    For an unauthenticated identity AWS IoT asks the IAM role alone, and no IoT policy ("Authorization with
    Amazon Cognito identities"). It may publish nothing, so it cannot wake a car. It does not hear the agent's
    log, nor who drives.
    """
    pool = cognito.CfnIdentityPool(
        stack,
        "PublicPool",
        allow_unauthenticated_identities=True,
        # The basic flow would hand out a token with which anybody chooses the session's name and length.
        allow_classic_flow=False,
    )
    principal = iam.WebIdentityPrincipal(
        _COGNITO,
        {
            "StringEquals": {f"{_COGNITO}:aud": pool.ref},
            "ForAnyValue:StringLike": {f"{_COGNITO}:amr": "unauthenticated"},
        },
    )
    role = iam.Role(stack, "PublicRole", assumed_by=principal)
    _listens(stack, role, VIEWER, robots=stack.settings.site_robots)
    withheld = [f"{LIVE}/{stack.settings.namespace}/*/{stream}" for stream in (LOG_STREAM, DRIVE_STREAM)]
    # Its subscriptions name no stream, so what counts is the refusal of each message.
    _rule(stack, role, "Receive", "topic", withheld, allow=False)
    _rule(stack, role, "Subscribe", "topicfilter", withheld, allow=False)
    cognito.CfnIdentityPoolRoleAttachment(
        stack, "PublicRoles", identity_pool_id=pool.ref, roles={"unauthenticated": role.role_arn}
    )
    CfnOutput(stack, "PublicPoolId", value=pool.ref)
    CfnOutput(stack, "PublicRobots", value=",".join(stack.settings.site_robots))


def _person(stack: PlatformStack, name: str, *, commands: bool = False) -> iam.Role:
    """A role that people and programs of this account may assume, if their own policy says so.

    Whoever looks hears pictures, and the answers to a viewer whose name it knows: in MQTT a wildcard is a
    whole level, so no subscription to the answers matches two names. It hears no other viewer's offer, and
    cannot answer in a robot's place.
    """
    role = iam.Role(stack, name.capitalize(), assumed_by=iam.AccountRootPrincipal())
    _listens(stack, role, name, robots=ALL_ROBOTS)
    namespace = stack.settings.namespace
    seen = [f"{VIEW}/{namespace}/*/{name}" for name in (PICTURE, f"{TO}*")]
    _rule(stack, role, "Subscribe", "topicfilter", seen)
    _rule(stack, role, "Receive", "topic", seen)
    sent = [f"{VIEW}/{namespace}/*/{name}" for name in (LEASE, VIDEO)]
    _rule(stack, role, "Publish", "topic", sent + [f"{CMD}/{namespace}/*"] * commands)
    CfnOutput(stack, f"{name.capitalize()}Role", value=role.role_arn)
    return role


def _relays(stack: PlatformStack, people: list[iam.Role]) -> None:
    """Relays for video by WebRTC: who looks may ask for short-lived credentials of a channel's TURN servers.
    Nothing is signalled over the channel: no role may connect to it."""
    channel = kinesisvideo.CfnSignalingChannel(stack, "Turn", type="SINGLE_MASTER")
    actions = ["kinesisvideo:GetIceServerConfig", "kinesisvideo:GetSignalingChannelEndpoint"]
    for role in people:
        role.add_to_policy(iam.PolicyStatement(actions=actions, resources=[channel.attr_arn]))
    CfnOutput(stack, "TurnChannel", value=channel.attr_arn)


def _listens(stack: PlatformStack, role: iam.Role, client: str, *, robots: list[str]) -> None:
    namespace = stack.settings.namespace
    named = [f"{LIVE}/{namespace}/{robot}/*" for robot in robots]
    heard = [f"{LIVE}/{namespace}/*"] if robots == ALL_ROBOTS else named
    _rule(stack, role, "Connect", "client", [f"{client_prefix(client, namespace)}*"])
    _rule(stack, role, "Subscribe", "topicfilter", heard)
    _rule(stack, role, "Receive", "topic", heard)


def _rule(
    stack: Stack, role: iam.Role, action: str, kind: str, names: list[str], *, allow: bool = True
) -> None:
    arns = [stack.format_arn(service="iot", resource=kind, resource_name=name) for name in names]
    effect = iam.Effect.ALLOW if allow else iam.Effect.DENY
    role.add_to_policy(iam.PolicyStatement(effect=effect, actions=[f"iot:{action}"], resources=arns))


# A robot's name is its thing name and its client id; the certificate is attached to the thing.
_ME = "${iot:Connection.Thing.ThingName}"
# The policy has no room for each topic by itself, so patterns cover several. In a policy ? is any one
# character, and * any number of them ("Using wildcard characters in MQTT and AWS IoT Core policies").
# A robot subscribes to its pongs, and to its own ping on the path broker.
_PING_OR_PONG = "p?ng"
# Of its own lanes this also allows view: a robot can wake nobody but itself.
_LIVE_OR_PING = "?i??"
# No other lane has a w there.
_ANSWER_OR_VIEW = "???w*"


def provisioning_template(namespace: str) -> dict[str, Any]:
    """The template's body. An existing thing keeps its attributes, and another serial number is refused, so
    that two robots cannot share a name."""
    name = fleet_name(namespace)
    return {
        "Parameters": {ROBOT_PARAMETER: {"Type": "String"}, SERIAL_PARAMETER: {"Type": "String"}},
        "Resources": {
            "certificate": {
                "Type": "AWS::IoT::Certificate",
                "Properties": {"CertificateId": {"Ref": "AWS::IoT::Certificate::Id"}, "Status": "Active"},
            },
            "policy": {"Type": "AWS::IoT::Policy", "Properties": {"PolicyName": name}},
            "thing": {
                "Type": "AWS::IoT::Thing",
                "Properties": {
                    "ThingName": {"Ref": ROBOT_PARAMETER},
                    "ThingTypeName": name,
                    "ThingGroups": [name],
                    "AttributePayload": {"vehicle": "vesc", "serial": {"Ref": SERIAL_PARAMETER}},
                },
                "OverrideSettings": {
                    "AttributePayload": "FAIL",
                    "ThingTypeName": "FAIL",
                    "ThingGroups": "DO_NOTHING",
                },
            },
        },
    }


def claim_policy(stack: Stack, *, namespace: str) -> dict[str, Any]:
    """The IoT policy document of a lasting claim: it allows provisioning with this fleet's template only."""
    asked = (
        "$aws/certificates/create-from-csr/json",
        f"$aws/provisioning-templates/{fleet_name(namespace)}/provision/json",
    )
    answered = [f"{topic}/{answer}" for topic in asked for answer in ("accepted", "rejected")]
    client = f"{claim_name(namespace)}-*"
    return {
        "Version": "2012-10-17",
        "Statement": [
            _allow("iot:Connect", _arns(stack, "client", client)),
            _allow("iot:Publish", _arns(stack, "topic", *asked)),
            _allow("iot:Subscribe", _arns(stack, "topicfilter", *answered)),
            _allow("iot:Receive", _arns(stack, "topic", *answered)),
        ],
    }


def robot_policy(stack: Stack, *, namespace: str) -> dict[str, Any]:
    """The IoT policy document of a robot: its own topics and shadow, and other robots' messages to the fleet.

    AWS allows 2048 characters without white space; a test checks that with the longest names. What a robot
    receives it has subscribed to, so the lanes stand in the statement for subscriptions alone.
    """
    mine = f"{namespace}/{_ME}"
    shadow = f"$aws/things/{_ME}/shadow/name/{SHADOW}"
    publish = (
        # Basic Ingest has the rule in the topic; only these rules are allowed.
        f"$aws/rules/{rule_name('record', namespace)}/{RECORD}/{mine}/*",
        f"$aws/rules/{rule_name('live', namespace)}/{LIVE}/{mine}/*",
        f"{_LIVE_OR_PING}/{mine}/*",
        f"{FLEET}/{mine}/*",
        f"{ASK}/{mine}/*",
    )
    # What every robot hears.
    heard_by_all = (f"{FLEET}/{namespace}/*",)
    subscribe = (
        f"{CMD}/{mine}/*",
        f"{_PING_OR_PONG}/{mine}/*",
        f"{_ANSWER_OR_VIEW}/{mine}/*",
        *heard_by_all,
        f"{shadow}/*",
    )
    return {
        "Version": "2012-10-17",
        "Statement": [
            {
                **_allow("iot:Connect", _arns(stack, "client", _ME)),
                "Condition": {"Bool": {"iot:Connection.Thing.IsAttached": ["true"]}},
            },
            _allow("iot:Publish", _arns(stack, "topic", *publish)),
            _allow(["iot:Publish", "iot:Receive"], _arns(stack, "topic", f"{shadow}/*")),
            _allow("iot:Subscribe", _arns(stack, "topicfilter", *subscribe)),
            _allow("iot:Receive", _arns(stack, "topic", f"*/{mine}/*", *heard_by_all)),
        ],
    }


def _allow(action: str | list[str], resources: list[str]) -> dict[str, Any]:
    return {"Effect": "Allow", "Action": action, "Resource": resources}


def _arns(stack: Stack, kind: str, *names: str) -> list[str]:
    return [stack.format_arn(service="iot", resource=kind, resource_name=name) for name in names]


class Fleet(PlatformStack):
    """The resources to register robots. One policy serves all robots: its variables restrict each certificate
    to the topics of its thing. Viewers and drivers have roles.

    The function Admit decides if a claim may have the name it asks for; ``presence`` keeps the robots' rows.
    """

    def __init__(self, app: App, settings: Settings, *, storage: Storage, quarantine: Quarantine) -> None:
        super().__init__(app, "fleet", settings, storage.encryption)
        namespace = settings.namespace
        self._environment = storage.environment(RegistryEnvironment)
        admit = self._admit(storage)
        self.presence = self._presence(storage, quarantine)
        name = fleet_name(namespace)
        robot_type = iot.CfnThingType(
            self,
            "RobotType",
            thing_type_name=name,
            thing_type_properties=iot.CfnThingType.ThingTypePropertiesProperty(
                thing_type_description="A robot that runs the iort agent",
                searchable_attributes=["vehicle"],
            ),
        )
        robots = iot.CfnThingGroup(self, "Robots", thing_group_name=name)
        policy = iot.CfnPolicy(
            self, "RobotPolicy", policy_name=name, policy_document=robot_policy(self, namespace=namespace)
        )
        iot.CfnPolicy(
            self,
            "ClaimPolicy",
            policy_name=claim_name(namespace),
            policy_document=claim_policy(self, namespace=namespace),
        )
        role = self._provisioning_role(name)
        template = iot.CfnProvisioningTemplate(
            self,
            "Provisioning",
            template_name=name,
            description="Registers a robot that made its own key",
            enabled=True,
            provisioning_role_arn=role.role_arn,
            pre_provisioning_hook=iot.CfnProvisioningTemplate.ProvisioningHookProperty(
                payload_version="2020-04-01", target_arn=admit.function_arn
            ),
            template_body=json.dumps(provisioning_template(namespace)),
        )
        template_arn = self.format_arn(service="iot", resource="provisioningtemplate", resource_name=name)
        asking = parts.may_call(self, "AdmitPermission", admit, source_arn=template_arn)
        # RegisterThing needs them: AWS tests role and hook when it creates the template.
        for needed in (robot_type, robots, policy, role, asking):
            template.node.add_dependency(needed)
        # A viewer sees every car, and may ask it for its live messages and its video; a driver also sends
        # commands.
        people = [_person(self, VIEWER)]
        if settings.drivers:
            people.append(_person(self, DRIVER, commands=True))
        if settings.turn:
            _relays(self, people)
        if settings.public:
            public_identity(self)
        CfnOutput(self, "LiveTransport", value=settings.live_transport)

    def _admit(self, storage: Storage) -> lambda_.Function:
        # AWS IoT waits 5 s for the answer, cold start included. Lambda assigns CPU by memory: this is one
        # core.
        admit = function(self, "Admit", self._environment, memory_mb=1769, timeout_s=4)
        storage.robots.grant(admit, "dynamodb:UpdateItem")
        # Reads the status of an admitted certificate, whose id is unknown at deployment.
        certificates = self.format_arn(service="iot", resource="cert", resource_name="*")
        allow(admit, ["iot:DescribeCertificate"], certificates)
        return admit

    def _presence(self, storage: Storage, quarantine: Quarantine) -> lambda_.Function:
        presence = function(self, "Presence", self._environment)
        # A late event is sorted in or ignored, so long retries are safe.
        invoked_by_rule(presence, quarantine.rejected, age=Duration.hours(6), retries=2)
        storage.may_keep(presence, *PRESENCE)
        return presence

    def _provisioning_role(self, name: str) -> iam.Role:
        """The actions of AWS IoT in the template's name: on this fleet's things, and on certificates.

        AWS does not document the actions that it needs. Its managed policy AWSIoTThingsRegistration has them,
        on every resource; this role has the same actions, without those that this template never uses.
        """
        role = parts.service_role(self, "ProvisioningRole")

        def allow(actions: list[str], *resources: tuple[str, str]) -> None:
            arns = [self.format_arn(service="iot", resource=r, resource_name=n) for r, n in resources]
            role.add_to_policy(
                iam.PolicyStatement(actions=[f"iot:{action}" for action in actions], resources=arns or ["*"])
            )

        group, kind, policy = ("thinggroup", name), ("thingtype", name), ("policy", name)
        things, certificates = ("thing", "*"), ("cert", "*")
        allow(["CreateThing", "UpdateThing"], things, kind)
        allow(["DescribeThing", "ListThingGroupsForThing", "ListThingPrincipals"], things)
        allow(["DescribeThingType"], kind)
        allow(["DescribeThingGroup"], group)
        allow(
            ["AddThingToThingGroup", "RemoveThingFromThingGroup", "UpdateThingGroupsForThing"], things, group
        )
        allow(["DescribeCertificate", "UpdateCertificate"], certificates)
        allow(["AttachPolicy", "AttachPrincipalPolicy", "DetachPolicy"], certificates)
        allow(["AttachThingPrincipal", "DetachThingPrincipal"], things, certificates)
        allow(["GetPolicy", "ListTargetsForPolicy"], policy)
        # These take no resources, or a certificate whose id is not known yet.
        allow(
            [
                "ListAttachedPolicies",
                "ListPolicyPrincipals",
                "ListPrincipalPolicies",
                "ListPrincipalThings",
                "RegisterThing",
            ]
        )
        return role
