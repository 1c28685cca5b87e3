"""AWS' own price list: read with the operator's credentials, and kept in a file with its date.

`GetProducts` returns products as JSON texts, with the usage type of a bill in their attributes and the price
of each tier under ``terms``. `PRODUCTS` names the product of each entry in `PRICES`. Sources: the service's
API reference, and "Analyzing, optimizing, and reducing CloudWatch costs" for CloudWatch's usage types.
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

from iort_station.cost.prices import PRICES, Price
from iort_station.errors import StationError
from iort_station.output import cache

# The region of the API, which knows all regions' prices.
API_REGION = "us-east-1"
# The price list has no such service.
_NONE = frozenset({"NotFoundException", "InvalidParameterException"})
# A price that differs from ours by this factor has another unit.
_MOST_TIMES = 10.0
_SHOWN = 12


class Product(NamedTuple):
    """A product: its service code, and a pattern of its usage type without the region's prefix.

    ``said`` is a pattern of the price's description, which may match instead. ``everywhere`` means that the
    product belongs to no region.
    """

    service: str
    usage: str
    said: str = ""
    everywhere: bool = False


# AWS does not document the usage types beside a `said`; they are assumed.
PRODUCTS = {
    "connection": Product("AWSIoT", "ConnectionMinutes"),
    "message": Product("AWSIoT", "Messages"),
    "rule": Product("AWSIoT", "Rules?Triggered", "rules? (is )?triggered"),
    "action": Product("AWSIoT", "(Rule)?Actions?(Executed)?", "actions? (is )?(executed|triggered)"),
    "shadow": Product("AWSIoT", "(Device)?Shadow.*", "device shadow"),
    "audit": Product("IoTDeviceDefender", ".*Audit.*", "audit"),
    "write": Product("AmazonDynamoDB", "WriteRequestUnits"),
    "read": Product("AmazonDynamoDB", "ReadRequestUnits"),
    "storage": Product("AmazonDynamoDB", "TimedStorage-ByteHrs"),
    "recovery": Product("AmazonDynamoDB", "TimedPITRStorage-ByteHrs"),
    "invocation": Product("AWSLambda", "Request"),
    "compute_arm": Product("AWSLambda", "Lambda-GB-Second-ARM"),
    "compute_x86": Product("AWSLambda", "Lambda-GB-Second"),
    "transition": Product("AmazonStates", "StateTransition"),
    "express_request": Product("AmazonStates", "StepFunctions-Request"),
    "express_duration": Product("AmazonStates", "StepFunctions-GB-Second"),
    "s3_standard": Product("AmazonS3", "TimedStorage-ByteHrs"),
    "s3_instant": Product("AmazonS3", "TimedStorage-GIR-ByteHrs"),
    "s3_instant_read": Product("AmazonS3", "Retrieval-SIA-GIR"),
    "s3_put": Product("AmazonS3", "Requests-Tier1"),
    "s3_get": Product("AmazonS3", "Requests-Tier2"),
    "s3_move": Product("AmazonS3", "Requests-GIR-Tier1"),
    "schedule": Product("AWSEvents", ".*ScheduledInvocation.*", "scheduled invocation"),
    "logs": Product("AmazonCloudWatch", "DataProcessing-Bytes"),
    "metric": Product("AmazonCloudWatch", "CW:MetricMonitorUsage"),
    "metric_request": Product("AmazonCloudWatch", "CW:GMD-Metrics"),
    "alarm": Product("AmazonCloudWatch", "CW:AlarmMonitorUsage"),
    "insights_alarm": Product("AmazonCloudWatch", "CW:MetricInsightAlarmUsage"),
    "dashboard": Product("AmazonCloudWatch", "DashboardsUsageHour", everywhere=True),
    "queue_request": Product("AWSQueueService", "Requests-Tier1"),
    "key": Product("awskms", "KMS-Keys"),
    "key_request": Product("awskms", "KMS-Requests"),
}


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
    products: dict[tuple[str, str | None], list[Mapping[str, Any]]] = {}
    for name, product in PRODUCTS.items():
        # A product without a region is requested by itself.
        usage = product.usage if product.everywhere else None
        key = product.service, usage
        if key not in products:
            field, value = ("usagetype", usage) if usage else ("regionCode", region)
            products[key] = list(_products(pricing, product.service, field, value))
        found = [one for one in products[key] if _is(one, product, region)]
        paid = sorted({price for one in found if (price := _first_paid(one))})
        if not found:
            kept[name] = f"{product.service} has no {product.usage} in {region}{_known(products[key])}"
        elif len(paid) != 1:
            kept[name] = f"{product.service}, {product.usage}: expected one price, got {len(paid)}"
        elif not 1 / _MOST_TIMES < paid[0] / PRICES[name].each < _MOST_TIMES:
            kept[name] = f"{product.service}, {product.usage}: ${paid[0]:g} has another unit than ours"
        else:
            each[name] = paid[0]
    if all(PRODUCTS[name].everywhere for name in each):
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


def _is(found: Mapping[str, Any], product: Product, region: str) -> bool:
    # "EU-" or "EUW1-"; often nothing in us-east-1; the region's name for KMS.
    prefix = f"(?:EU-|[A-Z]{{3}}[0-9]-|{re.escape(region)}-)?"
    usage = str(found["product"]["attributes"].get("usagetype", ""))
    if re.fullmatch(prefix + product.usage, usage):
        return True
    texts = " ".join(str(tier.get("description", "")) for tier in _tiers(found))
    return bool(product.said) and re.search(product.said, texts, re.IGNORECASE) is not None


def _tiers(found: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    for term in found.get("terms", {}).get("OnDemand", {}).values():
        yield from term["priceDimensions"].values()


def _first_paid(found: Mapping[str, Any]) -> float | None:
    """The price of the first tier that is not free, as in `PRICES`."""
    tiers = sorted(
        (float(tier["beginRange"]), float(tier["pricePerUnit"].get("USD", 0))) for tier in _tiers(found)
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
    new = path.with_suffix(".new")
    new.write_text(json.dumps(listed._asdict(), indent=1) + "\n")
    new.replace(path)


def load(path: Path) -> Listed | None:
    """The kept prices; None if there are none. Raises `StationError` for an invalid file."""
    try:
        found = json.loads(path.read_text())
        each = {name: _price(name, value) for name, value in found["each"].items()}
        kept = {str(name): str(why) for name, why in found["kept"].items()}
        return Listed(date.fromisoformat(found["read_on"]).isoformat(), str(found["region"]), each, kept)
    except FileNotFoundError:
        return None
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise StationError(
            f"{path} must be a price list of `iort cost --refresh` ({error}): refresh or delete it"
        ) from error


def _price(name: str, value: Any) -> float:
    dollars = float(value)
    if name not in PRODUCTS or not 0 < dollars < math.inf:
        raise ValueError(f"{name[:40]} {dollars} is not one of our prices")
    return dollars
