"""The alarms: `Alarm`, and those on metrics of AWS. Alarms on our own metrics stand with their metrics."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Alarm:
    """It goes off above the threshold, or ``below`` it: for ``periods`` in a row, or of ``within``.

    A ``threshold`` that is a text names the setting that holds it, in units of ``factor``. ``meaning`` says
    what happened, and ``action`` what the operator does, in Markdown. ``evidence`` says where more is known:
    in the quarantine, in the functions' logs, or in the past of cars. ``alert`` begins the attributes of the
    registry that name these cars.
    """

    meaning: str
    action: str
    threshold: float | str = 0
    periods: int = 1
    within: int = 0
    below: bool = False
    factor: float = 1
    evidence: Literal["quarantine", "logs", "cars"] = "logs"
    alert: str = ""

    @property
    def advice(self) -> str:
        """The action without links, which lead nowhere outside of docs/."""
        return re.sub(r"\[([^]]+)\]\([^)]+\)", r"\1", self.action)


# One for each queue, function, table, stream reader and state machine: the resource's name stands before the
# alarm's.
WAITING = Alarm(
    "messages are in quarantine",
    "they wait for a minute in a burst, or for good because the quarantine's function fails (`Last` after "
    "five attempts): look at that function's log group. They are kept for 14 days",
    evidence="quarantine",
)
# A car that empties its queue after an outage exceeds its share for some minutes.
PUT_OFF_WAITING = Alarm(
    "a robot is over its share of Lambda 2, and its summaries are late",
    "nothing is lost, and no other robot waits "
    "(see [a robot's share](../explanation/processing.md#a-robots-share)). Lambda 2's log names the robot, "
    "`iort robots show` says how many batches wait; mend what it sends, or `iort robots remove`",
    periods=15,
)
# Every hour each stream has a task, and every day a second one.
ARCHIVE_TASKS_WAITING = Alarm(
    "tasks of the archive wait for half an hour",
    "nothing is lost, the hours are archived later: the archive's function fails (its log says why), or the "
    "fleet is large and its ten environments are too few",
    periods=30,
)
ERRORS = Alarm(
    "the function failed",
    "its log group; an asynchronous event is tried again, a stream's batch too",
)
THROTTLED = Alarm(
    "the table refused writes",
    "a partition takes 1,000 units a second, and the table what `fleet_robots` gives it: one robot sends "
    "that much, or the fleet has grown",
)
BEHIND = Alarm(
    "the stream is read late",
    "summaries are late, nothing is lost for 24 hours: look at the function's errors and duration. A batch "
    "that always fails ends in quarantine by itself",
    threshold="stream_behind_s",
    factor=1000,
    periods=3,
)
FAILED = Alarm(
    "the state machine failed, and its work is not done",
    "the execution's history in Step Functions names the state and its error; afterwards run "
    "`iort analyse --fleet --new`. A drive that fails is a finding instead, and fails no execution",
)
# Of an hour, half of what the table takes at most.
VOLUME = Alarm(
    "the robots write half of what the table takes at most, for an hour",
    "Lambda 2's log names a robot over its daily bytes, and `iort cost` says what a robot should write; "
    "mend what it sends, or `iort robots remove`. A fleet that has grown needs a larger `fleet_robots`",
    threshold="telemetry_writes",
    factor=3600 / 2,
)
# By the ends of their names.
OF_RESOURCES = {
    "Waiting": WAITING,
    "Errors": ERRORS,
    "Throttled": THROTTLED,
    "Behind": BEHIND,
    "Failed": FAILED,
}
# By their names.
OF_ONE_RESOURCE = {
    "PutOffWaiting": PUT_OFF_WAITING,
    "ArchiveTasksWaiting": ARCHIVE_TASKS_WAITING,
    "BatchesVolume": VOLUME,
}
# Messages that can be lost without being in quarantine, by AWS' namespace and metric. Account-wide, since AWS
# documents no values for some of the dimensions.
OF_THE_ACCOUNT = {
    ("AWS/IoT", "ParseError"): Alarm(
        "messages are not JSON, and a rule could not read them",
        "`AWSIotLogsV2` has topic and client; an agent of ours never sends one. AWS IoT may call no error "
        "action for it, so it need not be in quarantine",
    ),
    ("AWS/IoT", "ErrorActionFailure"): Alarm(
        "failed messages of a rule did not reach the quarantine",
        "they are lost: `AWSIotLogsV2`; the queue's and its key's policies",
    ),
    ("AWS/IoT", "RuleMessageThrottled"): Alarm(
        "messages did not reach a rule",
        "ask AWS for a higher quota of rules",
    ),
    ("AWS/Lambda", "DestinationDeliveryFailures"): Alarm(
        "failures of a function are not in quarantine",
        "the function's role, the queue and its key. A batch of the stream is still in the telemetry table: "
        "`iort audit`",
    ),
}
