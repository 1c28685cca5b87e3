"""What one hostile robot and one stranger can spend at most a day, read from a deployment's templates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from aws_cdk import App

from app import build
from functions.alert import QUIET_S
from functions.incident import MAILS_AN_HOUR
from functions.shared.incidents import A_SECOND
from iort_contract.catalog.questions import QUESTIONS
from iort_station.cost.prices import MONTH_DAYS, PRICES
from stacks.settings import A_ROBOTS_MOST, CONNECTION_MESSAGES_S, Settings

_DAY_S = 86_400
Resource = Mapping[str, Any]


class Ceiling(NamedTuple):
    """A limit: what it bounds, its figure, the template's property that holds it, and dollars a day at it."""

    what: str
    limit: str
    held_by: str
    usd_a_day: float | None


class Templates:
    """The resources of all stacks of the app with these settings."""

    def __init__(self, **settings: Any) -> None:
        with TemporaryDirectory() as folder:
            layer = Path(folder, "layer")
            layer.mkdir()
            (layer / "nothing.py").touch()
            app = App(outdir=str(Path(folder, "out")))
            build(app, Settings(layer=layer, analysis_layer=layer, **settings))
            self.resources: dict[str, Resource] = {
                f"{stack.stack_name}/{key}": one
                for stack in app.synth().stacks
                for key, one in stack.template["Resources"].items()
            }

    def one(self, kind: str, name: str) -> Resource:
        """The properties of the resource whose construct has this name: its id ends with a hash."""
        (found,) = [
            one["Properties"]
            for key, one in self.resources.items()
            if one["Type"] == f"AWS::{kind}" and key.rpartition("/")[2][:-8] == name
        ]
        return dict(found)

    def kinds(self) -> set[str]:
        """The types of all resources."""
        return {one["Type"] for one in self.resources.values()}


_TABLES = {
    "Batches": "telemetry stored, all robots together",
    "Summary": "seconds stored, all robots together",
    "Robots": "robots' rows",
    "Archive": "the archive's notes and marks",
    "Quarantine": "refused messages stored",
    "Findings": "findings stored",
}
# A function, the mapping that calls it, and for what.
_READERS = (
    ("Quarantine", "Rejections", "refused messages read"),
    ("Later", "PutOffs", "batches over a robot's share"),
    ("Archive", "Tasks", "hours archived"),
)


def robot(templates: Templates) -> Iterator[Ceiling]:
    """The limits of a robot with a valid certificate that sends what it can."""
    for table, what in _TABLES.items():
        most = templates.one("DynamoDB::Table", table)["OnDemandThroughput"]["MaxWriteRequestUnits"]
        held_by = f"`{table}`: `MaxWriteRequestUnits`"
        yield Ceiling(what, f"{most:,} write units a second", held_by, _a_day("write", most))
    for function, mapping, what in _READERS:
        at_once = templates.one("Lambda::EventSourceMapping", mapping)["ScalingConfig"]["MaximumConcurrency"]
        memory_mb = templates.one("Lambda::Function", function)["MemorySize"]
        limit = f"{at_once} calls at once of {memory_mb} MB"
        usd = _a_day("compute_arm", at_once * memory_mb / 1024)
        yield Ceiling(what, limit, f"`{mapping}`: `MaximumConcurrency`", usd)
    files = templates.one("S3::Bucket", "Files")["LifecycleConfiguration"]["Rules"]
    (days,) = [rule["ExpirationInDays"] for rule in files if rule["Id"] == "old"]
    gb = int(_variable(templates, "Upload", "UPLOAD_BYTES_A_DAY")) / 1e9
    held_by = "`Upload`: `UPLOAD_BYTES_A_DAY`; `Files`: `ExpirationInDays`"
    usd = gb * days * PRICES["s3_standard"].usd / MONTH_DAYS
    yield Ceiling("files stored, by a robot", f"{gb:g} GB a day, each for {days} days", held_by, usd)
    timeout_s, questions = templates.one("Lambda::Function", "Answer")["Timeout"], QUESTIONS.values()
    assert timeout_s >= max(question.timeout_s for question in questions)
    limit = f"{sum(question.per_hour for question in questions)} an hour, of at most {timeout_s} s"
    gb_s = sum(question.per_hour * question.timeout_s * question.memory_mb / 1024 for question in questions)
    usd = gb_s * 24 * PRICES["compute_arm"].usd
    yield Ceiling("questions, by a robot", limit, "the catalogue's quotas; `Answer`: `Timeout`", usd)
    held_by = "`Alert`: one in 15 minutes a cause"
    yield Ceiling("mails, by a robot and cause", f"{_DAY_S // QUIET_S} a day", held_by, None)
    held_by = f"`Incident`: {MAILS_AN_HOUR} an hour"
    yield Ceiling("mails of incidents, by a robot", f"{24 * MAILS_AN_HOUR} a day", held_by, None)
    # Each is tried three times, and takes all of its time.
    called = templates.one("Lambda::Function", "Incident")
    gb_s = A_SECOND * 3 * called["Timeout"] * called["MemorySize"] / 1024
    limit = f"{A_SECOND * _DAY_S:,.0f} a day, each of three calls of at most {called['Timeout']} s"
    yield Ceiling(
        "incidents told, by a robot", limit, "`Summarize`: 0.1 a second", _a_day("compute_arm", gb_s)
    )
    gb = int(_variable(templates, "Summarize", "RECORD_BYTES_A_DAY")) / 1e9
    held_by = "`Summarize`: `RECORD_BYTES_A_DAY`; alarm `RobotsOverVolume`"
    usd = gb * 1e9 / 1024 * PRICES["write"].each
    yield Ceiling("telemetry of a robot, before an alarm names it", f"{gb:g} GB a day", held_by, usd)


