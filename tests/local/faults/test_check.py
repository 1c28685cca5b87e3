"""`iort-agent check` of a robot of the embedded cloud, through a proxy with network faults."""

from __future__ import annotations

import ssl
import time
from collections.abc import Callable

import pytest

from iort_agent.config import load_config
from iort_agent.sources import FAIL, OK, WARN, Finding
from iort_agent.verbs import connectivity
from iort_station.fleet import robots
from testkit.proxy import FREEZE, REFUSE, Proxy
from testkit.waiting import GUARD_S


def go(bundle: robots.Bundle, proxy: Proxy) -> dict[str, Finding]:
    robots.configure(bundle, {"port": proxy.port})
    return {one.what: one for one in connectivity.check_connection(load_config(bundle.config))}


def test_the_way_to_a_cloud_that_works(
    bundle: Callable[..., robots.Bundle], proxy: Proxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connectivity, "TIMEOUT_S", GUARD_S)
    monkeypatch.setattr(connectivity, "_FILE_ANSWER_S", GUARD_S)
    car = bundle()
    findings = go(car, proxy)
    assert {one.level for one in findings.values()} == {OK}
    assert list(findings) == [
        "name",
        "route",
        "port",
        "server certificate",
        "broker",
        "rules",
        "files",
        "clock",
    ]
    assert "by a round trip of" in findings["clock"].text
    now_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: now_ns() - 100_000_000_000)
    # Files go to another server, which this machine does not trust.
    monkeypatch.setattr(connectivity, "trusting", lambda _: ssl.create_default_context())
    findings = go(car, proxy)
    assert findings["clock"].level == findings["files"].level == WARN
    assert float(findings["clock"].text.split()[1]) == pytest.approx(-100, abs=30)
    assert "cannot be sent to 127.0.0.1" in findings["files"].text


# Python's `SSLSocket._create` raises without closing what it has made, if the connection is reset before.
LEFT_OPEN = pytest.mark.filterwarnings("ignore:unclosed <ssl.SSLSocket:ResourceWarning")


@pytest.mark.parametrize(
    ("mode", "text"),
    [
        pytest.param(REFUSE, "the connection ends before TLS", marks=LEFT_OPEN),
        (FREEZE, "says nothing for 0.5 s"),
    ],
)
def test_a_broken_network_is_named(
    bundle: Callable[..., robots.Bundle], proxy: Proxy, mode: str, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if mode == FREEZE:
        monkeypatch.setattr(connectivity, "TIMEOUT_S", 0.5)
    proxy.mode = mode
    failed = go(bundle(), proxy)["TLS"]
    assert failed.level == FAIL
    assert text in failed.text
