"""Who watches and drives at the broker: IAM roles for the operator's people, an identity for everybody."""

from __future__ import annotations

from aws_cdk import CfnOutput, Stack
from aws_cdk import aws_cognito as cognito
from aws_cdk import aws_iam as iam

from iort_contract.catalog.streams import DRIVE_STREAM, LOG_STREAM
from iort_contract.cloud import DRIVER, VIEWER, client_prefix
from iort_contract.topics import CMD, LIVE, VIEW
from stacks.parts.base import PlatformStack
from stacks.settings import ALL_ROBOTS

_COGNITO = "cognito-identity.amazonaws.com"


def viewer(stack: PlatformStack) -> None:
    """The role of a viewer, who sees every car and may ask it for its live messages (`VIEW`)."""
    _person(stack, VIEWER, publishes=[VIEW])


def driver(stack: PlatformStack) -> None:
    """The role of a driver: a viewer who may also send commands."""
    _person(stack, DRIVER, publishes=[VIEW, CMD])


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


def _person(stack: PlatformStack, name: str, *, publishes: list[str]) -> None:
    """A role that people and programs of this account may assume, if their own policy says so."""
    role = iam.Role(stack, name.capitalize(), assumed_by=iam.AccountRootPrincipal())
    _listens(stack, role, name, robots=ALL_ROBOTS)
    topics = [f"{lane}/{stack.settings.namespace}/*" for lane in publishes]
    _rule(stack, role, "Publish", "topic", topics)
    CfnOutput(stack, f"{name.capitalize()}Role", value=role.role_arn)


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
