"""Cars that publish to PubNub's stand-in as Lambda 1 would, one message at a time."""

from __future__ import annotations

import http.client
import json
import time

from iort_contract.catalog.derived import F1TENTH
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.cloud import channel as pubnub_channel
from iort_contract.messages.live import LiveSample, live_update
from testkit.waiting import GUARD_S

# Of a page that hears nobody.
SETTINGS = {"namespace": "iort", "subscribe_key": "sub-c-1", "origin": "127.0.0.1:9", "tls": False}
PUBLISH_KEY, SUBSCRIBE_KEY = "pub-local", "sub-local"
GAIN = F1TENTH.speed_to_erpm_gain
SAMPLE = {
    "voltage_input": 11.65,
    "temperature_pcb": 29.9,
    "current_motor": 3.96,
    "current_input": -5.27,
    "speed": -12_020,
    "duty_cycle": -0.127,
    "charge_drawn": 19,
    "energy_drawn": 222,
    "displacement": -4044,
    "fault_code": 0,
}


class Car:
    """Publishes live updates over plain HTTP, as Lambda 1 does."""

    def __init__(self, pubnub, name="car-1", boot="0a1b2c3d"):
        self.pubnub, self.name, self.boot, self.seq = pubnub, name, boot, 0

    def update(self, sample=SAMPLE, **change):
        now_us = time.time_ns() // 1000
        live = LiveSample(self.boot, self.seq, now_us - 12_000, now_us - 10_000, dict(sample))
        self.seq += 1
        stream = change.pop("stream", VESC_STREAM)
        return {
            **live_update(self.name, stream, live, now_us // 1000 - 6, now_us - 2_000),
            **change,
        }

    def send(self, sample=SAMPLE, **change):
        update = self.update(sample, **change)
        self.publish(update)
        return update

    def publish(self, message, channel=None):
        host, port = self.pubnub.origin.split(":")
        connection = http.client.HTTPConnection(host, int(port), timeout=GUARD_S)
        path = f"/publish/{PUBLISH_KEY}/{SUBSCRIBE_KEY}/0/{channel or pubnub_channel(self.name)}/0"
        connection.request("POST", path, json.dumps(message), {"Content-Type": "application/json"})
        assert connection.getresponse().status == 200
        connection.close()
