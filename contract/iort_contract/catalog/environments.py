"""The environment variables of each function: the stacks write them, the functions read them, by one class.

A field is the variable of its name in capitals.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from typing import Any, Mapping, TypeVar

E = TypeVar("E", bound="Environment")


@dataclass(frozen=True)
class Environment:
    """The variable of every function: the deployment's namespace, under which its metrics count."""

    namespace: str

    def variables(self) -> dict[str, str]:
        return {one.name.upper(): _text(getattr(self, one.name)) for one in fields(self)}

    @classmethod
    def read(cls: type[E], variables: Mapping[str, str]) -> E:  # noqa: PYI019 - Python 3.8 has no Self
        """Read the variables; KeyError names a missing one."""
        return cls(**{one.name: _value(str(one.type), variables[one.name.upper()]) for one in fields(cls)})


@dataclass(frozen=True)
class LiveEnvironment(Environment):
    """Lambda 1. ``live_fields`` has the fields of a stream on the dashboard; others are sent whole."""

    pubnub_parameter: str
    live_fields: Mapping[str, list[str]]
    rejected_queue: str


@dataclass(frozen=True)
class ArchiveEnvironment(Environment):
    """The archive's writer. ``archive_table`` is its manifest, ``archive_queue`` has its own tasks."""

    telemetry_table: str
    archive_table: str
    robots_table: str
    files_bucket: str
    archive_queue: str
    retention_s: int


@dataclass(frozen=True)
class LaterEnvironment(Environment):
    """What both summarizing functions need. Without an archive, ``archive_table`` is empty. They give
    incidents to ``incident_function``."""

    archive_table: str
    telemetry_table: str
    summary_table: str
    robots_table: str
    rejected_queue: str
    robot_metrics: bool
    incident_function: str


@dataclass(frozen=True)
class SummarizeEnvironment(LaterEnvironment):
    """Lambda 2, which puts batches off for `later`, and counts what each robot records."""

    put_off_queue: str
    record_bytes_a_day: int


@dataclass(frozen=True)
class QueryEnvironment(Environment):
    """The filter in the cloud; it reads the robots' parameters and writes large answers to the bucket."""

    telemetry_table: str
    robots_table: str
    files_bucket: str


@dataclass(frozen=True)
class EchoEnvironment(Environment):
    """The function that answers pings."""

    rejected_queue: str


@dataclass(frozen=True)
class UploadEnvironment(Environment):
    """The function that signs upload addresses."""

    files_bucket: str
    robots_table: str
    rejected_queue: str
    upload_bytes_a_day: int


@dataclass(frozen=True)
class AnswerEnvironment(Environment):
    """The function that answers robots' questions; ``findings_table`` has the robots' parameters."""

    robots_table: str
    findings_table: str
    files_bucket: str
    rejected_queue: str


@dataclass(frozen=True)
class AlertEnvironment(Environment):
    """The function that mails."""

    robots_table: str
    alarm_topic: str
    low_voltage_v: float


@dataclass(frozen=True)
class IncidentEnvironment(Environment):
    """The function that tells of incidents, by mail if ``incident_mails``, and by the webhook that the
    parameter holds. Only an ``embedded`` cloud's may go to this machine by http."""

    robots_table: str
    alarm_topic: str
    rejected_queue: str
    webhook_parameter: str
    incident_mails: bool
    embedded: bool


@dataclass(frozen=True)
class RegistryEnvironment(Environment):
    """Functions that only keep robots' rows: admit and presence."""

    robots_table: str


@dataclass(frozen=True)
class QuarantineEnvironment(Environment):
    """The function between queue and quarantine table."""

    quarantine_table: str
    retention_s: int


@dataclass(frozen=True)
class PlanEnvironment(Environment):
    """The functions that find drives and analyse them; hours that have expired are in the archive."""

    telemetry_table: str
    archive_table: str
    robots_table: str
    findings_table: str
    files_bucket: str


@dataclass(frozen=True)
class EvaluateEnvironment(Environment):
    """The function that compares drives with earlier ones, and with the fleet's."""

    findings_table: str
    files_bucket: str


@dataclass(frozen=True)
class PresentEnvironment(Environment):
    """The function that keeps findings and mails the serious ones, with links into the page."""

    findings_table: str
    files_bucket: str
    alarm_topic: str
    page_url: str


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:g}"
    return json.dumps(value) if isinstance(value, dict) else str(value)


def _value(kind: str, text: str) -> Any:
    if kind == "bool":
        return text == "true"
    plain = {"str": str, "int": int, "float": float}.get(kind)
    return plain(text) if plain else json.loads(text)
