"""Presence: the row is right with the broker's events in any order and any repetition."""

from __future__ import annotations

import itertools
import json
from decimal import Decimal

import pytest
from botocore.exceptions import ClientError

from functions import presence
from iort_contract.catalog.metrics import metrics_of
from iort_contract.dynamodb import plain
from iort_contract.limits import ContractError
from testkit.dynamodb import ROBOTS

MINUTE_MS = 60_000
T0 = 1_700_000_000_000


def connected(version=0, at_ms=T0, client="car", certificate="c" * 64):
    return {
        "clientId": client,
        "timestamp": at_ms,
        "eventType": "connected",
        "sessionIdentifier": "00000000-0000-0000-0000-000000000000",
        "principalIdentifier": certificate,
        "ipAddress": "192.0.2.0",
        "versionNumber": version,
    }


def disconnected(version=0, at_ms=T0, reason="CONNECTION_LOST", client="car"):
    return {
        "clientId": client,
        "timestamp": at_ms,
        "eventType": "disconnected",
        "sessionIdentifier": "00000000-0000-0000-0000-000000000000",
        "principalIdentifier": "c" * 64,
        "clientInitiatedDisconnect": False,
        "disconnectReason": reason,
        "versionNumber": version,
    }


@pytest.fixture
def table(dynamodb, monkeypatch):
    """moto's robots table with one robot; a call with events returns the resulting row."""
    monkeypatch.setenv("ROBOTS_TABLE", ROBOTS)
    monkeypatch.setenv("NAMESPACE", "iort")

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
    "back again": [
        connected(3, T0),
        disconnected(3, T0 + 1000),
        connected(4, T0 + 2000, certificate="d" * 64),
    ],
    "flapping": [
        connected(0, T0),
        disconnected(0, T0 + 10),
        connected(7, T0 + 20),
        disconnected(7, T0 + 30),
    ],
}


def test_events_in_any_order_and_repetition_give_the_same_row(table):
    for events in STORIES.values():
        _any_order(table, events)


def _any_order(table, events):
    last = max(events, key=lambda event: (event["versionNumber"], event["eventType"] == "disconnected"))
    for order in itertools.permutations(events):
        row = table(*order, order[0], order[-1])
        assert row["online"] == (last["eventType"] == "connected"), order
        assert row["session_version"] == last["versionNumber"]
        assert row["last_seen_ms"] == last["timestamp"]
        if row["online"]:
            assert "disconnect_reason" not in row
        newest = max(
            (event for event in events if event["eventType"] == "connected"),
            key=lambda event: event["versionNumber"],
        )
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
        _changes_nothing(table, event, capsys)


def _changes_nothing(table, event, capsys):
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


def test_times_are_stored_as_integers(table):
    assert table(connected())["last_seen_ms"] == Decimal(T0)
