"""List prices and default quotas with their date, in US dollars for `REGION`, without tax and discounts.

They are copied by hand from the services' pages. `iort cost --refresh` reads AWS' own list with the
operator's credentials (`GetProducts`), and keeps it in a file with its date.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

from botocore.exceptions import ClientError

from iort_station.errors import StationError
from iort_station.output import cache, whole

AS_OF = "2025-06-01"
REGION = "eu-west-1"
MONTH_HOURS = 730.0
MONTH_DAYS = MONTH_HOURS / 24
# The pricing page of each service, and its code in AWS' list.
SERVICES = {
    "IoT Core": ("https://aws.amazon.com/iot-core/pricing/", "AWSIoT"),
    "Device Defender": ("https://aws.amazon.com/iot-device-defender/pricing/", "IoTDeviceDefender"),
    "DynamoDB": ("https://aws.amazon.com/dynamodb/pricing/on-demand/", "AmazonDynamoDB"),
    "Lambda": ("https://aws.amazon.com/lambda/pricing/", "AWSLambda"),
    "Step Functions": ("https://aws.amazon.com/step-functions/pricing/", "AmazonStates"),
    "S3": ("https://aws.amazon.com/s3/pricing/", "AmazonS3"),
    "EventBridge": ("https://aws.amazon.com/eventbridge/pricing/", "AWSEvents"),
    "CloudWatch": ("https://aws.amazon.com/cloudwatch/pricing/", "AmazonCloudWatch"),
    "SQS": ("https://aws.amazon.com/sqs/pricing/", "AWSQueueService"),
    "KMS": ("https://aws.amazon.com/kms/pricing/", "awskms"),
    "PubNub": ("https://www.pubnub.com/docs/general/resources/pricing", ""),
}


class Price(NamedTuple):
    """``usd`` for ``per`` of ``unit``.

    In AWS' list the product has a usage type, as on a bill, that matches ``usage`` behind the region's
    prefix, or a description that matches ``said``; AWS does not document the usage types beside a `said`,
    they are assumed. ``everywhere``: it belongs to no region. ``seen`` names a second source of the number
    after `AS_OF`. It is empty for most prices, since the pages load a region's prices by a script.
    """

    usd: float
    per: float
    unit: str
    service: str
    usage: str = ""
    seen: str = ""
    said: str = ""
    everywhere: bool = False

    @property
    def each(self) -> float:
        """Dollars for one unit."""
        return self.usd / self.per


_PAGE = "the page, undated copy"
_IRELAND_EXAMPLE = "the page's example for Europe (Ireland), as read 2026-09-20"
_ARTILLERY = "artillery 2.0.28, platform/aws-lambda/prices.js: every region but five, which are not Ireland"
_KMS_COPY = "the page as copied 2019-10-30"

PRICES = {
    "connection": Price(
        0.08, 1e6, "minute connected", "IoT Core", "ConnectionMinutes", seen=_IRELAND_EXAMPLE
    ),
    "message": Price(1.00, 1e6, "message of up to 5 KB", "IoT Core", "Messages", seen=_IRELAND_EXAMPLE),
    "rule": Price(
        0.15, 1e6, "rule triggered, up to 5 KB", "IoT Core", "Rules?Triggered", said="rules? (is )?triggered"
    ),
    "action": Price(
        0.15,
        1e6,
        "action executed, up to 5 KB",
        "IoT Core",
        "(Rule)?Actions?(Executed)?",
        said="actions? (is )?(executed|triggered)",
    ),
    "shadow": Price(
        1.25, 1e6, "shadow operation, up to 1 KB", "IoT Core", "(Device)?Shadow.*", said="device shadow"
    ),
    "audit": Price(
        1.10,
        1000,
        "robot a month",
        "Device Defender",
        ".*Audit.*",
        seen="the page's example, as read 2026-09-20",
        said="audit",
    ),
    # us-east-1: 0.625 and 0.125 since November 2024 (airbyte.com, 2025-07-21), the same ratio as of storage.
    "write": Price(0.705, 1e6, "write request unit, up to 1 KB", "DynamoDB", "WriteRequestUnits"),
    "read": Price(0.141, 1e6, "read request unit, up to 4 KB", "DynamoDB", "ReadRequestUnits"),
    "storage": Price(0.283, 1, "GB-month", "DynamoDB", "TimedStorage-ByteHrs"),
    "recovery": Price(
        0.226, 1, "GB-month recoverable to a point in time", "DynamoDB", "TimedPITRStorage-ByteHrs"
    ),
    "invocation": Price(0.20, 1e6, "invocation", "Lambda", "Request"),
    "compute_arm": Price(
        0.0000133334, 1, "GB-second, Arm", "Lambda", "Lambda-GB-Second-ARM", seen=_ARTILLERY
    ),
    "compute_x86": Price(0.0000166667, 1, "GB-second, x86", "Lambda", "Lambda-GB-Second", seen=_ARTILLERY),
    "transition": Price(
        0.025,
        1000,
        "state transition",
        "Step Functions",
        "StateTransition",
        seen="the page's table, Europe (Ireland)",
    ),
    "express_request": Price(
        1.00, 1e6, "request of an express workflow", "Step Functions", "StepFunctions-Request"
    ),
    "express_duration": Price(
        0.00001667, 1, "GB-second of an express workflow", "Step Functions", "StepFunctions-GB-Second"
    ),
    "s3_standard": Price(0.023, 1, "GB-month in S3 Standard", "S3", "TimedStorage-ByteHrs"),
    "s3_instant": Price(
        0.005, 1, "GB-month in S3 Glacier Instant Retrieval", "S3", "TimedStorage-GIR-ByteHrs"
    ),
    "s3_instant_read": Price(0.03, 1, "GB read from S3 Glacier Instant Retrieval", "S3", "Retrieval-SIA-GIR"),
    "s3_put": Price(0.005, 1000, "PUT, COPY, POST or LIST", "S3", "Requests-Tier1"),
    "s3_get": Price(0.0004, 1000, "GET or HEAD", "S3", "Requests-Tier2"),
    "s3_move": Price(0.02, 1000, "object moved to S3 Glacier Instant Retrieval", "S3", "Requests-GIR-Tier1"),
    "schedule": Price(
        1.00, 1e6, "scheduled call", "EventBridge", ".*ScheduledInvocation.*", said="scheduled invocation"
    ),
    "logs": Price(0.57, 1, "GB of log lines", "CloudWatch", "DataProcessing-Bytes"),
    "metric": Price(
        0.30, 1, "metric a month", "CloudWatch", "CW:MetricMonitorUsage", seen="signoz.io, 2026-02-15"
    ),
    "metric_request": Price(0.01, 1000, "metric requested by GetMetricData", "CloudWatch", "CW:GMD-Metrics"),
    "alarm": Price(0.10, 1, "alarm a month", "CloudWatch", "CW:AlarmMonitorUsage"),
    "insights_alarm": Price(
        0.10,
        1,
        "metric a month that a Metrics Insights alarm analyses",
        "CloudWatch",
        "CW:MetricInsightAlarmUsage",
    ),
    "dashboard": Price(
        3.00,
        1,
        "dashboard a month",
        "CloudWatch",
        "DashboardsUsageHour",
        seen="factualminds.com, 2026-06-13",
        everywhere=True,
    ),
    "queue_request": Price(0.40, 1e6, "request", "SQS", "Requests-Tier1"),
    "key": Price(1.00, 1, "key a month", "KMS", "KMS-Keys", seen=_KMS_COPY),
    "key_request": Price(0.03, 1e4, "request", "KMS", "KMS-Requests", seen=_KMS_COPY),
    "pubnub_publish": Price(0.000123, 1, "replicated transaction, up to 2 KB", "PubNub", seen=_PAGE),
    "pubnub_receive": Price(0.000033, 1, "edge transaction, up to 2 KB", "PubNub", seen=_PAGE),
}

# PubNub's plans by monthly active users: (users up to, dollars a month). Each viewer is a user, and Lambda 1
# is one; robots do not connect to PubNub. Fair use limits the messages, and the free plan is for development
# only. Source: https://www.pubnub.com/pricing/, without a second source since AS_OF.
PUBNUB_MAU_PLANS = ((1_000, 98.0), (5_000, 370.0), (10_000, 550.0), (25_000, 1_130.0))


class Quota(NamedTuple):
    """A default quota of an account in `REGION`; AWS raises ``adjustable`` ones on request.

    ``seen`` is as in `Price`. A new account may have lower quotas, such as of Lambda's executions.
    """

    value: float
    unit: str
    adjustable: bool
    page: str
    seen: str = ""


_IOT_QUOTAS = "https://docs.aws.amazon.com/general/latest/gr/iot-core.html"
_DYNAMODB_QUOTAS = "https://docs.aws.amazon.com/amazondynamodb/latest/developerguide/ServiceQuotas.html"
_PARTITIONS = "https://docs.aws.amazon.com/amazondynamodb/latest/developerguide/bp-partition-key-design.html"
_LAMBDA_QUOTAS = "https://docs.aws.amazon.com/lambda/latest/dg/gettingstarted-limits.html"
_RAINMAKER = "docs.espressif.com, specs/limits of RainMaker Neo, undated copy"
_SCALING = "docs.aws.amazon.com/lambda/latest/dg/services-sqs-scaling.html, undated copy"

QUOTAS = {
    "IoT Core: connections": Quota(500_000, "connections", True, _IOT_QUOTAS, _RAINMAKER),
    # The lower of two: AWS' pages of 2019 to 2023 say 500 a second, later ones 3,000 in most regions. Service
    # Quotas shows an account's own.
    "IoT Core: connects in a minute after an outage": Quota(
        500 * 60, "connects", True, _IOT_QUOTAS, "the page in two copies, undated: 500 and 3,000 a second"
    ),
    "IoT Core: subscriptions": Quota(500_000, "subscriptions", True, _IOT_QUOTAS),
    "IoT Core: publishes in": Quota(20_000, "1/s", True, _IOT_QUOTAS),
    "IoT Core: rule evaluations": Quota(20_000, "1/s", True, _IOT_QUOTAS),
    "IoT Core: publishes of one connection": Quota(
        100, "1/s", False, _IOT_QUOTAS, "repost.aws, question QUshJCmEV8SOSkAJ00SWfQ4Q, undated copy"
    ),
    "IoT Core: connects of one client id": Quota(1, "1/s", False, _IOT_QUOTAS, _PAGE),
    "DynamoDB: writes to table telemetry": Quota(40_000, "units/s", True, _DYNAMODB_QUOTAS, _PAGE),
    "DynamoDB: writes to table summary": Quota(40_000, "units/s", True, _DYNAMODB_QUOTAS, _PAGE),
    "DynamoDB: writes to one partition": Quota(1_000, "units/s", False, _PARTITIONS),
    "Lambda: concurrent executions": Quota(1_000, "executions", True, _LAMBDA_QUOTAS, _SCALING),
}


# The region of the API, which knows all regions' prices, and its answer about an unknown service.
API_REGION = "us-east-1"
_NONE = frozenset({"NotFoundException", "InvalidParameterException"})
# A price that differs from ours by this factor has another unit.
_MOST_TIMES = 10.0
_SHOWN = 12
# Prices that AWS' list has.
LISTED = {name: price for name, price in PRICES.items() if price.usage}


class Listed(NamedTuple):
    """The price list of one day: dollars per unit by the names of `PRICES`; and the reasons why built-in
    prices were kept."""

    read_on: str
    region: str
    each: dict[str, float]
    kept: dict[str, str]

    def prices(self) -> dict[str, Price]:
        """The built-in prices, updated with those that were read."""
        listed = {
            name: PRICES[name]._replace(usd=each * PRICES[name].per, seen=f"AWS' price list, {self.read_on}")
            for name, each in self.each.items()
        }
        return {**PRICES, **listed}

    def changed(self) -> dict[str, tuple[float, float]]:
        """The built-in and the read price where they differ, in dollars for ``per`` units."""
        both = {name: (PRICES[name].usd, each * PRICES[name].per) for name, each in self.each.items()}
        return {name: (ours, aws) for name, (ours, aws) in both.items() if abs(aws - ours) > 1e-6 * ours}


def read(pricing: Any, region: str, today: date) -> Listed:
    """Read AWS' price list; raises `StationError` if that is not permitted, or the list has no product of
    ours."""
    each: dict[str, float] = {}
    kept: dict[str, str] = {}
    products: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for name, price in LISTED.items():
        _, code = SERVICES[price.service]
        # A product without a region is requested by itself.
        field, value = ("usagetype", price.usage) if price.everywhere else ("regionCode", region)
        if (code, value) not in products:
            products[code, value] = list(_products(pricing, code, field, value))
        known = products[code, value]
        rows = [row for row in known if _is(row, price, region)]
        paid = sorted({dollars for row in rows if (dollars := _first_paid(row))})
        if not rows:
            kept[name] = f"{code} has no {price.usage} in {region}{_known(known)}"
        elif len(paid) != 1:
            kept[name] = f"{code}, {price.usage}: expected one price, got {len(paid)}"
        elif not 1 / _MOST_TIMES < paid[0] / price.each < _MOST_TIMES:
            kept[name] = f"{code}, {price.usage}: ${paid[0]:g} has another unit than ours"
        else:
            each[name] = paid[0]
    if all(PRICES[name].everywhere for name in each):
        raise StationError(
            f"AWS' price list has none of our products in {region}: {next(iter(kept.values()))}"
        )
    return Listed(today.isoformat(), region, each, kept)


def _products(pricing: Any, service: str, field: str, value: str) -> Iterator[Mapping[str, Any]]:
    filters = [{"Type": "TERM_MATCH", "Field": field, "Value": value}]
    pages = pricing.get_paginator("get_products").paginate(
        ServiceCode=service, Filters=filters, FormatVersion="aws_v1"
    )
    try:
        for page in pages:
            yield from map(json.loads, page["PriceList"])
    except ClientError as error:
        if error.response["Error"]["Code"] in _NONE:
            return
        raise StationError(
            f"AWS' price list cannot be read: {error}. It needs the action pricing:GetProducts"
        ) from error


def _is(row: Mapping[str, Any], price: Price, region: str) -> bool:
    # "EU-" or "EUW1-"; often nothing in us-east-1; the region's name for KMS.
    prefix = f"(?:EU-|[A-Z]{{3}}[0-9]-|{re.escape(region)}-)?"
    if re.fullmatch(prefix + price.usage, str(row["product"]["attributes"].get("usagetype", ""))):
        return True
    texts = " ".join(str(tier.get("description", "")) for tier in _tiers(row))
    return bool(price.said) and re.search(price.said, texts, re.IGNORECASE) is not None


def _tiers(row: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    for term in row.get("terms", {}).get("OnDemand", {}).values():
        yield from term["priceDimensions"].values()


def _first_paid(row: Mapping[str, Any]) -> float | None:
    """The price of the first tier that is not free, as in `PRICES`."""
    tiers = sorted(
        (float(tier["beginRange"]), float(tier["pricePerUnit"].get("USD", 0))) for tier in _tiers(row)
    )
    return next((dollars for _, dollars in tiers if dollars > 0), None)


def _known(products: list[Mapping[str, Any]]) -> str:
    names = sorted({str(one["product"]["attributes"].get("usagetype", "")) for one in products})
    more = ", ..." if len(names) > _SHOWN else ""
    return f"; it has {', '.join(names[:_SHOWN])}{more}" if names else ""


def kept_at(environment: Mapping[str, str]) -> Path:
    """The file in which `iort cost --refresh` keeps the prices."""
    return cache(environment) / "prices.json"


def keep(listed: Listed, path: Path) -> None:
    """Write the file that `load` reads."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path, force=True) as part:
        part.write_text(json.dumps(listed._asdict(), indent=1) + "\n")


def load(path: Path) -> Listed | None:
    """The kept prices; None if there are none. Raises `StationError` for an invalid file."""
    try:
        content = json.loads(path.read_text())
        each = {name: _price(name, value) for name, value in content["each"].items()}
        kept = {str(name): str(why) for name, why in content["kept"].items()}
        return Listed(date.fromisoformat(content["read_on"]).isoformat(), str(content["region"]), each, kept)
    except FileNotFoundError:
        return None
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise StationError(
            f"{path} must be a price list of `iort cost --refresh` ({error}): refresh or delete it"
        ) from error


def _price(name: str, value: Any) -> float:
    dollars = float(value)
    if name not in LISTED or not 0 < dollars < math.inf:
        raise ValueError(f"{name[:40]} {dollars} is not one of our prices")
    return dollars
