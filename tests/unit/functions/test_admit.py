"""Admit: a name is admitted once, only to the robot for which the operator opened it; errors refuse."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time

import pytest
from botocore.stub import Stubber

from functions import admit
from iort_contract.dynamodb import plain
from iort_contract.tables import (
    ADMIT_CLAIM,
    ADMIT_FINGERPRINT,
    ADMIT_UNTIL_S,
    ADMITTED_CERTIFICATE,
    ADMITTED_MS,
    CONNECTED_MS,
    SERIAL,
)
from testkit.dynamodb import ROBOTS

LATER_S = int(time.time()) + 86_400


def request(robot="car", serial="s1", certificate="new", claim="claim"):
    """The request of AWS IoT; "Pre-provisioning hook input"."""
    return {
        "claimCertificateId": claim,
        "certificateId": certificate,
        "certificatePem": "-----BEGIN CERTIFICATE-----",
        "templateArn": "arn:aws:iot:eu-west-1:123456789012:provisioningtemplate/iort-robot",
        "clientId": "iort-claim-1",
        "parameters": {"Robot": robot, "Serial": serial},
    }


@pytest.fixture
def robots(dynamodb):
    """moto's robots table: `put` a row, `ask` the handler, `row` again."""

    class Robots:
        @staticmethod
        def put(robot="car", until_s=LATER_S, **row):
            item = {"robot": {"S": robot}, **{name: {"S": value} for name, value in row.items()}}
            if until_s is not None:
                item[ADMIT_UNTIL_S] = {"N": str(until_s)}
            dynamodb.put_item(TableName=ROBOTS, Item=item)

        @staticmethod
        def change(name, value):
            dynamodb.update_item(
                TableName=ROBOTS,
                Key={"robot": {"S": "car"}},
                UpdateExpression="SET #name = :value",
                ExpressionAttributeNames={"#name": name},
                ExpressionAttributeValues={":value": {"N": str(value)}},
            )

        @staticmethod
        def clear():
            for item in dynamodb.scan(TableName=ROBOTS)["Items"]:
                dynamodb.delete_item(TableName=ROBOTS, Key={"robot": item["robot"]})

        @staticmethod
        def ask(event):
            answer = admit.handler(event, None)
            assert answer.keys() == {"allowProvisioning"}
            return answer["allowProvisioning"]

        @staticmethod
        def row(robot="car"):
            return plain(dynamodb.get_item(TableName=ROBOTS, Key={"robot": {"S": robot}}).get("Item", {}))

    return Robots


def test_an_opened_name_is_admitted_once(robots, capsys):
    robots.put()
    assert robots.ask(request()) is True
    row = robots.row()
    assert (row[SERIAL], row[ADMITTED_CERTIFICATE]) == ("s1", "new")
    # The answer may have been lost; another certificate is another robot's.
    assert robots.ask(request()) is True
    assert robots.ask(request(certificate="second")) is False
    assert robots.row() == {**row, "admitted_ms": robots.row()["admitted_ms"]}
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [("RobotsAdmitted" in line, "RobotsRefused" in line) for line in lines] == [
        (True, False),
        (True, False),
        (False, True),
    ]


def test_the_admitted_certificate_is_admitted_again_after_the_time_limit(robots):
    robots.put(until_s=LATER_S, **{ADMIT_CLAIM: "claim", ADMIT_FINGERPRINT: "digits"})
    assert robots.ask(request()) is True
    robots.change(ADMIT_UNTIL_S, 1)
    # The answer came too late for AWS IoT; the robot asks again, and only this certificate may.
    for _ in range(3):
        assert robots.ask(request()) is True
        assert robots.ask(request(certificate="another")) is False
    assert robots.row()[ADMITTED_CERTIFICATE] == "new"


def test_a_claim_is_identified_by_its_id_and_its_certificates_fingerprint(robots, caplog):
    caplog.set_level("INFO")
    right = dict.fromkeys(("ab12", "cd34", "CD34", "0xAB12"), True)
    for claim, allowed in {**right, **dict.fromkeys(("ab", "0xab1", "0x", "ef56"), False)}.items():
        robots.clear()
        caplog.clear()
        robots.put(**{ADMIT_CLAIM: "ab12", ADMIT_FINGERPRINT: "cd34"})
        assert robots.ask(request(claim=claim)) is allowed, claim
        admitted, refused = f"car admitted: certificate new, claim {claim}", "for ab12 or cd34, asked with"
        assert (admitted if allowed else f"{refused} {claim}") in caplog.text


