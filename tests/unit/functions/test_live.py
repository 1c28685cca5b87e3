"""Lambda 1: the chosen fields go to the car's channel; whatever is wrong is counted and fails nothing."""

from __future__ import annotations

import contextlib
import json
import logging
import math

import boto3
import pytest
from hypothesis import given
from hypothesis import strategies as st

from functions import live
from functions.live import REFUSALS, Lane, RefusedError, age_ms
from functions.quarantine import entries
from functions.shared.delay_estimator import DelayEstimator
from functions.shared.pubnub_client import PublishError, PubNubPublisher
from iort_contract.catalog.environments import LiveEnvironment
from iort_contract.catalog.metrics import metrics_of
from iort_contract.cloud import channel as channel_of
from iort_contract.cloud import pubnub_parameter
from iort_contract.limits import LIVE_MAX_AGE_MS, MAX_PUBNUB_BYTES, SCHEMA_VERSION, ContractError
from iort_contract.messages.event import event_message, rule_event
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.tables import BY_FUNCTION, MESSAGE_BASE64, RECEIVED_MS, TOPIC
from iort_contract.topics import LIVE, build_topic

T_US = 1_700_000_000_000_000
SENT_US = T_US + 4_000
RECEIVED = (SENT_US + 30_000) // 1000
NOW_US = SENT_US + 35_000
FIELDS = {"vesc": ["speed", "voltage_input"]}
SAMPLE = {"speed": 1200, "voltage_input": 15.8, "fault_code": 0}


def event(stream="vesc", robot="car", namespace="iort", **changes):
    """What the live rule makes of a live message."""
    sample = changes.pop("sample", SAMPLE)
    ours = {name: changes.pop(name) for name in (TOPIC, RECEIVED_MS) if name in changes}
    message = json.loads(encode_live(LiveSample("0123abcd", 3, T_US, SENT_US, sample)))
    raw = json.dumps({**message, **changes}).encode()
    return {**rule_event(raw, build_topic(LIVE, robot, stream, namespace), RECEIVED), **ours}


class Channels:
    """Stands for PubNub: what was published, or the error that it answers with."""

    def __init__(self, error=None):
        self.sent, self.error = [], error

    def __call__(self, channel, message):
        if self.error is not None:
            raise self.error
        self.sent.append((channel, message))


def show(message, publish, *, fields=FIELDS, legs=None, now_us=NOW_US):
    """What a new environment does with a message: it writes what it counts at once."""
    lane = Lane(fields, publish, keep=pytest.fail)
    lane.estimator = legs or lane.estimator
    lane.show(message, now_us)


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


def test_the_chosen_fields_go_to_the_cars_channel_with_every_hops_time(counted):
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
    # How long the way was is not known of a car that has not measured its clock's offset.
    hops = {"InCarMs": 4, "ToLambdaMs": 5}
    assert counted() == {"LivePublished": 1, **hops}


def test_a_stream_that_is_not_configured_sends_every_field():
    channels = Channels()
    show(event("imu"), channels)
    assert channels.sent[0][1]["sample"] == SAMPLE
    assert channels.sent[0][1]["stream"] == "imu"


def test_a_stream_configured_with_no_field_sends_none_and_fields_that_are_not_there_are_not_made_up():
    channels = Channels()
    show(event(), channels, fields={"vesc": []})
    show(event(), channels, fields={"vesc": ["speed", "absent"]})
    assert [message["sample"] for _, message in channels.sent] == [{}, {"speed": 1200}]


def test_what_is_shown_live_is_null_where_no_sensor_is_fitted():
    channels = Channels()
    sample = {"temp_motor": -273.15, "temp_fet": 31.5, "current_motor": -60}
    for fields in ({}, {"vesc": frozenset({"temp_motor"})}):
        show(event(sample=sample), channels, fields=fields)
    assert [message["sample"] for _, message in channels.sent] == [
        {"temp_motor": None, "temp_fet": 31.5, "current_motor": -60},
        {"temp_motor": None},
    ]


def test_another_deployment_has_channels_of_its_own():
    channels = Channels()
    show(event(namespace="lab2"), channels)
    assert channels.sent[0][0] == channel_of("car", "lab2")


def test_the_robot_is_the_topics_whatever_the_message_claims():
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
def test_stale_by_its_time_in_the_car_and_in_the_cloud(
    in_car_ms, in_cloud_ms, stale, clock_error_us, counted
):
    sent_us = SENT_US + clock_error_us
    t_us = sent_us - round(in_car_ms * 1000)
    now_us = RECEIVED * 1000 + round(in_cloud_ms * 1000)
    channels = Channels()
    show(event(t=t_us, sent_us=sent_us), channels, now_us=now_us)
    age = age_ms("car", LiveSample("0123abcd", 0, t_us, sent_us, {}), RECEIVED, now_us, DelayEstimator())
    assert age == in_car_ms + in_cloud_ms
    assert len(channels.sent) == (not stale)
    totals = counted()
    assert totals.get("LiveStale", 0) == stale
    assert totals.get("LivePublished", 0) == (not stale)
    # A clock that is off says nothing of how long the way was, and rings no alarm.
    assert "CarToLambdaMs" not in totals


