"""What `iort doctor` finds of the servers of a kept cloud."""

from __future__ import annotations

import socket

import pytest

from iort_station import kept
from iort_station.page.background import BackgroundServer
from iort_station.upkeep import doctor
from iort_station.upkeep.deployment import FAIL, OK, WARN
from local.network.certificates import Authority, ServerCertificate

HOST = "127.0.0.1"


@pytest.fixture
def certificate(tmp_path):
    made = ServerCertificate(Authority(), tmp_path / "broker.pem", (HOST,))
    made.renew()
    return made


def found(port, ends_s):
    up = kept.Up(
        version=1,
        versions={},
        started_s=0.0,
        pids={},
        ports={"mqtt": port},
        listen=[],
        page=[],
        certificates=[kept.Certificate(name="broker", file="", hosts=[HOST], ends_s=ends_s)],
        ledger="",
        power_cut=False,
    )
    return {one.what: (one.level, one.text) for one in doctor._addresses(up)}


@pytest.mark.parametrize("later_s", [0, 30 * 86_400])
def test_a_broker_that_shows_another_certificate_than_its_files_is_told(certificate, later_s):
    with BackgroundServer(HOST, 0, tls=certificate.context()) as broker:
        told = found(broker.port, certificate.ends_s() + later_s)
    assert told["servers"][0] == OK
    if later_s:
        level, text = told["broker"]
        assert (level, "not the one in its file" in text) == (WARN, True)
    else:
        assert "broker" not in told


def test_a_broker_without_tls_is_no_broker(certificate):
    with BackgroundServer(HOST, 0) as broker:
        told = found(broker.port, certificate.ends_s())
    assert told["broker"] == (FAIL, "it shows no certificate, so no car can connect")


def test_a_server_that_does_not_listen_is_named():
    with socket.create_server((HOST, 0)) as server:
        port = server.getsockname()[1]
    level, text = found(port, 0.0)["servers"]
    assert (level, text) == (FAIL, f"no answer from mqtt at {HOST}:{port} (Connection refused)")
