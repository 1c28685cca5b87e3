"""A deployment's requirements for account and region, whatever is deployed there."""

from __future__ import annotations

from functools import partial

from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.catalog.rules import RULES
from iort_contract.cloud import claim_name, fleet_name
from iort_contract.topics import rule_name
from iort_station.cost import report
from iort_station.cost.usage import Usage
from iort_station.errors import StationError
from stacks.settings import UNRESERVED, Settings
from verify.preflight.deployed import resources
from verify.preflight.finding import Clients, Finding, fine, item, known, listed, stops, warning

# The CDK's default synthesizer needs this version of the bootstrap stack; a test compares it with the
# manifest.
BOOTSTRAP = 6
BOOTSTRAP_PARAMETER = "/cdk-bootstrap/hnb659fds/version"
# "CreatePolicyVersion", AWS IoT: with five, one must be deleted first.
POLICY_VERSIONS = 5
# The quotas should suffice for this fleet.
ROBOTS = 100
# Service Quotas' name of AWS IoT Core, and each quota with a fleet's need (cost/report.py).
IOT_CORE = "iotcore"
RULES_QUOTA = "Maximum number of rules per AWS account"
QUOTAS = {
    "Maximum concurrent client connections per account": "IoT Core: connections",
    "Inbound publish requests per second per account": "IoT Core: publishes in",
    "Rule evaluations per second per AWS account": "IoT Core: rule evaluations",
}
CONNECTS_QUOTA = "Connect requests per second per account"
# CloudFormation knows it where Kinesis Video Streams is.
TURN_TYPE = "AWS::KinesisVideo::SignalingChannel"


@item("credentials")
def credentials(clients: Clients, _settings: Settings) -> Finding:
    """Check the credentials and the region."""
    try:
        sts = clients.client("sts")
        answer = sts.get_caller_identity()
    except (BotoCoreError, ClientError, StationError) as error:
        return stops(
            str(error), "set AWS_PROFILE or AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, and AWS_REGION"
        )
    return fine(f"account {answer['Account']}, region {sts.meta.region_name}, as {answer['Arn']}")


@item("bootstrap")
def bootstrap(clients: Clients, _settings: Settings) -> Finding:
    """Check that the CDK's bootstrap stack exists, and is new enough for our templates."""
    ssm = clients.client("ssm")
    answer = known("ParameterNotFound", ssm.get_parameter, Name=BOOTSTRAP_PARAMETER)
    if answer is None:
        return stops("this account and region are not bootstrapped", "`make bootstrap`, once")
    version = int(answer["Parameter"]["Value"])
    if version < BOOTSTRAP:
        return stops(f"version must be {BOOTSTRAP} or newer, got {version}", "`make bootstrap` again")
    return fine(f"version {version}, needed is {BOOTSTRAP}")


@item("AWS IoT's log")
def iot_log(clients: Clients, settings: Settings) -> Finding:
    """Check that the region's one setting is free if `iort_log_level` needs it."""
    options = known("NotConfiguredException", clients.client("iot").get_v2_logging_options) or {}
    # CloudFormation's handler treats a disabled log as free.
    configured = bool(options.get("roleArn")) and not options.get("disableAllLogs")
    said = f"configured ({options.get('defaultLogLevel', 'no level')})" if configured else "not configured"
    if not configured or settings.iot_log_level == "off" or settings.embedded:
        return fine(f"{said}; iot_log_level is {settings.iot_log_level}")
    remedy = "leave `iot_log_level` off, or disable it: `aws iot set-v2-logging-options --disable-all-logs`"
    return _held(clients, settings, "AWS::IoT::Logging", said, remedy)


@item("Device Defender's audit")
def audit(clients: Clients, settings: Settings) -> Finding:
    """Check that the region's one configuration is free if `device_defender` needs it."""
    # CloudFormation's handler also decides by the role: without configuration, AWS answers without one.
    configured = bool(clients.client("iot").describe_account_audit_configuration().get("roleArn"))
    said = "configured" if configured else "not configured"
    wanted = "wanted" if settings.device_defender else "not wanted (device_defender=false)"
    if not configured or not settings.device_defender or settings.embedded:
        return fine(f"{said}; {wanted}")
    remedy = "leave `device_defender` off: the account has its audit"
    return _held(clients, settings, "AWS::IoT::AccountAuditConfiguration", said, remedy)


def _held(clients: Clients, settings: Settings, kind: str, said: str, remedy: str) -> Finding:
    """The finding on a setting that the region has only once, and that is set."""
    if any(one.kind == kind for one in resources(clients, f"{settings.namespace}-account")):
        return fine(f"{said}, by this deployment")
    return stops(
        f"{said}, not by this deployment: the stack account would fail with 'already exists'", remedy
    )


