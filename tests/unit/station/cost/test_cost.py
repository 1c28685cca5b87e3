"""The cost model against arithmetic done by hand, and its tables against the documents."""

from __future__ import annotations

import json
from collections import Counter
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
from iort_agent.video import video
from iort_agent.video.config import SimCamera, VideoConfig
from iort_contract.catalog.metrics import METRICS, metrics_of
from iort_contract.catalog.vesc import VESC_FIELDS
from iort_contract.cloud import IOT, PUBNUB
from iort_contract.topics import SHADOW
from iort_station.cli.main import app
from iort_station.cost import model, report
from iort_station.cost.prices import MONTH_DAYS
from iort_station.cost.report import deployment_dollars_per_month, variations
from iort_station.cost.usage import CLOCK_PING_S, Usage
from iort_station.errors import StationError
from scripts.docs_parts import ROOT
from stacks import analysis, archive, storage
from stacks.settings import Settings
from testkit.agent import Loopback, ManualClock, MemorySpool
from testkit.car import simulated_drive

# By PubNub, which uses every part of the model.
_ONE = Usage(live_transport=PUBNUB)
_ALWAYS = {"watched_hours": None}
_IOT = {"live_transport": IOT}
_HOUR = 3600
# AWS IoT Core, "Additional metering details".
_METER, _SHADOW_METER = 5 * 1024, 1024


def units(usage, lane, price, bill=model.bill):
    (count,) = [item.units for item in bill(usage) if (item.lane, item.price) == (lane, price)]
    return count


# --- a robot-hour: what is changed in the usage, and the units of a lane

CASES = [
    # An item of a batch and of a second fits in a write unit.
    ({}, "record", {"rule": _HOUR, "action": _HOUR, "write": _HOUR * (1 + 1)}),
    ({"batch_s": 0.0}, "record", {"rule": 50 * _HOUR}),
    ({"streams": 3}, "record", {"rule": 3 * _HOUR, "write": 3 * _HOUR * (1 + 1)}),
    # Messages through the broker, one in ten seconds, also trigger two more rules.
    ({**_ALWAYS, "live_hz": 4.0}, "live", {"message": 360, "invocation": 4 * _HOUR, "rule": 4 * _HOUR + 720}),
    ({**_ALWAYS, "live_hz": 0.05}, "live", {"message": 180, "invocation": 180}),
    ({"live_hz": 0.0}, "live", {"invocation": 0}),
    ({"watched_hours": 0.0}, "live", {"message": 360, "invocation": 360}),
    # A lease every five seconds is sent and received.
    ({"hours_per_day": 4.0}, "live", {"message": 360 + 2 * 720 / 2, "invocation": _HOUR * (10 + 0.1) / 2}),
    # By AWS IoT alone each viewer receives each message, and no function runs.
    (
        {**_IOT, "viewers": 3},
        "live",
        {
            "invocation": 0,
            "message": 36_000 * (1 + 3) + 3 * 2 * 720,
            "rule": 2 * 36_000,
            "connection": 3 * 60,
        },
    ),
    # Nobody receives what a car sends while nobody looks.
    ({**_IOT, "watched_hours": 0.0}, "live", {"message": 360, "rule": 720, "connection": 0}),
    ({**_IOT, "hours_per_day": 4.0}, "live", {"message": 18_000 * 2 + 180 + 720, "connection": 30}),
    # A ping and a pong for the clock's offset; those of the path rule tell it, too.
    ({}, "ping", {"message": 2 * 120, "rule": 120, "action": 120, "invocation": 0}),
    ({"ping_hz": 1.0}, "ping", {"message": 6 * _HOUR, "rule": 2 * _HOUR, "invocation": _HOUR}),
    # A CONNECT, its SUBSCRIBE, the shadow's request and answer with a PUBACK; two events of presence.
    ({"connects_per_hour": 3.0}, "connection", {"message": 3 * 13, "shadow": 3, "connection": 60}),
    ({"connects_per_hour": 3.0}, "connection", dict.fromkeys(("rule", "action", "invocation", "write"), 6)),
    ({"command_hz": 10.0}, "commands", {"message": 3 * 10 * _HOUR}),
    ({}, "commands", {"message": 0}),
    ({"questions_per_hour": 5.0}, "questions", {"message": 4 * 5, "write": 5, "read": 13 * 5}),
    (
        {"incidents_per_hour": 4.0},
        "incidents",
        {"rule": 8, "invocation": 8, "read": 16, "write": 16 + 24 + 4},
    ),
    # Directly: a renewal every five seconds and four messages of a session are sent and heard; the numbers
    # of the pictures are recorded in batches of a second.
    (
        {"video_minutes": 10.0, "viewers": 2},
        "video",
        {
            "message": 2 * 2 * (120 + 4),
            "connection": 20,
            "relay_minute": 0,
            "transfer_out": 0,
            "rule": 600,
            "write": 1200,
        },
    ),
    # A relay at each end; 1 Mbit/s to each viewer is 450 MB an hour.
    (
        {"video_minutes": 60.0, "viewers": 2, "video_relayed": 0.5},
        "video",
        {"relay_minute": 2 * 30 * 2, "transfer_out": 2 * 0.225},
    ),
    # A picture of 20 kB is four messages, sent once and heard by each.
    (
        {"video_minutes": 60.0, "viewers": 3, "video_broker": 1.0},
        "video",
        {"message": 4 * 4 * _HOUR * (1 + 3) + 2 * 3 * (720 + 4), "transfer_out": 3 * 0.288},
    ),
    # Three streams; their hours, days and nightly searches; only the driven one's objects are large.
    ({}, "archive", {"queue_request": 3 * 3 * (1 + 0.5 + 0.5), "s3_move": 0.5}),
    ({"rate_hz": 1.0, "hours_per_day": 0.1}, "archive", {"s3_instant": 0, "s3_move": 0}),
    # Two hours a day are half a night for each robot, with a tenth of the five states of all.
    (
        {"drive_minutes": 15.0, "robots": 10},
        "analysis",
        {"transition": 4 + 0.5 + 5 * 0.05, "invocation": 4 + 0.5 + 3 * 0.05, "s3_put": 4 * 5 + 0.5},
    ),
]


