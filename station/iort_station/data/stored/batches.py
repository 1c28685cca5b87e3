"""The tables of recorded batches and of their seconds."""

from __future__ import annotations

from iort_contract.dynamodb import SummaryTable, TelemetryTable
from iort_contract.topics import RECORD, build_topic
from iort_station.cloud import Cloud


def telemetry_table(cloud: Cloud) -> TelemetryTable:
    """The deployment's telemetry table."""
    return TelemetryTable(cloud.client("dynamodb"), cloud.output("storage", "TelemetryTable"))


def summary_table(cloud: Cloud) -> SummaryTable:
    """The deployment's summary table."""
    return SummaryTable(cloud.client("dynamodb"), cloud.output("storage", "SummaryTable"))


def topic_of(cloud: Cloud, robot: str, stream: str) -> str:
    """The topic of a robot's stream on the record lane."""
    return build_topic(RECORD, robot, stream, cloud.namespace)
