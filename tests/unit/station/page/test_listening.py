"""Live messages from the broker have the form of Lambda 1's."""

from __future__ import annotations

import json
import threading
from types import SimpleNamespace

import pytest

from iort_contract.limits import ContractError
from iort_contract.messages.live import LiveSample, decode_live_update, encode_live
from iort_station.cloud import Cloud
from iort_station.fleet.broker import Broker
from iort_station.fleet.roles import Role
from iort_station.fleet.viewing import Viewer
from iort_station.page.listening import BrokerListener, update_of
from iort_station.page.live import FleetWatch, heard_of, problem
from iort_station.page.pubnub import _Callback

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
    callback = _Callback(None)
    for message in (None, {}, {"hops": {}}, {"hops": {"sent_us": "x"}}):
        callback.message(None, SimpleNamespace(message=message, timetoken="1"))
    good = update_of("live/iort/car7/vesc", encode_live(LIVE))
    callback.message(None, SimpleNamespace(message=good, timetoken="1"))
    assert (callback.malformed, [one.robot for one in callback.heard]) == (4, ["car7"])


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
        assert again.wait(60)
    assert "viewer has failed unexpectedly" in caplog.text
