"""The bench's sections evaluate their measurements."""

from __future__ import annotations

import pytest

from bench.report import Section
from bench.ros import mixed_robot
from bench.sections import (
    SECTIONS,
    command,
    fairness,
    mixed,
    outage,
    query,
    recorder,
    ros2,
    round_trips,
    utilisation,
    viewing,
)
from bench.sections.round_trips import RAW
from bench.sections.utilisation import BATCHES, Measured
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.ros.definition import parse
from iort_contract.topics import BROKER, LAMBDA, RULE, live_topic, record_topic
from testkit import ROOT
from testkit.machine import Usage


def test_lambdas_report_lines_are_read():
    line = "REPORT RequestId: 8f50\tDuration: 12.34 ms\tBilled Duration: 13 ms\tMemory Size: 256 MB\t"
    tail = f"START RequestId: 8f50 Version: $LATEST\nREPORTED\nEND RequestId: 8f50\n{line}\n"
    assert utilisation.duration_ms(tail) == 12.34
    assert utilisation.duration_ms("START RequestId: 8f50\n") is None


def test_functions_are_compared_with_their_floors_beyond_an_empty_function():
    live, one = "Lambda 1 (live)", "Lambda 2, an event of 1 batch"
    many = f"Lambda 2, an event of {BATCHES} batches"
    cpu_ms = {
        live: [2.0, 2.2, 2.1],
        f"floor of {live}": [1.2, 1.2, 1.2],
        one: [3.7] * 3,
        f"floor of {one}": [1.2] * 3,
        many: [50.2] * 3,
        f"floor of {many}": [20.2] * 3,
        "empty function": [0.2] * 3,
    }
    measured = {name: Measured([[1.0]], values) for name, values in cpu_ms.items()}
    section = utilisation.report(measured, {"p50": 0.004, "p95": 0.005})
    values = {ratio.name: ratio.value for ratio in section.ratios}
    assert values[f"{live}: processor / its floor"] == 1.9
    assert values[f"{one}: processor / its floor"] == 3.5
    assert values[f"{many}: processor / its floor"] == 2.5
    assert values["node's cycle / thesis' 2 ms"] == 0.002
    assert [ratio.reached for ratio in section.ratios] == [True, False, True, True]


def test_the_outage_section_reports_before_during_and_after():
    second = 1_000_000
    live = [(t * second, 5.0) for t in range(8)] + [(70 * second + i * 100_000, 7.0) for i in range(20)]
    found = outage.Outage(
        lost=0,
        summarized=4000,
        sent=4000,
        duplicated=0,
        missing=0,
        drain_s=3.0,
        live=live,
        cut_us=8 * second,
        mended_us=68 * second,
    )
    section = outage.report(found)
    values = {ratio.name: ratio.value for ratio in section.ratios}
    assert values["samples lost over an outage"] == 0
    assert values["time to drain / outage"] == 0.05
    assert values["live delay after / before"] == 1.4
    assert ["from the way's return to the first live sample", "2.0 s"] in section.tables[0].rows
    assert ["live samples of the outage that came late to the dashboard", "0"] in section.tables[0].rows


def test_the_thesis_reader_follows_every_page():
    pages = [{"Items": [1, 2], "LastEvaluatedKey": "k"}, {"Items": [3]}]
    asked = []

    def read(**arguments):
        asked.append(arguments)
        return pages[len(asked) - 1]

    assert query.pages(read, Limit=2) == 3
    assert asked == [{"Limit": 2}, {"Limit": 2, "ExclusiveStartKey": "k"}]


