"""Answer: what a robot asks is answered once, within its limits, and everything else is refused with why."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from functions import answer
from functions.shared.questions import WORK, Bodies, RefusedError
from functions.shared.quotas import HOUR, Quota
from iort_contract.catalog.questions import CALIBRATION, QUESTIONS, RACELINE, Question
from iort_contract.findings_table import FindingsTable
from iort_contract.limits import ContractError
from iort_contract.messages.analysis import AnalysedDrive, DriveKey, Estimate
from iort_contract.messages.envelope import rule_event
from iort_contract.messages.files import File, file_key
from iort_contract.messages.questions import (
    FAILED,
    INVALID,
    MALFORMED,
    MAX_INLINE_BYTES,
    NO_DATA,
    OVER_QUOTA,
    REASONS,
    TOO_LARGE,
    TOO_LATE,
    UNKNOWN,
    Answer,
    Ask,
    Content,
    Refusal,
    decode_answer,
    encode_answer,
    encode_ask,
)
from iort_contract.tables import ROBOT
from iort_contract.topics import ANSWER, ASK, build_topic
from iort_contract.track import parse_track
from testkit.dynamodb import FILES, FINDINGS, ROBOTS

NOW_S = 1_700_000_000.0
NOW_US, NOW_MS = int(NOW_S * 1e6), int(NOW_S * 1000)
ID = "0123456789abcdef"
ECHO = Question("echo", "the body", 2, max_question_bytes=2 * MAX_INLINE_BYTES, max_answer_bytes=10**6)


def ask(body=None, **changes):
    return Ask(**{"id": ID, "sent_us": NOW_US, "valid_ms": 5_000, "body": body or {}, **changes})


def event(asked, robot="car", name="echo", received_s=0):
    message = asked if isinstance(asked, bytes) else encode_ask(asked)
    return rule_event(message, build_topic(ASK, robot, name), NOW_MS + 1000 * received_s)


@pytest.fixture(autouse=True)
def registered(dynamodb):
    dynamodb.put_item(TableName=ROBOTS, Item={ROBOT: {"S": "car"}})


class Served:
    """One environment of the function, with its answers."""

    def __init__(self, s3, dynamodb):
        self.dynamodb = dynamodb
        self.said = []
        self.work = lambda _robot, body: body
        work = dict.fromkeys(QUESTIONS, self._worked)
        self.desk = answer.Desk(work, self._quota, Bodies(s3, FILES), self._reply)

    def __call__(self, asked, *, now_s=NOW_S, **event_of):
        answer.serve(event(asked, **event_of), self.desk, now_s)
        return self.said[-1][1].body if self.said else None

    def _worked(self, robot, body):
        return self.work(robot, body)

    def _quota(self, question):
        named = (question.hour_attribute, question.count_attribute)
        return Quota(self.dynamodb, table=ROBOTS, named=named, period=HOUR, most=question.per_hour)

    def _reply(self, topic, found):
        self.said.append((topic.robot, decode_answer(encode_answer(found))))


@pytest.fixture
def serve(s3, dynamodb, monkeypatch):
    monkeypatch.setitem(QUESTIONS, ECHO.name, ECHO)
    return Served(s3, dynamodb)


def test_the_robot_of_the_topic_is_answered_and_counted(serve, capsys):
    assert serve(ask({"a": [1.5, None]})) == {"a": [1.5, None]}
    assert serve.said == [("car", Answer(ID, {"a": [1.5, None]}))]
    assert json.loads(capsys.readouterr().out)["QuestionsAnswered"] == 1


def test_a_number_beyond_json_is_refused_and_no_failure_of_the_function(serve):
    message = encode_ask(ask({"a": 1})).replace(b'{"a":1}', b'{"a":1e999}')
    assert serve(message).reason == INVALID


def test_an_unknown_question_is_refused(serve, capsys):
    refused = serve(ask(), name="nobody")
    assert (refused.reason, "calibration" in refused.text) == (UNKNOWN, True)
    assert json.loads(capsys.readouterr().out)["QuestionsRefused"] == 1


def test_the_quota_is_a_robots_own_and_new_each_hour(serve, dynamodb):
    dynamodb.put_item(TableName=ROBOTS, Item={ROBOT: {"S": "car2"}})
    assert [serve(ask({"n": n})) for n in range(2)] == [{"n": 0}, {"n": 1}]
    assert serve(ask()).reason == OVER_QUOTA
    assert serve(ask({"n": 1}), robot="car2") == {"n": 1}
    assert serve(ask({"n": 3}, sent_us=NOW_US + 3_600_000_000), now_s=NOW_S + 3600, received_s=3600) == {
        "n": 3
    }


def test_an_unregistered_robot_is_not_answered(serve, dynamodb):
    assert serve(ask(), robot="stranger").reason == OVER_QUOTA
    assert "Item" not in dynamodb.get_item(TableName=ROBOTS, Key={ROBOT: {"S": "stranger"}})


@pytest.mark.parametrize(
    ("asked", "late_s"),
    [
        # By the cloud's clock, whatever the robot's own says.
        ({"sent_us": NOW_US - 90_000_000, "offset_us": 90_000_000, "valid_ms": 1000}, 1.0),
        # Without an offset from the receipt, so a clock of 1970 is no reason.
        ({"sent_us": 0, "valid_ms": 1000}, 1.0),
    ],
)
def test_the_deadline_is_judged_by_the_clouds_clock(serve, asked, late_s):
    assert serve(ask({"n": 1}, **asked), now_s=NOW_S + late_s - 0.01) == {"n": 1}
    assert serve(ask({"n": 2}, **asked), now_s=NOW_S + late_s + 0.01).reason == TOO_LATE


def test_a_late_question_costs_no_quota(serve):
    for _ in range(5):
        assert serve(ask(), now_s=NOW_S + 60).reason == TOO_LATE
    assert serve(ask({"n": 1})) == {"n": 1}


def uploaded(s3, content, name="ask/track.json", robot="car"):
    """The file of a body, as the agent's upload leaves it."""
    sha256 = hashlib.sha256(content).hexdigest()
    key = file_key(robot, File(name, "other", "application/json", len(content), sha256, NOW_US))
    s3.put_object(Bucket=FILES, Key=key, Body=content)
    return Content(key, sha256, len(content))


