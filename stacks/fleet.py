"""Who may connect, and how a robot gets its certificate."""

from __future__ import annotations

import json

from aws_cdk import App, CfnOutput, Duration
from aws_cdk import aws_iam as iam
from aws_cdk import aws_iot as iot
from aws_cdk import aws_lambda as lambda_

from iort_contract.catalog.environments import RegistryEnvironment
from iort_contract.cloud import claim_name, fleet_name
from iort_contract.tables import PRESENCE
from stacks.parts import iot_core, viewers
from stacks.parts.base import PlatformStack
from stacks.parts.documents import claim_policy, provisioning_template, robot_policy
from stacks.parts.function import allow, function, invoked_by_rule
from stacks.quarantine import Quarantine
from stacks.settings import Settings
from stacks.storage import Storage


class Fleet(PlatformStack):
    """The resources to register robots. One policy serves all robots: its variables restrict each certificate
    to the topics of its thing. Viewers and drivers have roles (`stacks.parts.viewers`).

    The function Admit decides if a claim may have the name it asks for; ``presence`` keeps the robots' rows.
    """

    def __init__(self, app: App, settings: Settings, *, storage: Storage, quarantine: Quarantine) -> None:
        super().__init__(app, "fleet", settings, storage.encryption)
        namespace = settings.namespace
        self._environment = RegistryEnvironment(namespace, storage.robots.table_name)
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
        asking = iot_core.may_call(self, "AdmitPermission", admit, source_arn=template_arn)
        # RegisterThing needs them: AWS tests role and hook when it creates the template.
        for needed in (robot_type, robots, policy, role, asking):
            template.node.add_dependency(needed)
        viewers.viewer(self)
        if settings.drivers:
            viewers.driver(self)
        if settings.public:
            viewers.public_identity(self)
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
        role = iot_core.role(self, "ProvisioningRole")

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