@pytest.mark.parametrize(("changes", "lane", "expected"), CASES)
def test_a_lane_has_the_units_that_a_robot_takes_in_an_hour(changes, lane, expected):
    usage = replace(_ONE, **changes)
    assert {price: units(usage, lane, price) for price in expected} == pytest.approx(expected)


@pytest.mark.parametrize(
    ("changes", "lane", "expected"),
    [
        ({}, "record", {"message": 50 * _HOUR, "write": 2 * 50 * _HOUR}),
        ({"streams": 3}, "record", {"message": 3 * 50 * _HOUR}),
        ({}, "live", {"invocation": 50 * _HOUR}),
        ({"connects_per_hour": 2.0}, "connection", {"message": 2}),
    ],
)
def test_the_thesis_layout_pays_for_every_sample(changes, lane, expected):
    usage = replace(_ONE, **changes)
    assert {price: units(usage, lane, price, model.thesis_bill) for price in expected} == expected


def test_an_unwatched_car_and_a_car_without_a_live_lane_stay_below_their_goals():
    """As the thesis is compared: it archives and analyses nothing."""
    idle = replace(_ONE, watched_hours=0.0)
    assert model.total(model.bill(replace(idle, archive_days=0, drive_minutes=0.0))) < 0.014
    assert model.total(model.pubnub_bill(idle)) < model.total(model.pubnub_bill(_ONE)) / 99
    thesis = model.total(model.thesis_bill(_ONE))
    assert 0.6 < thesis < 0.8
    assert model.total(model.bill(replace(_ONE, live_hz=0.0))) < thesis / 20
    assert replace(_ONE, hours_per_day=4.0, watched_hours=9.0).live_per_s == 10


