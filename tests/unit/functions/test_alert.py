"""Alerts: which mails are sent, and how often."""

from __future__ import annotations

import itertools
import json
import math

import boto3
import pytest
from botocore.exceptions import ClientError

from functions import presence
from functions.alert import QUIET_S, Notices, causes, process
from iort_contract.catalog.metrics import metrics_of
from iort_contract.dynamodb import plain
from iort_contract.limits import ContractError
from testkit.dynamodb import NAMES, ROBOTS

NOW_S = 1_700_000_000


def event(**sample):
    return {"topic": "live/iort/car7/vesc", "t": 1, "received_ms": NOW_S * 1000, **sample}


class Mailbox(list):
    def __call__(self, subject, text):
        self.append((subject, text))


@pytest.fixture
def notices(dynamodb):
    for robot in ("car7", "car8"):
        dynamodb.put_item(TableName=NAMES["robots"], Item={"robot": {"S": robot}})
    return Notices(dynamodb, NAMES["robots"])


def emitted(capsys):
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    return [sum(line.get(name, 0) for line in lines) for name in ("AlertsSent", "AlertsHeld")]


def test_a_mail_names_the_faults_robot_code_and_time(notices):
    mailbox = Mailbox()
    process(event(fault_code=5, voltage_input=12.0), 10.5, notices, mailbox, NOW_S)
    ((subject, text),) = mailbox
    assert subject == "iort: car7, fault 5, MOSFET over-temperature"
    assert "2023-11-14 22:13:20 UTC" in text
    assert "live/iort/car7/vesc" in text


@pytest.mark.parametrize(
    ("sample", "keys"),
    [
        ({"fault_code": 2, "voltage_input": 9.0}, ["alert_fault_2", "alert_low_voltage"]),
        ({"fault_code": 0, "voltage_input": 9.0}, ["alert_low_voltage"]),
        # All unknown codes are one cause.
        *(({"fault_code": code}, ["alert_fault_unknown"]) for code in (99, 100, 0.5, 1e300, math.inf)),
        # A controller without voltage measurement reports 0.
        ({"fault_code": 0, "voltage_input": 0}, []),
        ({"fault_code": "3", "voltage_input": None}, []),
        ({"fault_code": True}, []),
        ({}, []),
    ],
)
def test_causes_follow_from_the_sample(sample, keys):
    assert [cause.key for cause in causes(sample, 10.5)] == keys


