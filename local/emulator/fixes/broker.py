"""Fixes of the MQTT broker: who is served, on which port, with which certificate, and how fast."""

from __future__ import annotations

import os
import ssl
from collections.abc import Awaitable, Callable, Iterable, Iterator
from contextlib import suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any

from ministack import app
from ministack.services import iot


def close_client_certificate() -> None:
    """MQTT over TLS needs a client certificate.

    AWS: authenticates a client on port 8883 by its certificate
      (https://docs.aws.amazon.com/iot/latest/developerguide/x509-client-certs.html).
    ministack: serves a client without a certificate as its own account, without policies.
    Test: tests/local/identity/test_isolation.py::test_a_client_without_a_certificate_cannot_connect
    Patch: none; ministack serves such clients on purpose, so upstream would have to agree on a switch first
    """
    iot._mtls_serve_conn = _for_a_certificate(iot._mtls_serve_conn)


def _for_a_certificate(serve: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(serve)
    async def serve_connection(reader: Any, writer: Any) -> None:
        tls = writer.get_extra_info("ssl_object")
        if tls is None or not tls.getpeercert(binary_form=True):
            await iot._mtls_close(writer)
        else:
            await serve(reader, writer)

    return serve_connection


# The topic of the message that asks for subscriptions next; taken by the first who asks.
_ASKED: ContextVar[list[str] | None] = ContextVar("asked", default=None)


def close_delivery_time() -> None:
    """The time of a delivery.

    AWS: does not apply; what a message costs AWS does not depend on the other subscriptions
      (https://docs.aws.amazon.com/iot/latest/developerguide/topics.html).
    ministack: compares every message with every subscription of every client. With 150 robots that takes 1.2
      ms. Here it compares those that a tree of the filters' levels leaves: 0.01 ms.
    Test: tests/local/emulator/test_time_fixes.py::test_a_message_meets_the_subscriptions_that_match
    Patch: none; it is about speed only, so that upstream should measure it with its own load
    """
    iot._subscriptions = Subscriptions()
    iot.broker_publish = asking(iot.broker_publish)


@dataclass
class _Node:
    """A level of filters: what may follow, and the filter that ends here."""

    next: dict[str, _Node] = field(default_factory=dict)
    filter: str | None = None


class Subscriptions(dict[str, Any]):
    """The subscriptions by filter. While a message is published, `values` gives those that may match."""

    def __init__(self) -> None:
        super().__init__()
        self._root = _Node()

    def setdefault(self, filter_: str, default: Any = None) -> Any:
        """As a dictionary does."""
        node = self._root
        for level in filter_.split("/"):
            node = node.next.setdefault(level, _Node())
        node.filter = filter_
        return super().setdefault(filter_, default)

    def pop(self, filter_: str, *default: Any) -> Any:
        """As a dictionary does."""
        path, node = [], self._root
        for level in filter_.split("/") if filter_ in self else ():
            path.append((node, level))
            node = node.next[level]
        node.filter = None
        for parent, level in reversed(path):
            if parent.next[level].next or parent.next[level].filter:
                break
            del parent.next[level]
        return super().pop(filter_, *default)

    def clear(self) -> None:
        """As a dictionary does."""
        super().clear()
        self._root = _Node()

    def values(self) -> Iterable[Any]:  # type: ignore[override]  # a list, where a dict has a view
        """All subscriptions, or those that may match the message."""
        asked = _ASKED.get()
        return [self[filter_] for filter_ in self._matching(asked.pop())] if asked else super().values()

    def _matching(self, topic: str) -> Iterator[str]:
        nodes = [self._root]
        for level in topic.split("/"):
            for node in nodes:
                if (rest := node.next.get("#")) and rest.filter:
                    yield rest.filter
            nodes = [one for node in nodes for key in (level, "+") if (one := node.next.get(key))]
        yield from (node.filter for node in nodes if node.filter)


def asking(publish: Callable[..., Any]) -> Callable[..., Any]:
    """A publish whose topic is known to the `Subscriptions`."""

    @wraps(publish)
    async def broker_publish(account: str, region: str, topic: str, payload: bytes, **rest: Any) -> None:
        # Basic Ingest reaches rules alone, and asks for no subscriptions.
        ingest = topic.startswith(iot._BASIC_INGEST_PREFIX)
        token = _ASKED.set(None if ingest else [iot._scoped_topic(account, region, topic)])
        try:
            await publish(account, region, topic, payload, **rest)
        finally:
            _ASKED.reset(token)

    return broker_publish


def close_https_port() -> None:
    """The gateway takes its own port only.

    AWS: does not apply; the embedded cloud must not take a port of the machine that nobody gave it.
    ministack: with USE_SSL also listens on port 443 where the process may.
    Test: tests/local/emulator/test_listener_fixes.py::test_every_listener_of_the_emulator_is_on_loopback
    Patch: none; ministack takes port 443 on purpose, so upstream would have to agree on a switch first
    """
    app._port_is_bindable = lambda _host, _port: False


_REMEMBERED = 1_024
OF_THE_SQL_ALONE = (
    "_rule_topic_filter",
    "_rule_select_clause",
    "_rule_where_clause",
    "_split_select_items",
    "_split_select_alias",
    "_sql_string_value",
)


def close_rule_time() -> None:
    """The time of a rule.

    AWS: does not apply; what a rule's SQL costs AWS does not show
      (https://docs.aws.amazon.com/iot/latest/developerguide/iot-sql-reference.html).
    ministack: takes the SQL of every rule apart for every message. Here it is taken apart once.
    Test: tests/local/emulator/test_time_fixes.py::test_a_rule_is_taken_apart_once
    Patch: none; it is about speed only, so that upstream should measure it with its own load
    """
    for name in OF_THE_SQL_ALONE:
        setattr(iot, name, lru_cache(_REMEMBERED)(getattr(iot, name)))


# The file with the private key, the certificate and its authority's.
VARIABLE = "IORT_BROKER_CERTIFICATE"


def close_server_certificate() -> None:
    """The broker's certificate is the operator's, and is renewed while it runs.

    AWS: does not apply; its endpoint has AWS' own certificate. One for a custom domain the operator renews
      (https://docs.aws.amazon.com/iot/latest/developerguide/iot-custom-endpoints-configurable-custom.html).
    ministack: issues one by itself for loopback and one name, good for 825 days, and reads it once.
    Test: tests/local/emulator/test_listener_fixes.py::test_the_broker_takes_over_a_renewed_certificate
    Patch: none; the file is in an environment variable, and upstream would want an API like AWS' own
    """
    # Only if there is a certificate.
    if os.environ.get(VARIABLE):
        file = Path(os.environ[VARIABLE])
        iot._mtls_ensure_server_cert = lambda: (file.read_text(), "")
        iot._mtls_context = _following(iot._mtls_context, file)


def _following(
    made: Callable[[], Awaitable[ssl.SSLContext | None]], file: Path
) -> Callable[[], Awaitable[ssl.SSLContext | None]]:
    loaded: dict[ssl.SSLContext, int] = {}

    @wraps(made)
    async def context() -> ssl.SSLContext | None:
        now = os.stat(file).st_mtime_ns  # noqa: PTH116 - asyncio's rule knows Path alone, and this takes microseconds
        found = await made()
        if found is not None and loaded.setdefault(found, now) != now:
            # A file that cannot be read keeps the certificate that is there.
            with suppress(OSError):
                found.load_cert_chain(file)
                loaded[found] = now
        return found

    return context
