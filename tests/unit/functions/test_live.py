"""Live: chosen fields go to the car's channel; faults are counted and fail no invocation."""

from __future__ import annotations

import json
import logging
import math

import boto3
import pytest

from functions import live
from functions.live import REFUSALS, Lane, RefusedError, age_ms
from functions.shared.pubnub_client import PublishError, PubNubPublisher, StoredPublisher
from iort_contract.catalog.environments import LiveEnvironment
from iort_contract.catalog.metrics import metrics_of
from iort_contract.cloud import channel as channel_of
from iort_contract.cloud import pubnub_parameter
from iort_contract.limits import LIVE_MAX_AGE_MS, MAX_PUBNUB_BYTES, SCHEMA_VERSION
from iort_contract.messages.envelope import rule_event
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.tables import MESSAGE_BASE64, RECEIVED_MS, TOPIC
from iort_contract.topics import LIVE, build_topic

T_US = 1_700_000_000_000_000
SENT_US = T_US + 4_000
RECEIVED = (SENT_US + 30_000) // 1000
NOW_US = SENT_US + 35_000
FIELDS = {"vesc": ["speed", "voltage_input"]}
SAMPLE = {"speed": 1200, "voltage_input": 15.8, "fault_code": 0}


def event(stream="vesc", robot="car", namespace="iort", **changes):
    """The event that the live rule makes from a live message."""
    sample = changes.pop("sample", SAMPLE)
    ours = {name: changes.pop(name) for name in (TOPIC, RECEIVED_MS) if name in changes}
    message = json.loads(encode_live(LiveSample("0123abcd", 3, T_US, SENT_US, sample)))
    raw = json.dumps({**message, **changes}).encode()
    return {**rule_event(raw, build_topic(LIVE, robot, stream, namespace), RECEIVED), **ours}


class Channels:
    """A fake PubNub: it records published messages or raises an error."""

    def __init__(self, error=None):
        self.sent, self.error = [], error

    def __call__(self, channel, message):
        if self.error is not None:
            raise self.error
        self.sent.append((channel, message))


def show(message, publish, *, fields=FIELDS, now_us=NOW_US):
    """Process one message in a new environment, which writes its counts at once."""
    Lane(fields, publish).show(message, now_us)


@pytest.fixture
def counted(capsys):
    """The metrics written since the last call, summed by name; every line is checked on the way."""

    def read():
        totals = {}
        for line in capsys.readouterr().out.splitlines():
            entry = json.loads(line, parse_constant=pytest.fail)
            (directive,) = entry["_aws"]["CloudWatchMetrics"]
            for metric in directive["Metrics"]:
                assert metric["Name"] in metrics_of("live")
                value = entry[metric["Name"]]
                value = sum(value) if isinstance(value, list) else value
                totals[metric["Name"]] = totals.get(metric["Name"], 0) + value
        return totals

    return read


def test_the_chosen_fields_go_to_the_cars_channel_with_the_times_of_all_hops(counted):
    channels = Channels()
    show(event(), channels)
    ((channel, message),) = channels.sent
    assert channel == channel_of("car")
    assert message == {
        "v": SCHEMA_VERSION,
        "robot": "car",
        "stream": "vesc",
        "boot": "0123abcd",
        "seq": 3,
        "t": T_US,
        "hops": {"sent_us": SENT_US, "received_ms": RECEIVED, "lambda_us": NOW_US},
        "sample": {"speed": 1200, "voltage_input": 15.8},
    }
    # Without a measured clock offset, the transport time is unknown.
    hops = {"InCarMs": 4, "ToLambdaMs": 5}
    assert counted() == {"LivePublished": 1, **hops}


NOT_FITTED = {"temp_motor": -273.15, "temp_fet": 31.5, "current_motor": -60}


@pytest.mark.parametrize(
    ("fields", "sample", "shown"),
    [
        ({"imu": []}, SAMPLE, SAMPLE),
        ({"vesc": []}, SAMPLE, {}),
        ({"vesc": ["speed", "absent"]}, SAMPLE, {"speed": 1200}),
        # A sensor that is not fitted is null.
        ({}, NOT_FITTED, {**NOT_FITTED, "temp_motor": None}),
        ({"vesc": frozenset({"temp_motor"})}, NOT_FITTED, {"temp_motor": None}),
    ],
)
def test_a_stream_sends_its_configured_fields_or_all(fields, sample, shown):
    channels = Channels()
    show(event(sample=sample), channels, fields=fields)
    assert channels.sent[0][1]["sample"] == shown


