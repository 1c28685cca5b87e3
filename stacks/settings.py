"""The deployment's parameters, read once from the CDK context."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from aws_cdk import App, RemovalPolicy

from iort_contract.catalog.vesc import VESC_FIELDS, VESC_STREAM
from iort_contract.cloud import LOW_VOLTAGE_V
from iort_contract.limits import DEFAULT_NAMESPACE, ContractError
from iort_contract.topics import check_namespace

ROOT = Path(__file__).resolve().parent.parent

DEV, PROD = "dev", "prod"
STAGES = (DEV, PROD)
_RESERVED_FOR_LIVE = 5
IOT_LOG_LEVELS = ("off", "error", "warn", "info", "debug")
OWN_LOGS, ALL_LOGS = "own", "all"
FUNCTION_LOGS = (OWN_LOGS, ALL_LOGS)
_EMAIL = re.compile(r"[^@\s,]+@[^@\s,]+\.[^@\s,]+")
# "Tag naming limits and requirements": up to 128 and 256 characters, and aws: is AWS' own.
_TAG_KEY = re.compile(r"(?!aws:)[\w .:/=+@-]{1,128}", re.IGNORECASE)
_TAG_VALUE = re.compile(r"[\w .:/=+@-]{0,256}")


# Parse one context value; raises `SettingsError`.
_Reader = Callable[[str, Any], Any]


class SettingsError(ValueError):
    """A context value that the stacks cannot use; the text names the key, the value and the allowed
    values."""


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """Alarm thresholds; each is a context key of the same name.

    The voltage suits a battery of three lithium cells. The temperatures are those of the controller's board
    and MOSFETs; a VESC throttles from 85 degC.
    """

    low_voltage_v: float = LOW_VOLTAGE_V
    high_temperature_degc: float = 80.0
    stream_behind_s: float = 60.0
    car_to_lambda_ms: float = 2_000.0


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings that may differ between two deployments of the same stacks.

    ``namespace`` prefixes topics, rules and stacks. ``stage`` is dev, which deletes all data with its stack,
    or prod, which keeps and protects tables and files. ``tags`` are put on every resource. ``customer_key``
    encrypts stored data with a key of the account; ``keep_customer_key`` keeps that key without using it, for
    data that it has encrypted. ``budget_usd`` is the account's monthly budget (0: none), and ``alarm_email``
    receives its alerts and every alarm. ``old_telemetry`` keeps the telemetry table of a deployment from
    before batches had ids. ``robot_metrics`` also counts every robot by itself, at a cost per robot.
    ``retention_days`` is the lifetime of telemetry and summaries, ``files_days`` of uploaded files (0: for
    good). ``upload_gb_a_day`` is a robot's daily upload limit, in 1e9 bytes. ``live_concurrency`` is the
    reserved concurrency of Lambda 1, which also limits it (0: nothing; None: see `reserved_for_live`).
    ``live_fields`` maps a stream to its fields on the dashboard. ``function_logs`` is "own" for the
    functions' own lines, or "all" to add Lambda's lines about every invocation. ``device_defender`` and
    ``iot_log_level`` ("" for none) apply to the whole account. ``site`` adds the stack that puts the page on
    the web. ``layer`` is the folder of Lambda 1's third-party code. ``embedded`` is true for the embedded
    cloud, which is deployed with the caller's own credentials.
    """

    namespace: str = DEFAULT_NAMESPACE
    stage: str = DEV
    tags: Mapping[str, str] = field(default_factory=dict)
    customer_key: bool = False
    keep_customer_key: bool = False
    old_telemetry: bool = False
    robot_metrics: bool = False
    budget_usd: int = 0
    alarm_email: str | None = None
    thresholds: Thresholds = field(default_factory=Thresholds)
    retention_days: int = 90
    files_days: int = 0
    upload_gb_a_day: int = 50
    live_concurrency: int | None = None
    live_fields: Mapping[str, list[str]] = field(default_factory=lambda: {VESC_STREAM: list(VESC_FIELDS)})
    layer: Path = ROOT / "build" / "layer" / "lambda"
    device_defender: bool = False
    iot_log_level: str = ""
    function_logs: str = OWN_LOGS
    site: bool = False
    embedded: bool = False

    @property
    def protected(self) -> bool:
        """Whether data outlives its stack: retained, with point-in-time recovery, and protected from deletion
        and termination."""
        return self.stage == PROD

    @property
    def reserved_for_live(self) -> int:
        """Reserved concurrency of Lambda 1, 0 for none.

        Lambda rejects a reservation that leaves an account fewer than 100 unreserved executions
        (PutFunctionConcurrency). New accounts have 10 in all, so their first deployment would fail.
        """
        if self.live_concurrency is None:
            return _RESERVED_FOR_LIVE if self.protected else 0
        return self.live_concurrency

    @property
    def account_wide(self) -> bool:
        """Whether any setting of the whole account is on."""
        return not self.embedded and (self.device_defender or bool(self.iot_log_level))

    @property
    def removal_policy(self) -> RemovalPolicy:
        """The removal policy of resources that hold data."""
        return RemovalPolicy.RETAIN if self.protected else RemovalPolicy.DESTROY

    @classmethod
    def from_context(cls, app: App) -> Settings:
        """Read ``-c key=value`` and cdk.json; raises `SettingsError` for an invalid value."""
        return cls.read(app.node.try_get_context)

    @classmethod
    def read(cls, context: Callable[[str], Any]) -> Settings:
        """Read from ``context``, which returns a key's value or None; raises `SettingsError`."""
        given: dict[str, Any] = {
            key: read(key, value) for key, read in _READ.items() if (value := context(key)) is not None
        }
        given["thresholds"] = Thresholds(
            **{
                one.name: _positive(one.name, value)
                for one in fields(Thresholds)
                if (value := context(one.name)) is not None
            }
        )
        settings = cls(**given)
        if settings.budget_usd and not settings.alarm_email:
            raise SettingsError("context budget_usd needs alarm_email, which receives the alerts")
        if settings.site and settings.embedded:
            raise SettingsError(
                "context site: the embedded cloud has no CloudFront; `make demo` serves the page"
            )
        if not settings.layer.is_dir():
            raise SettingsError(f"layer {settings.layer} is missing: run `make layer`")
        return settings