def test_round_trips_with_the_thesis_ping_are_shown_beside_its_figures():
    took_ms = {BROKER: 52.0, RULE: 53.0, LAMBDA: 58.0, RAW: 51.0}
    cells = {
        ("0.5 KB", hz): {way: [[ms] * 3] * 3 for way, ms in took_ms.items()} for hz in round_trips.RATES_HZ
    }
    section = Section("round_trips", "")
    round_trips.report_far(section, cells, [60.0] * 3)
    rows = {row[0]: row[1:] for row in section.tables[0].rows}
    assert rows["0.5 KB at 10 Hz"][0] == "52.00 ms (p95 52.00)"
    assert rows["thesis, 2018"][:3] == ["50 - 60 ms", "100 - 110 ms", "150 - 200 ms"]
    values = {ratio.name: ratio.value for ratio in section.ratios}
    assert values["broker round trip / raw MQTT client, with 25 ms each way"] == 1.02
    assert values["robot - broker with 25 ms each way / thesis' 60 ms"] == 0.8667
    assert values["car to subscriber with 25 ms each way / thesis' 300 ms"] == 0.2


def test_a_query_is_shown_beside_the_thesis_query_from_the_same_place():
    section = query.report({name: query.Way([1.0], [0.5]) for name in query.THESIS_S})
    theirs = {row[0]: row[-1] for row in section.tables[0].rows}
    assert theirs[query.OURS_QUERY] == theirs[query.THESIS_QUERY] == "6.1 s"
    assert theirs[query.OURS_SCAN] == theirs[query.THESIS_SCAN] == "14.1 s"
    assert theirs[query.LAMBDA_QUERY] == "5.5 s (512 MB)"


def test_the_ros2_section_has_targets_for_processor_loss_and_delay():
    runs = [
        ros2.Run(
            "rmw_a",
            load,
            load == "spread",
            1000,
            {ros2.AGENT: agent_us, ros2.FLOOR: 100.0},
            {},
            {ros2.AGENT: lost},
            {},
            {},
        )
        for load, agent_us, lost in (
            ("fast", 80.0, 0),
            ("many", 120.0, 3),
            ("spread", 110.0, 0),
            ("big", 300.0, 0),
        )
    ]
    section = Section("ros2", "")
    ros2.report(section, runs, {"rmw_a": (ros2.Spread(3.0, 3.5, 9), ros2.Spread(1.0, 2.0, 9), 0.5)})
    assert [(ratio.value, ratio.reached) for ratio in section.ratios] == [
        *(
            (0.8, True),
            (0, True),
            (1.2, False),
            (3, False),
            (1.1, None),
            (0, True),
            (3.0, None),
            (0, True),
            (1.5, False),
        ),
    ]


def test_the_recorders_section_has_targets_for_processor_bytes_and_loss():
    one = recorder.Run(
        "rosbag record",
        10.0,
        10_000,
        {recorder.WITH: 0.3, recorder.WITHOUT: 0.1, recorder.RECORDER: 0.2},
        {recorder.WITH: 32_000_000, recorder.RECORDER: 32_000_000},
        {recorder.WITH: recorder.Spread(2.0, 3.0, 9), recorder.WITHOUT: recorder.Spread(1.5, 2.0, 9)},
        0,
        16_000_000,
        0.3,
    )
    section = Section("recorder", "")
    recorder.report(section, [one])
    assert [(ratio.value, ratio.reached) for ratio in section.ratios] == [
        *((1.5, False), (1.0, True), (0.5, None), (0.2, None), (0, True), (1.0, True), (0.001389, None)),
    ]


def test_the_mixed_robots_topics_have_the_types_of_their_definitions():
    for topic in mixed_robot.topics().values():
        assert parse(topic.kind, topic.definition).kind == topic.kind
    by_name = mixed_robot.topics()
    assert by_name["/imu"].rate_hz == 1000
    assert by_name["/map"].rate_hz == 0, "latched"
    assert [name for name, one in by_name.items() if one.time == mixed_robot.ARRIVAL] == [
        "/tf",
        "/tick",
        "/contact",
    ]


def mixed_run(arrived):
    found = mixed.Recorded(seconds=mixed.SECONDS, bag_bytes=4000, bag_bz2_bytes=2000)
    found.published.update({"/tf": 60, "/imu": 40})
    found.recorded.update({"/tf": 60, "/imu": 40})
    cpu_s = {mixed.RECORDER: 0.1, mixed.AGENT: 0.3, mixed.FLOOR: 0.2}
    found.used = {who: Usage(spent_s, 50.0) for who, spent_s in cpu_s.items()}
    found.agent = {"sources": [{"source": "ROS 1", "/scan": {"messages": 5, "left_out": {"ranges": 5}}}]}
    mixed.count(found, arrived, ended=100.0)
    return found


