"""Faults between a car and its cloud: every sample is in the table once and in order.

The processes are real: the installed agent, the embedded cloud's broker, and a proxy between the two that is
killed, freezes, resets and delays. Network faults run side by side, each with a car of its own.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

import pytest

from iort_contract.catalog.streams import AGENT_STREAM
from iort_contract.limits import LIVE_MAX_AGE_MS
from iort_station.data.accounts import accounts
from iort_station.fleet import identity, robots
from iort_station.operations import audit
from local.cloud import EmbeddedCloud
from testkit.proxy import FREEZE, PASS, REFUSE, Proxy
from testkit.waiting import GUARD_S, until
from tests.local.data.drives import RATE_HZ, Agent, counted, counter_log
from tests.local.faults.test_uplink import set_status

OUTAGE_S = 60
DRIVE_S = 75
FAKETIME = next(Path("/usr/lib").glob("*/faketime/libfaketime.so.1"), None)
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="mounting needs root")


def _settings(log: Path, port: int, **more):
    return {
        "port": port,
        "queue": {"path": "spool.db", **more.pop("queue", {})},
        "sources": [{"type": "bag", "path": str(log)}],
        **more,
    }


def _killed(proxy: Proxy, over: threading.Event) -> None:
    over.wait(5)
    proxy.mode = REFUSE
    over.wait(OUTAGE_S)
    proxy.mode = PASS


def _frozen(proxy: Proxy, over: threading.Event) -> None:
    over.wait(5)
    proxy.mode = FREEZE
    over.wait(50)
    proxy.mode = PASS


def _reset(proxy: Proxy, over: threading.Event) -> None:
    proxy.reset_every(2)
    over.wait()
    proxy.reset_every(None)


def _slow(proxy: Proxy, over: threading.Event) -> None:
    proxy.latency_s = 0.25
    for _ in range(4):
        if over.wait(10):
            return
        proxy.mode = FREEZE
        over.wait(4)
        proxy.mode = PASS


FAULTS = {"killed": _killed, "frozen": _frozen, "reset": _reset, "slow": _slow}


@pytest.fixture(scope="module")
def drives(embedded: EmbeddedCloud, tmp_path_factory):
    """Run every network fault at once, each with its own car: name -> (car, agent, report)."""
    folder = tmp_path_factory.mktemp("faults")
    log = counter_log(folder / "counter.csv", DRIVE_S)
    finished = {}

    def drive(name, fault):
        over = threading.Event()
        with Proxy("127.0.0.1", embedded.cloud.mqtt_port) as proxy:
            car = robots.add(embedded.cloud, f"fault-{name}", out=folder, settings=_settings(log, proxy.port))
            agent = Agent(car, drain_s=90)
            meddler = threading.Thread(target=fault, args=(proxy, over))
            meddler.start()
            agent.process.wait(DRIVE_S + 300)
            over.set()
            meddler.join()
            finished[name] = (car.robot, agent, agent.report())

    threads = [threading.Thread(target=drive, args=item) for item in FAULTS.items()]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return finished


@pytest.mark.heavy
@pytest.mark.parametrize("name", FAULTS)
def test_a_network_fault_loses_no_sample(embedded, drives, name):
    robot, agent, report = drives[name]
    assert counted(embedded, robot) == list(range(DRIVE_S * RATE_HZ))
    assert report["spool"]["dropped_samples"] == 0
    assert report["streams"]["vesc"]["samples"] == DRIVE_S * RATE_HZ
    until(lambda: audit.samples_summarized(embedded.cloud, robot, "vesc") == DRIVE_S * RATE_HZ)
    if name != "slow":
        assert agent.said("connected to")


def test_the_live_lane_stays_current_while_the_backlog_drains(embedded, bundle, proxy, tmp_path):
    from iort_station.page.pubnub import Listener

    log = counter_log(tmp_path / "counter.csv", 600)
    car = bundle(**_settings(log, proxy.port), live={"when": "always"})
    with Listener(
        robot=car.robot,
        namespace=embedded.namespace,
        **embedded.keys.reading(),
    ) as listener:
        proxy.mode = REFUSE
        agent = Agent(car)
        until(lambda: agent.status().get("spool", {}).get("samples", 0) >= 6 * RATE_HZ)
        passed_us = time.time_ns() // 1000
        proxy.mode = PASS
        until(lambda: len(listener.heard) >= 10)
        agent.stop()
        driven = agent.report()["streams"]["vesc"]["samples"]
    # Live samples were fresh when they left the car; none is from the outage.
    oldest_us = 1000 * LIVE_MAX_AGE_MS
    assert min(heard.hops["sent_us"] for heard in listener.heard) > passed_us
    assert max(heard.hops["sent_us"] - heard.t_us for heard in listener.heard) < oldest_us
    assert counted(embedded, car.robot) == list(range(driven))


@pytest.mark.parametrize("broker", [PASS, REFUSE])
def test_a_killed_agent_resumes_its_queue(embedded, bundle, proxy, tmp_path, broker):
    """Closed batches survive; at most the open batch, one second long, is lost."""
    car = bundle(**_settings(counter_log(tmp_path / "long.csv", 600), proxy.port))
    first = Agent(car)
    until(lambda: first.said("connected to"))
    proxy.mode = broker
    closed = until(lambda: first.told()["streams"].get("vesc", {}).get("stored", 0))
    # Then it has been written, and the next one, too.
    until(lambda: first.told()["streams"]["vesc"]["stored"] >= closed + RATE_HZ)
    first.kill()
    proxy.mode = PASS
    log = counter_log(tmp_path / "counter.csv", 10)
    robots.configure(car, {"sources": [{"type": "bag", "path": str(log)}]})
    Agent(car).report()
    found = counted(embedded, car.robot)
    restart = found.index(0, 1)
    assert found[:restart] == list(range(restart))
    assert restart >= closed
    assert found[restart:] == list(range(10 * RATE_HZ))


@pytest.mark.heavy
def test_a_claimed_robot_that_is_killed_in_an_outage_loses_only_its_open_batch(embedded, proxy, tmp_path):
    """The recommended way to a robot sets no queue, and it is on the disk."""
    claim = identity.claim(embedded.cloud, "claimed-killed", out=tmp_path / "claim")
    car = robots.Bundle("claimed-killed", claim.parent)
    provision = [Path(sys.executable).parent / "iort-agent", "provision", "--config", claim]
    subprocess.run(provision, check=True, timeout=GUARD_S)
    assert "queue" not in car.config.read_text()
    log = counter_log(tmp_path / "long.csv", 600)
    # The written motion command is that of its simulated car.
    settings = {"port": proxy.port, "sources": [{"type": "bag", "path": str(log)}], "downlink": {}}
    robots.configure(car, settings)
    first = Agent(car)
    until(lambda: first.said("connected to"))
    proxy.mode = REFUSE
    until(lambda: first.told()["spool"]["batches"] >= 12)
    closed = first.told()["streams"]["vesc"]["stored"]
    until(lambda: first.told()["streams"]["vesc"]["stored"] >= closed + RATE_HZ)
    first.kill()
    proxy.mode = PASS
    robots.configure(car, {"sources": [{"type": "bag", "path": str(counter_log(tmp_path / "short.csv", 2))}]})
    Agent(car).report()
    found = counted(embedded, car.robot)
    restart = found.index(0, 1)
    assert found[:restart] == list(range(restart))
    assert restart >= closed
    told = accounts(embedded.cloud, car.robot)
    headers = audit.headers(embedded.cloud, car.robot, "vesc")
    vesc = audit.held_against(audit.audit("vesc", headers), told, time.time_ns() // 1000)
    assert (vesc.missing, len(vesc.runs)) == (0, 2)
    (short,) = [one for one in vesc.shortfalls if one.samples is None]
    assert short.cause == "were in open batches, at most one second: the run did not end properly"


@pytest.mark.skipif(FAKETIME is None, reason="libfaketime is not installed: apt install faketime")
def test_samples_survive_a_clock_set_back_an_hour(embedded, bundle, tmp_path):
    log = counter_log(tmp_path / "counter.csv", 600)
    car = bundle(
        queue={"path": "spool.db"}, sources=[{"type": "bag", "path": str(log)}], metrics={"every_s": 1}
    )
    clock = tmp_path / "clock"
    clock.write_text("+0")
    agent = Agent(
        car,
        environment={
            "LD_PRELOAD": str(FAKETIME),
            "FAKETIME_TIMESTAMP_FILE": str(clock),
            "FAKETIME_CACHE_DURATION": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        },
    )
    until(lambda: list(audit.batches(embedded.cloud, car.robot, "vesc")))
    clock.write_text("-1h")

    def offsets_ms():
        own = audit.batches(embedded.cloud, car.robot, AGENT_STREAM)
        return [value for batch in own for value in batch.columns["clock_offset_ms"] if value is not None]

    # The clock is really set, and the car measures the change.
    until(lambda: max(offsets_ms(), default=0) > 3_590_000)
    agent.stop()
    report = agent.report()
    batches = list(audit.batches(embedded.cloud, car.robot, "vesc"))
    values = [int(v) for batch in sorted(batches, key=lambda b: b.seq) for v in batch.columns["speed"]]
    assert values == list(range(report["streams"]["vesc"]["samples"]))
    assert report["spool"]["samples"] == 0


@as_root
def test_recording_recovers_from_a_full_disk(embedded, bundle, proxy, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(disk)], check=True)
    try:
        log = counter_log(tmp_path / "counter.csv", 600)
        settings = _settings(log, proxy.port, queue={"path": str(disk / "spool.db")})
        car = bundle(**settings)
        agent = Agent(car)
        until(lambda: agent.said("connected to"))
        proxy.mode = REFUSE
        filler = disk / "filler"
        with pytest.raises(OSError, match="No space left"):
            filler.write_bytes(bytes(4 * 1024 * 1024))
        until(lambda: agent.status().get("alarms"))
        filler.unlink()
        until(lambda: not agent.told()["alarms"])
        proxy.mode = PASS
        agent.stop()
        taken = agent.report()["streams"]["vesc"]["samples"]
    finally:
        subprocess.run(["umount", str(disk)], check=True)
    assert counted(embedded, car.robot) == list(range(taken))


@pytest.mark.parametrize("damage", ["payloads", "header"])
def test_a_corrupt_spool_is_set_aside(embedded, bundle, proxy, tmp_path, damage):
    """The car's count and the batch numbers reveal the loss. If the file is unreadable, the damage is
    reported. All later batches arrive.
    """
    log = counter_log(tmp_path / "counter.csv", 600)
    car = bundle(**_settings(log, proxy.port), metrics={"every_s": 1})
    proxy.mode = REFUSE
    first = Agent(car)
    until(lambda: first.status().get("spool", {}).get("samples", 0) >= 4 * RATE_HZ)
    first.kill()
    spool = car.folder / "spool.db"
    with closing(sqlite3.connect(spool)) as database:
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        query = "SELECT seq, samples, payload FROM batches WHERE stream = 'vesc' ORDER BY seq"
        written = database.execute(query).fetchall()
    bad, noise = spool.read_bytes(), os.urandom(8192)
    if damage == "header":
        bad, lost, known = noise + bad[8192:], written, 0
    else:
        lost, known = written[1:3], 2
        for _, _, payload in lost:
            assert payload in bad
            bad = bad.replace(payload, noise[: len(payload)])
        noise = noise[: min(len(payload) for _, _, payload in lost)]
    spool.write_bytes(bad)
    kept = [row for row in written if row not in lost]

    proxy.mode = PASS
    second = Agent(car)
    alarms = until(lambda: second.status().get("alarms"))
    (aside,) = car.folder.glob("spool.db.corrupt-*Z")
    assert aside.read_bytes() == bad if damage == "header" else noise in aside.read_bytes()
    for told in (f"set aside as {aside.name}", f"at least {known} lost"):
        assert [told in alarm for alarm in alarms] == [True]
        assert second.said(told)
    until(lambda: audit.last_figures(embedded.cloud, car.robot).get("dropped_batches") == known)
    second.stop()
    report = second.report(status=1 if known else 0)
    assert report["spool"]["dropped_batches"] == known
    assert report["spool"]["dropped_samples"] == sum(samples for _, samples, _ in lost[:known])

    # The table has everything else in order, and each missing number was lost.
    batches = list(audit.batches(embedded.cloud, car.robot, "vesc"))
    stored = [(batch.seq, len(batch.times_us)) for batch in batches]
    assert stored[: len(kept)] == [(seq, samples) for seq, samples, _ in kept]
    found = counted(embedded, car.robot)[sum(samples for _, samples, _ in kept) :]
    assert found == list(range(report["streams"]["vesc"]["samples"]))
    items = audit.headers(embedded.cloud, car.robot, "vesc")
    runs = audit.audit("vesc", items, from_start=True).runs
    missing = [seq for run in runs for gap in run.missing for seq in range(gap.first, gap.last + 1)]
    assert missing == [seq for seq, _, _ in lost[:known]]
    told = accounts(embedded.cloud, car.robot)[report["boot"]].not_recorded()["queue"]
    assert told["damaged_files"] == 1
    assert told.get("dropped_samples", 0) == report["spool"]["dropped_samples"]


def test_no_sample_is_lost_when_a_certificate_is_revoked_and_replaced(embedded, bundle, proxy, tmp_path):
    log = counter_log(tmp_path / "counter.csv", 600)
    car = bundle(**_settings(log, proxy.port))
    agent = Agent(car)
    until(lambda: audit.samples_summarized(embedded.cloud, car.robot, "vesc"))
    # The revocation also ends the session; on AWS, within minutes.
    set_status(embedded, car.robot, "REVOKED")
    until(lambda: agent.said("inactive or revoked"))
    waiting = agent.told()["spool"]["samples"]
    until(lambda: agent.status().get("spool", {}).get("samples", 0) >= waiting + 2 * RATE_HZ)
    status = agent.told()
    assert status["connection"]["connected"] is False
    assert any("inactive or revoked" in trouble["text"] for trouble in status["troubles"])

    iot = embedded.cloud.client("iot")
    (revoked,) = iot.list_thing_principals(thingName=car.robot)["principals"]
    (policy,) = iot.list_attached_policies(target=revoked)["policies"]
    fresh = iot.create_keys_and_certificate(setAsActive=True)
    iot.attach_policy(policyName=policy["policyName"], target=fresh["certificateArn"])
    iot.attach_thing_principal(thingName=car.robot, principal=fresh["certificateArn"])
    contents = {"private.key": fresh["keyPair"]["PrivateKey"], "certificate.pem": fresh["certificatePem"]}
    for name, content in contents.items():
        (car.folder / "new").write_text(content)
        (car.folder / "new").replace(car.folder / name)
    until(lambda: agent.status().get("connection", {}).get("connected"))
    agent.stop()
    report = agent.report()
    assert report["spool"]["dropped_samples"] == report["spool"]["samples"] == 0
    assert counted(embedded, car.robot) == list(range(report["streams"]["vesc"]["samples"]))


@as_root
def test_an_agent_starts_without_name_resolution(embedded, bundle, tmp_path):
    if shutil.which("unshare") is None:
        pytest.skip("unshare is not installed: apt install util-linux")
    log = counter_log(tmp_path / "counter.csv", 6)
    name = "localhost"
    car = bundle(endpoint=name, sources=[{"type": "bag", "path": str(log)}])
    hosts = tmp_path / "hosts"
    hosts.touch()
    mount = f'mount --bind {hosts} /etc/hosts && exec "$@"'
    agent = Agent(car, before=["unshare", "--mount", "sh", "-c", mount, "sh"])
    until(lambda: agent.said("does not resolve"))
    with hosts.open("a") as file:
        file.write(f"127.0.0.1 {name}\n")
    agent.report()
    assert counted(embedded, car.robot) == list(range(6 * RATE_HZ))
