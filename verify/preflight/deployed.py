"""Checks the deployment of the same namespace: its stacks, other resources with its names, and settings that
cannot change in one step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.catalog.rules import RULES
from iort_contract.cloud import IOT, PUBNUB, claim_name, fleet_name, pubnub_parameter
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.topics import check_namespace, rule_name
from iort_station.errors import StationError
from stacks.settings import NEW_ACCOUNT, PROD, Settings
from verify.preflight.finding import Clients, Finding, fine, item, known, listed, stops, warning

# Every stack that app.py may create, in the order of deployment; a test compares it with the app.
STACKS = (
    *("storage", "quarantine", "fleet", "processing", "ingest", "archive", "analysis", "monitoring", "site"),
    "account",
)
_WAYS = {PUBNUB: "PubNub", IOT: "AWS IoT"}
# In these states neither CloudFormation nor the CDK can continue.
_STUCK = {
    "ROLLBACK_COMPLETE": "its first deployment failed: delete it (`aws cloudformation delete-stack`)",
    "ROLLBACK_FAILED": "its first deployment failed: delete it (`aws cloudformation delete-stack`)",
    "CREATE_FAILED": "its first deployment failed: delete it (`aws cloudformation delete-stack`)",
    "DELETE_FAILED": "its deletion failed: its events say what stayed; delete it again",
    "REVIEW_IN_PROGRESS": "its change set was never executed: delete the stack, it is empty",
    "UPDATE_ROLLBACK_FAILED": "`aws cloudformation continue-update-rollback`, then deploy again",
}


class Resource(NamedTuple):
    """A resource of a deployed stack."""

    kind: str
    logical_id: str
    physical_id: str


def stack(clients: Clients, name: str) -> dict[str, Any] | None:
    """A stack as CloudFormation describes it; None if it does not exist."""
    describe = clients.client("cloudformation").describe_stacks
    answer = known("ValidationError", describe, StackName=name)
    return dict(answer["Stacks"][0]) if answer else None


def resources(clients: Clients, name: str) -> list[Resource]:
    """The resources of a stack; empty if it does not exist."""

    def summaries() -> list[dict[str, str]]:
        client = clients.client("cloudformation")
        return list(listed(client, "list_stack_resources", "StackResourceSummaries", StackName=name))

    return [
        Resource(one["ResourceType"], one["LogicalResourceId"], one["PhysicalResourceId"])
        for one in known("ValidationError", summaries) or ()
        if "PhysicalResourceId" in one and one["ResourceStatus"] != "DELETE_COMPLETE"
    ]


@item("stacks")
def stacks(clients: Clients, settings: Settings) -> Finding:
    """Check that every existing stack can be updated."""
    stacks = {name: stack(clients, name) for name in (f"{settings.namespace}-{noun}" for noun in STACKS)}
    states = {name: str(found["StackStatus"]) for name, found in stacks.items() if found is not None}
    stuck = {name: state for name, state in states.items() if _todo(state)}
    if stuck:
        return stops(
            ", ".join(f"{name} is {state}" for name, state in stuck.items()),
            "; ".join(dict.fromkeys(f"{state}: {_todo(state)}" for state in stuck.values())),
        )
    return fine(
        f"{len(states)} of {len(STACKS)} are there, each can be updated" if states else "none: a first one"
    )


def _todo(state: str) -> str:
    if state in _STUCK:
        return _STUCK[state]
    return "somebody else's deployment is running: wait for its end" if state.endswith("IN_PROGRESS") else ""


@item("names")
def names(clients: Clients, settings: Settings) -> Finding:
    """Check that fixed names are free if the stack that creates them does not exist."""
    taken: list[str] = []
    for noun, look in {"fleet": _things, "ingest": _rules, "monitoring": _dashboards}.items():
        if stack(clients, f"{settings.namespace}-{noun}") is None:
            taken += look(clients, settings.namespace)
    if taken:
        return stops(
            f"exist without their stack: {', '.join(taken)}",
            "delete them, or deploy under another name: -c namespace=...",
        )
    return fine("free, or used by this deployment")


def _things(clients: Clients, namespace: str) -> Iterator[str]:
    iot, fleet, claim = clients.client("iot"), fleet_name(namespace), claim_name(namespace)
    for name, ask in {
        f"thing type {fleet}": partial(iot.describe_thing_type, thingTypeName=fleet),
        f"thing group {fleet}": partial(iot.describe_thing_group, thingGroupName=fleet),
        f"policy {fleet}": partial(iot.get_policy, policyName=fleet),
        f"policy {claim}": partial(iot.get_policy, policyName=claim),
        f"provisioning template {fleet}": partial(iot.describe_provisioning_template, templateName=fleet),
    }.items():
        if known("ResourceNotFoundException", ask) is not None:
            yield name


def _rules(clients: Clients, namespace: str) -> Iterator[str]:
    ours = {rule_name(rule, namespace) for rule in RULES}
    rules = {one["ruleName"] for one in listed(clients.client("iot"), "list_topic_rules", "rules")}
    yield from sorted(f"rule {name}" for name in rules & ours)


def _dashboards(clients: Clients, namespace: str) -> Iterator[str]:
    client, prefix = clients.client("cloudwatch"), f"{namespace}-"
    entries = listed(client, "list_dashboards", "DashboardEntries", DashboardNamePrefix=prefix)
    ours = {f"{prefix}{name}" for name in ("platform", "robots")}
    yield from sorted(f"dashboard {name}" for name in {one["DashboardName"] for one in entries} & ours)


def has_pubnub_keys(clients: Clients, namespace: str) -> bool:
    """Whether something is stored where PubNub's keys belong. It stays encrypted."""
    ask = clients.client("ssm").get_parameter
    return known("ParameterNotFound", ask, Name=pubnub_parameter(namespace)) is not None


