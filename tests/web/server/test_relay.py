"""The embedded cloud's relay serves pages of this machine, and no page elsewhere that a browser shows."""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from pathlib import Path

import pytest

from local.network.certificates import Authority
from local.network.relay import Relay

REFUSED, NO_GATEWAY = 403, 502


@pytest.fixture
def relay(tmp_path: Path) -> Iterator[Relay]:
    Authority().write_own(tmp_path / "ca.pem")
    # Nothing listens on port 9.
    with Relay("127.0.0.1", 0, gateway="https://127.0.0.1:9", authority=str(tmp_path / "ca.pem")) as relay:
        yield relay


@pytest.mark.parametrize(
    ("origin", "status"),
    [
        ("http://127.0.0.1:8080", NO_GATEWAY),
        ("http://localhost:8080", NO_GATEWAY),
        ("http://[::1]:8080", NO_GATEWAY),
        (None, NO_GATEWAY),
        ("https://elsewhere.example", REFUSED),
        ("http://127.0.0.1.elsewhere.example", REFUSED),
        ("http://192.0.2.1", REFUSED),
        ("null", REFUSED),
    ],
)
def test_only_a_page_of_this_machine_gets_through(relay: Relay, origin: str | None, status: int) -> None:
    socket = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Protocol": "mqtt"}
    call = {"Content-Type": "application/x-amz-json-1.1", "X-Amz-Target": "AWSCognitoIdentityService.GetId"}
    for method, path, headers in (("GET", "/mqtt", socket), ("POST", "/", call)):
        connection = http.client.HTTPConnection(relay.host, relay.port, timeout=30)
        connection.request(method, path, headers=headers | ({"Origin": origin} if origin else {}))
        assert connection.getresponse().status == status
        connection.close()