def at_the_broker() -> Iterator[Ceiling]:
    """What AWS' own quota of a connection bounds; no template can lower it."""
    held_by = "AWS: throughput and publishes of a connection"
    limit = f"{A_ROBOTS_MOST} write units a second: 512 KB, 100 messages"
    yield Ceiling("telemetry of one robot, stored", limit, held_by, _a_day("write", A_ROBOTS_MOST))
    metered = A_ROBOTS_MOST / 5
    usd = sum(_a_day(price, metered) for price in ("message", "rule", "action"))
    what = "messages of one robot, each with a rule and its action"
    yield Ceiling(what, f"{metered:.0f} a second, of 5 KB each", "AWS: the same", usd)
    held_by = "AWS: publishes of a connection; none of ours"
    usd = _a_day("pubnub_publish", CONNECTION_MESSAGES_S)
    limit = f"{CONNECTION_MESSAGES_S} a second"
    yield Ceiling("live messages of one robot through PubNub", limit, held_by, usd)


def stranger(templates: Templates) -> Iterator[Ceiling]:
    """What the internet reaches without credentials."""
    doors = {
        "AWS::Cognito::IdentityPool": "identities that may listen",
        "AWS::CloudFront::Distribution": "the page on the web",
        "AWS::Lambda::Url": "functions with an address",
        "AWS::ApiGatewayV2::Api": "an API",
    }
    for kind, what in doors.items():
        if kind in templates.kinds():
            yield Ceiling(what, "none: AWS' quotas of the account", f"`{kind}`", None)
        else:
            yield Ceiling(what, "none there", f"no `{kind}` in any template", 0.0)


@cache
def default() -> Templates:
    """Of the default deployment."""
    return Templates()


def rows() -> Iterator[tuple[str, str, str, str, str]]:
    """The table of docs/explanation/security.md."""
    tables = {
        "a hostile robot": (*robot(default()), *at_the_broker()),
        "a stranger": tuple(stranger(default())),
    }
    for who, ceilings in tables.items():
        for one in ceilings:
            usd = "-" if one.usd_a_day is None else f"{one.usd_a_day:.2f}"
            yield who, one.what, one.limit, one.held_by, usd


def _a_day(price: str, units_a_second: float) -> float:
    return units_a_second * _DAY_S * PRICES[price].each


def _variable(templates: Templates, function: str, name: str) -> str:
    variables = templates.one("Lambda::Function", function)["Environment"]["Variables"]
    return str(variables[name])
