"""What one robot and one stranger can spend is bounded by a property of a template, for all there is."""

from __future__ import annotations

import pytest

from scripts import ceilings
from scripts.ceilings import Templates


@pytest.fixture(scope="module")
def templates() -> Templates:
    return ceilings.default()


def named(templates: Templates, kind: str) -> set[str]:
    return {
        key.rpartition("/")[2][:-8]
        for key, one in templates.resources.items()
        if one["Type"] == f"AWS::{kind}"
    }


def test_every_table_and_every_reader_of_a_queue_has_a_limit_in_the_table(templates):
    held = " ".join(one.held_by for one in ceilings.robot(templates))
    for table in named(templates, "DynamoDB::Table"):
        assert f"`{table}`: `MaxWriteRequestUnits`" in held
    streams = {"SummarizeDynamoDBEventSource"}
    for mapping in named(templates, "Lambda::EventSourceMapping"):
        if not any(mapping.startswith(stream) for stream in streams):
            assert f"`{mapping}`: `MaximumConcurrency`" in held


@pytest.mark.parametrize(
    ("kind", "name", "held"),
    [
        ("DynamoDB::Table", "Batches", "OnDemandThroughput"),
        ("Lambda::EventSourceMapping", "Tasks", "ScalingConfig"),
        ("S3::Bucket", "Files", "LifecycleConfiguration"),
    ],
)
def test_a_limit_that_is_taken_away_has_no_figure(templates, monkeypatch, kind, name, held):
    (key,) = [
        key
        for key, one in templates.resources.items()
        if one["Type"] == f"AWS::{kind}" and key.rpartition("/")[2][:-8] == name
    ]
    resource = templates.resources[key]
    without = {which: value for which, value in resource["Properties"].items() if which != held}
    monkeypatch.setitem(templates.resources, key, {**resource, "Properties": without})
    with pytest.raises(KeyError, match=held):
        list(ceilings.robot(templates))


def test_the_fleets_size_is_what_the_tables_take():
    of_one = next(iter(ceilings.robot(Templates(fleet_robots=1))))
    of_many = next(iter(ceilings.robot(Templates(fleet_robots=100))))
    assert (of_one.limit, of_many.limit) == ("662 write units a second", "5,612 write units a second")
    assert (round(of_one.usd_a_day), round(of_many.usd_a_day)) == (40, 342)


def test_a_stranger_finds_no_door_unless_the_page_is_on_the_web(templates):
    assert {one.usd_a_day for one in ceilings.stranger(templates)} == {0.0}
    public = Templates(site=True, live_transport="iot", site_robots=["car1"])
    open_ = [one.held_by for one in ceilings.stranger(public) if one.usd_a_day is None]
    assert open_ == ["`AWS::Cognito::IdentityPool`", "`AWS::CloudFront::Distribution`"]
