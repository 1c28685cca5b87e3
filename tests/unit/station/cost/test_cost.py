"""The cost model against arithmetic done by hand, and its tables against the documents."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from bench.load import message_sizes
from functions.shared.metrics import Gathered, emit
from functions.shared.summary import measure
from iort_agent.agent import Agent
from iort_agent.config import Config
from iort_agent.lanes.pings import CLOCK_EVERY_S
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.mqtt.failures import SHORTEST_S
from iort_agent.runtime import Runtime
from iort_agent.spool.memory import MemorySpool
from iort_contract.catalog.metrics import METRICS, metrics_of
from iort_contract.cloud import IOT, PUBNUB
from iort_contract.topics import SHADOW
from iort_station.cli.main import app
from iort_station.cost import model, report
from iort_station.cost.model import (
    FREE_ALARMS,
    FREE_DASHBOARD_METRICS,
    FREE_DASHBOARDS,
    FREE_METRICS,
    PAGE_REFRESH_S,
    deployment_dollars_per_month,
)
from iort_station.cost.prices import PRICES, QUOTAS, SERVICES
from iort_station.cost.usage import CLOCK_PING_S, Usage
from iort_station.errors import StationError
from scripts.docs_parts import ROOT
from testkit.agent import Loopback, ManualClock
from testkit.car import simulated_drive

# By PubNub, which uses every part of the model.
_ONE = Usage(live_transport=PUBNUB)


def _units(items, lane, price):
    return sum(item.units for item in items if (item.lane, item.price) == (lane, price))


def test_the_record_lane_costs_a_rule_an_action_and_write_units_a_batch():
    items = model.bill(_ONE)
    assert _units(items, "record", "message") == 0, "Basic Ingest has no messaging charge"
    assert _units(items, "record", "rule") == _units(items, "record", "action") == 3600
    assert _units(items, "record", "write") == 3600 * (1 + 1), "each item fits in a unit"
    rules = next(i for i in items if (i.lane, i.what, i.price) == ("record", "batches", "rule"))
    assert rules.dollars == pytest.approx(3600 * 0.15e-6)


def test_the_live_lane_costs_a_rule_an_action_and_an_invocation_a_message():
    always = replace(_ONE, watched_hours=None)
    items = model.bill(replace(always, live_hz=4.0))
    assert _units(items, "live", "invocation") == 4 * 3600
    assert _units(items, "live", "message") == 360
    # Messages through the broker also trigger two more rules.
    assert _units(items, "live", "rule") == _units(items, "live", "action") == 4 * 3600 + 2 * 360
    throttled = model.bill(replace(always, live_hz=0.05))
    assert _units(throttled, "live", "message") == _units(throttled, "live", "invocation") == 180
    assert _units(model.bill(replace(_ONE, live_hz=0.0)), "live", "invocation") == 0


def test_a_car_that_nobody_looks_at_sends_a_message_in_ten_seconds():
    idle = replace(_ONE, watched_hours=0.0)
    items = model.bill(idle)
    assert _units(items, "live", "invocation") == _units(items, "live", "message") == 360
    assert model.total(model.pubnub_bill(idle)) < model.total(model.pubnub_bill(_ONE)) / 99
    # The goal, as the thesis is compared: it archives and analyses nothing.
    assert model.total(model.bill(replace(idle, archive_days=0, drive_minutes=0.0))) < 0.014
    half = replace(_ONE, hours_per_day=4.0, watched_hours=2.0)
    assert half.live_per_s == pytest.approx((10 + 0.1) / 2)
    # A lease every five seconds is sent and received.
    assert _units(model.bill(half), "live", "message") == 360 + 2 * 720 / 2
    assert replace(half, watched_hours=9.0).live_per_s == 10


def test_by_aws_iot_alone_each_message_is_sent_to_each_viewer_and_no_function_runs():
    usage = replace(_ONE, live_transport="iot", viewers=3)
    items = model.bill(usage)
    assert _units(items, "live", "invocation") == 0
    assert _units(items, "live", "message") == 36_000 * (1 + 3) + 3 * 2 * 720
    assert _units(items, "live", "rule") == 2 * 36_000, "a fault, and a low battery"
    assert _units(items, "live", "connection") == 3 * 60
    assert model.total(model.pubnub_bill(usage)) == model.pubnub_mau_dollars_per_month(usage) == 0


def test_a_car_without_measured_pings_still_pings_for_the_clock_offset():
    assert CLOCK_PING_S == CLOCK_EVERY_S
    items = model.bill(_ONE)
    assert _units(items, "ping", "message") == 2 * 120, "a ping and a pong"
    assert _units(items, "ping", "rule") == _units(items, "ping", "action") == 120
    measured = model.bill(replace(_ONE, ping_hz=1.0))
    assert _units(measured, "ping", "message") == 6 * 3600, "those of the path rule tell the clock, too"


def test_the_ratio_is_also_given_without_log_lines():
    """The thesis' column includes Lambda's own log lines, and ours does not."""
    unlogged = [
        sum(item.dollars for item in items if item.service != "CloudWatch")
        for items in (model.thesis_bill(_ONE), model.bill(_ONE))
    ]
    (row,) = (row for row in report.robot_hour(_ONE).body if row[0] == "total AWS without log lines")
    assert row[-1] == f"1/{unlogged[0] / unlogged[1]:.1f}"


def test_an_idle_deployment_pays_for_polling_monitoring_and_storage():
    rest = deployment_dollars_per_month(_ONE)
    # Five long polls of 20 s at all times, for each of three queues.
    assert rest["polling the queues"] == pytest.approx(3 * 657_000 * 0.40e-6)
    assert rest["alarms"] == pytest.approx((_ONE.alarms - 10) * 0.10), "ten are free"
    insights = rest["alarms by Metrics Insights, at most"]
    assert insights == pytest.approx(_ONE.insights_metrics * 0.10), "and none of those"
    assert rest["metrics"] == pytest.approx((len(METRICS) - 10) * 0.30)
    # Twenty hours, twice a minute, the largest dashboard.
    shown = max(_ONE.dashboards)
    assert rest["metrics requested by the live page"] == pytest.approx(20 * 120 * shown * 0.00001)
    assert "key" not in rest
    assert deployment_dollars_per_month(replace(_ONE, customer_key=True))["key"] == 1.0
    fleet = deployment_dollars_per_month(replace(_ONE, robots=1000, device_defender=True))
    assert fleet["audit of the robots"] == pytest.approx(1.1)
    assert "audit of the robots" not in deployment_dollars_per_month(_ONE)


@pytest.mark.parametrize(
    ("dashboards", "billed"),
    [((), 0), ((50, 50, 50), 0), ((51,), 1), ((50, 1, 2, 3), 1), ((106, 18), 1), ((51, 50, 50, 50, 50), 2)],
)
def test_three_dashboards_of_up_to_fifty_metrics_are_free(dashboards, billed):
    rest = deployment_dollars_per_month(replace(_ONE, dashboards=dashboards))
    assert rest["dashboards"] == billed * 3.0


def test_metrics_of_every_robot_are_billed_per_robot():
    for robots, billed in ((7, 0), (8, 1)):
        usage = replace(_ONE, robots=robots, robot_metrics=True)
        rest = deployment_dollars_per_month(usage)
        assert rest["dashboards"] == billed * 3.0, "20 metrics and four a robot"
        assert rest["metrics"] == pytest.approx((len(METRICS) + 10 * robots - 10) * 0.30)


def test_the_live_page_refreshes_as_often_as_the_model_assumes():
    source = (ROOT / "station/web/src/views/cloudwatch.ts").read_text()
    assert f"const REFRESH_S = {PAGE_REFRESH_S};" in source


def test_point_in_time_recovery_is_billed_by_the_stored_size():
    def kept(usage, price):
        return sum(item.units for item in model.bill(usage) if item.price == price)

    assert kept(_ONE, "recovery") == 0
    assert kept(replace(_ONE, recoverable=True), "recovery") == kept(_ONE, "storage") > 0


def test_the_thesis_layout_pays_for_every_sample():
    items = model.thesis_bill(_ONE)
    assert _units(items, "record", "message") == 50 * 3600
    assert _units(items, "record", "write") == 2 * 50 * 3600
    assert _units(items, "live", "invocation") == 50 * 3600
    assert 0.6 < model.total(items) < 0.8


def test_the_cost_without_a_live_lane_is_under_a_twentieth_of_the_thesis():
    ours = model.total(model.bill(replace(_ONE, live_hz=0.0)))
    assert ours < model.total(model.thesis_bill(_ONE)) / 20


def test_a_batch_of_one_sample_costs_as_much_as_the_thesis_record_lane():
    single = model.bill(replace(_ONE, batch_s=0.0, live_hz=0.0))
    assert _units(single, "record", "rule") == 50 * 3600


def test_a_larger_fleet_needs_fewer_lambda_2_calls_per_robot():
    calls = {
        robots: model.summarize_calls_per_s(Usage(robots=robots)) / robots for robots in (1, 100, 10_000)
    }
    assert calls[1] > calls[100] > calls[10_000]
    assert calls[1] == 1 / model.WINDOW_S
    records = 10_000 * (_ONE.batches_per_s + _ONE.own_batches_per_s)
    assert calls[10_000] * 10_000 == pytest.approx(records / 500), "a call takes five hundred records at most"


def test_pubnub_counts_publishes_and_receipts_or_users():
    items = model.pubnub_bill(replace(_ONE, viewers=3))
    assert [item.units for item in items] == [36_000, 108_000]
    assert items[0].dollars == pytest.approx(36_000 * 0.000123)
    assert model.pubnub_mau_dollars_per_month(_ONE) == 98.0
    assert model.pubnub_mau_dollars_per_month(replace(_ONE, viewers=10**6)) is None


def test_every_item_has_a_price_and_every_price_names_its_page():
    for items in (model.bill(replace(_ONE, ping_hz=1.0)), model.thesis_bill(_ONE), model.pubnub_bill(_ONE)):
        assert all(item.price in PRICES and item.units >= 0 for item in items)
    assert all(
        SERVICES[price.service][0].startswith("https://") and price.usd > 0 for price in PRICES.values()
    )


@pytest.mark.parametrize(
    "wrong", [{"robots": 0}, {"rate_hz": 0.0}, {"batch_s": 2.0}, {"live_hz": -1.0}, {"hours_per_day": 25.0}]
)
def test_an_impossible_usage_is_refused(wrong):
    with pytest.raises(StationError):
        model.bill(replace(_ONE, **wrong))


def test_the_modelled_log_size_of_lambda_1_matches_its_real_lines(capsys):
    counted = Gathered("live")
    for i in range(36_000):
        delays = dict.fromkeys(("InCarMs", "UplinkMs", "ToLambdaMs", "CarToLambdaMs"), 2.34 + i % 97)
        counted.add(1_700_000_000 + i / 10, LivePublished=1, **delays)
    written = len(capsys.readouterr().out)
    assert written == pytest.approx(_units(model.bill(_ONE), "live", "logs") * 1e9, rel=0.1)
    whole = _units(model.bill(replace(_ONE, function_logs="all")), "live", "logs") * 1e9
    assert whole - 36_000 * len(model.PLATFORM_LINES) == pytest.approx(written, rel=0.1)


def test_each_environment_gathers_its_own_metrics():
    assert model._live_lines_per_s(_ONE) == 0.1
    # Twenty milliseconds each: two at a time, and more than a hundred in ten seconds.
    assert model._live_lines_per_s(replace(_ONE, robots=10)) == 1.0
    assert model._live_lines_per_s(replace(_ONE, live_hz=0.01)) == 0.01


def test_the_modelled_length_of_other_lines_matches_the_real_lines(capsys):
    batch = message_sizes.batch_of(simulated_drive(50), 50)
    emit("summarize", BatchesSummarized=2, SamplesSummarized=100)
    emit("health", **measure("vesc", [batch]))
    emit("echo", PongsSent=1)
    lengths = [len(line) for line in capsys.readouterr().out.splitlines()]
    modelled = [model._SUMMARIZE_LINE, model._HEALTH_LINE, model._PONG_LINE]
    assert lengths == pytest.approx(modelled, rel=0.1)


def test_the_quota_that_breaks_first_needs_the_fewest_robots():
    paper = report.on_paper(replace(_ONE, robots=10_000, live_concurrency=5))
    at = [need.robots_at_quota for need in paper.needs if need.robots_at_quota]
    assert at == sorted(at)
    assert paper.breaks_first.robots_at_quota == 5 / (10 * 0.020)
    unreserved = report.on_paper(Usage(robots=10_000))
    assert unreserved.breaks_first.name.startswith("IoT Core")


def test_without_pubnub_nothing_of_lambda_1_is_billed():
    """The default deployment's whole bill, which README begins with."""
    iot, pubnub = Usage(), _ONE
    assert iot.live_transport == IOT
    computed, with_lambda_1 = (
        {item.lane for item in model.bill(one) if item.service in ("Lambda", "CloudWatch") and item.units}
        for one in (iot, pubnub)
    )
    assert with_lambda_1 - computed == {"live"}
    fixed, with_pubnub = (deployment_dollars_per_month(one)["metrics"] for one in (iot, pubnub))
    assert with_pubnub - fixed == pytest.approx(0.3 * len(metrics_of("live")))


