"""The log widgets of dashboards: queries to Logs Insights and their answers."""

from __future__ import annotations

import json
from typing import Any

import pytest

from iort_station.errors import StationError
from iort_station.operations import cloudwatch
from iort_station.operations.cloudwatch import readable

NOW_S = 1_700_000_000
NAME = "iort-platform"
QUERY = "SOURCE '/aws/lambda/a' | SOURCE \"b\" | fields @timestamp, @message\n| filter @message like /a|b/"


class Insights:
    """A fake CloudWatch with one dashboard, and Logs Insights with these answers, one a call."""

    namespace = "iort"

    def __init__(self, *answers: dict[str, Any], query: str = QUERY, **properties: Any) -> None:
        self.answers = list(answers)
        self.asked: dict[str, Any] = {}
        widget = {"type": "log", "properties": {"query": query, **properties}}
        self.body = {"widgets": [{"type": "text", "properties": {}}, widget]}

    def client(self, _service: str) -> Insights:
        return self

    def get_dashboard(self, **_name: str) -> dict[str, str]:
        return {"DashboardBody": json.dumps(self.body)}

    def start_query(self, **asked: Any) -> dict[str, str]:
        self.asked = asked
        return {"queryId": "q"}

    def get_query_results(self, **asked: str) -> dict[str, Any]:
        assert asked == {"queryId": "q"}
        return self.answers.pop(0)


def row(**cells: str) -> list[dict[str, str]]:
    return [{"field": f"@{name}", "value": value} for name, value in cells.items()]


def test_the_widgets_own_query_is_sent_for_its_log_groups() -> None:
    found = [row(timestamp="t1", message="one", ptr="x"), row(message="x" * 5000, log="1:a", ptr="y")]
    cloud = Insights({"status": "Scheduled"}, {"status": "Running"}, {"status": "Complete", "results": found})
    told = cloudwatch.rows(cloud, NAME, 1, minutes=15, now_s=NOW_S)
    assert cloud.asked == {
        "logGroupNames": ["/aws/lambda/a", "b"],
        "queryString": "fields @timestamp, @message\n| filter @message like /a|b/",
        "startTime": NOW_S - 900,
        "endTime": NOW_S,
    }
    # Columns are in their order of appearance; a missing cell is empty, and long cells are cut.
    assert told["columns"] == ["@timestamp", "@message", "@log"]
    assert told["rows"] == [["t1", "one", ""], ["", "x" * cloudwatch.MAX_TEXT, "1:a"]]
    assert (told["found"], told["from_s"], told["to_s"]) == (2, NOW_S - 900, NOW_S)


TRACE = 'Traceback (most recent call last):\n  File "live.py", line 61, in handler\n    publish(event)'


@pytest.mark.parametrize(
    ("message", "head"),
    [
        # The embedded cloud's, Lambda's in text with its own spaces, a logged one, and one after another.
        (f"{TRACE}\nValueError: no gain", "ValueError: no gain"),
        (
            f"[ERROR] ValueError: no gain\n{TRACE}".replace("  ", "\u00a0\u00a0"),
            "[ERROR] ValueError: no gain",
        ),
        (
            f"[ERROR]\t10:00Z\tnot sent\n{TRACE}\nKeyError: 'gain'",
            "[ERROR] 10:00Z not sent: KeyError: 'gain'",
        ),
        (f"{TRACE}\nKeyError: 1\n\nDuring handling ...\n\n{TRACE}\nOSError: two", "OSError: two"),
        ("[WARNING]\tno traceback", "[WARNING]\tno traceback"),
        ("{no JSON", "{no JSON"),
    ],
)
def test_the_first_line_of_a_text_record_is_what_happened(message: str, head: str) -> None:
    first, _, details = readable(message).partition("\n")
    assert first == head
    assert details in ("", message.strip())
    assert ("Traceback" in details) == ("Traceback" in message)


def test_the_first_line_of_a_json_record_is_what_happened() -> None:
    frames = ['  File "live.py", line 61, in handler\n    publish(event)\n']
    failed = {"errorType": "ValueError", "errorMessage": "no gain", "stackTrace": frames, "requestId": "r"}
    uncaught = readable(json.dumps({"timestamp": "t", "log_level": "ERROR", **failed}))
    assert uncaught == f"[ERROR] ValueError: no gain\n{frames[0].rstrip()}\nrequestId: r"
    logged = readable(json.dumps({"level": "ERROR", "message": "not sent", **failed}))
    assert logged.startswith("[ERROR] not sent: ValueError: no gain\n")
    assert readable('{"level": "WARN", "message": "late"}') == "[WARN] late"
    assert readable('{"_aws": {}, "Lost": 1}') == '{"_aws": {}, "Lost": 1}'


def test_rows_over_the_limit_are_counted_and_left_out() -> None:
    cloud = Insights({"status": "Complete", "results": [row(message=str(i)) for i in range(250)]})
    told = cloudwatch.rows(cloud, NAME, 1, minutes=15, now_s=NOW_S)
    assert (len(told["rows"]), told["found"]) == (cloudwatch.MAX_ROWS, 250)


def test_a_query_keeps_its_own_query_language() -> None:
    cloud = Insights({"status": "Complete"}, queryLanguage="PPL")
    assert cloudwatch.rows(cloud, NAME, 1, minutes=15, now_s=NOW_S)["rows"] == []
    assert cloud.asked["queryLanguage"] == "PPL"


@pytest.mark.parametrize("status", ["Failed", "Cancelled", "Timeout"])
def test_a_failed_query_is_an_error(status: str) -> None:
    with pytest.raises(StationError, match=f"ended the query: {status.lower()}"):
        cloudwatch.rows(Insights({"status": status}), NAME, 1, minutes=15)


def test_only_log_widgets_that_name_log_groups_can_be_queried() -> None:
    for number in (0, 2):
        with pytest.raises(StationError, match="not a log widget"):
            cloudwatch.rows(Insights(), NAME, number, minutes=15)
    with pytest.raises(StationError, match="must name a log group"):
        cloudwatch.rows(Insights(query="SOURCE logGroups(namePrefix: ['a']) | fields x"), NAME, 1, minutes=15)


@pytest.mark.parametrize("name", ["billing", "iort", "iort2-platform", "IORT-platform"])
def test_the_logs_of_another_deployments_dashboard_are_not_queried(name: str) -> None:
    cloud = Insights({"status": "Complete"})
    with pytest.raises(StationError, match="another deployment's"):
        cloudwatch.rows(cloud, name, 1, minutes=15)
    assert not cloud.asked
