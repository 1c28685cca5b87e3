"""Alerts: which mails are sent, and how often."""

from __future__ import annotations

import json
import math

import boto3
import pytest

from functions.alert import QUIET_S, Notices, causes, process
from iort_contract.limits import ContractError
from testkit.dynamodb import NAMES

NOW_S = 1_700_000_000


def event(**sample):
    return {"topic": "live/iort/car7/vesc", "t": 1, "received_ms": NOW_S * 1000, **sample}


class Mailbox:
    def __init__(self):
        self.mails = []

    def __call__(self, subject, text):
        self.mails.append((subject, text))


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
    ((subject, text),) = mailbox.mails
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
    assert len(mailbox.mails) == 1
    assert emitted(capsys) == [1, 49]
    process(event(fault_code=1), 10.5, notices, mailbox, NOW_S + QUIET_S)
    assert len(mailbox.mails) == 2
    # Another cause and another car are mailed at once.
    process(event(fault_code=4), 10.5, notices, mailbox, NOW_S + QUIET_S)
    process({**event(fault_code=1), "topic": "live/iort/car8/vesc"}, 10.5, notices, mailbox, NOW_S + QUIET_S)
    assert [subject.split(",")[0] for subject, _ in mailbox.mails[2:]] == ["iort: car7", "iort: car8"]


def test_only_one_of_two_environments_sends_the_mail(dynamodb, notices):
    mailbox = Mailbox()
    for one in (notices, Notices(dynamodb, NAMES["robots"])):
        process(event(fault_code=1), 10.5, one, mailbox, NOW_S)
    assert len(mailbox.mails) == 1


def test_a_mail_that_failed_is_sent_by_the_next_event(notices):
    def refused(_subject, _text):
        raise ConnectionError("no SNS")

    with pytest.raises(ConnectionError):
        process(event(fault_code=1), 10.5, notices, refused, NOW_S)
    mailbox = Mailbox()
    process(event(fault_code=1), 10.5, notices, mailbox, NOW_S)
    assert len(mailbox.mails) == 1


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
    assert mailbox.mails == []
    assert "Item" not in dynamodb.get_item(TableName=NAMES["robots"], Key={"robot": {"S": "car7"}})


def test_an_error_of_the_table_is_raised(aws):
    with pytest.raises(boto3.client("dynamodb").exceptions.ResourceNotFoundException):
        process(event(fault_code=1), 10.5, Notices(boto3.client("dynamodb"), "none"), Mailbox(), NOW_S)


def test_an_invalid_topic_is_refused(notices):
    with pytest.raises(ContractError):
        process({**event(fault_code=1), "topic": "x"}, 10.5, notices, Mailbox(), NOW_S)