@item("Lambda's concurrency")
def concurrency(clients: Clients, settings: Settings) -> Finding:
    """Check that Lambda 1's reservation leaves enough for the others."""
    lambda_ = clients.client("lambda")
    limit = lambda_.get_account_settings()["AccountLimit"]
    total, unreserved = limit["ConcurrentExecutions"], limit["UnreservedConcurrentExecutions"]
    wanted, held = settings.reserved_for_live, 0
    if wanted and unreserved - wanted < UNRESERVED:
        # An update may hold the reservation already.
        for one in resources(clients, f"{settings.namespace}-processing"):
            if one.kind == "AWS::Lambda::Function" and one.logical_id.startswith("Live"):
                answer = lambda_.get_function_concurrency(FunctionName=one.physical_id)
                held = answer.get("ReservedConcurrentExecutions", 0)
    text = (
        f"{total} concurrent executions, {unreserved} of them unreserved; {wanted} are to be reserved; "
        f"at once {settings.at_once.tasks} archive, and {settings.at_once.drives} analyse"
    )
    if wanted and unreserved + held - wanted < UNRESERVED:
        return stops(
            f"{text}, and Lambda requires {UNRESERVED} unreserved",
            "ask for more ('Service Quotas', AWS Lambda, 'Concurrent executions'), or -c live_concurrency=0",
        )
    if total < UNRESERVED:
        return warning(text, "ask for more before the fleet grows: docs/how-to/deploy.md, Lambda's limit")
    return fine(text)


@item("AWS IoT's quotas")
def quotas(clients: Clients, settings: Settings) -> Finding:
    """Check that our rules fit, and how many robots the quotas allow."""
    service = clients.client("service-quotas")
    values: dict[str, float] = {}
    for operation in ("list_aws_default_service_quotas", "list_service_quotas"):
        quotas = listed(service, operation, "Quotas", ServiceCode=IOT_CORE)
        values.update((one["QuotaName"], one["Value"]) for one in quotas)
    ours = {rule_name(rule, settings.namespace) for rule in RULES}
    others = {rule["ruleName"] for rule in listed(clients.client("iot"), "list_topic_rules", "rules")} - ours
    if RULES_QUOTA in values and len(others) + len(ours) > values[RULES_QUOTA]:
        return stops(
            f"{len(others)} rules of others and {len(ours)} of ours exceed the limit {values[RULES_QUOTA]:g}",
            "remove rules, or ask for more ('Service Quotas', AWS IoT Core)",
        )
    needs = {need.name: need.needed for need in report.needs(Usage())}
    robots = {name: values[name] / needs[need] for name, need in QUOTAS.items() if name in values}
    if CONNECTS_QUOTA in values:
        # After an outage the whole fleet reconnects within a minute.
        robots[CONNECTS_QUOTA] = values[CONNECTS_QUOTA] * 60
    missing = (QUOTAS.keys() | {CONNECTS_QUOTA}) - robots.keys()
    if not robots:
        return warning("AWS reports none of the quotas", "see 'Service Quotas', AWS IoT Core, in the console")
    scarce = min(robots, key=lambda name: robots[name])
    text = f"for {robots[scarce]:,.0f} robots that drive at once; first limit: {scarce}, {values[scarce]:g}"
    if missing:
        text += f"; unknown: {', '.join(sorted(missing))}"
    if robots[scarce] < ROBOTS:
        return warning(text, "ask for more ('Service Quotas', AWS IoT Core) before the fleet grows")
    return fine(text)


@item("spending")
def spending(_clients: Clients, settings: Settings) -> Finding:
    """Say loudly who hears of costs, and what bounds them."""
    lacking = {
        "alarm_email": "nobody hears of an alarm",
        "budget_usd": "nobody hears of the bill before its end of the month",
    }
    missing = {name: why for name, why in lacking.items() if not getattr(settings, name)}
    if not settings.files_days:
        missing["files_days"] = "uploaded files are kept, and paid, for good"
    text = (
        f"telemetry takes at most {settings.telemetry_writes:,} write units a second "
        f"(fleet_robots={settings.fleet_robots})"
    )
    if not missing or settings.embedded:
        return fine(text)
    return warning(
        f"{text}; not set: {'; '.join(f'{name}: {why}' for name, why in missing.items())}",
        "-c alarm_email=you@example.org -c budget_usd=50 (docs/explanation/security.md, what one can spend)",
    )


@item("policy versions")
def policy_versions(clients: Clients, settings: Settings) -> Finding:
    """Check that a changed policy has room for another version."""
    ask = partial(known, "ResourceNotFoundException", clients.client("iot").list_policy_versions)
    names = (fleet_name(settings.namespace), claim_name(settings.namespace))
    answers = {name: ask(policyName=name) for name in names}
    counts = {name: len(answer["policyVersions"]) for name, answer in answers.items() if answer}
    if not counts:
        return fine("no policy yet")
    text = ", ".join(f"{name} has {count} of {POLICY_VERSIONS}" for name, count in counts.items())
    if max(counts.values()) < POLICY_VERSIONS:
        return fine(text)
    return warning(
        f"{text}: AWS IoT takes no other version of a policy that has {POLICY_VERSIONS}",
        "if this deployment changes the policy, delete an old version first: `aws iot list-policy-versions "
        "--policy-name NAME`, `aws iot delete-policy-version --policy-name NAME --policy-version-id 1`",
    )


@item("relays for video")
def relays(clients: Clients, settings: Settings) -> Finding:
    """Check that the region has Kinesis Video Streams if `turn` needs it."""
    if not settings.turn:
        return fine("not wanted (turn=false)")
    ask = clients.client("cloudformation").describe_type
    if known("TypeNotFoundException", ask, Type="RESOURCE", TypeName=TURN_TYPE) is None:
        return stops(
            f"this region has no Kinesis Video Streams: CloudFormation does not know {TURN_TYPE}",
            "deploy without -c turn=true, and give car.yaml a server of your own (`video.turn`), or choose "
            "another region",
        )
    return fine("this region has Kinesis Video Streams; turn=true")


ITEMS = (bootstrap, iot_log, audit, concurrency, quotas, spending, policy_versions, relays)