def batch(seq, n):
    return encode_batch(
        Batch("0badcafe", seq, [1_700_000_000_000_000 + i for i in range(n)], {"x": [1.0] * n})
    )


def test_the_mixed_robot_section_counts_each_batch_once_and_late_batches():
    tf, imu = record_topic("bench", "tf"), record_topic("bench", "imu")
    found = mixed_run(
        [
            (99.0, tf, batch(0, 30)),
            (99.5, tf, batch(0, 30)),
            (103.0, tf, batch(1, 20)),
            (99.0, imu, batch(0, 40)),
            (99.0, live_topic("bench", "imu"), b"live"),
            (99.0, record_topic("bench", "agent"), batch(0, 1)),
        ]
    )
    assert found.arrived == {"/tf": 50, "/imu": 40}
    assert found.late == 20
    assert found.lane_bytes["live"] == 4
    assert found.lost(found.arrived) == 10
    assert found.lost({"/tf": 90, "/imu": 40}) == 0


def test_the_mixed_robot_section_has_targets_for_lost_and_omitted_messages():
    sent = batch(0, 60)
    section = Section("mixed", "")
    mixed.report(section, mixed_run([(99.0, record_topic("bench", "tf"), sent)]))
    values = {ratio.name.removeprefix("mixed robot: "): ratio for ratio in section.ratios}
    assert values["messages that the agent lost"].value == 40
    assert values["messages that the agent lost"].reached is False
    assert values["fields that the agent left out"].value == 5
    assert values["the agent's processor / rosbag record's"].value == 3.0
    assert values["the agent's processor / a bare rospy subscriber's"].value == 1.5
    assert values["bytes published / bytes of the bag"].value == pytest.approx(len(sent) / 4000, rel=1e-3)


def test_the_fairness_target_is_twice_the_delay_of_a_car_alone():
    section = Section("fairness", "")
    delays = {"nothing": [[10.0] * 80], "bad messages": [[19.0] * 80], "good messages": [[21.0] * 40]}
    fairness.report(section, delays, "Delays", "a car's p95", "updates of the car", 4.0)
    values = [(ratio.value, ratio.reached) for ratio in section.ratios]
    assert values == [(1.9, True), (1.0, True), (2.1, False), (0.5, False)]
    assert section.ratios[0].name == "a car's p95 beside a robot of bad messages / alone"
    assert section.tables[0].rows[1][:2] == ["bad messages", "80"]


def test_a_car_that_sends_while_nobody_looks_misses_the_target_and_so_does_a_late_one():
    targets = {}
    for idle, wake_ms in ((6, 100.0), (600, 1500.0)):
        delays = {"iot": [9.0, 11.0], "pubnub": [20.0, 30.0]}
        section = viewing.report(idle, dict.fromkeys(delays, [wake_ms] * 20), delays)
        targets[idle] = [ratio.reached for ratio in section.ratios]
    assert targets == {6: [True] * 3, 600: [False] * 3}
    assert section.tables[0].rows[0][2].startswith("10.0 ms")


def test_a_command_is_compared_with_python_of_the_same_turn():
    found = {
        "python -c pass": [command.Times(0.04, 0.02), command.Times(0.08, 0.04)],
        **{name: [command.Times(0.5, 0.2), command.Times(0.9, 0.4)] for name in command.TARGETS},
    }
    found["iort --help"] = [command.Times(0.5, 0.3), command.Times(0.9, 0.6)]
    section = command.report(found)
    assert [(ratio.value, ratio.reached) for ratio in section.ratios[:2]] == [(15.0, False), (10.0, True)]
    assert section.tables[0].rows[1] == ["iort --help", "0.700 s", "0.450 s", "0.25 s"]


def test_the_documentation_lists_every_section():
    text = (ROOT / "docs/explanation/benchmark.md").read_text()
    assert {key for key in SECTIONS if f"| `{key}` |" in text} == set(SECTIONS)