def test_an_archived_hour_is_read_twice_and_kept_in_two_classes():
    own = _ONE.own_batches_per_s * _HOUR * model.OWN_ITEM_BYTES
    vesc = _HOUR * model.sizes_of(50, 1).telemetry_item
    # Three streams, each with four reads of its rows and a fortnight's search.
    assert units(_ONE, "archive", "read") == pytest.approx(2 * (vesc + own) / 4096 + 3 * (4 + 14))
    later = (365 - 30) / MONTH_DAYS
    moved, small = (size * model.ARCHIVED_SHARE / 1e9 for size in (vesc, own))
    assert units(_ONE, "archive", "s3_instant") == pytest.approx(moved * later)
    standard = moved * 30 / MONTH_DAYS + small * 365 / MONTH_DAYS
    assert units(_ONE, "archive", "s3_standard") == pytest.approx(standard)


def test_a_larger_fleet_needs_fewer_lambda_2_calls_per_robot():
    calls = {
        robots: model.summarize_calls_per_s(Usage(robots=robots)) / robots for robots in (1, 100, 10_000)
    }
    assert calls[1] > calls[100] > calls[10_000]
    assert calls[1] == 1 / model.WINDOW_S
    records = 10_000 * (_ONE.batches_per_s + _ONE.own_batches_per_s)
    assert calls[10_000] * 10_000 == pytest.approx(records / 500), "a call takes five hundred records at most"
    # Six write units a batch, and a thousand a shard.
    assert model.summarize_calls_per_s(Usage(robots=10_000, rate_hz=1000.0)) == 60 / model.WINDOW_S


def test_video_costs_nothing_while_nobody_looks():
    relayed = replace(_ONE, video_relayed=1.0)
    assert model.bill(relayed) == model.bill(_ONE)
    assert deployment_dollars_per_month(relayed) == deployment_dollars_per_month(_ONE)
    looked = deployment_dollars_per_month(replace(relayed, video_minutes=1.0))
    assert looked["relays' signalling channel"] == 0.03


def test_pubnub_counts_publishes_and_receipts_or_users():
    items = model.pubnub_bill(replace(_ONE, viewers=3))
    assert [item.units for item in items] == [36_000, 108_000]
    assert items[0].dollars == pytest.approx(36_000 * 0.000123)
    assert model.pubnub_mau_dollars_per_month(_ONE) == 98.0
    assert model.pubnub_mau_dollars_per_month(replace(_ONE, viewers=10**6)) is None
    assert model.total(model.pubnub_bill(Usage())) == model.pubnub_mau_dollars_per_month(Usage()) == 0


@pytest.mark.parametrize(
    "wrong",
    [
        {"robots": 0},
        {"rate_hz": 0.0},
        {"batch_s": 2.0},
        {"live_hz": -1.0},
        {"hours_per_day": 25.0},
        {"video_minutes": 61.0},
        {"video_relayed": 0.6, "video_broker": 0.5},
    ],
)
def test_an_impossible_usage_is_refused(wrong):
    with pytest.raises(StationError):
        model.bill(replace(_ONE, **wrong))


# --- a deployment's month


def test_an_idle_deployment_pays_for_polling_monitoring_and_storage():
    rest = deployment_dollars_per_month(_ONE)
    assert rest == pytest.approx(
        {
            # Five long polls of 20 s at all times, for each of three queues.
            "polling the queues": 3 * 657_000 * 0.40e-6,
            # Ten are free, and none of those by Metrics Insights.
            "alarms": (_ONE.alarms - 10) * 0.10,
            "alarms by Metrics Insights, at most": _ONE.insights_metrics * 0.10,
            "metrics": (len(METRICS) - 10) * 0.30,
            "dashboards": 0.0,
            # Twenty hours, twice a minute, the largest dashboard.
            "metrics requested by the live page": 20 * 120 * max(_ONE.dashboards) * 0.00001,
        }
    )
    assert deployment_dollars_per_month(replace(_ONE, customer_key=True))["key"] == 1.0


@pytest.mark.parametrize(
    ("dashboards", "billed"),
    [((), 0), ((50, 50, 50), 0), ((51,), 1), ((50, 1, 2, 3), 1), ((106, 18), 1), ((51, 50, 50, 50, 50), 2)],
)
def test_three_dashboards_of_up_to_fifty_metrics_are_free(dashboards, billed):
    rest = deployment_dollars_per_month(replace(_ONE, dashboards=dashboards))
    assert rest["dashboards"] == billed * 3.0


