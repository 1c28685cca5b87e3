"""AWS' own price list, read with the operator's credentials, and kept with the day it was read on.

`GetProducts` answers with products as JSON texts: attributes, among them the usage type as a bill names it,
and under ``terms`` the price of each tier. What is asked for, of `PRICES`, is in `PRODUCTS`. Sources: the
service's API reference, and for CloudWatch's usage types "Analyzing, optimizing, and reducing CloudWatch
costs".
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

# The API's own region; what it tells is of all.
API_REGION = "us-east-1"
# Nothing of these is in the price list under that name.
_NONE = frozenset({"NotFoundException", "InvalidParameterException"})
# A price so many times ours, or so little, is of another unit.
_MOST_TIMES = 10.0
_SHOWN = 12


class Product(NamedTuple):
    """Where a price is: the service's code, and its usage type after the region's letters as a pattern, or
    what the price's description says. ``everywhere``: of no region."""

    service: str
    usage: str
    said: str = ""
    everywhere: bool = False


# What `said` stands beside is not in AWS' documentation, and assumed.
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
    """What the price list said on a day: dollars for one unit by the names of `PRICES`, and why the
    built-in price of a product is kept."""

    read_on: str
    region: str
    each: dict[str, float]
    kept: dict[str, str]

    def prices(self) -> dict[str, Price]:
        """The built-in prices with what was read instead."""
        listed = {
            name: PRICES[name]._replace(usd=each * PRICES[name].per, seen=f"AWS' price list, {self.read_on}")
            for name, each in self.each.items()
        }
        return {**PRICES, **listed}

    def changed(self) -> dict[str, tuple[float, float]]:
        """The built-in price and the one that was read, in dollars for ``per`` units, where they differ."""
        both = {name: (PRICES[name].usd, each * PRICES[name].per) for name, each in self.each.items()}
        return {name: (ours, aws) for name, (ours, aws) in both.items() if abs(aws - ours) > 1e-6 * ours}


def read(pricing: Any, region: str, today: date) -> Listed:
    """What AWS' price list says, by a client of it.

    Raises `StationError` where it may not be read, or knows nothing that we ask for.
    """
    each: dict[str, float] = {}
    kept: dict[str, str] = {}
    products: dict[tuple[str, str | None], list[Mapping[str, Any]]] = {}
    for name, product in PRODUCTS.items():
        # What is of no region is one product among those of all, so it is asked for by itself.
        usage = product.usage if product.everywhere else None
        key = product.service, usage
        if key not in products:
            field, value = ("usagetype", usage) if usage else ("regionCode", region)
            products[key] = list(_products(pricing, product.service, field, value))
        found = [one for one in products[key] if _is(one, product, region)]
        paid = sorted({price for one in found if (price := _first_paid(one))})
        if not found:
            kept[name] = f"{product.service} has no {product.usage} in {region}{_there_are(products[key])}"
        elif len(paid) != 1:
            kept[name] = f"{product.service}, {product.usage}: expected one price, got {len(paid)}"
        elif not 1 / _MOST_TIMES < paid[0] / PRICES[name].each < _MOST_TIMES:
            kept[name] = f"{product.service}, {product.usage}: ${paid[0]:g} is of another unit than ours"
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
    # "EU-", "EUW1-", in us-east-1 often nothing, of KMS the region's own name.
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
    """The price of the first tier that is not free, as everywhere in `PRICES`."""
    tiers = sorted(
        (float(tier["beginRange"]), float(tier["pricePerUnit"].get("USD", 0))) for tier in _tiers(found)
    )
    return next((dollars for _, dollars in tiers if dollars > 0), None)


def _there_are(products: list[Mapping[str, Any]]) -> str:
    names = sorted({str(one["product"]["attributes"].get("usagetype", "")) for one in products})
    more = ", ..." if len(names) > _SHOWN else ""
    return f"; it has {', '.join(names[:_SHOWN])}{more}" if names else ""


def kept_at(environment: Mapping[str, str]) -> Path:
    """The file that `iort cost --refresh` keeps the prices in, by the environment."""
    home = environment.get("XDG_CACHE_HOME") or Path(environment.get("HOME", "~")).expanduser() / ".cache"
    return Path(home) / "iort" / "prices.json"


def keep(listed: Listed, path: Path) -> None:
    """Write what `load` reads."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_suffix(".new")
    new.write_text(json.dumps(listed._asdict(), indent=1) + "\n")
    new.replace(path)


def load(path: Path) -> Listed | None:
    """What was kept; None where nothing was. Raises `StationError` for a file that is none of ours."""
    try:
        found = json.loads(path.read_text())
        each = {name: _price(name, value) for name, value in found["each"].items()}
        kept = {str(name): str(why) for name, why in found["kept"].items()}
        return Listed(date.fromisoformat(found["read_on"]).isoformat(), str(found["region"]), each, kept)
    except FileNotFoundError:
        return None
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise StationError(
            f"{path} is no price list that `iort cost --refresh` wrote ({error}): refresh it, or delete it"
        ) from error


def _price(name: str, value: Any) -> float:
    dollars = float(value)
    if name not in PRODUCTS or not 0 < dollars < math.inf:
        raise ValueError(f"{name[:40]} {dollars}: not one of our prices")
    return dollars