def test_the_import_creates_the_client_and_loads_few_modules():
    program = (
        "import sys; from functions import admit; "
        "print('boto3' in sys.modules, 's3transfer' in sys.modules, admit._dynamodb.cache_info().currsize)"
    )
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        "AWS_DEFAULT_REGION": "eu-west-1",
    }
    for lambda_, made in (({}, 0), ({"AWS_LAMBDA_INITIALIZATION_TYPE": "on-demand"}, 1)):
        said = subprocess.run(
            [sys.executable, "-c", program],
            env={**environment, **lambda_},
            capture_output=True,
            text=True,
            check=True,
        )
        assert said.stdout.split() == ["False", "False", str(made)]


REFUSED = [
    (None, {}, "is not registered"),
    ({"until_s": None}, {}, "no certificate may be issued"),
    # A working robot keeps its name until the operator opens the name again.
    ({"until_s": None, SERIAL: "s1", ADMITTED_CERTIFICATE: "old"}, {}, "no certificate may be issued"),
    ({"until_s": 1}, {}, "is over"),
    ({SERIAL: "another"}, {}, "another machine has the name"),
    ({ADMIT_CLAIM: "another"}, {}, "open for another claim"),
    ({"robot": "other"}, {}, "is not registered"),
    ({SERIAL: "s1", ADMITTED_CERTIFICATE: "new"}, {"serial": "s2"}, "another machine has the name"),
]


def test_every_other_request_is_refused_and_changes_nothing(robots, caplog):
    for row, asked, why in REFUSED:
        robots.clear()
        caplog.clear()
        if row is not None:
            robots.put(**row)
        before = robots.row()
        assert robots.ask(request(**asked)) is False
        assert why in caplog.text
        assert robots.row() == before


def test_a_request_that_meets_the_opened_conditions_is_admitted(robots):
    for row in [{ADMIT_CLAIM: "claim"}, {SERIAL: "s1"}, {SERIAL: "s1", ADMIT_CLAIM: "claim"}]:
        robots.put(**row)
        assert robots.ask(request()) is True
        assert robots.row()[ADMITTED_CERTIFICATE] == "new"


INCOMPLETE = [
    {},
    {"parameters": None},
    {**request(), "parameters": {}},
    {**request(), "parameters": {"Robot": "car"}},
    {**request(), "parameters": {"Robot": "car", "Serial": ""}},
    {**request(), "parameters": {"Robot": "car", "Serial": ["s1"]}},
    request(robot="a/b"),
    request(robot=None),
    request(serial="x" * 801),
    {**request(), "certificateId": None},
    # Without its claim's number a request cannot be told from another claim's.
    {name: value for name, value in request().items() if name != "claimCertificateId"},
]


def test_an_incomplete_request_is_refused(robots, capsys):
    robots.put()
    before = robots.row()
    for event in INCOMPLETE:
        assert robots.ask(event) is False, event
        assert robots.row() == before
        assert json.loads(capsys.readouterr().out)["RobotsRefused"] == 1


def test_a_request_is_refused_after_an_error_of_the_table(robots, caplog):
    for code in ["ThrottlingException", "AccessDeniedException", "InternalServerError"]:
        caplog.clear()
        with Stubber(admit._dynamodb()) as stub:
            for _ in range(2):
                stub.add_client_error("update_item", code)
            assert robots.ask(request()) is False
        assert "the check failed" in caplog.text


def test_a_deployment_without_its_table_refuses(robots, monkeypatch):
    robots.put()
    monkeypatch.delenv("ROBOTS_TABLE")
    assert robots.ask(request()) is False


def test_the_slowest_answer_is_in_time(synthesized):
    (timeout_s,) = (
        function["Timeout"]
        for function in synthesized.resources("AWS::Lambda::Function").values()
        if function["Handler"] == "functions.admit.handler"
    )
    config = admit._CONFIG
    # Botocore waits up to a second, at random, before a second attempt.
    assert config.retries["total_max_attempts"] == 1
    # Take the admission, ask for the status of the certificate that has it, take it instead of that.
    assert 3 * (config.connect_timeout + config.read_timeout) < timeout_s < 5