@pytest.mark.parametrize(("robots", "billed"), [(7, 0), (8, 1)])
def test_metrics_of_every_robot_are_billed_per_robot(robots, billed):
    rest = deployment_dollars_per_month(replace(_ONE, robots=robots, robot_metrics=True))
    assert rest["dashboards"] == billed * 3.0, "20 metrics and four a robot"
    assert rest["metrics"] == pytest.approx((len(METRICS) + 10 * robots - 10) * 0.30)


def test_without_pubnub_nothing_of_lambda_1_is_billed():
    """The default deployment's whole bill, which README begins with."""
    computed, with_lambda_1 = (
        {item.lane for item in model.bill(each) if item.service in ("Lambda", "CloudWatch") and item.units}
        for each in (Usage(), _ONE)
    )
    assert with_lambda_1 - computed == {"live"}
    fixed, with_pubnub = (deployment_dollars_per_month(each)["metrics"] for each in (Usage(), _ONE))
    assert with_pubnub - fixed == pytest.approx(0.3 * len(metrics_of("live")))


# --- the figures, as they were first computed

FIGURES = json.loads(Path(__file__).with_name("figures.json").read_text())
SETTINGS = {
    **variations(Usage()),
    "three streams at 10 Hz by PubNub, always": Usage(
        streams=3, rate_hz=10.0, live_transport=PUBNUB, watched_hours=None, viewers=3
    ),
    "two hundred by PubNub with everything": Usage(
        robots=200,
        streams=2,
        rate_hz=100.0,
        batch_s=0.5,
        ping_hz=1.0,
        command_hz=5.0,
        questions_per_hour=30.0,
        connects_per_hour=4.0,
        hours_per_day=6.0,
        watched_hours=1.5,
        live_transport=PUBNUB,
        viewers=12,
        retention_days=60,
        archive_days=3000,
        drive_minutes=25.0,
        function_logs="all",
        recoverable=True,
        customer_key=True,
        robot_metrics=True,
        live_concurrency=5,
        alarms=50,
        dashboards=(60, 20, 22),
    ),
    "slow and short": Usage(
        rate_hz=1.0,
        live_hz=0.05,
        hours_per_day=0.1,
        watched_hours=0.0,
        archive_days=20,
        agent_every_s=0.0,
        dashboard_hours=0.0,
    ),
    "ten thousand robots at 1000 Hz": Usage(
        robots=10_000, rate_hz=1000.0, live_hz=30.0, agent_every_s=1.0, viewers=2000, live_transport=PUBNUB
    ),
}


def by_lane(items):
    sums = Counter()
    for item in items:
        sums[f"{item.service}, {item.lane}"] += item.dollars
    return dict(sums)


@pytest.mark.parametrize("name", sorted(SETTINGS.keys() | FIGURES.keys()))
def test_the_figures_stay_as_they_were_first_computed(name):
    usage = SETTINGS[name]
    figures = {
        "aws": by_lane(model.bill(usage)),
        "thesis": by_lane(model.thesis_bill(usage)),
        "pubnub": by_lane(model.pubnub_bill(usage)),
        "month": deployment_dollars_per_month(usage),
        "quotas": {need.name: need.needed for need in report.needs(usage)},
    }
    for table, expected in FIGURES[name].items():
        rows = {what: value for what, value in figures[table].items() if value}
        assert rows == pytest.approx(expected, rel=0.01), table


# --- sizes, lines, stacks, agent and documents that the model assumes


@pytest.mark.parametrize("row", model.TABLE, ids=lambda row: str(row.samples))
def test_the_table_of_sizes_matches_measured_sizes(row):
    # Versions of zlib differ a little in size.
    fresh = message_sizes.batch_sizes(row.samples, 1.0)
    assert row == pytest.approx(fresh, rel=0.03), "put in what `python -m bench.load.message_sizes` prints"
    if row.samples in (10, 50):
        # One byte over a kilobyte is billed as two units.
        assert max(fresh.telemetry_item, fresh.summary_item) <= 1024