def test_the_documents_and_the_model_count_the_same_monitoring():
    text = (ROOT / "docs/reference/metrics.md").read_text()
    platform, services, robots = _ONE.dashboards
    for line in (
        f"| {len(METRICS)} | $0.30 each | {FREE_METRICS} |",
        f"| {_ONE.alarms} | $0.10 each | {FREE_ALARMS} |",
        f"| 4, of up to {_ONE.insights_metrics} metrics | $0.10 for each",
        f"| 3, of {platform}, {services} and {robots} metrics | $3 each | {FREE_DASHBOARDS}, of up to",
        f"of up to {FREE_DASHBOARD_METRICS} metrics each |",
        f"| {platform} metrics every {PAGE_REFRESH_S} s | $0.01 for 1,000 metrics | none |",
    ):
        assert line in text


def test_the_command_prints_json_that_adds_up(tmp_path):
    done = CliRunner().invoke(
        app, ["cost", "--live-hz", "2", "--json"], env={"XDG_CACHE_HOME": str(tmp_path)}
    )
    assert done.exit_code == 0, done.output
    answer = json.loads(done.output)
    assert answer["usage"]["live_hz"] == 2.0
    summed = sum(item["dollars_per_robot_hour"] for item in answer["items"])
    assert summed == pytest.approx(answer["dollars_per_robot_hour"])


