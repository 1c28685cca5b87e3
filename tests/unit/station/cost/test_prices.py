"""AWS' price list, as GetProducts answers it."""

from __future__ import annotations

import json
from datetime import date

import boto3
import pytest
from botocore.exceptions import ClientError
from botocore.stub import Stubber
from typer.testing import CliRunner

from iort_station.cli.main import app
from iort_station.cost import model, report
from iort_station.cost.model import deployment_dollars_per_month
from iort_station.cost.prices import API_REGION, LISTED, PRICES, SERVICES, Listed, keep, kept_at, load, read
from iort_station.cost.usage import Usage
from iort_station.errors import StationError

TODAY = date(2026, 11, 22)
REGION = "eu-west-1"
# For each price: the service, its name on a bill in Ireland, and the built-in price.
USAGES = {
    "connection": "EUW1-ConnectionMinutes",
    "message": "EUW1-Messages",
    "rule": "EUW1-RulesTriggered",
    "action": "EUW1-ActionsExecuted",
    "shadow": "EUW1-DeviceShadow",
    "key": "eu-west-1-KMS-Keys",
    "key_request": "eu-west-1-KMS-Requests",
    "dashboard": "DashboardsUsageHour",
}


def product(service, usage, *tiers, description="", region=REGION):
    """One entry of PriceList, as the API reference shows them; a tier is (from, dollars)."""
    sku = "".join(filter(str.isalnum, usage)).upper()[:16]
    ends = [*(f"{begin:g}" for begin, _ in tiers[1:]), "Inf"]
    dimensions = {
        f"{sku}.JRTCKXETXF.{i}": {
            "unit": "Requests",
            "endRange": end,
            "description": description or f"${dollars} per {usage}",
            "appliesTo": [],
            "rateCode": f"{sku}.JRTCKXETXF.{i}",
            "beginRange": f"{begin:g}",
            "pricePerUnit": {"USD": f"{dollars:.10f}"},
        }
        for i, ((begin, dollars), end) in enumerate(zip(tiers, ends, strict=True))
    }
    term = {
        "priceDimensions": dimensions,
        "sku": sku,
        "effectiveDate": "2026-11-01T00:00:00Z",
        "offerTermCode": "JRTCKXETXF",
        "termAttributes": {},
    }
    attributes = {"servicecode": service, "usagetype": usage, "regionCode": region, "operation": ""}
    return {
        "product": {"productFamily": "API Request", "attributes": attributes, "sku": sku},
        "serviceCode": service,
        "terms": {"OnDemand": {f"{sku}.JRTCKXETXF": term}},
        "version": "20261120010203",
        "publicationDate": "2026-11-20T01:02:03Z",
    }


def as_built_in():
    """The price list with the built-in prices."""
    return {
        name: product(
            SERVICES[one.service][1],
            USAGES.get(name, f"EU-{one.usage}"),
            (0, PRICES[name].each),
            region="" if one.everywhere else REGION,
        )
        for name, one in LISTED.items()
    }


class Pricing:
    """A fake pricing client: the requested products, two a page, or an error for a service."""

    def __init__(self, products, **refused):
        self.products, self.refused = list(products), refused

    def get_paginator(self, operation):
        assert operation == "get_products"
        return self

    def paginate(self, *, ServiceCode, Filters, FormatVersion):
        assert FormatVersion == "aws_v1"
        if ServiceCode in self.refused:
            error = {"Error": {"Code": self.refused[ServiceCode], "Message": "no"}}
            raise ClientError(error, "GetProducts")
        (asked,) = Filters
        assert asked["Type"] == "TERM_MATCH"
        found = [
            json.dumps(one)
            for one in self.products
            if one["serviceCode"] == ServiceCode
            and one["product"]["attributes"][asked["Field"]] == asked["Value"]
        ]
        for i in range(0, len(found) or 1, 2):
            yield {"FormatVersion": "aws_v1", "PriceList": found[i : i + 2]}


def test_an_unchanged_price_list_changes_nothing():
    listed = read(Pricing(as_built_in().values()), REGION, TODAY)
    assert (listed.read_on, listed.region, listed.kept) == ("2026-11-22", REGION, {})
    assert listed.each.keys() == LISTED.keys()
    assert listed.changed() == {}
    assert report.differences(listed).body == [(f"as built in: {len(LISTED)} of {len(LISTED)}", "", "")]