def test_the_other_sizes_match_measured_sizes():
    for name, size in message_sizes.message_sizes().items():
        assert getattr(model, name) == pytest.approx(size, rel=0.03), name
    assert message_sizes.archived_share() == pytest.approx(model.ARCHIVED_SHARE, rel=0.05)


@pytest.mark.parametrize(
    ("rate_hz", "batch_s"), [(0.1, 1.0), (15.0, 1.0), (35.0, 1.0), (50.0, 0.2), (50.0, 0.0), (150.0, 1.0)]
)
def test_interpolated_sizes_are_close_to_measured_sizes(rate_hz, batch_s):
    sizes, fresh = model.sizes_of(rate_hz, batch_s), message_sizes.batch_sizes(rate_hz, batch_s)
    assert sizes[1:] == pytest.approx(fresh[1:], rel=0.05)


def test_a_short_batch_of_a_fast_stream_is_overestimated_by_at_most_a_third():
    sizes, fresh = model.sizes_of(1000.0, 0.05), message_sizes.batch_sizes(1000.0, 0.05)
    assert fresh.telemetry_item <= sizes.telemetry_item <= 1.33 * fresh.telemetry_item


def test_the_simulated_drive_has_the_vescs_fields():
    assert list(simulated_drive(1)[0]) == [name for name, field in VESC_FIELDS.items() if 1 in field.ros]


@pytest.mark.parametrize(
    ("item", "expected"),
    [
        ({"a": "bc"}, 3),
        ({"n": 0}, 3),
        ({"n": 12345}, 5),
        ({"n": -1.5}, 4),
        ({"b": True}, 2),
        ({"l": [1, 12345]}, 1 + 3 + (1 + 2) + (1 + 4)),
    ],
)
def test_item_sizes_are_counted_as_dynamodb_counts_them(item, expected):
    assert message_sizes.item_bytes(item) == expected


def test_the_modelled_log_size_of_lambda_1_matches_its_real_lines(capsys):
    counted = Gathered("live")
    for i in range(36_000):
        delays = dict.fromkeys(("InCarMs", "UplinkMs", "ToLambdaMs", "CarToLambdaMs"), 2.34 + i % 97)
        counted.add(1_700_000_000 + i / 10, LivePublished=1, **delays)
    written = len(capsys.readouterr().out)
    assert written == pytest.approx(units(_ONE, "live", "logs") * 1e9, rel=0.1)
    whole = units(replace(_ONE, function_logs="all"), "live", "logs") * 1e9
    assert whole - 36_000 * model.PLATFORM_BYTES == pytest.approx(written, rel=0.1)


def test_each_environment_gathers_its_own_metrics():
    # Twenty milliseconds each: two at a time, and more than a hundred in ten seconds.
    for changes, lines in (({}, 0.1), ({"robots": 10}, 1.0), ({"live_hz": 0.01}, 0.01)):
        assert model.live_lines_per_s(replace(_ONE, **changes)) == lines


def test_the_modelled_length_of_other_lines_matches_the_real_lines(capsys, monkeypatch):
    monkeypatch.setenv("NAMESPACE", "iort")
    emit("summarize", BatchesSummarized=2, SamplesSummarized=100)
    emit("health", **measure("vesc", [message_sizes.batch_of(simulated_drive(50), 50)]))
    emit("echo", PongsSent=1)
    emit("incident", WebhooksSent=1)
    emit("presence", RobotsConnected=True, RobotsDisconnected=False)
    lengths = [len(line) for line in capsys.readouterr().out.splitlines()]
    modelled = [
        *(model._SUMMARIZE_LINE, model._HEALTH_LINE, model._PONG_LINE),
        *(model._INCIDENT_LINE, model._PRESENCE_LINE),
    ]
    assert lengths == pytest.approx(modelled, rel=0.1)


