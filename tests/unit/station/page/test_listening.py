"""Live messages from the broker have the form of Lambda 1's."""

from __future__ import annotations

import json

import pytest

from iort_contract.limits import ContractError
from iort_contract.messages.live import LiveSample, decode_live_update, encode_live
from iort_station.page.live.heard import heard_of
from iort_station.page.live.listening import update_of

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
    with pytest.raises(ContractError):
        decode_live_update(update_of(topic, message))