def test_the_requests_pass_botocores_validation():
    """botocore's Stubber checks requests and responses against its model of the API, with paging."""
    client = boto3.client("pricing", region_name=API_REGION, aws_access_key_id="x", aws_secret_access_key="x")
    products = as_built_in().values()
    with Stubber(client) as stubber:
        for service, everywhere in dict.fromkeys(
            (SERVICES[one.service][1], one.everywhere) for one in LISTED.values()
        ):
            found = [
                json.dumps(one)
                for one in products
                if one["serviceCode"] == service
                and everywhere == (not one["product"]["attributes"]["regionCode"])
            ]
            field, value = ("usagetype", USAGES["dashboard"]) if everywhere else ("regionCode", REGION)
            asked = {
                "ServiceCode": service,
                "FormatVersion": "aws_v1",
                "Filters": [{"Type": "TERM_MATCH", "Field": field, "Value": value}],
            }
            first = {"FormatVersion": "aws_v1", "PriceList": found[:1], "NextToken": "more"}
            stubber.add_response("get_products", first, asked)
            rest = {"FormatVersion": "aws_v1", "PriceList": found[1:]}
            stubber.add_response("get_products", rest, {**asked, "NextToken": "more"})
        listed = read(client, REGION, TODAY)
        stubber.assert_no_pending_responses()
    assert (listed.each.keys(), listed.kept, listed.changed()) == (LISTED.keys(), {}, {})


def test_every_aws_price_is_requested():
    assert PRICES.keys() - LISTED.keys() == {"pubnub_publish", "pubnub_receive"}


def test_a_changed_price_is_reported_and_used():
    products = as_built_in() | {"rule": product("AWSIoT", USAGES["rule"], (0, 0.30e-6))}
    listed = read(Pricing(products.values()), REGION, TODAY)
    assert listed.changed() == {"rule": (0.15, pytest.approx(0.30))}
    line, rest = report.differences(listed).body
    assert line[1:] == ("0.15", "0.3")
    assert rest[0].startswith(f"as built in: {len(LISTED) - 1} of")
    changed, before = (model.bill(Usage(), prices) for prices in (listed.prices(), PRICES))
    more = sum(item.units for item in before if item.price == "rule") * 0.15e-6
    assert model.total(changed) == pytest.approx(model.total(before) + more)


def test_the_price_list_applies_to_an_idle_deployment():
    products = as_built_in() | {"metric": product("AmazonCloudWatch", "EU-CW:MetricMonitorUsage", (0, 0.6))}
    prices = read(Pricing(products.values()), REGION, TODAY).prices()
    rest, before = (deployment_dollars_per_month(Usage(), each) for each in (prices, PRICES))
    assert rest.pop("metrics") == pytest.approx(2 * before.pop("metrics"))
    assert rest == pytest.approx(before)


def test_the_first_tier_that_is_not_free_is_the_price():
    tiers = (25, 0.30), (1000, 0.20), (0, 0.0)
    products = as_built_in() | {"storage": product("AmazonDynamoDB", "EU-TimedStorage-ByteHrs", *tiers)}
    assert read(Pricing(products.values()), REGION, TODAY).each["storage"] == 0.30


def test_a_renamed_product_is_found_by_its_description():
    said = "$0.15 per million Rules Triggered"
    products = as_built_in() | {"rule": product("AWSIoT", "EUW1-R42", (0, 0.2e-6), description=said)}
    assert read(Pricing(products.values()), REGION, TODAY).each["rule"] == 0.2e-6


def test_a_region_without_a_usage_prefix_is_read():
    products = [
        product("AmazonDynamoDB", "WriteRequestUnits", (0, 0.625e-6), region="us-east-1"),
        product("AmazonDynamoDB", "IA-WriteRequestUnits", (0, 0.78e-6), region="us-east-1"),
    ]
    assert read(Pricing(products), "us-east-1", TODAY).each == {"write": 0.625e-6}


@pytest.mark.parametrize(
    ("instead", "why"),
    [
        (
            [],
            "AWSIoT has no Rules?Triggered in eu-west-1; it has EUW1-ActionsExecuted, EUW1-ConnectionMinutes",
        ),
        ([0.1e-6, 0.2e-6], "expected one price, got 2"),
        ([0.0], "expected one price, got 0"),
        ([0.15], "another unit than ours"),
    ],
)
def test_a_missing_price_keeps_its_built_in_value_with_the_reason(instead, why):
    products = as_built_in()
    del products["rule"]
    found = [product("AWSIoT", USAGES["rule"], (0, dollars)) for dollars in instead]
    listed = read(Pricing([*products.values(), *found]), REGION, TODAY)
    assert list(listed.kept) == ["rule"]
    assert why in listed.kept["rule"]
    assert listed.prices()["rule"] == PRICES["rule"]


