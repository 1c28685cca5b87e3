"""The figures of the KTH thesis of 2018, shown beside our own: its tables 6.1 to 6.3, 6.5 and 6.6.

"A Practical Approach of an Internet of Robotic Things Platform": a car with ROS in Stockholm, AWS in Dublin,
a ping of 50 ms. The round trips of its table 6.4 are in `local.figures`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from testkit.command import Table

SOURCE = "KTH thesis of 2018"
ROS, AWS_IOT, LAMBDA, DYNAMODB, CLOUDWATCH = "ROS", "AWS IoT", "Lambda", "DynamoDB", "CloudWatch"
# For a service or a criterion that its tables lack.
UNSAID = "not in its tables"
# Between its car and its cloud.
PING_MS = 50


@dataclass(frozen=True, eq=False)
class Criteria:
    """One of its tables: an entry for every service and criterion."""

    number: str
    title: str
    criteria: tuple[str, ...]
    rows: Mapping[str, tuple[str, ...]]

    def as_table(self) -> Table:
        """Return the table as in the thesis."""
        head = ["service", *self.criteria]
        return Table(
            f"{SOURCE}, table {self.number}: {self.title}", head, [[k, *v] for k, v in self.rows.items()]
        )


FUNCTIONALITY = Criteria(
    "6.1",
    "functionality",
    ("interaction", "compute", "storage", "monitoring"),
    {
        ROS: ("yes", "yes", "files", "own"),
        AWS_IOT: ("no", "partially (SQL only)", "no", "own"),
        LAMBDA: ("no", "yes (disk 512 MB)", "no", "own"),
        DYNAMODB: ("no", "no", "database", "own"),
        CLOUDWATCH: ("no", "no", "no", "several services'"),
    },
)
INTEROPERABILITY = Criteria(
    "6.2",
    "interoperability",
    ("pattern", "protocol", "payload"),
    {
        ROS: ("publish/subscribe", "TCPROS/UDPROS, AWS SDK, AWS MQTT SDK", "ROS messages"),
        AWS_IOT: ("publish/subscribe, push", "MQTT, IoT rules", "JSON"),
        LAMBDA: ("push and pull", "AWS SDK, DynamoDB streams", "JSON"),
        DYNAMODB: ("-", "-", "JSON"),
    },
)
SCALABILITY = Criteria(
    "6.3",
    "composability and scalability",
    ("modular", "stateless", "concurrency", "elasticity"),
    {
        ROS: ("yes", "yes", "limited (by the master)", "no"),
        AWS_IOT: ("yes", "yes", "unlimited", "yes"),
        LAMBDA: ("yes", "yes", "unlimited", "yes"),
        DYNAMODB: ("yes", "yes", "no", "limited (stream shards)"),
    },
)
TABLES = (FUNCTIONALITY, INTEROPERABILITY, SCALABILITY)

# Table 6.5: an invocation by memory size in MB, and a cycle of the ROS node.
LAMBDA_1 = {128: "20 - 40 ms", 256: "10 - 15 ms", 512: "8 - 12 ms"}
LAMBDA_2 = "12 ms (128 MB)"
NODE_CYCLE_MS = 2
# Table 6.6: 14,368 points; in Lambda with 512 MB, its fastest.
QUERY_ON_PREMISES, SCAN_ON_PREMISES = "6.1 s", "14.1 s"
QUERY_IN_LAMBDA, SCAN_IN_LAMBDA = "5.5 s (512 MB)", "12.9 s (512 MB)"


def said(service: str, criterion: str) -> str:
    """Return the entry of its tables, with the criterion before it. Raises `KeyError` for a missing entry."""
    for table in TABLES:
        if criterion in table.criteria:
            return f"{criterion}: {table.rows[service][table.criteria.index(criterion)]}"
    raise KeyError(criterion)
