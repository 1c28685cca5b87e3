"""Settings that follow from the account: what the operator does not give, `make deploy` hands to the CDK."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError

from iort_station.errors import StationError
from stacks.settings import NEW_ACCOUNT, Settings
from verify.preflight.finding import Clients


def account_concurrency(clients: Clients, _settings: Settings) -> str:
    """What the account's functions may have at once, by Lambda's GetAccountSettings."""
    total = clients.client("lambda").get_account_settings()["AccountLimit"]["ConcurrentExecutions"]
    # Fewer than ever a new account had are planned as such a one's.
    return str(max(NEW_ACCOUNT, int(total)))


# By the context's key. Each is asked with the settings as they were given; what it raises leaves the default.
DERIVED: Mapping[str, Callable[[Clients, Settings], str]] = {"account_concurrency": account_concurrency}


def derive(clients: Clients, given: Mapping[str, Any]) -> dict[str, str]:
    """The context that the account gives, by key, without what is ``given``."""
    settings, answers = Settings.read(given.get), dict[str, str]()
    for key, ask in DERIVED.items():
        if key not in given:
            try:
                answers[key] = ask(clients, settings)
            except (BotoCoreError, ClientError, StationError):
                # The preflight's item about the same tells why.
                continue
    return answers
