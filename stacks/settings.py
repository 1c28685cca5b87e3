"""The deployment's parameters, read once from the CDK context."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple, NoReturn

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from iort_contract.catalog.rules import DAY_S, LOW_VOLTAGE_V, RULES, Call, Rule
from iort_contract.catalog.vesc import VESC_FIELDS, VESC_STREAM
from iort_contract.cloud import IOT, PUBNUB
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.page import PAGE_URL
from iort_contract.tables import DEFAULT_RETENTION_DAYS
from iort_contract.topics import check_namespace, check_robot

if TYPE_CHECKING:
    # Only here: it takes seconds to load.
    from aws_cdk import App

ROOT = Path(__file__).resolve().parent.parent

DEV: Final = "dev"
PROD: Final = "prod"
_RESERVED_FOR_LIVE = 5
# "PutFunctionConcurrency": a reservation must leave this many executions to all other functions.
UNRESERVED = 100
# A new account's executions: "Lambda quotas" says that they are fewer than 1,000, and new accounts report 10.
# And the least that a queue's mapping takes: "Configuring scaling behavior for SQS event source mappings".
NEW_ACCOUNT, LEAST_OF_A_QUEUE = 10, 2
ALL_LOGS: Final = "all"
# The robots of a public page, if it shows all.
ALL_ROBOTS = ["*"]
# AWS IoT ends a connection with more subscriptions.
_MOST_SITE_ROBOTS = 50
# "AWS IoT Core endpoints and quotas", message broker: a connection's throughput is 512 KB a second, in at
# most 100 messages, each of which may begin another unit of 1 KB.
CONNECTION_BYTES_S, CONNECTION_MESSAGES_S = 512 * 1024, 100
A_ROBOTS_MOST = CONNECTION_BYTES_S // 1024 + CONNECTION_MESSAGES_S
# Write units a second of a robot with lidar: docs/explanation/cost.md. Summaries are by second and stream.
_WRITES = {"Batches": 50, "Summary": 20}
# These tables grow by events, not by samples. Refused messages wait in their queue instead.
_WRITES_OF_ALL = {"Robots": 500, "Archive": 500, "Quarantine": 200, "Findings": 500}
# "Tag naming limits and requirements": up to 128 and 256 characters, and aws: is AWS' own.
_TAG_KEY = re.compile(r"(?!aws:)[\w .:/=+@-]{1,128}", re.IGNORECASE)
_TAG_VALUE = re.compile(r"[\w .:/=+@-]{0,256}")


class SettingsError(ValueError):
    """A context value that the stacks cannot use; the text names the key, the value and the allowed
    values."""


def _robots(value: Any) -> list[str]:
    """Parse robots: an array in cdk.json, ``car1,car2`` on the command line; `ALL_ROBOTS` alone is all of
    them."""
    names = value.split(",") if isinstance(value, str) else value
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError("must be robots as car1,car2, or *")
    if names == ALL_ROBOTS:
        return names
    if len(set(names)) > _MOST_SITE_ROBOTS:
        raise ValueError(f"must be at most {_MOST_SITE_ROBOTS} robots")
    return sorted({check_robot(name) for name in names})


def _tags(value: Any) -> dict[str, str]:
    """Parse tags: an object in cdk.json, ``team=lab,cost-centre=7`` on the command line."""
    pairs = value
    if isinstance(value, str):
        split = [pair.partition("=") for pair in value.split(",")]
        pairs = {key: text for key, is_, text in split} if all(is_ for _, is_, _ in split) else None
    if not isinstance(pairs, Mapping) or not all(
        isinstance(text, str) and _TAG_KEY.fullmatch(str(key)) and _TAG_VALUE.fullmatch(text)
        for key, text in pairs.items()
    ):
        raise ValueError("must be key=value,key=value with AWS' tags")
    return dict(pairs)


class AtOnce(NamedTuple):
    """How many executions work that nobody waits for has at most: of the archive's ``tasks``, and of the
    analysis' ``robots`` or ``drives``, which never run at the same time in one run."""

    tasks: int
    robots: int
    drives: int