def test_each_deployment_has_its_own_channels():
    channels = Channels()
    show(event(namespace="lab2"), channels)
    assert channels.sent[0][0] == channel_of("car", "lab2")


def test_the_topic_names_the_robot_and_the_message_cannot_change_it():
    channels = Channels()
    show(event(robot="mine", channel="iort.other"), channels)
    assert channels.sent[0][0] == channel_of("mine")
    assert channels.sent[0][1]["robot"] == "mine"


@pytest.mark.parametrize(
    ("in_car_ms", "in_cloud_ms", "stale"),
    [
        (0, 0, False),
        (LIVE_MAX_AGE_MS, 0, False),
        (LIVE_MAX_AGE_MS + 1, 0, True),
        (0, LIVE_MAX_AGE_MS, False),
        (0, LIVE_MAX_AGE_MS + 1, True),
        (LIVE_MAX_AGE_MS / 2, LIVE_MAX_AGE_MS / 2, False),
        (LIVE_MAX_AGE_MS / 2 + 1, LIVE_MAX_AGE_MS / 2, True),
    ],
)
# A car whose clock is a day off is as fresh as any other.
@pytest.mark.parametrize("clock_error_us", [0, 86_400_000_000, -86_400_000_000])
def test_a_message_is_stale_after_too_long_in_the_car_and_the_cloud(
    in_car_ms, in_cloud_ms, stale, clock_error_us, counted
):
    sent_us = SENT_US + clock_error_us
    t_us = sent_us - round(in_car_ms * 1000)
    now_us = RECEIVED * 1000 + round(in_cloud_ms * 1000)
    channels = Channels()
    show(event(t=t_us, sent_us=sent_us), channels, now_us=now_us)
    assert age_ms(LiveSample("0123abcd", 0, t_us, sent_us, {}), RECEIVED, now_us) == in_car_ms + in_cloud_ms
    assert len(channels.sent) == (not stale)
    totals = counted()
    assert totals.get("LiveStale", 0) == stale
    assert totals.get("LivePublished", 0) == (not stale)
    # A wrong clock gives no transport time and sets off no alarm.
    assert "CarToLambdaMs" not in totals


MESSAGE = encode_live(LiveSample("0123abcd", 3, T_US, SENT_US, SAMPLE))


def handed(message):
    """An event with any bytes in it."""
    return rule_event(message, build_topic(LIVE, "car", "vesc"), RECEIVED)


def saying(**changes):
    """An event whose message has these keys changed; `...` removes a key."""
    said = {**json.loads(MESSAGE), **changes}
    return handed(json.dumps({name: value for name, value in said.items() if value is not ...}).encode())


MALFORMED = [
    *({key: value for key, value in event().items() if key != gone} for gone in event()),
    *(saying(**{gone: ...}) for gone in json.loads(MESSAGE) if gone != "nonfinite"),
    {},
    event(topic="live/iort/car"),
    event(topic=None),
    event(topic="live/iort/c r/vesc"),
    handed(b""),
    handed(MESSAGE[:-1]),
    handed(b"\xff\x00" + MESSAGE),
    handed(b"[]"),
    saying(v=2),
    saying(v="1"),
    saying(boot="XYZ"),
    saying(seq=-1),
    saying(sample=None),
    saying(sample=[1, 2]),
    saying(sample={"speed": [1]}),
    saying(sample={"": 1}),
    saying(sample={"speed": math.nan}),
    saying(t=1e300),
    saying(sent_us="now"),
    saying(offset_us="0"),
    saying(offset_us=None),
    {**event(), MESSAGE_BASE64: "%"},
    {**event(), MESSAGE_BASE64: {}},
    {**event(), RECEIVED_MS: None},
    {**event(), RECEIVED_MS: "soon"},
    {**event(), RECEIVED_MS: math.inf},
    {**event(), RECEIVED_MS: math.nan},
    {**event(), RECEIVED_MS: {}},
    [],
    [event()],
    "text",
    7,
    None,
]


def test_an_error_of_pubnub_is_counted_and_not_raised(counted, caplog):
    show(event(), Channels(PublishError("status 403")))
    assert counted() == {"PubNubFailed": 1}
    assert "car: status 403" in caplog.text