def test_a_large_body_is_a_file_both_ways(serve, s3):
    body = {"text": "x" * MAX_INLINE_BYTES}
    found = serve(ask(uploaded(s3, json.dumps(body).encode())))
    assert found.place.startswith(f"https://{FILES}.s3.eu-west-1.amazonaws.com/results/ask/car/{ID}.json?")
    stored = s3.get_object(Bucket=FILES, Key=f"results/ask/car/{ID}.json")["Body"].read()
    assert json.loads(stored) == body
    assert (hashlib.sha256(stored).hexdigest(), len(stored)) == (found.sha256, found.size)


def test_too_large_a_question_or_answer_is_refused(serve, s3):
    assert serve(ask({"text": "x" * MAX_INLINE_BYTES})).reason == TOO_LARGE
    huge = uploaded(s3, json.dumps({"text": "x" * ECHO.max_question_bytes}).encode())
    assert serve(ask(huge)).reason == TOO_LARGE
    serve.work = lambda *_: {"text": "x" * ECHO.max_answer_bytes}
    assert serve(ask()).reason == TOO_LARGE


@pytest.mark.parametrize("wrong", [{"robot": "car2"}, {"name": "notes.json"}, {"content": b"no JSON"}])
def test_a_file_that_is_not_the_robots_own_question_is_refused(serve, s3, wrong):
    given = {"content": b"{}", **wrong}
    assert serve(ask(uploaded(s3, **given))).reason == INVALID


def test_a_file_with_other_content_than_told_is_refused(serve, s3):
    told = uploaded(s3, b'{"a":1}')
    for wrong in ({"sha256": "0" * 64}, {"size": 3}, {"place": told.place.replace("track", "none")}):
        # Each attempt is a question of its own hour.
        serve.dynamodb.put_item(TableName=ROBOTS, Item={ROBOT: {"S": "car"}})
        assert serve(ask(told._replace(**wrong))).reason == INVALID


def test_a_refusal_of_the_answer_reaches_the_robot(serve):
    def no_data(*_):
        raise RefusedError(NO_DATA, "nothing yet")

    serve.work = no_data
    assert serve(ask()) == Refusal(NO_DATA, "nothing yet")


def test_an_error_is_told_to_the_robot_and_fails_the_invocation(serve):
    serve.work = lambda *_: 1 / 0
    with pytest.raises(ZeroDivisionError):
        serve(ask())
    assert serve.said[-1][1].body == Refusal(FAILED, "ZeroDivisionError")
    # No question is malformed because its answer is: the invocation fails, and nothing is quarantined.
    serve.work = lambda *_: {"speed_mps": float("nan")}
    with pytest.raises(RuntimeError, match="the answer cannot be made"):
        serve(ask())
    assert serve.said[-1][1].body == Refusal(FAILED, "ContractError")


@pytest.mark.parametrize(
    ("message", "told"), [(b"{}", 0), (b"\xff", 0), (b'{"id":7}', 0), (b'{"id":"0123456789abcdef"}', 1)]
)
def test_every_malformed_question_is_refused_and_told_if_it_has_an_id(serve, message, told):
    with pytest.raises(ContractError):
        serve(message)
    assert [found.body.reason for _, found in serve.said] == [MALFORMED] * told


# --- the questions that ship ------------------------------------------------------------------------


def parameters(dynamodb, start_us, **values):
    drive = DriveKey("car", start_us, "00c0ffee")
    estimates = {name: Estimate(value, value - 1, value + 1, "ohm") for name, value in values.items()}
    analysed = AnalysedDrive(drive, start_us + 1, "nightly", 100, estimates, {}, {})
    FindingsTable(dynamodb, FINDINGS).put_drive(analysed)