def test_the_model_has_the_memory_and_the_times_of_stacks_agent_and_page():
    large = Settings(account_concurrency=1000)
    assert (analysis._CORE_MB, large.at_once.drives) == (model.ANALYSIS_MB, model.DRIVES_AT_ONCE)
    assert (archive._MEMORY_MB, storage._RARE_AFTER_DAYS) == (model.ARCHIVE_MB, model.STANDARD_DAYS)
    assert (CLOCK_EVERY_S, SHORTEST_S) == (CLOCK_PING_S, report.SHORTEST_RECONNECT_S)
    pictures = (video._MOST_BYTES, VideoConfig(SimCamera()).pictures_hz)
    assert pictures == (Usage().picture_bytes, Usage().picture_hz)
    source = (ROOT / "station/web/src/views/cloudwatch.ts").read_text()
    assert f"const REFRESH_S = {report.PAGE_REFRESH_S};" in source


def test_the_documents_and_the_model_count_the_same_monitoring():
    text = (ROOT / "docs/reference/metrics.md").read_text()
    platform, services, robots = _ONE.dashboards
    for line in (
        f"| {len(METRICS)} | $0.30 each | {report.FREE_METRICS} |",
        f"| {_ONE.alarms} | $0.10 each | {report.FREE_ALARMS} |",
        f"| 4, of up to {_ONE.insights_metrics} metrics | $0.10 for each",
        f"| 3, of {platform}, {services} and {robots} metrics | $3 each | {report.FREE_DASHBOARDS}, of up to",
        f"of up to {report.FREE_DASHBOARD_METRICS} metrics each |",
        f"| {platform} metrics every {report.PAGE_REFRESH_S} s | $0.01 for 1,000 metrics | none |",
    ):
        assert line in text


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
    requests = [message for message in uplink.published if f"/name/{SHADOW}/" in message.topic]
    assert [(message.topic.rpartition("/")[2], message.payload) for message in requests] == [("get", b"")]
    # Without desired settings, the shadow holds only the agent's report.
    uplink.deliver(f"{requests[0].topic}/rejected", b'{"code": 404}')
    dispatcher.run_pending()
    agent.tick()
    assert uplink.published[-1].topic.endswith("/update")
    assert len(json.dumps(json.loads(uplink.published[-1].payload)["state"])) < _SHADOW_METER


# --- the tables and the command


def test_the_quota_that_breaks_first_needs_the_fewest_robots():
    needs = report.needs(replace(_ONE, robots=10_000, live_concurrency=5))
    at = [need.robots_at_quota for need in needs if need.robots_at_quota]
    assert at == sorted(at)
    assert needs[0].robots_at_quota == 5 / (10 * 0.020)
    assert report.needs(Usage(robots=10_000))[0].name.startswith("IoT Core")


def test_an_outage_is_compared_with_the_lower_quota_of_awss_pages():
    times = {need.name: need.times for need in report.needs(Usage(robots=60_000))}
    assert times["IoT Core: connects in a minute after an outage"] == 2
    assert times["IoT Core: connects of one client id"] == 1, "the agent waits a second at least"


def test_the_ratio_is_also_given_without_log_lines():
    """The thesis' column includes Lambda's own log lines, and ours does not."""
    unlogged = [
        sum(item.dollars for item in items if item.service != "CloudWatch")
        for items in (model.thesis_bill(_ONE), model.bill(_ONE))
    ]
    (row,) = (row for row in report.robot_hour(_ONE).body if row[0] == "total AWS without log lines")
    assert row[-1] == f"1/{unlogged[0] / unlogged[1]:.1f}"


def test_the_command_prints_json_that_adds_up(tmp_path):
    given = ["cost", "--live-hz", "2", "--hours-per-day", "4", "--json"]
    done = CliRunner().invoke(app, given, env={"XDG_CACHE_HOME": str(tmp_path)})
    assert done.exit_code == 0, done.output
    answer = json.loads(done.output)
    usage = Usage(live_hz=2.0, hours_per_day=4.0, watched_hours=4.0)
    assert answer["usage"] == json.loads(json.dumps(vars(usage)))
    summed = sum(item["dollars_per_robot_hour"] for item in answer["items"])
    assert summed == pytest.approx(answer["dollars_per_robot_hour"]) == model.total(model.bill(usage))