@pytest.mark.parametrize("batch_s", [0.0, 0.2, 1.0])
def test_each_stream_is_billed_separately(batch_s):
    one, three = (
        {
            (item.lane, item.what, item.price): item.units
            for item in model.bill(Usage(streams=streams, batch_s=batch_s))
        }
        for streams in (1, 3)
    )
    times = {what: three[what] / units for what, units in one.items() if units}
    for what in (
        ("record", "batches", "rule"),
        ("record", "batches", "action"),
        ("record", "telemetry written", "write"),
        ("record", "telemetry kept", "storage"),
        ("record", "summary kept", "storage"),
    ):
        assert times[what] == pytest.approx(3), what
    # The window limits Lambda 2's calls until its events are full.
    assert times["record", "Lambda 2", "invocation"] <= 3
    assert times["connection", "minutes", "connection"] == times["agent, rtt", "kept", "storage"] == 1
    messages = [next(i.units for i in model.thesis_bill(usage) if i.what == "messages") for usage in USAGES]
    assert messages[1] == 3 * messages[0]


USAGES = (Usage(), Usage(streams=3))


# The cost model's figures of a connection match the agent's messages when it connects.

_BY_IOT = Usage()
# AWS IoT Core, "Additional metering details".
_METER, _SHADOW_METER = 5 * 1024, 1024


