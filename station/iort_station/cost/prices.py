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

AS_OF, REGION = "2025-06-01", "eu-west-1"
MONTH_HOURS = 730.0
MONTH_DAYS = MONTH_HOURS / 24
# The pricing page of each service, and its code in AWS' list.
SERVICES = {
    "IoT Core": ("https://aws.amazon.com/iot-core/pricing/", "AWSIoT"),
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
    they are assumed. ``everywhere``: it belongs to no region.
    """

    service: str
    usd: float
    per: float
    unit: str
    usage: str = ""
    said: str = ""
    everywhere: bool = False

    @property
    def each(self) -> float:
        """Dollars for one unit."""
        return self.usd / self.per


def _of(service: str, **prices: tuple[Any, ...]) -> dict[str, Price]:
    return {name: Price(service, *price) for name, price in prices.items()}


# "Confirmed" names a second source of the number after `AS_OF`. Most prices have none, since the pages load a
# region's prices by a script.
PRICES = {
    # Confirmed: connection and message, by the page's example for Europe (Ireland), as read 2026-09-20.
    **_of(
        "IoT Core",
        connection=(0.08, 1e6, "minute connected", "ConnectionMinutes"),
        message=(1.00, 1e6, "message of up to 5 KB", "Messages"),
        rule=(0.15, 1e6, "rule triggered, up to 5 KB", "Rules?Triggered", "rules? (is )?triggered"),
        action=(
            *(0.15, 1e6, "action executed, up to 5 KB"),
            *("(Rule)?Actions?(Executed)?", "actions? (is )?(executed|triggered)"),
        ),
        shadow=(1.25, 1e6, "shadow operation, up to 1 KB", "(Device)?Shadow.*", "device shadow"),
    ),
    # us-east-1: 0.625 and 0.125 since November 2024 (airbyte.com, 2025-07-21), the same ratio as of storage.
    **_of(
        "DynamoDB",
        write=(0.705, 1e6, "write request unit, up to 1 KB", "WriteRequestUnits"),
        read=(0.141, 1e6, "read request unit, up to 4 KB", "ReadRequestUnits"),
        storage=(0.283, 1, "GB-month", "TimedStorage-ByteHrs"),
        recovery=(0.226, 1, "GB-month recoverable to a point in time", "TimedPITRStorage-ByteHrs"),
    ),
    # Confirmed: compute, by artillery 2.0.28, platform/aws-lambda/prices.js: every region but five, which are
    # not Ireland.
    **_of(
        "Lambda",
        invocation=(0.20, 1e6, "invocation", "Request"),
        compute_arm=(0.0000133334, 1, "GB-second, Arm", "Lambda-GB-Second-ARM"),
        compute_x86=(0.0000166667, 1, "GB-second, x86", "Lambda-GB-Second"),
    ),
    # Confirmed: transition, by the page's table for Europe (Ireland).
    **_of(
        "Step Functions",
        transition=(0.025, 1000, "state transition", "StateTransition"),
        express_request=(1.00, 1e6, "request of an express workflow", "StepFunctions-Request"),
        express_duration=(0.00001667, 1, "GB-second of an express workflow", "StepFunctions-GB-Second"),
    ),
    **_of(
        "S3",
        s3_standard=(0.023, 1, "GB-month in S3 Standard", "TimedStorage-ByteHrs"),
        s3_instant=(0.005, 1, "GB-month in S3 Glacier Instant Retrieval", "TimedStorage-GIR-ByteHrs"),
        s3_instant_read=(0.03, 1, "GB read from S3 Glacier Instant Retrieval", "Retrieval-SIA-GIR"),
        s3_put=(0.005, 1000, "PUT, COPY, POST or LIST", "Requests-Tier1"),
        s3_get=(0.0004, 1000, "GET or HEAD", "Requests-Tier2"),
        s3_move=(0.02, 1000, "object moved to S3 Glacier Instant Retrieval", "Requests-GIR-Tier1"),
    ),
    **_of(
        "EventBridge",
        schedule=(1.00, 1e6, "scheduled call", ".*ScheduledInvocation.*", "scheduled invocation"),
    ),
    # Confirmed: metric, by signoz.io, 2026-02-15; dashboard, by factualminds.com, 2026-06-13.
    **_of(
        "CloudWatch",
        logs=(0.57, 1, "GB of log lines", "DataProcessing-Bytes"),
        metric=(0.30, 1, "metric a month", "CW:MetricMonitorUsage"),
        metric_request=(0.01, 1000, "metric requested by GetMetricData", "CW:GMD-Metrics"),
        alarm=(0.10, 1, "alarm a month", "CW:AlarmMonitorUsage"),
        insights_alarm=(
            *(0.10, 1, "metric a month that a Metrics Insights alarm analyses"),
            "CW:MetricInsightAlarmUsage",
        ),
        dashboard=(3.00, 1, "dashboard a month", "DashboardsUsageHour", "", True),
    ),
    **_of("SQS", queue_request=(0.40, 1e6, "request", "Requests-Tier1")),
    # Confirmed by the page as copied 2019-10-30.
    **_of(
        "KMS",
        key=(1.00, 1, "key a month", "KMS-Keys"),
        key_request=(0.03, 1e4, "request", "KMS-Requests"),
    ),
    # Confirmed by an undated copy of the page.
    **_of(
        "PubNub",
        pubnub_publish=(0.000123, 1, "replicated transaction, up to 2 KB"),
        pubnub_receive=(0.000033, 1, "edge transaction, up to 2 KB"),
    ),
}

# PubNub's plans by monthly active users: (users up to, dollars a month). Each viewer is a user, and Lambda 1
# is one; robots do not connect to PubNub. Fair use limits the messages, and the free plan is for development
# only. Source: https://www.pubnub.com/pricing/, without a second source since AS_OF.
PUBNUB_MAU_PLANS = ((1_000, 98.0), (5_000, 370.0), (10_000, 550.0), (25_000, 1_130.0))


class Quota(NamedTuple):
    """A default quota of an account in `REGION`; AWS raises ``adjustable`` ones on request."""

    value: float
    unit: str
    adjustable: bool = True


# IoT Core's are of https://docs.aws.amazon.com/general/latest/gr/iot-core.html. The others are of the same
# services' developer guides: DynamoDB's ServiceQuotas and bp-partition-key-design, Lambda's
# gettingstarted-limits. A new account may have lower quotas, such as of Lambda's executions.
QUOTAS = {
    # Confirmed: docs.espressif.com, specs/limits of RainMaker Neo, undated copy.
    "IoT Core: connections": Quota(500_000, "connections"),
    # The lower of two: AWS' pages of 2019 to 2023 say 500 a second, later ones 3,000 in most regions. Service
    # Quotas shows an account's own.
    "IoT Core: connects in a minute after an outage": Quota(500 * 60, "connects"),
    "IoT Core: subscriptions": Quota(500_000, "subscriptions"),
    "IoT Core: publishes in": Quota(20_000, "1/s"),
    "IoT Core: rule evaluations": Quota(20_000, "1/s"),
    # Confirmed: repost.aws, question QUshJCmEV8SOSkAJ00SWfQ4Q, undated copy.
    "IoT Core: publishes of one connection": Quota(100, "1/s", adjustable=False),
    # Confirmed by undated copies of the pages: this one, both writes to a table, and Lambda's executions.
    "IoT Core: connects of one client id": Quota(1, "1/s", adjustable=False),
    "DynamoDB: writes to table telemetry": Quota(40_000, "units/s"),
    "DynamoDB: writes to table summary": Quota(40_000, "units/s"),
    "DynamoDB: writes to one partition": Quota(1_000, "units/s", adjustable=False),
    "Lambda: concurrent executions": Quota(1_000, "executions"),
}


# The region of the API, which knows all regions' prices, and its answers about an unknown service.
API_REGION = "us-east-1"
_UNKNOWN = frozenset({"NotFoundException", "InvalidParameterException"})
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
        return PRICES | {
            name: PRICES[name]._replace(usd=each * PRICES[name].per) for name, each in self.each.items()
        }

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
    # "EU-" or "EUW1-"; often nothing in us-east-1; the region's name for KMS.
    prefix = f"(?:EU-|[A-Z]{{3}}[0-9]-|{re.escape(region)}-)?"
    for name, price in LISTED.items():
        _, code = SERVICES[price.service]
        # A product without a region is requested by itself.
        query = ("usagetype", price.usage) if price.everywhere else ("regionCode", region)
        if (code, query[1]) not in products:
            products[code, query[1]] = list(_products(pricing, code, *query))
        known = products[code, query[1]]
        rows = [row for row in known if _is(row, price, prefix)]
        paid = sorted({dollars for row in rows if (dollars := _first_paid(row))})
        if not rows:
            usages = sorted({_usage(row) for row in known})
            more = ", ..." if len(usages) > _SHOWN else ""
            others = f"; it has {', '.join(usages[:_SHOWN])}{more}" if usages else ""
            kept[name] = f"{code} has no {price.usage} in {region}{others}"
        elif len(paid) != 1:
            kept[name] = f"{code}, {price.usage}: expected one price, got {len(paid)}"
        elif not 1 / _MOST_TIMES < paid[0] / price.each < _MOST_TIMES:
            kept[name] = f"{code}, {price.usage}: ${paid[0]:g} has another unit than ours"
        else:
            each[name] = paid[0]
    if all(PRICES[name].everywhere for name in each):
        why = next(iter(kept.values()))
        raise StationError(f"AWS' price list has none of our products in {region}: {why}")
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
        if error.response["Error"]["Code"] in _UNKNOWN:
            return
        raise StationError(
            f"AWS' price list cannot be read: {error}. It needs the action pricing:GetProducts"
        ) from error


def _is(row: Mapping[str, Any], price: Price, prefix: str) -> bool:
    if re.fullmatch(prefix + price.usage, _usage(row)):
        return True
    texts = " ".join(str(tier.get("description", "")) for tier in _tiers(row))
    return bool(price.said) and re.search(price.said, texts, re.IGNORECASE) is not None


def _usage(row: Mapping[str, Any]) -> str:
    return str(row["product"]["attributes"].get("usagetype", ""))


def _tiers(row: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    for term in row.get("terms", {}).get("OnDemand", {}).values():
        yield from term["priceDimensions"].values()


def _first_paid(row: Mapping[str, Any]) -> float | None:
    """The price of the first tier that is not free, as in `PRICES`."""
    tiers = ((float(tier["beginRange"]), float(tier["pricePerUnit"].get("USD", 0))) for tier in _tiers(row))
    return next((dollars for _, dollars in sorted(tiers) if dollars > 0), None)


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
        each = {name: _dollars(name, value) for name, value in content["each"].items()}
        kept = {str(name): str(why) for name, why in content["kept"].items()}
        return Listed(date.fromisoformat(content["read_on"]).isoformat(), str(content["region"]), each, kept)
    except FileNotFoundError:
        return None
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise StationError(
            f"{path} must be a price list of `iort cost --refresh` ({error}): refresh or delete it"
        ) from error


def _dollars(name: str, value: Any) -> float:
    dollars = float(value)
    if name not in LISTED or not 0 < dollars < math.inf:
        raise ValueError(f"{name[:40]} {dollars} is not one of our prices")
    return dollars
