"""A finding of the preflight, and its creation from any answer of AWS."""

from __future__ import annotations

import enum
import re
from collections.abc import Callable, Iterator
from functools import partial, wraps
from typing import Any, NamedTuple, Protocol, TypeVar

from botocore.exceptions import BotoCoreError, ClientError

from iort_station.errors import StationError
from stacks.settings import Settings

_DENIED = {"AccessDenied", "AccessDeniedException", "UnauthorizedOperation", "UnauthorizedException"}
_ACTION = re.compile(r"not authorized to perform:? ([a-z0-9-]+:\w+)", re.IGNORECASE)


T = TypeVar("T")


class Verdict(enum.Enum):
    """The meaning of a finding for the deployment."""

    FINE = "fine"
    WARNING = "warning"
    STOPS = "stops"


class Clients(Protocol):
    """Creates clients of AWS' services; `iort_station.cloud.Cloud` is one."""

    def client(self, service: str) -> Any:
        """A boto3 client."""


class Finding(NamedTuple):
    """What an item of the preflight has found; ``do`` is the remedy."""

    verdict: Verdict
    found: str
    do: str = ""
    item: str = ""

    def __str__(self) -> str:
        done = f" -> {self.do}" if self.do else ""
        return f"{self.verdict.value}: {self.item}: {self.found}{done}"


# Nothing to do; the operator should know; the deployment would fail, or lose something.
fine, warning, stops = (partial(Finding, verdict) for verdict in Verdict)
Item = Callable[[Clients, Settings], Finding]


def item(name: str) -> Callable[[Item], Item]:
    """Name a function's finding. A missing answer of AWS is a warning and never stops: the deployment itself
    may need other permissions."""

    def wrap(look: Item) -> Item:
        @wraps(look)
        def ask(clients: Clients, settings: Settings) -> Finding:
            try:
                finding = look(clients, settings)
            except ClientError as error:
                finding = _not_answered(error)
            except (BotoCoreError, StationError) as error:
                finding = warning(f"not answered: {error}", "look at the network and the region")
            return finding._replace(item=name)

        return ask

    return wrap


def known(absent: str, ask: Callable[..., T], **arguments: Any) -> T | None:
    """AWS' answer; None if it is the error with that name, by which AWS says that there is nothing."""
    try:
        return ask(**arguments)
    except ClientError as error:
        if code(error) != absent:
            raise
        return None


def listed(client: Any, operation: str, key: str, **arguments: Any) -> Iterator[Any]:
    """The entries of all pages of a list."""
    for page in client.get_paginator(operation).paginate(**arguments):
        yield from page.get(key, ())


def code(error: ClientError) -> str:
    """AWS' name of an error."""
    return str(error.response["Error"]["Code"])


def _not_answered(error: ClientError) -> Finding:
    if code(error) not in _DENIED:
        return warning(f"not answered: {error}", "ask it by hand, or continue without it")
    named = _ACTION.search(str(error))
    action = named[1] if named else error.operation_name
    text = f"not answered: the permission {action} is missing"
    return warning(text, f"allow {action}, or go on without it")
