"""Live messages: heard at PubNub and at the broker, shown by `iort watch`, and robots kept awake for them."""

from __future__ import annotations

import json
import threading
from collections import defaultdict
from dataclasses import replace
from types import SimpleNamespace

import pytest
from botocore.exceptions import ClientError
from rich.console import Console

from iort_contract.catalog.derived import Vehicle
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import ContractError
from iort_contract.messages.live import (
    VIEW_LEASE_MS,
    Lease,
    LiveSample,
    decode_lease,
    decode_live_update,
    encode_live,
    lease_topic,
    live_update,
)
from iort_contract.topics import parse_topic
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import viewing
from iort_station.fleet.broker import Broker
from iort_station.fleet.roles import Role
from iort_station.fleet.viewing import Viewer
from iort_station.page.listening import BrokerListener, update_of
from iort_station.page.live import GONE_S, MAX_ROBOTS, STALE_S, FleetWatch, heard_of, problem
from iort_station.page.pubnub import Listener
from testkit.waiting import GUARD_S

LIVE = LiveSample("0badcafe", 7, 1_000_000, 2_000_000, {"speed": 1.5, "temp_motor": -1e9}, 0, 5, 100)


def test_a_cars_own_message_becomes_an_update():
    update = update_of("live/iort/car7/vesc", encode_live(LIVE))
    heard = decode_live_update(json.loads(json.dumps(update)))
    assert (heard.robot, heard.stream, heard.received_ms, heard.lambda_us) == ("car7", "vesc", None, None)
    assert (heard.live.seq, heard.live.sent_us, heard.live.offset_us, heard.live.next_ms) == (
        7,
        2_000_000,
        5,
        100,
    )
    assert heard_of(update, 2_500_000).delay_ms == 500


@pytest.mark.parametrize(
    ("topic", "message"),
    [("live/iort/car7", encode_live(LIVE)), ("live/iort/car7/vesc", b"{}"), ("live/iort/car7/vesc", b"\xff")],
)
def test_a_malformed_message_becomes_an_update_that_is_refused(topic, message):
    update = update_of(topic, message)
    with pytest.raises(ContractError) as refused:
        decode_live_update(update)
    fleet = FleetWatch({})
    fleet.take(update, 0, 0)
    assert (fleet.refused, fleet.cars()) == (1, [])
    told = problem(update, refused.value)
    assert fleet.newest_refused == told
    assert ("of car7: " in told) is (topic == "live/iort/car7/vesc")
    assert update["error"] in told


def test_a_listener_counts_what_is_malformed_and_hears_the_next_one():
    listener = BrokerListener(Cloud(region="eu-west-1"))
    listener._take("live/iort/car7/vesc", b"{}")
    listener._take("live/iort/car7/vesc", encode_live(LIVE))
    assert (listener.malformed, [one.robot for one in listener.heard]) == (1, ["car7"])
    pubnub = Listener(subscribe_key="sub-c-1", robot=None)
    for message in (None, {}, {"hops": {}}, {"hops": {"sent_us": "x"}}):
        pubnub.message(None, SimpleNamespace(message=message, timetoken="1"))
    good = update_of("live/iort/car7/vesc", encode_live(LIVE))
    pubnub.message(None, SimpleNamespace(message=good, timetoken="1"))
    assert (pubnub.malformed, [update.robot for update in pubnub.heard]) == (4, ["car7"])


def test_a_connections_thread_goes_on_after_an_unexpected_exception(caplog):
    taken = []

    def take(_topic, message):
        taken.append(message)
        if len(taken) == 1:
            raise RuntimeError("a fault of the reader")

    cloud = Cloud(region="eu-west-1")
    broker = Broker(cloud, Role(cloud), on_message=take)
    for payload in (b"1", b"2"):
        broker._heard(SimpleNamespace(publish_packet=SimpleNamespace(topic="live/x", payload=payload)))
    assert taken == [b"1", b"2"]
    assert "a fault of the reader" in caplog.text