class Settings(BaseModel):
    """Settings that may differ between two deployments of the same stacks; each is a context key.

    docs/reference/deployment.md has a table of the descriptions.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    stage: Literal["dev", "prod"] = Field(
        default=DEV,
        description="`dev`: everything goes with its stack. `prod`: tables, queues, logs, files and the key "
        "stay when the stack goes; tables have point-in-time recovery and deletion protection, stacks "
        "termination protection",
    )
    namespace: Annotated[str, BeforeValidator(check_namespace)] = Field(
        default=DEFAULT_NAMESPACE,
        description="prefix of topics, rules and stacks; another one for a second stage in the same account",
    )
    tags: Annotated[dict[str, str], BeforeValidator(_tags)] = Field(
        default={}, description="`team=lab,cost-centre=7`: on every resource, beside `project` and `stage`"
    )
    retention_days: Annotated[int, Field(ge=1, le=3650)] = Field(
        default=DEFAULT_RETENTION_DAYS, description="lifetime of telemetry and summaries"
    )
    archive: bool = Field(
        default=True,
        description="finished hours of telemetry go to Parquet in the bucket before they expire, and stay: "
        "[the archive](archive.md). `false`: no more hours do",
    )
    files_days: int = Field(ge=0, le=3650, default=365, description="lifetime of uploaded files; 0: for good")
    fleet_robots: Annotated[int, Field(ge=1, le=100_000)] = Field(
        default=20,
        description="how many robots drive at once: the tables take that many writes a second, and no more "
        "([what that bounds](../explanation/security.md#what-one-can-spend-at-most))",
    )
    record_gb_a_day: Annotated[int, Field(ge=1, le=10_000)] = Field(
        default=5,
        description="what a robot may record a day, in 1e9 bytes; above it an alarm goes off. AWS IoT has no "
        "limit of a day, so nothing is refused",
    )
    upload_gb_a_day: Annotated[int, Field(ge=1, le=10_000)] = Field(
        default=50, description="a robot's daily upload limit, in 1e9 bytes"
    )
    live_transport: Literal["pubnub", "iot"] = Field(
        default="iot",
        description="how live messages reach the page: `iot` by AWS IoT's own WebSockets, so that Lambda 1 "
        "has nothing to do, or `pubnub` by Lambda 1 and PubNub "
        "([the difference](page.md#two-ways-to-the-page)). "
        "Without a value `make deploy` takes PubNub if its keys are stored, and AWS IoT otherwise; a plain "
        "`cdk deploy` takes AWS IoT",
    )
    drivers: bool = Field(
        default=False,
        description="makes the role of [drivers](../explanation/security.md#viewers-and-drivers), who drive "
        "from the page. `false`: nobody drives from a browser",
    )
    turn: bool = Field(
        default=False,
        description="relays for video across the internet: STUN and TURN servers of Amazon Kinesis Video "
        "Streams, with credentials for minutes ([how](../how-to/deploy.md#video-across-the-internet)). "
        "`false`: video goes directly, or as pictures over the broker",
    )
    live_concurrency: Annotated[int, Field(ge=0, le=1000)] | None = Field(
        default=None,
        description="reserved concurrency of Lambda 1, which also limits it; 0: nothing. Without a value: 5 "
        "in `prod` with PubNub where `account_concurrency` allows it, otherwise nothing "
        "([why](../how-to/deploy.md#lambdas-limit-in-a-new-account))",
    )
    account_concurrency: Annotated[int, Field(ge=NEW_ACCOUNT, le=100_000)] = Field(
        default=NEW_ACCOUNT,
        description="the executions that the account's functions may have at once, from which the limits of "
        "all work follow that nobody waits for; `make deploy` asks Lambda, and without a value it is a new "
        "account's ([how](../how-to/deploy.md#lambdas-limit-in-a-new-account))",
    )
    customer_key: bool = Field(
        default=False,
        description="one key of the account's own, rotated every year, for tables, queues, files, topic and "
        "logs ([decision 11](../decisions/security/0011-one-key-through-services.md)): $1 a month and $0.03 "
        "per 10,000 requests. It goes in two steps: [how](../how-to/deploy.md#a-key-of-ones-own)",
    )
    keep_customer_key: bool = Field(
        default=False, description="keeps that key without using it, for data that it has encrypted"
    )
    alarm_email: str | None = Field(
        pattern=r"^[^@\s,]+@[^@\s,]+\.[^@\s,]+$",
        default=None,
        description="receives alarms, alerts and the budget's mails; AWS asks this address for its consent "
        "once",
    )
    incident_mails: bool = Field(
        default=True,
        description="mails to `alarm_email` when the event recorder keeps an incident, or cannot "
        "([how](../how-to/recorder.md#mail-and-webhook)). `false`: only the webhook tells, if there is one",
    )
    budget_usd: Annotated[int, Field(ge=0, le=1_000_000)] = Field(
        default=0,
        description="a monthly budget of the account, 0 for none: a mail at 80 % spent, and when the "
        "forecast passes all of it. A budget by tag counts nothing until the tag is activated in the "
        "billing console",
    )
    low_voltage_v: float = Field(
        gt=0,
        allow_inf_nan=False,
        default=LOW_VOLTAGE_V,
        description="a low battery: three lithium cells; 14 for four",
    )
    high_temperature_degc: float = Field(
        gt=0,
        allow_inf_nan=False,
        default=80.0,
        description="a hot controller, on its board or MOSFETs; a VESC throttles from 85 degC",
    )
    stream_behind_s: float = Field(
        gt=0, allow_inf_nan=False, default=60.0, description="how far Lambda 2 may be behind"
    )
    car_to_lambda_ms: float = Field(
        gt=0, allow_inf_nan=False, default=2_000.0, description="live samples older than this are late"
    )
    function_logs: Literal["own", "all"] = Field(
        default="own", description="`all` keeps Lambda's own lines about every invocation, too: see below"
    )
    robot_metrics: bool = Field(
        default=False, description="every robot's health as metrics of its own: see below"
    )
    device_defender: bool = Field(default=False, description="a daily audit of the account's AWS IoT")
    iot_log_level: Literal["off", "error", "warn", "info", "debug"] = Field(
        default="off",
        description="AWS IoT's own log: `error`, `warn`, `info` or `debug` "
        "([how](../how-to/alarms.md#aws-iots-own-log))",
    )
    nightly_analysis: bool = Field(
        default=True,
        description="analyses the last two days' drives every night at 03:00 UTC; `false` leaves it to "
        "[`iort analyse`](../explanation/analysis.md)",
    )
    page_url: str = Field(
        pattern=r"^https?://[^\s#?]+/$",
        default=PAGE_URL,
        description="where the page is, for the links in mails about findings",
    )
    site: bool = Field(default=False, description="the page on the web: [how](page.md#on-the-web)")
    site_robots: Annotated[list[str], BeforeValidator(_robots)] = Field(
        default=[],
        description="the robots that everybody sees on the page on the web, as `car1,car2`, at most 50, or "
        "`*` for all. Needed with `site` and `live_transport=iot`; with PubNub, its access token says which",
    )
    embedded: bool = Field(
        default=False, description="for the embedded cloud, with the caller's own credentials"
    )
    layer: Annotated[Path, BeforeValidator(lambda folder: ROOT / folder)] = Field(
        default=ROOT / "build" / "layer" / "lambda", description="the folder of Lambda 1's third-party code"
    )
    analysis_layer: Annotated[Path, BeforeValidator(lambda folder: ROOT / folder)] = Field(
        default=ROOT / "build" / "layer" / "analysis",
        description="the folder of numpy and pyarrow, for the functions that archive and analyse. The "
        "embedded cloud's functions use this machine's",
    )
    live_fields: dict[str, list[str]] = {VESC_STREAM: list(VESC_FIELDS)}

    @property
    def protected(self) -> bool:
        """Whether data outlives its stack: retained, with point-in-time recovery, and protected from deletion
        and termination."""
        return self.stage == PROD

    @property
    def reserved_for_live(self) -> int:
        """Reserved concurrency of the function Live, 0 for none: a small account has nothing to reserve from,
        and without PubNub nothing calls it."""
        if self.live_concurrency is None:
            allowed = self.account_concurrency >= UNRESERVED + _RESERVED_FOR_LIVE
            called = self.live_transport == PUBNUB
            return _RESERVED_FOR_LIVE if self.protected and allowed and called else 0
        return self.live_concurrency

    @property
    def at_once(self) -> AtOnce:
        """Hundredths of the account. Of a new one's ten executions, with two each for the queues of waiting
        batches and of refused messages, three stay for whatever robots and people wait for.

        The embedded cloud's functions share this machine's cores.
        """
        if self.embedded:
            return AtOnce(LEAST_OF_A_QUEUE, 2, 2)
        hundredth = self.account_concurrency // 100
        return AtOnce(max(LEAST_OF_A_QUEUE, hundredth), max(1, hundredth), max(1, 4 * hundredth))

    @property
    def has_live(self) -> bool:
        """Whether the function Live exists. On AWS it stays without its rule, which costs nothing, so that
        one deployment is enough to change the way; the embedded cloud is always new."""
        return self.live_transport == PUBNUB or not self.embedded

    @property
    def rules(self) -> list[Rule]:
        """The catalogue's rules. Without PubNub whoever looks at a car subscribes to its live messages, so no
        rule sends them on."""
        return [
            rule for rule in RULES.values() if rule.action != Call("live") or self.live_transport == PUBNUB
        ]

    @property
    def public(self) -> bool:
        """Whether anybody may see live messages, by an identity of Amazon Cognito. The embedded cloud has it
        for whoever builds such a page: it listens on loopback."""
        return self.embedded or (self.site and self.live_transport == IOT)

    @property
    def writes(self) -> dict[str, int]:
        """The most write units a second of each table, by its construct: for the whole fleet, and beside it
        for one robot that writes as much as AWS IoT takes from a connection."""
        return {
            table: A_ROBOTS_MOST + of_a_robot * self.fleet_robots for table, of_a_robot in _WRITES.items()
        } | _WRITES_OF_ALL

    @property
    def telemetry_writes(self) -> int:
        """The most write units a second of the telemetry table."""
        return self.writes["Batches"]

    @property
    def retention_s(self) -> int:
        """The lifetime of telemetry and summaries."""
        return self.retention_days * DAY_S

    @property
    def account_wide(self) -> bool:
        """Whether any setting of the whole account is on."""
        return not self.embedded and (self.device_defender or self.iot_log_level != "off")

    @model_validator(mode="before")
    @classmethod
    def _no_flag_is_a_number(cls, given: dict[str, Any]) -> dict[str, Any]:
        """Pydantic reads ``true`` in cdk.json as 1, which nobody means by it."""
        for key, value in given.items():
            if isinstance(value, bool) and cls.model_fields[key].annotation is not bool:
                raise ValueError(f"{key} must be a number or text, got {value}")
        return given

    @classmethod
    def from_context(cls, app: App) -> Settings:
        """Read ``-c key=value`` and cdk.json; raises `SettingsError` for an invalid value."""
        return cls.read(app.node.try_get_context)

    @classmethod
    def read(cls, context: Callable[[str], Any]) -> Settings:
        """Read from ``context``, which returns a key's value or None; raises `SettingsError`."""
        given = {key: value for key in CONTEXT_KEYS if (value := context(key)) is not None}
        try:
            settings = cls(**given)
        except ValidationError as error:
            _refuse(error)
        if settings.budget_usd and not settings.alarm_email:
            raise SettingsError("context budget_usd needs alarm_email, which receives the alerts")
        if settings.site and settings.embedded:
            raise SettingsError(
                "context site: the embedded cloud has no CloudFront; `make demo` serves the page"
            )
        if settings.turn and settings.embedded:
            raise SettingsError(
                "context turn: the embedded cloud has no relays; `video.turn` in car.yaml names a server of "
                "your own"
            )
        if settings.public and not settings.site_robots:
            raise SettingsError(
                "context site_robots must name the robots that anybody may see, as car1,car2, or be * for "
                "all, got none: the page is open to everybody with site and live_transport=iot, or embedded"
            )
        needed = [settings.layer] if settings.has_live else []
        needed += [] if settings.embedded else [settings.analysis_layer]
        if missing := [folder for folder in needed if not folder.is_dir()]:
            raise SettingsError(f"layer {missing[0]} is missing: run `make layer`")
        return settings


# The fields of the dashboard are no context key.
CONTEXT_KEYS = Settings.model_fields.keys() - {"live_fields"}


def _refuse(error: ValidationError) -> NoReturn:
    first = error.errors()[0]
    text = re.sub(r"^\w+ should", "must", first["msg"]).removeprefix("Value error, ")
    # The contract's errors show the value, and name the key.
    if first["type"] != "value_error" or ", got " not in text:
        text = f"{first['loc'][0]} {text}, got {first['input']!r}"
    raise SettingsError(f"context {text}") from error
