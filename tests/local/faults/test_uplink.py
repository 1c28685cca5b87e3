"""The uplink against the embedded cloud's broker, through a proxy with network faults."""

from __future__ import annotations

import logging
import os
import shutil
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import trustme

from iort_agent.common.threads import SystemClock
from iort_agent.mqtt import aws, dispatch
from iort_agent.mqtt.aws import IotCore
from iort_agent.mqtt.client import Broker, Network
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.mqtt.failures import REFUSED, UNSTEADY, Backoff, Pace
from iort_contract.topics import BROKER, CMD, PING, build_topic
from iort_station.fleet import robots
from local.cloud import EmbeddedCloud
from testkit.mqtt import Robot
from testkit.namespaces import NoNamespacesError, machines
from testkit.proxy import FREEZE, PASS, REFUSE, Proxy
from testkit.waiting import until

# linux/rtnetlink.h: notices of IPv4 addresses.
RTMGRP_IPV4_IFADDR = 0x10


class UplinkLog:
    """Records the uplink's notices to its handlers, and the messages on the robot's ping topic."""

    def __init__(self, uplink: IotCore, robot: str) -> None:
        self.connections: list[bool] = []
        self.messages: list[bytes] = []
        self.topic = build_topic(PING, robot, BROKER)
        self.uplink = uplink
        uplink.on_connection(self.connections.append)
        uplink.subscribe(self.topic, lambda message: self.messages.append(message.payload))

    def echo(self, payload: bytes) -> None:
        """Send a message and receive it again, by a subscription."""
        until(lambda: self.uplink.subscribed(self.topic))
        self.uplink.publish(self.topic, payload, qos=1, done=lambda _: None)
        until(lambda: payload in self.messages)


@contextmanager
def connecting(bundle: robots.Bundle, proxy: Proxy, **other: Any) -> Iterator[UplinkLog]:
    files = [bundle.folder / name for name in ("certificate.pem", "private.key", "root-ca.pem")]
    changes = {name: other.pop(name) for name in Broker._fields if name in other}
    broker = Broker("127.0.0.1", proxy.port, bundle.robot, *files)._replace(**changes)
    uplink = IotCore(broker, **{"clock": SystemClock(), "dispatcher": Dispatcher(), **other})
    log = UplinkLog(uplink, bundle.robot)
    uplink.start()
    try:
        yield log
    finally:
        uplink.stop(5.0)


def set_status(embedded: EmbeddedCloud, robot: str, status: str) -> None:
    iot = embedded.cloud.client("iot")
    (arn,) = iot.list_thing_principals(thingName=robot)["principals"]
    iot.update_certificate(certificateId=arn.rsplit("/", 1)[-1], newStatus=status)


def paced(proxy: Proxy) -> bool:
    """Return whether attempts were at most about one a second. On a busy machine one attempt is late and
    the next on time, so all are counted together, and half of the expected time is enough.
    """
    return proxy.attempts[-1] - proxy.attempts[0] >= (len(proxy.attempts) - 1) / 2


def self_signed(folder: Path) -> None:
    unknown = trustme.CA()
    unknown.private_key_pem.write_to_path(str(folder / "private.key"))
    unknown.cert_pem.write_to_path(str(folder / "certificate.pem"))


def test_the_uplink_reconnects_and_resubscribes_after_a_reset(bundle, proxy):
    with connecting(bundle(), proxy) as log:
        log.echo(b"before")
        proxy.reset()
        until(lambda: log.connections[:2] == [True, False])
        log.echo(b"after")
        assert log.connections == [True, False, True]
        status = log.uplink.status()
        assert (status.connected, status.connects) == (True, 2)
        assert "closed the connection" in (status.last_error or "")


class Endless(Backoff):
    def next_s(self, pace: Pace = UNSTEADY) -> float:
        return 3600.0


class Wifi(Network):
    """A network that comes when the test says so."""

    def __init__(self) -> None:
        self.back = threading.Event()

    def close(self) -> None:
        """It hears no notices."""

    def came(self) -> bool:
        came = self.back.is_set()
        self.back.clear()
        return came


def test_a_network_that_comes_back_ends_the_wait(bundle, proxy):
    wifi = Wifi()
    with connecting(bundle(), proxy, backoff=Endless(), network=lambda: wifi) as log:
        log.echo(b"before")
        proxy.reset()
        until(lambda: log.connections == [True, False])
        wifi.back.set()
        log.echo(b"after")


def test_a_network_of_which_the_kernel_tells_ends_the_wait(bundle, proxy, tmp_path):
    """The notices are those of another machine's kernel, which gets an address when the test says so."""
    with ExitStack() as stack:
        try:
            (robot,) = stack.enter_context(machines(tmp_path, "robot"))
        except NoNamespacesError as error:
            pytest.skip(str(error))
        notices = robot.socket(socket.SOCK_RAW, family=socket.AF_NETLINK, bind=(0, RTMGRP_IPV4_IFADDR))
        notices.setblocking(False)
        network = partial(Network, notices)
        log = stack.enter_context(connecting(bundle(), proxy, backoff=Endless(), network=network))
        log.echo(b"before")
        proxy.reset()
        until(lambda: log.connections == [True, False])
        robot.run("ip", "address", "add", "10.77.0.1/24", "dev", "lo")
        log.echo(b"after")


def test_repeated_resets_cause_at_most_one_attempt_a_second(bundle, proxy):
    with connecting(bundle(), proxy):
        proxy.reset_every(0.3)
        assert proxy.wait_attempts(5, 120)
    assert paced(proxy)