def test_a_lasting_fault_is_mailed_once_per_quiet_period(notices, capsys):
    mailbox = Mailbox()
    for tenth in range(50):
        process(event(fault_code=1), 10.5, notices, mailbox, NOW_S + tenth // 10)
    assert len(mailbox) == 1
    assert emitted(capsys) == [1, 49]
    process(event(fault_code=1), 10.5, notices, mailbox, NOW_S + QUIET_S)
    assert len(mailbox) == 2
    # Another cause and another car are mailed at once.
    process(event(fault_code=4), 10.5, notices, mailbox, NOW_S + QUIET_S)
    process({**event(fault_code=1), "topic": "live/iort/car8/vesc"}, 10.5, notices, mailbox, NOW_S + QUIET_S)
    assert [subject.split(",")[0] for subject, _ in mailbox[2:]] == ["iort: car7", "iort: car8"]


def test_only_one_of_two_environments_sends_the_mail(dynamodb, notices):
    mailbox = Mailbox()
    for one in (notices, Notices(dynamodb, NAMES["robots"])):
        process(event(fault_code=1), 10.5, one, mailbox, NOW_S)
    assert len(mailbox) == 1


def test_a_mail_that_failed_is_sent_by_the_next_event(notices):
    def refused(_subject, _text):
        raise ConnectionError("no SNS")

    with pytest.raises(ConnectionError):
        process(event(fault_code=1), 10.5, notices, refused, NOW_S)
    mailbox = Mailbox()
    process(event(fault_code=1), 10.5, notices, mailbox, NOW_S)
    assert len(mailbox) == 1


def test_the_other_attributes_of_the_registrys_row_are_kept(dynamodb, notices):
    dynamodb.put_item(TableName=NAMES["robots"], Item={"robot": {"S": "car7"}, "vehicle": {"S": "f1tenth"}})
    process(event(fault_code=1), 10.5, notices, Mailbox(), NOW_S)
    row = dynamodb.get_item(TableName=NAMES["robots"], Key={"robot": {"S": "car7"}})["Item"]
    assert row["vehicle"] == {"S": "f1tenth"}
    assert row["alert_fault_1"] == {"N": str(NOW_S)}


def test_a_removed_robot_that_still_sends_gets_no_row(dynamodb, notices):
    mailbox = Mailbox()

    def removed_meanwhile(_subject, _text):
        dynamodb.delete_item(TableName=NAMES["robots"], Key={"robot": {"S": "car7"}})
        raise ConnectionError("no SNS")

    with pytest.raises(ConnectionError):
        process(event(fault_code=1), 10.5, notices, removed_meanwhile, NOW_S)
    process(event(fault_code=1), 10.5, notices, mailbox, NOW_S)
    assert mailbox == []
    assert "Item" not in dynamodb.get_item(TableName=NAMES["robots"], Key={"robot": {"S": "car7"}})


def test_an_error_of_the_table_is_raised(aws):
    with pytest.raises(boto3.client("dynamodb").exceptions.ResourceNotFoundException):
        process(event(fault_code=1), 10.5, Notices(boto3.client("dynamodb"), "none"), Mailbox(), NOW_S)


def test_an_invalid_topic_is_refused(notices):
    with pytest.raises(ContractError):
        process({**event(fault_code=1), "topic": "x"}, 10.5, notices, Mailbox(), NOW_S)


# Presence: the row is right with the broker's events in any order and any repetition.

MINUTE_MS = 60_000
T0 = 1_700_000_000_000


def session(kind, version, at_ms, client, certificate="c" * 64, **more):
    return {
        "clientId": client,
        "timestamp": at_ms,
        "eventType": kind,
        "sessionIdentifier": "00000000-0000-0000-0000-000000000000",
        "principalIdentifier": certificate,
        "versionNumber": version,
        **more,
    }


def connected(version=0, at_ms=T0, client="car", **given):
    return session("connected", version, at_ms, client, ipAddress="192.0.2.0", **given)


def disconnected(version=0, at_ms=T0, reason="CONNECTION_LOST", client="car"):
    more = {"clientInitiatedDisconnect": False, "disconnectReason": reason}
    return session("disconnected", version, at_ms, client, **more)


@pytest.fixture
def table(dynamodb):
    """moto's robots table with one robot; a call with events returns the resulting row."""

    def row_after(*events):
        dynamodb.put_item(TableName=ROBOTS, Item={"robot": {"S": "car"}, "speed_to_erpm_gain": {"N": "4614"}})
        for event in events:
            presence.handler(event, None)
        row = plain(dynamodb.get_item(TableName=ROBOTS, Key={"robot": {"S": "car"}})["Item"])
        assert row.pop("speed_to_erpm_gain") == 4614
        return row

    return row_after


def test_a_connection_and_its_end_are_recorded(table):
    assert table(connected()) == {
        "robot": "car",
        "online": True,
        "connected_ms": T0,
        "last_seen_ms": T0,
        "session_version": 0,
        "certificate_id": "c" * 64,
    }
    row = table(connected(), disconnected(at_ms=T0 + 5, reason="MQTT_KEEP_ALIVE_TIMEOUT"))
    assert (row["online"], row["disconnected_ms"], row["last_seen_ms"]) == (False, T0 + 5, T0 + 5)
    assert row["disconnect_reason"] == "MQTT_KEEP_ALIVE_TIMEOUT"
    assert row["connected_ms"] == T0


STORIES = {
    "a day": [connected(3, T0), disconnected(3, T0 + 10 * MINUTE_MS)],
    # The broker's clocks are up to two minutes apart.
    "clocks apart": [connected(3, T0 + MINUTE_MS), disconnected(3, T0)],
    "takeover": [connected(3, T0), connected(4, T0 + 1000), disconnected(3, T0 + 1001, "DUPLICATE_CLIENTID")],
    "back": [connected(3), disconnected(3, T0 + 1000), connected(4, T0 + 2000, certificate="d" * 64)],
    "flapping": [connected(), disconnected(0, T0 + 10), connected(7, T0 + 20), disconnected(7, T0 + 30)],
}


@pytest.mark.parametrize("events", STORIES.values(), ids=STORIES)
def test_events_in_any_order_and_repetition_give_the_same_row(table, events):
    last = max(events, key=lambda event: (event["versionNumber"], event["eventType"] == "disconnected"))
    connects = [event for event in events if event["eventType"] == "connected"]
    newest = max(connects, key=lambda event: event["versionNumber"])
    for order in itertools.permutations(events):
        row = table(*order, order[0], order[-1])
        assert row["online"] == (last["eventType"] == "connected"), order
        assert row["session_version"] == last["versionNumber"]
        assert row["last_seen_ms"] == last["timestamp"]
        assert not (row["online"] and "disconnect_reason" in row)
        assert row["connected_ms"] == newest["timestamp"], order
        assert row["certificate_id"] == newest["principalIdentifier"], order


def test_versions_that_restart_after_an_hour_are_newer(table):
    away = disconnected(9, T0)
    back = connected(0, T0 + 61 * MINUTE_MS)
    for order in itertools.permutations([connected(9, T0 - MINUTE_MS), away, back]):
        row = table(*order)
        assert (row["online"], row["session_version"]) == (True, 0), order


def test_a_connection_of_several_hours_ends(table):
    assert table(connected(2), disconnected(2, T0 + 300 * MINUTE_MS))["online"] is False
    # A copy of the connect event that comes hours late does not set the robot online again.
    assert table(connected(2), disconnected(2, T0 + 300 * MINUTE_MS), connected(2))["online"] is False


def test_the_agents_version_is_recorded(table, capsys):
    assert table({"robot": "car", "agent_version": "0.1.0"}) == {"robot": "car", "agent_version": "0.1.0"}
    row = table({"robot": "car", "agent_version": "0.1.0"}, connected())
    assert (row["agent_version"], row["online"]) == ("0.1.0", True)


def test_a_client_without_a_row_gets_no_row(table, dynamodb, capsys):
    for event in (
        connected(client="iort-claim-1"),
        disconnected(client="x"),
        {"robot": "x", "agent_version": "1"},
    ):
        presence.handler(event, None)
    table()
    assert dynamodb.scan(TableName=ROBOTS)["Count"] == 1
    counted = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["PresenceIgnored"] for line in counted] == [1, 1, 1]


