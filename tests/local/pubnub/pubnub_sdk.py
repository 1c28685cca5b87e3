"""PubNub's SDK and plain requests, for tests of the stand-in."""

from __future__ import annotations

import http.client
import json

from pubnub.enums import PNReconnectionPolicy
from pubnub.pnconfiguration import PNConfiguration
from pubnub.pubnub import PubNub

from testkit.waiting import GUARD_S

WAIT_S = GUARD_S


def sdk(standin, *, publish_key="pub", subscribe_key="sub", uuid="car"):
    """Make a client of the real SDK; stop it before the server stops."""
    configuration = PNConfiguration()
    configuration.publish_key, configuration.subscribe_key = publish_key, subscribe_key
    configuration.uuid, configuration.origin, configuration.ssl = uuid, standin.origin, False
    configuration.daemon, configuration.disable_config_locking = True, False
    configuration.reconnect_policy = PNReconnectionPolicy.LINEAR
    configuration.reconnection_interval = 0.1
    return PubNub(configuration)


def publish(pubnub, channel, message, *, post=False):
    return pubnub.publish().channel(channel).message(message).use_post(post).sync()


def ask(standin, path, method="GET", body=None, headers=None):
    connection = http.client.HTTPConnection(standin.host, standin.port, timeout=WAIT_S)
    try:
        connection.request(method, path, body, headers or {})
        response = connection.getresponse()
        return response, response.read().decode()
    finally:
        connection.close()


def poll(standin, channels, token, **arguments):
    response, body = ask(standin, f"/v2/subscribe/sub/{channels}/0?tt={token}&uuid=raw", **arguments)
    assert response.status == 200, body
    answer = json.loads(body)
    return answer["t"]["t"], answer["m"]


PAYLOADS = [
    {"v": 1, "sample": {"speed": 1.5, "fault_code": 0, "note": None, "ok": True}},
    {"text": "Grüße, 世界, 🚗 \u2028 \u0000"},
    {"html": "<script>alert('&amp;')</script> \"quoted\" \\ / ?a=b&c=d#e %2F %"},
    [1, [2.5, -0.1], 2**63, 1e308],
    "text, with/slash",
    0,
    False,
]
