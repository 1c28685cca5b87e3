"""What one hostile robot and one stranger can spend at most a day, read from a deployment's templates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from aws_cdk import App

from app import build
from functions.alert import QUIET_S
from iort_contract.catalog.questions import QUESTIONS
from iort_station.cost.prices import MONTH_DAYS, PRICES
from stacks.settings import A_ROBOTS_MOST, CONNECTION_MESSAGES_S, Settings

_DAY_S = 86_400
_QUIET_MAILS = _DAY_S // QUIET_S
Resource = Mapping[str, Any]


@dataclass(frozen=True)
class Ceiling:
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


def robot(templates: Templates) -> Iterator[Ceiling]:
    """The limits of a robot with a valid certificate that sends what it can."""
    for table, what in {
        "Batches": "telemetry stored, all robots together",
        "Summary": "seconds stored, all robots together",
        "Robots": "robots' rows",
        "Archive": "the archive's notes and marks",
        "Quarantine": "refused messages stored",
        "Findings": "findings stored",
    }.items():
        most = templates.one("DynamoDB::Table", table)["OnDemandThroughput"]["MaxWriteRequestUnits"]
        limit = f"{most:,} write units a second"
        yield Ceiling(what, limit, f"`{table}`: `MaxWriteRequestUnits`", _a_second("write", most))
    for function, mapping, what in (
        ("Quarantine", "Rejections", "refused messages read"),
        ("Later", "PutOffs", "batches over a robot's share"),
        ("Archive", "Tasks", "hours archived"),
    ):
        at_once = templates.one("Lambda::EventSourceMapping", mapping)["ScalingConfig"]["MaximumConcurrency"]
        memory_mb = templates.one("Lambda::Function", function)["MemorySize"]
        yield Ceiling(
            what,
            f"{at_once} calls at once of {memory_mb} MB",
            f"`{mapping}`: `MaximumConcurrency`",
            _a_second("compute_arm", at_once * memory_mb / 1024),
        )
    files = templates.one("S3::Bucket", "Files")["LifecycleConfiguration"]["Rules"]
    (days,) = [rule["ExpirationInDays"] for rule in files if rule["Id"] == "old"]
    gb = int(_variable(templates, "Upload", "UPLOAD_BYTES_A_DAY")) / 1e9
    yield Ceiling(
        "files stored, by a robot",
        f"{gb:g} GB a day, each for {days} days",
        "`Upload`: `UPLOAD_BYTES_A_DAY`; `Files`: `ExpirationInDays`",
        gb * days * PRICES["s3_standard"].usd / MONTH_DAYS,
    )
    asked_s = sum(one.per_hour * one.timeout_s * one.memory_mb / 1024 for one in QUESTIONS.values())
    slow = templates.one("Lambda::Function", "Answer")
    assert slow["Timeout"] >= max(one.timeout_s for one in QUESTIONS.values())
    number = sum(one.per_hour for one in QUESTIONS.values())
    yield Ceiling(
        "questions, by a robot",
        f"{number} an hour, of at most {slow['Timeout']} s",
        "the catalogue's quotas; `Answer`: `Timeout`",
        asked_s * 24 * PRICES["compute_arm"].usd,
    )
    yield Ceiling(
        "mails, by a robot and cause", f"{_QUIET_MAILS} a day", "`Alert`: one in 15 minutes a cause", None
    )
    record_gb = int(_variable(templates, "Summarize", "RECORD_BYTES_A_DAY")) / 1e9
    yield Ceiling(
        "telemetry of a robot, before an alarm names it",
        f"{record_gb:g} GB a day",
        "`Summarize`: `RECORD_BYTES_A_DAY`; alarm `RobotsOverVolume`",
        record_gb * 1e9 / 1024 * PRICES["write"].usd / PRICES["write"].per,
    )


def at_the_broker() -> Iterator[Ceiling]:
    """What AWS' own quota of a connection bounds; no template can lower it."""
    yield Ceiling(
        "telemetry of one robot, stored",
        f"{A_ROBOTS_MOST} write units a second: 512 KB, 100 messages",
        "AWS: throughput and publishes of a connection",
        _a_second("write", A_ROBOTS_MOST),
    )
    metered = A_ROBOTS_MOST / 5
    per_message = sum(PRICES[name].usd / PRICES[name].per for name in ("message", "rule", "action"))
    yield Ceiling(
        "messages of one robot, each with a rule and its action",
        f"{metered:.0f} a second, of 5 KB each",
        "AWS: the same",
        metered * _DAY_S * per_message,
    )

    yield Ceiling(
        "live messages of one robot through PubNub",
        f"{CONNECTION_MESSAGES_S} a second",
        "AWS: publishes of a connection; none of ours",
        CONNECTION_MESSAGES_S * _DAY_S * PRICES["pubnub_publish"].usd,
    )


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


def _a_second(price: str, units: float) -> float:
    return units * _DAY_S * PRICES[price].usd / PRICES[price].per


def _variable(templates: Templates, function: str, name: str) -> str:
    variables = templates.one("Lambda::Function", function)["Environment"]["Variables"]
    return str(variables[name])