@pytest.mark.parametrize("code", ["NotFoundException", "InvalidParameterException"])
def test_a_missing_service_keeps_its_built_in_prices(code):
    listed = read(Pricing(as_built_in().values(), awskms=code), REGION, TODAY)
    assert listed.kept == {
        "key": "awskms has no KMS-Keys in eu-west-1",
        "key_request": "awskms has no KMS-Requests in eu-west-1",
    }


def test_a_denied_request_names_the_required_action():
    with pytest.raises(StationError, match="pricing:GetProducts"):
        read(Pricing([], AWSIoT="AccessDeniedException"), REGION, TODAY)


def test_a_region_without_our_products_is_an_error():
    with pytest.raises(StationError, match="none of our products in mars-1"):
        read(Pricing(as_built_in().values()), "mars-1", TODAY)


def test_a_price_list_is_kept_with_its_date(tmp_path):
    path = kept_at({"XDG_CACHE_HOME": str(tmp_path / "cache")})
    assert path == tmp_path / "cache" / "iort" / "prices.json"
    assert kept_at({"HOME": "/home/car"}).parts[-3:] == (".cache", "iort", "prices.json")
    assert load(path) is None
    listed = Listed("2026-11-22", REGION, {"rule": 0.3e-6}, {"key": "not found"})
    keep(listed, path)
    assert load(path) == listed
    assert json.loads(path.read_text()).keys() == {"read_on", "region", "each", "kept"}
    assert [one.name for one in path.parent.iterdir()] == ["prices.json"]


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"each": {}}',
        '{"read_on": "soon", "region": "x", "each": {}, "kept": {}}',
        '{"read_on": "2026-11-22", "region": "x", "each": {"tea": 1}, "kept": {}}',
        '{"read_on": "2026-11-22", "region": "x", "each": {"rule": -1}, "kept": {}}',
        '{"read_on": "2026-11-22", "region": "x", "each": {"rule": "cheap"}, "kept": {}}',
    ],
)
def test_an_invalid_price_file_is_named(tmp_path, text):
    path = tmp_path / "prices.json"
    path.write_text(text)
    with pytest.raises(StationError, match=r"prices\.json must be a price list"):
        load(path)


def run(*given, **environment):
    return CliRunner().invoke(app, ["cost", *given], env=environment)


def test_later_calls_use_the_kept_price_list_and_name_its_date(tmp_path):
    environment = {"XDG_CACHE_HOME": str(tmp_path)}
    listed = Listed("2026-11-22", "eu-north-1", {"rule": 0.3e-6}, {"key": "not found"})
    keep(listed, kept_at(environment))
    said = " ".join(run(**environment).output.split())
    assert "AWS' price list as read on 2026-11-22, eu-north-1; built-in prices of 2025-06-01 for key;" in said
    told = json.loads(run("--json", **environment).output)
    assert (told["prices_as_of"], told["region"]) == ("2026-11-22", "eu-north-1")
    assert told["prices_changed"] == {"rule": [0.15, pytest.approx(0.3)]}
    expected = model.total(model.bill(Usage(), listed.prices()))
    assert told["dollars_per_robot_hour"] == pytest.approx(expected)
    kept_at(environment).unlink()
    assert "List prices of 2025-06-01" in run(**environment).output


def test_the_embedded_cloud_has_no_price_list(tmp_path):
    done = CliRunner().invoke(app, ["--local", "cost", "--refresh"], env={"XDG_CACHE_HOME": str(tmp_path)})
    assert isinstance(done.exception, StationError)
    assert "only AWS" in str(done.exception)


def test_missing_credentials_are_an_error_with_advice(tmp_path):
    nothing = dict.fromkeys(
        ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "AWS_PROFILE")
    )
    files = {name: str(tmp_path / "none") for name in ("AWS_CONFIG_FILE", "AWS_SHARED_CREDENTIALS_FILE")}
    done = run(
        "--refresh", XDG_CACHE_HOME=str(tmp_path), AWS_EC2_METADATA_DISABLED="true", **nothing, **files
    )
    assert isinstance(done.exception, StationError)
    assert "no AWS credentials" in str(done.exception)
    assert not list(tmp_path.iterdir())
