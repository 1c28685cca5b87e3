"""Questions of a robot, on the embedded cloud with enforcement on, by the agent's own parts."""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from iort_agent.config import load_config
from iort_agent.errors import AskError
from iort_agent.files.upload import downloader
from iort_contract.catalog.questions import CALIBRATION
from iort_contract.findings_table import FindingsTable
from iort_contract.messages.analysis import AnalysedDrive, DriveKey, Estimate
from iort_contract.messages.questions import (
    MALFORMED,
    MAX_INLINE_BYTES,
    NO_DATA,
    OVER_QUOTA,
    TOO_LARGE,
    TOO_LATE,
    UNKNOWN,
    decode_answer,
    encode_ask,
)
from iort_contract.messages.questions import Ask as Question
from iort_contract.topics import ANSWER, ASK, build_topic
from iort_station.fleet import robots
from iort_station.operations import quarantine
from testkit.car import Ask, asking
from testkit.mqtt import Robot
from testkit.waiting import until

HALL = (Path(__file__).parents[3] / "docs/examples/hall.csv").read_text()
WAIT_S = 60.0


@pytest.fixture(scope="module")
def bundle_of_asker(embedded: Any, tmp_path_factory: pytest.TempPathFactory) -> robots.Bundle:
    bundle = robots.add(embedded.cloud, "asker", out=tmp_path_factory.mktemp("robots"))
    table = FindingsTable(
        embedded.cloud.client("dynamodb"), embedded.cloud.output("storage", "FindingsTable")
    )
    drive = DriveKey("asker", 1_700_000_000_000_000, "00c0ffee")
    estimates = {"effective_mass_kg": Estimate(4.25, 4.0, 4.5, "kg")}
    table.put_drive(AnalysedDrive(drive, drive.start_us + 1, "nightly", 1000, estimates, {}, {}))
    return bundle


@pytest.fixture
def ask(bundle_of_asker: robots.Bundle) -> Iterator[Ask]:
    """Ask as the agent does: `ask("calibration", {})`."""
    with asking(bundle_of_asker) as asks:
        yield asks


def refusal(ask: Ask, name: str, body: Any) -> str:
    with pytest.raises(AskError) as refused:
        ask(name, body)
    return refused.value.reason


def test_a_robot_gets_its_own_calibration(ask: Ask) -> None:
    found = ask("calibration", {})["parameters"]
    assert found["effective_mass_kg"]["value"] == 4.25
    assert found["effective_mass_kg"]["unit"] == "kg"


def test_a_track_too_large_for_a_message_goes_by_a_file(ask: Ask) -> None:
    body = {"track": f"{HALL}# {'x' * MAX_INLINE_BYTES}", "car": {"width_m": 0.4}}
    found = ask("raceline", body)
    assert found["car"]["mass_kg"] == {"value": 4.25, "unit": "kg", "from": "calibration"}
    assert found["car"]["width_m"]["from"] == "question"
    assert 0 < found["lap_s"] < found["centre_line_lap_s"]


def test_an_answer_by_a_file_can_be_read_at_its_address(
    embedded: Any, bundle_of_asker: robots.Bundle
) -> None:
    config = load_config(bundle_of_asker.config)
    s3, bucket = embedded.cloud.client("s3"), embedded.cloud.output("storage", "FilesBucket")
    place = {"Bucket": bucket, "Key": "results/ask/asker/0badcafe.json"}
    s3.put_object(**place, Body=b'{"a":1}')
    download = downloader(config.root_ca)
    assert download(s3.generate_presigned_url("get_object", Params=place), 7) == b'{"a":1}'
    with pytest.raises(OSError, match=r"the server says 40[34]"):
        download(s3.generate_presigned_url("get_object", Params=place).replace("0bad", "1bad"), 7)


def test_unknown_and_too_large_questions_are_refused(ask: Ask) -> None:
    assert refusal(ask, "nobody", {}) == UNKNOWN
    assert refusal(ask, "calibration", {"padding": "x" * CALIBRATION.max_question_bytes}) == TOO_LARGE


def test_the_hourly_quota_is_the_robots_own(ask: Ask, embedded: Any, bundle: Any) -> None:
    client, table = embedded.cloud.client("dynamodb"), embedded.cloud.output("storage", "RobotsTable")

    def spent(hour: str) -> None:
        client.update_item(
            TableName=table,
            Key={"robot": {"S": "asker"}},
            UpdateExpression="SET #hour = :hour, #count = :most",
            ExpressionAttributeNames={
                "#hour": CALIBRATION.hour_attribute,
                "#count": CALIBRATION.count_attribute,
            },
            ExpressionAttributeValues={":hour": {"S": hour}, ":most": {"N": str(CALIBRATION.per_hour)}},
        )

    spent(time.strftime("%Y-%m-%dT%H", time.gmtime()))
    assert refusal(ask, "calibration", {}) == OVER_QUOTA
    other = bundle()
    with Robot(other.folder) as robot:
        robot.online().subscribe(f"{ANSWER}/iort/{robot.name}/+")
        assert said(robot, "calibration")["refused"] == NO_DATA
    spent("2001-01-01T00")
    assert ask("calibration", {})["parameters"]


def said(robot: Robot, name: str, payload: bytes | None = None, **changes: Any) -> dict[str, Any]:
    """The answer to a question in the robot's own words."""
    asked = Question(uuid.uuid4().hex, time.time_ns() // 1000, 60_000, {})
    message = payload or encode_ask(replace(asked, **changes))
    assert robot.publish(build_topic(ASK, robot.name, name), message) == "SUCCESS"
    topic, answer = robot.next_message(WAIT_S)
    assert topic == build_topic(ANSWER, robot.name, name)
    assert decode_answer(answer).id == json.loads(message)["id"]
    return dict(json.loads(answer))


def test_a_late_question_and_a_malformed_one_are_refused(embedded: Any, bundle: Any) -> None:
    late_us = time.time_ns() // 1000 - 10_000_000
    with Robot(bundle().folder) as robot:
        robot.online().subscribe(f"{ANSWER}/iort/{robot.name}/+")
        late = said(robot, "calibration", sent_us=late_us, offset_us=0, valid_ms=1000)
        assert late["refused"] == TOO_LATE
        # The robot's own clock says nothing without its offset.
        assert said(robot, "calibration", sent_us=late_us, valid_ms=60_000)["refused"] == NO_DATA
        malformed = json.dumps({"v": 1, "id": "0badcafe", "body": []}).encode()
        assert said(robot, "calibration", malformed)["refused"] == MALFORMED
        (kept,) = until(lambda: list(quarantine.entries(embedded.cloud, robot=robot.name)))
    assert kept.topic == build_topic(ASK, robot.name, "calibration")


def test_the_operator_asks_what_a_robot_may_ask(
    iort: Any, bundle_of_asker: robots.Bundle, tmp_path: Path
) -> None:
    answer = iort("ask", bundle_of_asker.robot, "calibration")
    assert answer.exit_code == 0, answer.output
    assert json.loads(answer.stdout)["parameters"]["effective_mass_kg"]["value"] == 4.25
    (tmp_path / "track.json").write_text('{"track": 7}')
    refused = iort("ask", bundle_of_asker.robot, "raceline", "--body", str(tmp_path / "track.json"))
    assert refused.exit_code == 1
    assert "invalid: track must be" in str(refused.exception)
    # The robot's quota is none of its parameters.
    assert "asked_" not in iort("robots", "list").stdout