class Served:
    """One environment of the function, with its results."""

    def __init__(self):
        self.channels, self.refused, self.now_us = Channels(), [], NOW_US
        self.lane = Lane(FIELDS, self.channels)

    def __call__(self, message):
        try:
            self.lane.serve(message, self.now_us)
        except RefusedError as error:
            self.refused.append(str(error))


@pytest.mark.parametrize("malformed", MALFORMED, ids=range(len(MALFORMED)))
def test_a_malformed_message_is_refused_and_counted(malformed, counted):
    served = Served()
    served(malformed)
    assert (len(served.refused), served.channels.sent) == (1, [])
    assert counted() == {"LiveRefused": 1}


def test_a_robot_with_too_many_refusals_is_cut_off_and_others_are_not(counted):
    served = Served()
    for _ in range(REFUSALS + 30):
        served({**handed(b"x"), TOPIC: build_topic(LIVE, "bad", "vesc")})
    # The bad robot's valid messages are dropped too; all other robots' are processed.
    served(event(robot="bad"))
    for i in range(40):
        served(event(robot=f"good{i}"))
    assert ["LiveCutOff" in reason for reason in served.refused] == [*[False] * (REFUSALS - 1), True]
    assert [message["robot"] for _, message in served.channels.sent] == [f"good{i}" for i in range(40)]
    served.now_us += 11_000_000
    # Once it sends valid messages again, they are shown.
    mended = event(robot="bad", t=served.now_us, sent_us=served.now_us)
    served({**mended, RECEIVED_MS: served.now_us // 1000})
    assert served.channels.sent[-1][1]["robot"] == "bad"
    totals = counted()
    assert (totals["LiveRefused"], totals["LiveCutOff"]) == (REFUSALS, 31)
    assert totals["LivePublished"] == 41


def test_a_robot_that_is_refused_once_a_second_is_never_cut_off(counted):
    served = Served()
    for second in range(100):
        served.now_us = NOW_US + second * 1_000_000
        served(handed(b"x"))
    assert len(served.refused) == 100
    # A clock that is set back refills the rate limiter only once.
    served.now_us = NOW_US
    for _ in range(REFUSALS + 1):
        served(handed(b"x"))
    assert "LiveCutOff" in counted()


def test_the_handler_takes_fields_and_publisher_from_its_environment(aws, monkeypatch, invoke, counted):
    parameter = pubnub_parameter("lab2")
    boto3.client("ssm").put_parameter(Name=parameter, Type="SecureString", Value=json.dumps(KEYS))
    given = LiveEnvironment("lab2", parameter, {"vesc": ["speed"], "imu": []}, "queue")
    for name, value in given.variables().items():
        monkeypatch.setenv(name, value)
    # Too old to be sent.
    invoke(live.handler, event())
    assert live.lane().fields == {"vesc": ["speed"], "imu": []}
    assert live.lane() is live.lane()
    assert counted() == {"LiveStale": 1}


# --- the publisher, without a network -------------------------------------------------------------

KEYS = {"publish_key": "pub-c-secret", "subscribe_key": "sub-c-secret"}


@pytest.mark.parametrize(
    ("extra", "origin", "tls"),
    [({}, "ps.pndsn.com", True), ({"origin": "127.0.0.1:9", "tls": False}, "127.0.0.1:9", False)],
)
def test_the_keys_come_from_a_secure_parameter(aws, extra, origin, tls):
    name = pubnub_parameter()
    value = json.dumps({**KEYS, **extra})
    boto3.client("ssm").put_parameter(Name=name, Type="SecureString", Value=value)
    config = PubNubPublisher.from_parameter(name)._client.config
    assert (config.publish_key, config.subscribe_key) == tuple(KEYS.values())
    assert (config.origin, config.ssl) == (origin, tls)
    assert config.connect_timeout == config.non_subscribe_request_timeout == 1


@pytest.mark.parametrize("stored", [None, "no JSON", "[]", '{"publish_key": "pub-c-secret"}'])
def test_without_keys_messages_are_counted_and_nothing_fails(aws, monkeypatch, caplog, counted, stored):
    ssm, name = boto3.client("ssm"), pubnub_parameter("lab3")
    if stored is not None:
        ssm.put_parameter(Name=name, Type="SecureString", Value=stored)
    for key, value in LiveEnvironment("lab3", name, {}, "queue").variables().items():
        monkeypatch.setenv(key, value)
    lane = live.lane()
    for number in range(30):
        lane.serve(event(seq=number), NOW_US + number)
    lane.counted.add(NOW_US / 1e6 + 60, LiveStale=1)
    assert counted()["LiveNotConfigured"] == 30
    # The reason once, and no key in it.
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "iort pubnub" in caplog.text
    assert "secret" not in caplog.text


def test_keys_that_are_stored_later_are_found_without_a_call_for_every_message(aws):
    name, now_s = pubnub_parameter(), [1000.0]
    publisher = StoredPublisher(name, lambda: now_s[0])

    def attempt():
        # Too long for PubNub, so that nothing is sent.
        with pytest.raises(PublishError) as caught:
            publisher.publish("iort.car", {"text": "x" * MAX_PUBNUB_BYTES})
        return str(caught.value)

    assert "iort pubnub" in attempt()
    boto3.client("ssm").put_parameter(Name=name, Type="SecureString", Value=json.dumps(KEYS))
    now_s[0] += 9
    assert "iort pubnub" in attempt()
    now_s[0] += 1
    assert "URL encoding" in attempt()
    boto3.client("ssm").delete_parameter(Name=name)
    assert "URL encoding" in attempt()


def test_keys_that_cannot_be_read_are_a_failure_of_the_dashboard_alone(monkeypatch, counted):
    for name, value in {
        "ENDPOINT_URL_SSM": "http://127.0.0.1:9",
        "MAX_ATTEMPTS": "1",
        "ACCESS_KEY_ID": "a",
        "SECRET_ACCESS_KEY": "b",
        "DEFAULT_REGION": "eu-west-1",
    }.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    show(event(), StoredPublisher(pubnub_parameter()).publish)
    assert counted() == {"PubNubFailed": 1}


def test_a_message_over_the_size_limit_is_refused_before_sending():
    publisher = PubNubPublisher(**KEYS)
    with pytest.raises(PublishError, match=r"at most 32768 bytes after URL encoding, got \d+"):
        publisher.publish("iort.car", {"text": "x" * MAX_PUBNUB_BYTES})
    # Measured as PubNub measures: a quote is three bytes in a URL.
    with pytest.raises(PublishError, match="after URL encoding"):
        publisher.publish("iort.car", {"text": '"' * (MAX_PUBNUB_BYTES // 6)})


def test_any_error_of_the_sdk_becomes_a_publish_error_without_keys(monkeypatch):
    publisher = PubNubPublisher(**KEYS)

    def broken(*_arguments):
        raise ValueError("https://ps.pndsn.com/publish/pub-c-secret/sub-c-secret/0/iort.car/0")

    monkeypatch.setattr(publisher._client, "request_sync", broken)
    with pytest.raises(PublishError) as caught:
        publisher.publish("iort.car", {})
    assert "secret" not in str(caught.value)
    assert "ValueError" in str(caught.value)


def test_the_loggers_that_could_show_the_keys_are_silenced():
    for name in ("httpx", "httpcore", "urllib3", "pubnub"):
        assert not logging.getLogger(name).isEnabledFor(logging.INFO)


@pytest.mark.parametrize("clock_error_us", [0, 86_400_000_000, -86_400_000_000])
@pytest.mark.parametrize(
    ("leg_ms", "stale"), [(0, False), (LIVE_MAX_AGE_MS, False), (LIVE_MAX_AGE_MS + 1, True), (60_000, True)]
)
def test_a_new_environment_uses_the_clock_offset_that_the_car_measured(
    leg_ms, stale, clock_error_us, counted
):
    received_ms = SENT_US // 1000 + leg_ms
    sent_us = SENT_US + clock_error_us
    message = event(t=sent_us, sent_us=sent_us, offset_us=-clock_error_us)
    channels = Channels()
    show({**message, RECEIVED_MS: received_ms}, channels, now_us=received_ms * 1000)
    assert len(channels.sent) == (not stale)
    totals = counted()
    assert (totals.get("LiveStale", 0), totals.get("LivePublished", 0)) == (stale, not stale)
    # Stale ones count too: the alarm watches them.
    assert totals.get("CarToLambdaMs", 0) == leg_ms
    if not stale:
        assert channels.sent[0][1]["hops"]["offset_us"] == -clock_error_us