MESSAGE = encode_live(LiveSample("0123abcd", 3, T_US, SENT_US, SAMPLE))


def handed(message):
    """An event with any bytes in it."""
    return rule_event(message, build_topic(LIVE, "car", "vesc"), RECEIVED)


def saying(**changes):
    """An event whose message says something else; nothing where that is `...`."""
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


@pytest.mark.parametrize("malformed", MALFORMED, ids=range(len(MALFORMED)))
def test_a_malformed_event_is_counted_and_refused(malformed, counted):
    channels = Channels()
    with pytest.raises(RefusedError) as raised:
        show(malformed, channels)
    assert channels.sent == []
    assert counted() == {"LiveRefused": 1}
    assert len(str(raised.value)) < 1000


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@given(
    st.dictionaries(st.sampled_from(sorted(event())), json_values),
    st.dictionaries(st.sampled_from(sorted(json.loads(MESSAGE))), json_values),
    json_values,
)
def test_nothing_in_an_event_raises_anything_else(changes, said, anything):
    channels = Channels()
    for one in ({**event(), **changes}, saying(**said), anything):
        with contextlib.suppress(RefusedError):
            show(one, channels)
    for channel, message in channels.sent:
        assert channel.startswith("iort.")
        json.dumps(message, allow_nan=False)


def test_what_pubnub_does_not_take_is_counted_and_not_raised(counted, caplog):
    show(event(), Channels(PublishError("status 403")))
    assert counted() == {"PubNubFailed": 1}
    assert "car: status 403" in caplog.text


ARN = "arn:aws:lambda:eu-west-1:000000000000:function:iort-processing-Live-1"


class Queue:
    """Stands for the queue before the quarantine: what it took, or that it takes nothing."""

    def __init__(self, *, takes=True):
        self.kept, self.takes = [], takes

    def __call__(self, body):
        if self.takes:
            self.kept.append(body)
        return self.takes


class Served:
    """One environment of the function, and what it did with each event."""

    def __init__(self, *, takes=True):
        self.channels, self.queue, self.now_us = Channels(), Queue(takes=takes), NOW_US
        self.lane = Lane(FIELDS, self.channels, self.queue)

    def __call__(self, message):
        self.lane.serve(message, self.now_us, ARN)


@pytest.mark.parametrize("malformed", MALFORMED, ids=range(len(MALFORMED)))
def test_what_is_refused_goes_to_the_queue_and_fails_no_invocation(malformed, counted):
    served = Served()
    served(malformed)
    (entry,) = entries(served.queue.kept[0], lambda _info: [])
    assert len(served.queue.kept) == 1
    assert entry.source == f"{BY_FUNCTION} iort-processing-Live-1"
    assert entry.reason.startswith("Refused: ")
    with contextlib.suppress(AttributeError, ContractError):
        assert entry.payload == event_message(malformed)
    assert counted() == {"LiveRefused": 1}


def test_what_the_queue_does_not_take_fails_the_invocation_so_that_lambda_sends_it_there():
    with pytest.raises(RefusedError, match="not JSON"):
        Served(takes=False)(handed(b"not JSON"))


def test_a_robot_that_is_refused_over_and_over_is_cut_off_and_no_other_is(counted):
    served = Served()
    for _ in range(REFUSALS + 30):
        served({**handed(b"x"), TOPIC: build_topic(LIVE, "bad", "vesc")})
    # Its good ones are not looked at either, and every other robot's are.
    served(event(robot="bad"))
    for i in range(40):
        served(event(robot=f"good{i}"))
    assert len(served.queue.kept) == REFUSALS
    assert [entries(body, list)[0].reason.count("LiveCutOff") for body in served.queue.kept] == [
        *[0] * (REFUSALS - 1),
        1,
    ]
    assert [message["robot"] for _, message in served.channels.sent] == [f"good{i}" for i in range(40)]
    served.now_us += 11_000_000
    # And once it is mended it is seen again.
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
    assert len(served.queue.kept) == 100
    # A clock that is set back gives nothing twice.
    served.now_us = NOW_US
    for _ in range(REFUSALS + 1):
        served(handed(b"x"))
    assert "LiveCutOff" in counted()


class Context:
    invoked_function_arn = ARN


def test_the_handler_has_fields_publisher_and_queue_of_its_environment(aws, monkeypatch, counted):
    parameter = pubnub_parameter("lab2")
    boto3.client("ssm").put_parameter(Name=parameter, Type="SecureString", Value=json.dumps(KEYS))
    queue = boto3.client("sqs").create_queue(QueueName="rejected")["QueueUrl"]
    given = LiveEnvironment("lab2", parameter, {"vesc": ["speed"], "imu": []}, queue)
    for name, value in given.variables().items():
        monkeypatch.setenv(name, value)
    assert live.handler(handed(b"x"), Context) is None
    (message,) = boto3.client("sqs").receive_message(QueueUrl=queue)["Messages"]
    (entry,) = entries(message["Body"], lambda _info: [])
    assert (entry.payload, live.lane().fields) == (b"x", {"vesc": ["speed"], "imu": []})
    assert live.lane() is live.lane()
    assert counted() == {"LiveRefused": 1}
    boto3.client("sqs").delete_queue(QueueUrl=queue)
    with pytest.raises(RefusedError):
        live.handler(handed(b"x"), Context)


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


