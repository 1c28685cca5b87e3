"""Settings of the whole account: Device Defender's audit and AWS IoT's log.

An account has one of each per region. This stack fails where they are already configured, so it is built
only on request (`device_defender`, `iot_log_level`), and deployed last. The embedded cloud has neither.
"""

from __future__ import annotations

from aws_cdk import App, ArnFormat
from aws_cdk import aws_iam as iam
from aws_cdk import aws_iot as iot

from stacks import parts
from stacks.parts import PlatformStack
from stacks.settings import Settings

# The "Audit checks" of certificates, policies, clients and Cognito's identities. The others concern role
# aliases and intermediate authorities, which this platform does not use.
_CHECKS = (
    "AUTHENTICATED_COGNITO_ROLE_OVERLY_PERMISSIVE_CHECK",
    "CA_CERTIFICATE_EXPIRING_CHECK",
    "CA_CERTIFICATE_KEY_QUALITY_CHECK",
    "CONFLICTING_CLIENT_IDS_CHECK",
    "DEVICE_CERTIFICATE_EXPIRING_CHECK",
    "DEVICE_CERTIFICATE_KEY_QUALITY_CHECK",
    "DEVICE_CERTIFICATE_SHARED_CHECK",
    "IOT_POLICY_OVERLY_PERMISSIVE_CHECK",
    "LOGGING_DISABLED_CHECK",
    "REVOKED_CA_CERTIFICATE_STILL_ACTIVE_CHECK",
    "REVOKED_DEVICE_CERTIFICATE_STILL_ACTIVE_CHECK",
    "UNAUTHENTICATED_COGNITO_ROLE_OVERLY_PERMISSIVE_CHECK",
)
# What these checks read. Source: the managed policy AWSIoTDeviceDefenderAudit, without role aliases and the
# services last accessed, which only the disabled checks read.
AUDIT_READS = (
    "cognito-identity:GetIdentityPoolRoles",
    "iam:GetPolicy",
    "iam:GetPolicyVersion",
    "iam:GetRole",
    "iam:GetRolePolicy",
    "iam:ListAttachedRolePolicies",
    "iam:ListRolePolicies",
    "iot:DescribeCACertificate",
    "iot:DescribeCertificate",
    "iot:GetEffectivePolicies",
    "iot:GetLoggingOptions",
    "iot:GetPolicy",
    "iot:GetV2LoggingOptions",
    "iot:ListCACertificates",
    "iot:ListCertificates",
    "iot:ListPolicies",
)
# AWS IoT creates this log group and never expires it; docs/how-to/alarms.md says how to set the retention.
_LOG_GROUP = "AWSIotLogsV2"


class Account(PlatformStack):
    """A daily audit and the log, as the settings ask."""

    def __init__(self, app: App, settings: Settings) -> None:
        super().__init__(app, "account", settings)
        if settings.device_defender:
            self._audit()
        if settings.iot_log_level != "off":
            self._log(settings.iot_log_level)

    def _audit(self) -> None:
        role = parts.service_role(self, "AuditRole")
        role.add_to_policy(iam.PolicyStatement(actions=[*AUDIT_READS], resources=["*"]))
        on = iot.CfnAccountAuditConfiguration.AuditCheckConfigurationProperty(enabled=True)
        audit = iot.CfnAccountAuditConfiguration(
            self,
            "Audit",
            account_id=self.account,
            role_arn=role.role_arn,
            audit_check_configurations=iot.CfnAccountAuditConfiguration.AuditCheckConfigurationsProperty(
                **{name.lower(): on for name in _CHECKS}
            ),
        )
        daily = iot.CfnScheduledAudit(
            self,
            "Daily",
            frequency="DAILY",
            target_check_names=list(_CHECKS),
        )
        audit.node.add_dependency(role)
        daily.node.add_dependency(audit)

    def _log(self, level: str) -> None:
        role = parts.service_role(self, "LogRole")
        streams = self.format_arn(
            service="logs",
            resource="log-group",
            resource_name=f"{_LOG_GROUP}:*",
            arn_format=ArnFormat.COLON_RESOURCE_NAME,
        )
        role.add_to_policy(
            iam.PolicyStatement(
                actions=["logs:CreateLogGroup", "logs:CreateLogStream", "logs:PutLogEvents"],
                resources=[streams],
            )
        )
        log = iot.CfnLogging(
            self,
            "Log",
            account_id=self.account,
            default_log_level=level.upper(),
            role_arn=role.role_arn,
        )
        log.node.add_dependency(role)