def test_a_viewers_thread_goes_on_after_an_unexpected_exception(caplog):
    calls, again = [], threading.Event()

    def robots():
        calls.append(None)
        if len(calls) == 2:
            raise RuntimeError("a fault of the viewer")
        if len(calls) > 2:
            again.set()
        return []

    with Viewer(Cloud(region="eu-west-1", access_key_id="x", secret_access_key="x"), robots, every_s=0.01):
        assert again.wait(GUARD_S)
    assert "viewer has failed unexpectedly" in caplog.text


NOW_US = 1_700_000_000_000_000


def update(robot="car1", **sample):
    live = LiveSample("0badcafe", 0, NOW_US - 12_000, NOW_US - 10_000, sample)
    return live_update(robot, VESC_STREAM, live, NOW_US // 1000 - 6, NOW_US - 2_000)


def text(fleet, width=120, now_us=NOW_US):
    console = Console(width=width, file=None, record=True, quiet=False, force_terminal=False)
    with console.capture() as captured:
        console.print(fleet.table(now_us, width))
    return captured.get()


def test_every_car_is_shown_with_its_newest_values():
    fleet = FleetWatch({"car1": Vehicle(4614.0)})
    fleet.take(update(speed=9228, voltage_input=11.72, temperature_pcb=28.4, fault_code=0), 0, NOW_US)
    fleet.take(update("car10", speed=500), 0, NOW_US)
    fleet.take(update("car2", fault_code=5), 0, NOW_US)
    lines = text(fleet).splitlines()
    assert [line.split()[0] for line in lines] == ["car", "car1", "car2", "car10"]
    assert lines[1].split() == ["car1", "online", "2.0", "m/s", "11.7", "28", "10", "ms", "0.0", "s"]
    assert "MOSFET over-temperature (5)" in lines[2]
    assert "500 erpm" in lines[3]


def test_speed_uses_the_cars_gain_and_offset():
    fleet = FleetWatch({"car1": Vehicle(4614.0, 4614.0)})
    fleet.take(update(speed=9228), 0, NOW_US)
    assert "1.0 m/s" in text(fleet)


def test_a_car_becomes_stale_and_then_gone():
    fleet = FleetWatch({})
    fleet.take(update(speed=1), 0, NOW_US)
    (car,) = fleet.cars()
    states = [car.state(NOW_US + int(s * 1e6)) for s in (0, STALE_S + 0.1, GONE_S + 0.1)]
    assert states == ["online", "stale", "gone"]
    assert GONE_S < 5


def test_a_delayed_sample_is_stale():
    fleet = FleetWatch({})
    fleet.take(update(), 0, NOW_US + 2_000_000)
    assert fleet.cars()[0].state(NOW_US + 2_000_000) == "stale"


def test_the_delay_is_measured_on_the_clouds_clock():
    fleet = FleetWatch({})
    behind = update()
    behind["hops"] |= {"sent_us": NOW_US - 3_600_000_000, "offset_us": 3_600_000_000 - 10_000}
    behind["t"] = NOW_US - 3_600_002_000
    fleet.take(behind, 0, NOW_US)
    assert fleet.cars()[0].delay_ms == 10
    assert fleet.cars()[0].state(NOW_US) == "online"


def test_the_table_fits_a_narrow_terminal():
    fleet = FleetWatch({"car1": Vehicle(4614.0)})
    fleet.take(update(speed=9228, voltage_input=11.7, fault_code=5), 0, NOW_US)
    for width in (40, 60, 100):
        assert all(len(line) <= width for line in text(fleet, width).splitlines())
    assert "2.0 m/s" in text(fleet, 40)


def test_an_invalid_update_is_counted():
    fleet = FleetWatch({})
    good = update()
    bad = [7, None, [], {}, {**good, "v": 9}, {**good, "robot": "[red]x"}, {**good, "hops": {}}]
    bad += [{**good, "t": "1"}, {**good, "sample": 3}]
    for each in bad:
        fleet.take(each, 0, NOW_US)
    assert fleet.refused == len(bad)
    assert fleet.cars() == []


def test_the_number_of_robots_is_bounded():
    fleet = FleetWatch({})
    for i in range(MAX_ROBOTS + 3):
        fleet.take(update(f"car{i}"), 0, NOW_US + i)
    assert len(fleet.cars()) == MAX_ROBOTS
    assert fleet.cars()[0].robot == "car3"


LEASE = Lease("0badcafe", 10, VIEW_LEASE_MS)


class ViewedCloud:
    """Keeps the leases that are published, by robot."""

    namespace = "iort"

    def __init__(self, *, refuses=False):
        self.refuses = refuses
        self.heard = defaultdict(list)
        self.renewed = threading.Semaphore(0)

    def client(self, service):
        assert service == "iot-data"
        return self

    def publish(self, *, topic, qos, payload):
        if self.refuses:
            raise ClientError({"Error": {"Code": "ForbiddenException", "Message": "no"}}, "Publish")
        assert qos == 0
        robot = parse_topic(topic).robot
        assert topic == lease_topic(robot, "iort")
        self.heard[robot].append(decode_lease(payload))
        self.renewed.release()


def test_a_viewer_renews_its_leases_and_ends_them():
    cloud = ViewedCloud()
    with viewing.Viewer(cloud, ["a", "b"], rate_hz=2, broker=True, every_s=0.01) as viewer:
        assert set(cloud.heard) == {"a", "b"}, "awake at once"
        for _ in range(6):
            assert cloud.renewed.acquire(timeout=GUARD_S)
    assert viewer.problem == ""
    for leases in cloud.heard.values():
        *held, ended = leases
        assert len(held) >= 3
        assert {(one.viewer, one.rate_hz, one.lease_ms, one.broker) for one in held} == {
            (ended.viewer, 2, VIEW_LEASE_MS, True)
        }
        assert ended.lease_ms == 0


def test_a_robot_that_comes_is_woken_and_one_that_goes_is_let_go():
    cloud = ViewedCloud()
    online = ["a"]
    with viewing.Viewer(cloud, lambda: online, every_s=0.01):
        online[:] = ["b"]
        while not cloud.heard["b"]:
            assert cloud.renewed.acquire(timeout=GUARD_S)
    assert cloud.heard["a"][-1].lease_ms == 0


def test_a_viewer_whose_network_is_gone_ends_soon(monkeypatch):
    monkeypatch.setattr(viewing, "_GOODBYE_S", 0.1)
    cloud = ViewedCloud()
    asked, network = threading.Semaphore(0), threading.Event()

    def robots():
        asked.release()
        # The second time it hangs.
        assert not cloud.heard or network.wait(GUARD_S)
        return ["a"]

    viewer = viewing.Viewer(cloud, robots, every_s=0.01)
    with viewer:
        assert asked.acquire(timeout=GUARD_S)
        assert asked.acquire(timeout=GUARD_S)
    assert viewer._thread.is_alive(), "it did not wait for the network"
    network.set()
    viewer._thread.join(GUARD_S)


def test_who_may_not_wake_robots_is_told_and_looks_on():
    cloud = ViewedCloud(refuses=True)
    with viewing.Viewer(cloud, ["a"]) as viewer:
        assert "cannot be woken" in viewer.problem
    with pytest.raises(StationError, match="cannot be woken"):
        viewing.view(cloud, ["a"], LEASE)
    assert viewing.view(cloud, [], LEASE) == 0


def test_a_car_that_nobody_holds_awake_is_online_until_its_next_message_is_due():
    live = LiveSample("0badcafe", 0, 1_000_000, 1_000_000, {"speed": 1})
    fleet = FleetWatch({})
    fleet.take(live_update("idle", "vesc", replace(live, next_ms=10_000), 1000, 1_000_000), 0, 1_000_000)
    fleet.take(live_update("old", "vesc", live, 1000, 1_000_000), 0, 1_000_000)
    states = [
        [car.state(1_000_000 + round(after_s * 1e6)) for car in fleet.cars()]
        for after_s in (STALE_S + 0.1, 10 + STALE_S - 0.1, 10 + STALE_S + 0.1, 10 + GONE_S + 0.1)
    ]
    assert states == [["online", "stale"], ["online", "gone"], ["stale", "gone"], ["gone", "gone"]]
