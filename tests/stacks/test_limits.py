"""A run of the analysis ends within its limits, and what a robot or a stranger can spend is bounded."""

from __future__ import annotations

import pytest

from scripts import ceilings
from scripts.ceilings import Templates
from stacks.settings import AtOnce
from stacks.states import LONGEST_S, states


def tasks(states):
    """All tasks of a machine, also those of its maps' items."""
    for name_, state in states.items():
        if state["Type"] == "Task":
            yield name_, state
        yield from tasks(state.get("ItemProcessor", {}).get("States", {}))


def machine():
    arns = dict.fromkeys(("Plan", "Analyse", "Evaluate", "Present"), "arn")
    return states("aws", arns, bucket="files", at_once=AtOnce(2, 1, 1))["States"]


def test_a_call_that_lambda_refuses_is_repeated_until_the_run_ends() -> None:
    """So no catch sees it, and it is no failed drive. Pauses with full jitter are half as long on average."""
    calls = [(key, task) for key, task in tasks(machine()) if "lambda" in task["Resource"]]
    assert {key for key, _ in calls} == {"Robots", "Plan", "Analyse", "Evaluate", "Present", "Failed"}
    for _, task in calls:
        first = next(
            one
            for one in task["Retry"]
            if {"Lambda.TooManyRequestsException", "States.ALL"} & set(one["ErrorEquals"])
        )
        assert first["ErrorEquals"] == ["Lambda.TooManyRequestsException"]
        assert first["MaxAttempts"] * first["MaxDelaySeconds"] / 2 >= 2 * LONGEST_S
        # "Step Functions service quotas": an execution ends at 25,000 events, an attempt has three.
        assert 3 * LONGEST_S / (first["MaxDelaySeconds"] / 2) < 25_000
        assert first["MaxDelaySeconds"] * 5 < LONGEST_S


# What one robot and one stranger can spend is bounded by a property of a template, for all there is.


@pytest.fixture(scope="module")
def templates() -> Templates:
    return ceilings.default()


def ceilings_named(templates: Templates, kind: str) -> set[str]:
    return {
        key.rpartition("/")[2][:-8]
        for key, one in templates.resources.items()
        if one["Type"] == f"AWS::{kind}"
    }


def test_every_table_and_every_reader_of_a_queue_has_a_limit_in_the_table(templates):
    held = " ".join(one.held_by for one in ceilings.robot(templates))
    for table in ceilings_named(templates, "DynamoDB::Table"):
        assert f"`{table}`: `MaxWriteRequestUnits`" in held
    streams = {"SummarizeDynamoDBEventSource"}
    for mapping in ceilings_named(templates, "Lambda::EventSourceMapping"):
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
