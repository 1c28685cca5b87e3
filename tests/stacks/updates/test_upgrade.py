"""A deployment of version 1, before batches had ids, is updated in one `cdk deploy` and keeps its telemetry.

version1.json has that deployment's exports and its table, by stage.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

BEFORE = json.loads((Path(__file__).parent / "version1.json").read_text())


@pytest.fixture(scope="module", params=["dev", "prod"])
def stage(request):
    return request.param


@pytest.fixture(scope="module")
def updated(stage, deployment):
    """Every stack's template for that deployment, with and without the setting."""
    prod = {"stage": "prod", "customer_key": True, "budget_usd": 50, "alarm_email": "lab@example.org"}
    given = prod if stage == "prod" else {}
    return {True: deployment(**given, old_telemetry=True).templates, False: deployment(**given).templates}


def exports(templates):
    return {
        output["Export"]["Name"]: output["Value"]
        for template in templates.values()
        for output in template.get("Outputs", {}).values()
        if "Export" in output
    }


def old_tables(templates):
    tables = templates["iort-storage"]["Resources"].items()
    return {name: table for name, table in tables if name.startswith("Telemetry")}


def test_every_old_export_stays_unchanged(updated, stage):
    before, after = BEFORE[stage]["exports"], exports(updated[True])
    assert len(before) > 30
    assert {name: after.get(name) for name in before} == before


def test_an_update_without_the_setting_removes_imported_exports(updated, stage):
    """CloudFormation refuses this: the old record rule and Lambda 2 import the removed exports."""
    gone = BEFORE[stage]["exports"].keys() - exports(updated[False])
    assert len(gone) == 3
    assert all(name.startswith("iort-storage:") and "Telemetry" in name for name in gone)
    assert not old_tables(updated[False])


def test_the_old_table_stays_unchanged_in_every_stage(updated, stage):
    before = BEFORE[stage]["telemetry"]
    (table,) = old_tables(updated[True]).values()
    assert table["Properties"] == before["Properties"]
    assert (table["DeletionPolicy"], table["UpdateReplacePolicy"]) == ("Retain", "Retain")


def test_no_stack_imports_the_old_table(updated):
    """No function reads or writes it, so the setting can be removed later."""
    for name, template in updated[True].items():
        imported = json.dumps(template["Resources"])
        assert "iort-storage:ExportsOutput" in imported or name in ("iort-storage", "iort-account"), name
        assert "Telemetry" not in "".join(re.findall(r"iort-storage:(\w+)", imported)), name


def test_both_tables_are_outputs(updated):
    outputs = updated[True]["iort-storage"]["Outputs"]
    (old,) = old_tables(updated[True])
    assert outputs["OldTelemetryTable"]["Value"] == {"Ref": old}
    assert outputs["TelemetryTable"]["Value"] != {"Ref": old}


# "AWS::IoT::ThingType ThingTypeProperties": both have "Update requires: Replacement", which the schema does
# not say; and CloudFormation cannot create a second type of the same name.
THING_TYPE = {
    "ThingTypeDescription": "A robot that runs the iort agent",
    "SearchableAttributes": ["vehicle"],
}


def test_the_thing_types_properties_are_frozen(updated):
    (kind,) = (
        one["Properties"]
        for one in updated[True]["iort-fleet"]["Resources"].values()
        if one["Type"] == "AWS::IoT::ThingType"
    )
    assert kind["ThingTypeName"] == "iort-robot"
    assert kind["ThingTypeProperties"] == THING_TYPE, (
        "CloudFormation replaces a thing type whose description or searchable attributes change, and cannot "
        "while the first has its name: every deployment's update would fail. Make a second thing type with a "
        "logical id and a name of its own, which provisioning gives to new things, and keep the first, which "
        "things have. A search needs no searchable attribute: fleet indexing finds attributes and shadows."
    )