NOW_MS = 1_800_000_000_000
ITS_ROW = {ADMITTED_CERTIFICATE: {"S": "first"}, ADMITTED_MS: {"N": str(NOW_MS)}}


@pytest.mark.parametrize(
    ("status", "connected_ms", "gives_way"),
    [
        ("PENDING_ACTIVATION", None, True),
        # A working robot uses its older certificate while a new one is issued.
        ("PENDING_ACTIVATION", NOW_MS + 1, True),
        ("ACTIVE", None, False),
        ("INACTIVE", None, False),
        ("REVOKED", None, False),
        (None, None, True),
        (None, NOW_MS - 3_600_000, True),
        (None, NOW_MS - 60_000, False),
        (None, NOW_MS + 3_600_000, False),
    ],
)
def test_only_a_certificate_that_never_connected_gives_way(status, connected_ms, gives_way):
    row = dict(ITS_ROW)
    if connected_ms is not None:
        row[CONNECTED_MS] = {"N": str(connected_ms)}
    assert admit.gives_way(row, status) is gives_way


@pytest.fixture
def iot(monkeypatch):
    """moto's AWS IoT: `made` makes a certificate with a status."""
    import boto3

    monkeypatch.setenv("AWS_DEFAULT_REGION", "eu-west-1")
    client = boto3.client("iot", region_name="eu-west-1")

    def made(status):
        number = client.create_keys_and_certificate(setAsActive=True)["certificateId"]
        client.update_certificate(certificateId=number, newStatus=status)
        return number

    return made


def spent(robots, certificate, **row):
    """A name to which a certificate was admitted some time ago."""
    robots.clear()
    robots.put(**{SERIAL: "s1", ADMIT_CLAIM: "claim", ADMIT_FINGERPRINT: "digits", **row})
    assert robots.ask(request(certificate=certificate, claim=row.get(ADMIT_CLAIM, "claim"))) is True
    robots.change(ADMITTED_MS, time.time_ns() // 1_000_000 - admit.SETTLED_MS)


def test_an_admitted_certificate_that_never_registered_gives_way_to_another(robots, iot):
    first = iot("PENDING_ACTIVATION")
    spent(robots, first)
    assert robots.ask(request(certificate="second")) is True
    assert robots.row()[ADMITTED_CERTIFICATE] == "second"
    # The first certificate has lost the name.
    assert robots.ask(request(certificate=first)) is False


def test_a_registered_certificate_keeps_the_name(robots, iot, caplog):
    spent(robots, iot("ACTIVE"))
    before = robots.row()
    assert robots.ask(request(certificate="second")) is False
    assert "another certificate has its admission" in caplog.text
    assert robots.row() == before


@pytest.mark.parametrize(
    ("asked", "changed"),
    [
        ({"claim": "another"}, {}),
        ({"serial": "s2"}, {}),
        ({}, {ADMIT_UNTIL_S: 1}),
        # AWS IoT may still be registering it.
        ({}, {ADMITTED_MS: LATER_S * 1000}),
    ],
)
def test_a_request_of_another_robot_asks_aws_iot_nothing(robots, iot, monkeypatch, asked, changed):
    spent(robots, iot("PENDING_ACTIVATION"))
    for name, value in changed.items():
        robots.change(name, value)
    before = robots.row()
    monkeypatch.setattr(admit, "_status", pytest.fail)
    assert robots.ask(request(certificate="second", **asked)) is False
    assert robots.row() == before


def test_a_certificate_keeps_the_name_while_aws_iot_does_not_answer(robots, iot, monkeypatch, caplog):
    spent(robots, iot("PENDING_ACTIVATION"))
    monkeypatch.setenv("AWS_ENDPOINT_URL_IOT", "http://127.0.0.1:9")
    assert robots.ask(request(certificate="second")) is False
    assert "the check failed" in caplog.text


def test_one_of_two_simultaneous_takeovers_succeeds(robots, iot):
    first = iot("PENDING_ACTIVATION")
    spent(robots, first)
    # Both have read the row; the second one's condition is no longer met.
    now_ms = time.time_ns() // 1_000_000
    has = admit.Earlier(first, int(robots.row()[ADMITTED_MS]))
    assert admit._take(admit.admission(request(certificate="second"), now_ms, has)) is None
    assert admit._take(admit.admission(request(certificate="third"), now_ms, has)) is not None
    assert robots.row()[ADMITTED_CERTIFICATE] == "second"