def test_refused_connections_are_retried_with_backoff(bundle, proxy, caplog):
    proxy.mode = REFUSE
    with connecting(bundle(), proxy):
        assert proxy.wait_attempts(4, 120)
        proxy.mode = PASS
        assert proxy.wait_attempts(5, 120)
    assert paced(proxy)
    said = [r.getMessage() for r in caplog.records if "cannot connect" in r.message and r.levelno > 10]
    assert len(said) == 2, "one line for the loss, one with the likely cause after three failures in a row"
    assert "again and again" in said[1]


def test_the_uplink_detects_a_frozen_broker(bundle, proxy):
    assert aws.KEEP_ALIVE_S + aws.PING_TIMEOUT_S <= 45
    with connecting(bundle(), proxy, keep_alive_s=2, ping_timeout_s=1) as log:
        log.echo(b"before")
        proxy.mode = FREEZE
        # On a slow machine the broker may have been too late before.
        until(lambda: log.connections[-1] is False)
        assert "no longer answers" in (log.uplink.status().last_error or "")
        proxy.mode = PASS
        log.echo(b"after")


def test_a_takeover_is_reported_as_a_takeover(bundle, proxy, caplog):
    car = bundle()
    with connecting(car, proxy) as log:
        log.echo(b"before")
        with Robot(car.folder) as other:
            other.online()
            until(lambda: log.connections[:2] == [True, False])
        assert f"another client has connected as {car.robot}" in caplog.text


def test_a_revoked_certificate_ends_the_connection(embedded, bundle, proxy, caplog):
    caplog.set_level(logging.INFO)
    car = bundle()
    with connecting(car, proxy) as log:
        log.echo(b"before")
        set_status(embedded, car.robot, "REVOKED")
        # AWS disconnects within minutes; the embedded cloud leaves it to the next connect.
        proxy.reset()
        until(lambda: "inactive or revoked" in caplog.text)
        attempts = len(proxy.attempts)
        errors = [r for r in caplog.records if r.levelno == logging.ERROR]
        assert len(errors) == 1
        assert "`iort-agent check`" in errors[0].getMessage()
        # Attempts are slow now, but immediate after a change of the file.
        assert not proxy.wait_attempts(attempts + 1, 3)
        set_status(embedded, car.robot, "ACTIVE")
        os.utime(car.folder / "certificate.pem")
        log.echo(b"after")


def test_another_robots_name_is_rejected_and_logged_once(bundle, proxy, caplog):
    with connecting(bundle(), proxy, client_id="somebody-else"):
        until(lambda: "does not let it connect" in caplog.text)
        assert not proxy.wait_attempts(2, 3), f"the next attempt is due after {REFUSED.shortest_s} s"
    (error,) = [r for r in caplog.records if r.levelno == logging.ERROR]
    assert "not authorized" in error.getMessage()


def test_the_uplink_connects_after_an_unknown_certificate_is_replaced(bundle, proxy, caplog, tmp_path):
    car = bundle()
    good = tmp_path / "good"
    shutil.copytree(car.folder, good)
    self_signed(car.folder)
    with connecting(car, proxy) as log:
        until(lambda: "certificate is unknown" in caplog.text)
        assert log.connections == []
        for name in ("private.key", "certificate.pem"):
            (good / name).replace(car.folder / name)
        log.echo(b"good")
    assert paced(proxy)


def test_an_expired_certificate_is_reported_as_expired(bundle, proxy, caplog):
    class LateClock(SystemClock):
        def now_us(self) -> int:
            return 40_000_000_000_000_000  # the year 3237

    car = bundle()
    self_signed(car.folder)
    with connecting(car, proxy, clock=LateClock()):
        until(lambda: "certificate expired on" in caplog.text)
        assert not proxy.wait_attempts(2, 2)


def test_a_broker_of_another_authority_is_not_trusted(bundle, proxy, tmp_path, caplog):
    car = bundle()
    self_signed(tmp_path)
    with connecting(car, proxy, root_ca=tmp_path / "certificate.pem") as log:
        # The client deliberately waits up to half a minute after a failed handshake.
        until(lambda: "TLS failed" in caplog.text)
        assert log.connections == []


def test_the_system_trust_store_applies_without_a_root_ca(bundle, proxy, caplog):
    with connecting(bundle(), proxy, root_ca=None) as log:
        until(lambda: "TLS failed" in caplog.text)
        assert log.connections == []


def test_a_rejected_subscription_is_logged_once_and_affects_no_other(bundle, proxy, caplog, monkeypatch):
    monkeypatch.setattr(dispatch, "_AGAIN_S", 0.1)
    monkeypatch.setattr(dispatch, "_AGAIN_SLOWLY_S", 0.1)
    with connecting(bundle(), proxy) as log:
        log.uplink.subscribe("cmd/iort/somebody-else/drive", lambda _: None)
        log.echo(b"good")
        until(lambda: "cannot subscribe" in caplog.text)
        threading.Event().wait(0.5)
        assert caplog.text.count("cannot subscribe") == 1
        assert log.connections == [True]


def test_a_subscription_while_connected_takes_effect(bundle, proxy):
    car = bundle()
    with connecting(car, proxy) as log:
        log.echo(b"before")
        heard: list[bytes] = []
        topic = build_topic(CMD, car.robot, "drive")
        log.uplink.subscribe(topic, lambda message: heard.append(message.payload))
        until(lambda: log.uplink.subscribed(topic))
