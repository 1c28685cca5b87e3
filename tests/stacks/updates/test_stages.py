"""The stages dev and prod: the deletion of data, and encryption with a customer key."""

from __future__ import annotations

import json

import pytest

from tests.stacks.templates import Reader, name

# Resources with data: prod retains them, dev deletes them.
HOLDS_DATA = {
    "AWS::DynamoDB::Table",
    "AWS::KMS::Key",
    "AWS::Logs::LogGroup",
    "AWS::S3::Bucket",
    "AWS::SQS::Queue",
}


def holding_data(app):
    return [
        resource
        for template in app.templates.values()
        for resource in template["Resources"].values()
        if resource["Type"] in HOLDS_DATA
    ]


def test_dev_deletes_data_with_its_stacks(synthesized):
    for resource in holding_data(synthesized):
        assert (resource["DeletionPolicy"], resource["UpdateReplacePolicy"]) == ("Delete", "Delete"), resource
    for table in synthesized.resources("AWS::DynamoDB::Table").values():
        assert not table["DeletionProtectionEnabled"]
    assert not synthesized.protected
    assert not synthesized.resources("AWS::KMS::Key")
    assert not synthesized.resources("AWS::Budgets::Budget")


def test_prod_retains_data(production):
    for resource in holding_data(production):
        assert (resource["DeletionPolicy"], resource["UpdateReplacePolicy"]) == ("Retain", "Retain"), resource
    for table in production.resources("AWS::DynamoDB::Table").values():
        assert table["DeletionProtectionEnabled"]
        assert table["PointInTimeRecoverySpecification"] == {"PointInTimeRecoveryEnabled": True}
    assert production.protected == set(production.templates)


def test_the_stages_have_the_same_resources_but_for_key_and_budget(synthesized, production):
    def resources(app):
        return {
            (noun, name(logical_id), resource["Type"])
            for noun, template in app.templates.items()
            for logical_id, resource in template["Resources"].items()
        }

    more = {(stack, kind) for stack, _, kind in resources(production) - resources(synthesized)}
    assert more >= {("storage", "AWS::KMS::Key"), ("monitoring", "AWS::Budgets::Budget")}
    assert sorted(resources(synthesized) - resources(production)) == []


# --- the customer key -------------------------------------------------------------------------------

# The path of a resource's encryption key in its properties.
KEY_OF = {
    "AWS::DynamoDB::Table": ("SSESpecification", "KMSMasterKeyId"),
    "AWS::Logs::LogGroup": ("KmsKeyId",),
    "AWS::SNS::Topic": ("KmsMasterKeyId",),
    "AWS::SQS::Queue": ("KmsMasterKeyId",),
    "AWS::S3::Bucket": (
        "BucketEncryption",
        "ServerSideEncryptionConfiguration",
        0,
        "ServerSideEncryptionByDefault",
        "KMSMasterKeyID",
    ),
}


@pytest.mark.parametrize("kind", KEY_OF)
def test_the_customer_key_encrypts_all_stored_data(production, kind):
    reader = Reader(production)
    for properties in production.resources(kind).values():
        value = properties
        for step in KEY_OF[kind]:
            value = value[step]
        assert reader.text(value) == "Key.Arn"


def test_the_customer_key_can_be_used_only_by_this_account_and_these_services(production):
    (key,) = production.resources("AWS::KMS::Key").values()
    assert key["EnableKeyRotation"]
    reader = Reader(production)
    for statement in key["KeyPolicy"]["Statement"]:
        (who,) = (
            statement["Principal"].items() if isinstance(statement["Principal"], dict) else [("AWS", "*")]
        )
        if statement.get("Condition") is None:
            if statement.get("Sid") == "Alarms":
                # AWS' example for alarms has no condition; an alarm without access would fail silently.
                assert statement == {
                    "Sid": "Alarms",
                    "Effect": "Allow",
                    "Principal": {"Service": "cloudwatch.amazonaws.com"},
                    "Action": ["kms:Decrypt", "kms:GenerateDataKey*"],
                    "Resource": "*",
                }
            else:
                # The account's root delegates to its own IAM policies.
                assert reader.text(who[1]).endswith(":root")
            continue
        conditions = {key: value for each in statement["Condition"].values() for key, value in each.items()}
        assert conditions.keys() & {
            "kms:CallerAccount",
            "kms:EncryptionContext:aws:logs:arn",
        }
        if who[1] == "*":
            assert reader.text(conditions["kms:CallerAccount"]) == "${AWS::AccountId}"
            through = reader.texts(conditions["kms:ViaService"])
            assert [service.split(".")[0] for service in through] == ["dynamodb", "s3", "sns", "sqs"]
        if "kms:CreateGrant" in statement["Action"]:
            assert conditions["kms:GrantIsForAWSResource"] is True


# --- tags and budget --------------------------------------------------------------------------------


def test_every_taggable_resource_has_the_configured_tags(production):
    for template in production.templates.values():
        for logical_id, resource in template["Resources"].items():
            tags = resource.get("Properties", {}).get("Tags")
            if isinstance(tags, list):
                assert {"Key": "team", "Value": "lab"} in tags, logical_id
                assert {"Key": "stage", "Value": "prod"} in tags, logical_id
                assert {"Key": "project", "Value": "iort"} in tags, logical_id
    assert json.dumps(production.templates).count('"team"') > 20


def test_the_budget_notifies_the_address(production):
    (budget,) = production.resources("AWS::Budgets::Budget").values()
    assert budget["Budget"]["BudgetLimit"] == {"Amount": 50, "Unit": "USD"}
    assert budget["Budget"]["TimeUnit"] == "MONTHLY"
    kinds = {}
    for notification in budget["NotificationsWithSubscribers"]:
        assert notification["Subscribers"] == [{"SubscriptionType": "EMAIL", "Address": "lab@example.org"}]
        kinds[notification["Notification"]["NotificationType"]] = notification["Notification"]["Threshold"]
    assert kinds == {"ACTUAL": 80, "FORECASTED": 100}