def test_a_message_too_large_is_refused_before_it_is_sent():
    publisher = PubNubPublisher(**KEYS)
    with pytest.raises(PublishError, match=r"at most 32768 bytes after URL encoding, got \d+"):
        publisher.publish("iort.car", {"text": "x" * MAX_PUBNUB_BYTES})
    # Measured as PubNub measures: a quote is three bytes in a URL.
    with pytest.raises(PublishError, match="after URL encoding"):
        publisher.publish("iort.car", {"text": '"' * (MAX_PUBNUB_BYTES // 6)})


def test_whatever_the_sdk_raises_is_a_publish_error_without_keys(monkeypatch):
    publisher = PubNubPublisher(**KEYS)

    def broken(*_arguments):
        raise ValueError("https://ps.pndsn.com/publish/pub-c-secret/sub-c-secret/0/iort.car/0")

    monkeypatch.setattr(publisher._client, "request_sync", broken)
    with pytest.raises(PublishError) as caught:
        publisher.publish("iort.car", {})
    assert "secret" not in str(caught.value)
    assert "ValueError" in str(caught.value)


def test_the_loggers_that_would_show_the_keys_are_quiet():
    for name in ("httpx", "httpcore", "pubnub"):
        assert not logging.getLogger(name).isEnabledFor(logging.INFO)


def late(sent_us, received_ms, legs, channels, robot="car"):
    """A live message that was received at once by Lambda, however long it took to get there."""
    message = {**event(robot=robot, t=sent_us, sent_us=sent_us), "received_ms": received_ms}
    show(message, channels, legs=legs, now_us=received_ms * 1000)


@pytest.mark.parametrize("offset_us", [0, 3_600_000_000, -3_600_000_000])
def test_messages_that_a_stall_held_up_are_stale_whatever_the_cars_clock(capsys, offset_us):
    channels, legs = Channels(), DelayEstimator()
    start_us = NOW_US
    for i in range(20):
        late(start_us + i * 100_000 + offset_us, (start_us + i * 100_000) // 1000 + 30, legs, channels)
    assert len(channels.sent) == 20
    # Six seconds of messages come all at once.
    for i in range(20, 80):
        late(start_us + i * 100_000 + offset_us, (start_us + 80 * 100_000) // 1000 + 30, legs, channels)
    assert len(channels.sent) == 20 + 20
    assert capsys.readouterr().out.count('LiveStale":1') == 40


@pytest.mark.parametrize("clock_error_us", [0, 86_400_000_000, -86_400_000_000])
@pytest.mark.parametrize(
    ("leg_ms", "stale"), [(0, False), (LIVE_MAX_AGE_MS, False), (LIVE_MAX_AGE_MS + 1, True), (60_000, True)]
)
def test_a_car_that_knows_its_clocks_offset_is_judged_by_it_in_an_environment_without_history(
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
    # The stale ones too: they are what its alarm waits for.
    assert totals.get("CarToLambdaMs", 0) == leg_ms
    if not stale:
        assert channels.sent[0][1]["hops"]["offset_us"] == -clock_error_us


def test_clock_set_back_is_believed_after_the_window():
    legs = DelayEstimator()
    assert legs.excess_us("car", "0badcafe", 0, 0) == 0
    assert legs.excess_us("car", "0badcafe", -5_000_000, 100) == 5_100_000
    for second in range(1, 40):
        excess = legs.excess_us("car", "0badcafe", second * 1_000_000 - 5_000_000, second * 1000)
    assert excess == 0


def test_a_robot_that_says_anothers_run_makes_nothing_of_the_others_late(capsys):
    """The name of a run stands in what robots send each other."""
    channels, legs = Channels(), DelayEstimator()
    late(NOW_US, NOW_US // 1000 + 30, legs, channels)
    late(NOW_US + 3_600_000_000, NOW_US // 1000 + 40, legs, channels, robot="thief")
    late(NOW_US + 100_000, NOW_US // 1000 + 130, legs, channels)
    assert [channel for channel, _ in channels.sent] == ["iort.car", "iort.thief", "iort.car"]
    assert "LiveStale" not in capsys.readouterr().out


def test_another_run_of_a_robot_is_measured_by_itself():
    legs = DelayEstimator()
    assert legs.excess_us("car", "0badcafe", 3_600_000_000, 0) == 0
    assert legs.excess_us("car", "cafebabe", 0, 0) == 0
    assert legs.excess_us("car", "cafebabe", 0, 70) == 70_000


def test_legs_remember_a_bounded_number_of_robots_and_one_run_of_each():
    legs = DelayEstimator()
    for i in range(3000):
        legs.excess_us(f"car{i}", "0badcafe", 0, 0)
        legs.excess_us("hostile", f"{i:08x}", 0, 0)
    assert len(legs._runs) == 1000
    assert "car2999" in legs._runs