def messages(usage):
    """The metered messages of an hour, by kind."""
    return {item.what: item.units for item in model.bill(usage) if item.price == "message"}


class Counting(Loopback):
    """An uplink that records its subscriptions."""

    def __init__(self, *given, **named):
        super().__init__(*given, **named)
        self.filters = []

    def subscribe(self, topic_filter, handler):
        self.filters.append(topic_filter)
        super().subscribe(topic_filter, handler)


def test_an_agent_subscribes_as_the_model_assumes():
    clock, dispatcher = ManualClock(), Dispatcher()
    uplink = Counting(clock, dispatcher)
    config = Config("car1", "host", Path(), Path(), ())
    agent = Runtime(Agent(config, uplink=uplink, spool=MemorySpool(max_bytes=10**6), clock=clock))
    assert len(uplink.filters) == model.SUBSCRIPTIONS
    assert all(len(topic) < _METER for topic in uplink.filters)
    uplink.connect()
    dispatcher.run_pending()
    agent.tick()
    asked = [message for message in uplink.published if f"/name/{SHADOW}/" in message.topic]
    assert [(message.topic.rpartition("/")[2], message.payload) for message in asked] == [("get", b"")]
    # Without desired settings, the shadow holds only the agent's report.
    uplink.deliver(f"{asked[0].topic}/rejected", b'{"code": 404}')
    dispatcher.run_pending()
    agent.tick()
    assert uplink.published[-1].topic.endswith("/update")
    assert len(json.dumps(json.loads(uplink.published[-1].payload)["state"])) < _SHADOW_METER