def test_the_calibration_has_each_parameter_of_its_newest_drive(dynamodb):
    parameters(dynamodb, 1_000_000, old=1.0, both=1.0)
    parameters(dynamodb, 2_000_000, both=2.0)
    asked = {"robot": "car", "question": CALIBRATION.name, "body": {}}
    found = answer.operators(asked)["body"]["parameters"]
    assert {name: (one["value"], one["drive"][:16]) for name, one in found.items()} == {
        "old": (1.0, "0000000001000000"),
        "both": (2.0, "0000000002000000"),
    }
    assert answer.operators({**asked, "robot": "car2"})["refused"] == NO_DATA
    missing = {"mass": "16 s are too short"}
    nothing = AnalysedDrive(DriveKey("car3", 1, "00c0ffee"), 2, "nightly", 1, {}, missing, {})
    FindingsTable(dynamodb, FINDINGS).put_drive(nothing)
    refused = answer.operators({**asked, "robot": "car3"})
    assert (refused["refused"], "16 s are too short" in str(refused)) == (NO_DATA, True)
    assert answer.operators({**asked, "question": "nobody"})["refused"] == UNKNOWN


HALL = (Path(__file__).parents[3] / "docs/examples/hall.csv").read_text()


def raceline(**body):
    return answer.operators({"robot": "car", "question": RACELINE.name, "body": body})


def test_the_raceline_uses_the_questions_limits_then_the_calibration_then_defaults(dynamodb):
    parameters(dynamodb, 1_000_000, effective_mass_kg=4.2, battery_open_voltage_v=12.0)
    parameters(dynamodb, 2_000_000, battery_resistance_ohm=0.1, friction_n=-1.0)
    found = raceline(track=HALL, car={"grip": 0.5})["body"]
    used = {name: (one["value"], one["from"]) for name, one in found["car"].items()}
    assert used["grip"] == (0.5, "question")
    assert used["mass_kg"] == (4.2, "calibration")
    # At 80 % of 12 V, 24 A flow through 0.1 ohm.
    assert used["power_w"] == (pytest.approx(12 * 0.8 * 24), "calibration")
    assert used["rolling_n"] == (0, "default"), "an estimate below 0 is no force"
    assert used["speed_mps"] == (10, "default")
    assert 0 < found["lap_s"] < found["centre_line_lap_s"]
    lengths = {name: len(values) for name, values in found["line"].items()}
    assert set(lengths) == {"s_m", "x_m", "y_m", "offset_m", "curvature_1pm", "speed_mps", "time_s"}
    assert len(set(lengths.values())) == 1
    assert len(json.dumps(found)) < MAX_INLINE_BYTES
    as_lists = {name: list(values) for name, values in vars(parse_track(HALL)).items()}
    assert raceline(track=as_lists, car={"grip": 0.5})["body"] == found


@pytest.mark.parametrize(
    ("body", "told"),
    [
        ({}, "track must be a CSV text or an object of columns, got None"),
        ({"track": "1,2,3"}, "line 1 must be the four numbers"),
        ({"track": {"x_m": [1]}}, "a track must be the four lists"),
        ({"track": HALL, "car": {"wings": 2}}, "car must be an object of width_m"),
        ({"track": HALL, "car": {"grip": "wet"}}, "grip must be 0.05 to 5 1, got 'wet'"),
        ({"track": HALL, "car": {"grip": int("9" * 400)}}, "grip must be 0.05 to 5 1, got 999"),
        ({"track": HALL, "car": {"width_m": 3}}, "the track must be wider than the car (3 m)"),
        ({"track": HALL, "car": {"rolling_n": 500}}, "the motor must pull more than rolling and the air"),
    ],
)
def test_what_is_no_track_or_car_is_refused_with_the_reason(dynamodb, body, told):
    refused = raceline(**body)
    assert refused["refused"] == INVALID
    assert told in refused["text"]


def test_the_handler_answers_a_robot_and_an_operator(s3, dynamodb, rejected, invoke, published):
    asked = encode_ask(ask(valid_ms=60_000))
    parameters(dynamodb, 1_000_000, resistance=1.0)
    now_ms = 4_000_000_000_000
    invoke(answer.handler, rule_event(asked, build_topic(ASK, "car", "calibration"), now_ms))
    ((topic, payload),) = published()
    assert topic == build_topic(ANSWER, "car", "calibration")
    assert decode_answer(payload).body["parameters"]["resistance"]["value"] == 1.0
    again = invoke(answer.handler, {"robot": "car", "question": "calibration", "body": {}})
    assert again["body"] == decode_answer(payload).body


def test_every_question_of_the_catalogue_has_its_work():
    for name, question in QUESTIONS.items():
        # A name is an attribute's of the robot's row.
        assert name.isidentifier()
        assert question.max_question_bytes <= 8 * 1024 * 1024
    assert WORK.keys() == QUESTIONS.keys()
    assert all(reason.isidentifier() for reason in REASONS)