def _namespace(_key: str, value: Any) -> str:
    try:
        return check_namespace(value)
    except ContractError as error:
        raise SettingsError(f"context {error}") from error


def _whole(low: int, high: int) -> _Reader:
    def read(key: str, value: Any) -> int:
        # The CDK CLI passes every -c as text, cdk.json a number of either kind.
        text = str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)
        if not text.isdecimal() or not low <= int(text) <= high:
            raise SettingsError(f"context {key} must be a whole number from {low} to {high}, got {value!r}")
        return int(text)

    return read


def _one_of(*allowed: str) -> _Reader:
    def read(key: str, value: Any) -> str:
        if value not in allowed:
            raise SettingsError(
                f"context {key} must be {', '.join(allowed[:-1])} or {allowed[-1]}, got {value!r}"
            )
        return str(value)

    return read


def _log_level(key: str, value: Any) -> str:
    level: str = _one_of(*IOT_LOG_LEVELS)(key, value)
    return "" if level == "off" else level


def _positive(key: str, value: Any) -> float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not 0 < number < math.inf:
        raise SettingsError(f"context {key} must be a number above 0, got {value!r}")
    return number


def _boolean(key: str, value: Any) -> bool:
    if str(value).lower() not in ("true", "false"):
        raise SettingsError(f"context {key} must be true or false, got {value!r}")
    return str(value).lower() == "true"


def _email(key: str, value: Any) -> str:
    if not isinstance(value, str) or not _EMAIL.fullmatch(value):
        raise SettingsError(f"context {key} must be one e-mail address, got {value!r}")
    return value


def _tags(key: str, value: Any) -> dict[str, str]:
    """Parse tags: an object in cdk.json, ``team=lab,cost-centre=7`` on the command line."""
    tags: Mapping[Any, Any] | None = value if isinstance(value, Mapping) else None
    if isinstance(value, str):
        pairs = [pair.split("=", 1) for pair in value.split(",")]
        tags = {pair[0]: pair[-1] for pair in pairs} if all(len(pair) == 2 for pair in pairs) else None
    if tags is None or not all(
        isinstance(name, str)
        and _TAG_KEY.fullmatch(name)
        and isinstance(text, str)
        and _TAG_VALUE.fullmatch(text)
        for name, text in tags.items()
    ):
        raise SettingsError(f"context {key} must be key=value,key=value with AWS' tags, got {_shown(value)}")
    return dict(tags)


def _folder(_key: str, value: Any) -> Path:
    return ROOT / str(value)


def _shown(value: Any) -> str:
    return repr(value) if isinstance(value, str) else json.dumps(value, default=str)


_READ: Mapping[str, _Reader] = {
    "namespace": _namespace,
    "stage": _one_of(*STAGES),
    "retention_days": _whole(1, 3650),
    "files_days": _whole(0, 3650),
    "upload_gb_a_day": _whole(1, 10_000),
    "live_concurrency": _whole(0, 1000),
    "budget_usd": _whole(0, 1_000_000),
    "embedded": _boolean,
    "customer_key": _boolean,
    "keep_customer_key": _boolean,
    "device_defender": _boolean,
    "old_telemetry": _boolean,
    "robot_metrics": _boolean,
    "site": _boolean,
    "iot_log_level": _log_level,
    "function_logs": _one_of(*FUNCTION_LOGS),
    "alarm_email": _email,
    "tags": _tags,
    "layer": _folder,
}
