"""Settings that follow from the account: what the operator does not give, `make deploy` hands to the CDK."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.cloud import IOT, PUBNUB
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.topics import check_namespace
from iort_station.errors import StationError
from stacks.settings import NEW_ACCOUNT
from verify.preflight.deployed import has_pubnub_keys, transport
from verify.preflight.finding import Clients


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