def test_a_connect_adds_its_messages_to_an_hour():
    more, less = (
        messages(_BY_IOT),
        messages(replace(_BY_IOT, connects_per_hour=0.0)),
    )
    assert {what: more[what] - less[what] for what in more if more[what] != less[what]} == {
        "CONNECT and SUBSCRIBE": 1 + model.SUBSCRIPTIONS,
        "shadow request, answer and PUBACK": 3,
    }


def test_a_connect_adds_two_events_of_presence():
    items = model.bill(replace(_BY_IOT, connects_per_hour=3.0))
    units = {item.price: item.units for item in items if item.lane == "connection"}
    for price in ("rule", "action", "invocation", "write"):
        assert units[price] == 2 * 3, price
    assert units["shadow"] == 3
    assert units["connection"] == 60, "minutes, however often"


def test_a_command_is_sent_received_and_acknowledged():
    commanded = messages(replace(_BY_IOT, command_hz=10.0))
    assert commanded["sent, received, acknowledged"] == 3 * 10 * 3600
    assert messages(_BY_IOT)["sent, received, acknowledged"] == 0


def test_the_thesis_layout_pays_for_connects_without_subscriptions():
    items = {item.what: item.units for item in model.thesis_bill(replace(_BY_IOT, connects_per_hour=2.0))}
    assert items["CONNECT"] == 2


def test_the_modelled_length_of_a_presence_line_matches_the_real_line(capsys, monkeypatch):
    monkeypatch.setenv("NAMESPACE", "iort")
    emit("presence", RobotsConnected=True, RobotsDisconnected=False)
    assert len(capsys.readouterr().out) == pytest.approx(model._PRESENCE_LINE, rel=0.1)


def test_an_outage_is_compared_with_the_lower_quota_of_awss_pages():
    assert QUOTAS["IoT Core: connects in a minute after an outage"].value == 500 * 60
    paper = {need.name: need.times for need in report.on_paper(Usage(robots=60_000)).needs}
    assert paper["IoT Core: connects in a minute after an outage"] == 2
    assert paper["IoT Core: connects of one client id"] == 1, "the agent waits a second at least"
    assert report.SHORTEST_RECONNECT_S == SHORTEST_S