def transport(clients: Clients, namespace: str) -> str | None:
    """The deployed way of live messages; None without a deployment."""
    fleet = stack(clients, f"{namespace}-fleet")
    if fleet is None:
        return None
    outputs = {one["OutputKey"]: one["OutputValue"] for one in fleet.get("Outputs", [])}
    # Before there was another way, it had no output.
    return str(outputs.get("LiveTransport", PUBNUB))


@item("live messages")
def live_messages(clients: Clients, settings: Settings) -> Finding:
    """Say which way live messages will take, and warn if it is another one than now."""
    name, wanted = pubnub_parameter(settings.namespace), settings.live_transport
    stored, now = has_pubnub_keys(clients, settings.namespace), transport(clients, settings.namespace)
    keys = f"PubNub's keys are {'' if stored else 'not '}stored in {name}"
    text = f"by {_WAYS[wanted]} (live_transport={wanted}); {keys}"
    if now is not None and now != wanted:
        return warning(
            f"{text}; deployed is {_WAYS[now]}: pages, site and viewers of that way hear nothing more",
            f"-c live_transport={now} keeps it"
            + (", with `iort pubnub` for the keys" if now == PUBNUB and not stored else ""),
        )
    if wanted == PUBNUB and not stored:
        return warning(f"{text}: nobody sees live messages", "`iort pubnub`, or without -c live_transport")
    return fine(text)


@item("changed settings")
def changes(clients: Clients, settings: Settings) -> Finding:
    """Check that the settings may follow those of the deployed stacks."""
    storage = f"{settings.namespace}-storage"
    deployed = stack(clients, storage)
    if deployed is None:
        return fine("nothing is deployed")
    used = _key_users(clients, storage)
    if used and not (settings.customer_key or settings.keep_customer_key):
        return stops(
            f"customer_key was true and is false now: {_used_by(used)} the key, whose "
            "export CloudFormation does not remove, and what is encrypted already would have no key",
            "in two steps: first -c keep_customer_key=true, later without it (docs/how-to/deploy.md)",
        )
    tags = {tag["Key"]: tag["Value"] for tag in deployed.get("Tags", [])}
    if tags.get("stage") == PROD != settings.stage:
        return warning(
            "the deployed stage is prod, the new one is dev: data would no longer be protected",
            "pass -c stage=prod, as always; leave it out only to take the deployment down",
        )
    wanted = {"site": settings.site, "account": settings.account_wide}
    gone = [f"{settings.namespace}-{noun}" for noun, want in wanted.items() if not want]
    gone = [name for name in gone if stack(clients, name) is not None]
    if gone:
        return warning(
            f"deployed, and not among the settings: {', '.join(gone)} (stays as it is)",
            "give the parameter as before, or delete the stack: `aws cloudformation delete-stack`",
        )
    return fine("none that must not be")


def _key_users(clients: Clients, storage: str) -> list[str]:
    """The stacks that import the storage stack's key."""
    client = clients.client("cloudformation")
    # The CDK names an export by its reading, the construct, and a hash.
    prefixes = tuple(f"{storage}:ExportsOutput{how}Key" for how in ("FnGetAtt", "Ref"))
    exports = (one["Name"] for one in listed(client, "list_exports", "Exports"))
    return [user for name in exports if name.startswith(prefixes) for user in _importers(client, name)]


def _importers(client: Any, export: str) -> list[str]:
    try:
        return list(listed(client, "list_imports", "Imports", ExportName=export))
    except ClientError as error:
        # AWS answers with an error if no stack imports it.
        if "not imported" not in str(error):
            raise
        return []


def _used_by(importers: list[str]) -> str:
    names = sorted(set(importers))
    return f"{', '.join(names)} {'imports' if len(names) == 1 else 'import'}"


ITEMS = (stacks, names, live_messages, changes)


def account_concurrency(clients: Clients, _namespace: str) -> str:
    """What the account's functions may have at once, by Lambda's GetAccountSettings."""
    total = clients.client("lambda").get_account_settings()["AccountLimit"]["ConcurrentExecutions"]
    # Fewer than ever a new account had are planned as such a one's.
    return str(max(NEW_ACCOUNT, int(total)))


def live_transport(clients: Clients, namespace: str) -> str:
    """PubNub if its keys are stored. If nobody may look for them, a deployment keeps the way that it has."""
    try:
        return PUBNUB if has_pubnub_keys(clients, namespace) else IOT
    except (BotoCoreError, ClientError):
        if transport(clients, namespace) == PUBNUB:
            return PUBNUB
        raise


# By the context's key. Each is asked with the deployment's namespace; what it raises leaves the default.
DERIVED: Mapping[str, Callable[[Clients, str], str]] = {
    "account_concurrency": account_concurrency,
    "live_transport": live_transport,
}


def namespace_of(given: Mapping[str, Any]) -> str:
    """The deployment's namespace; raises `ContractError` for an invalid one."""
    return check_namespace(given.get("namespace", DEFAULT_NAMESPACE))


def derive(clients: Clients, given: Mapping[str, Any]) -> dict[str, str]:
    """The context that the account gives, by key, without what is ``given``."""
    namespace, answers = namespace_of(given), dict[str, str]()
    for key, ask in DERIVED.items():
        if key not in given:
            try:
                answers[key] = ask(clients, namespace)
            except (BotoCoreError, ClientError, StationError):
                # The preflight's item about the same tells why.
                continue
    return answers