NO_EVENTS = [
    {},
    {"eventType": "connected"},
    {**connected(), "timestamp": "1"},
    {**connected(), "timestamp": True},
    {**connected(), "versionNumber": -1},
    {**connected(), "versionNumber": 1.5},
    {**connected(), "clientId": "a/b"},
    {**connected(), "principalIdentifier": None},
    {**connected(), "principalIdentifier": "x" * 200},
    {**disconnected(), "disconnectReason": ["x"]},
    {**connected(), "eventType": "connect_failed"},
    {"robot": "car", "agent_version": ""},
    {"robot": "car", "agent_version": {"deep": 1}},
    {"robot": "#", "agent_version": "1"},
]


def test_a_foreign_event_changes_nothing(table, capsys):
    for event in NO_EVENTS:
        with pytest.raises(ContractError):
            presence.change(event)
        assert table(event) == {"robot": "car"}
        assert json.loads(capsys.readouterr().out)["PresenceIgnored"] == 1


def test_an_error_of_dynamodb_is_raised_so_that_lambda_retries(table, monkeypatch):
    monkeypatch.setenv("ROBOTS_TABLE", "gone")
    with pytest.raises(ClientError, match="ResourceNotFoundException"):
        presence.handler(connected(), None)


def test_connections_disconnections_and_ignored_events_are_counted(table, capsys):
    table(connected(), disconnected(), disconnected())
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    counted = [{name: line[name] for name in metrics_of("presence") if name in line} for line in lines]
    assert counted == [{"RobotsConnected": 1}, {"RobotsDisconnected": 1}, {"PresenceIgnored": 1}]
