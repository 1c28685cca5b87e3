"""What the analysis of drives has found: the findings, and a row of each analysed drive."""

from __future__ import annotations

from iort_contract.findings_table import FindingsTable
from iort_station.cloud import Cloud


def findings_table(cloud: Cloud) -> FindingsTable:
    """The table of findings; raises `StationError` if it is not deployed."""
    return FindingsTable(cloud.client("dynamodb"), cloud.output("storage", "FindingsTable"))
