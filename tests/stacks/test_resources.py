"""The properties of the stacks' rules, tables, functions and logs."""

from __future__ import annotations

import json
import re

import pytest

from iort_contract.archive import ARCHIVE_PREFIX, HOUR
from iort_contract.catalog.rules import RULES
from iort_contract.cloud import ANALYSIS_PREFIX, IOT, PLANS_PREFIX, PUBNUB, RESULTS_PREFIX
from iort_contract.messages.files import FILES_PREFIX
from iort_contract.tables import BATCH, ENTRY, EXPIRES_S, FINDING, ROBOT, SECOND, TOPIC
from iort_contract.topics import rule_name
from iort_station.cost.model import RECORDS_A_CALL, WINDOW_S
from stacks.checks import granted, several
from stacks.settings import A_ROBOTS_MOST, Settings
from stacks.storage import VERSIONS_DAYS
from stacks.variations import EVERYTHING
from tests.stacks.templates import Reader, name
from tests.stacks.test_updates import identity

WAYS = {IOT: {}, PUBNUB: {"live_transport": PUBNUB}}


@pytest.fixture(scope="module")
def rules(synthesized):
    rules = synthesized.resources("AWS::IoT::TopicRule").values()
    return {rule["RuleName"]: rule["TopicRulePayload"] for rule in rules}


@pytest.fixture(scope="module")
def functions(synthesized):
    return {name(k): v for k, v in synthesized.resources("AWS::Lambda::Function").items()}


# --- rules ------------------------------------------------------------------------------------------


def test_the_rules_are_the_contracts(rules):
    assert set(rules) == {rule_name(rule) for rule in RULES}
    for rule in RULES:
        payload = rules[rule_name(rule)]
        assert payload["Sql"] == RULES[rule].statement()
        assert payload["AwsIotSqlVersion"] == "2016-03-23"
        assert not payload.get("RuleDisabled")
        # By AWS' SQL an OR with a comparison with null is Undefined, and so selects nothing.
        assert " or " not in payload["Sql"].lower()


def test_the_default_deployment_needs_no_third_party(deployment):
    """Lambda 1 stays, and its export, so that one deployment changes the way."""
    templates = {way: deployment(**given).templates for way, given in WAYS.items()}
    rules = {
        way: {
            one["Properties"]["RuleName"].removeprefix("iort_")
            for one in each["ingest"]["Resources"].values()
            if one["Type"] == "AWS::IoT::TopicRule"
        }
        for way, each in templates.items()
    }
    assert rules == {IOT: RULES.keys() - {"live"}, PUBNUB: RULES.keys()}
    for way, each in templates.items():
        assert each["fleet"]["Outputs"]["LiveTransport"]["Value"] == way
        assert not any(one.startswith("Public") for one in each["fleet"]["Outputs"])
    assert templates[IOT]["processing"] == templates[PUBNUB]["processing"]


def test_every_rule_has_exactly_its_one_action(rules, reader):
    actions = {rule.removeprefix("iort_"): payload["Actions"] for rule, payload in rules.items()}
    assert all(len(each) == 1 for each in actions.values())
    record, live, pong, echo, upload, ask, presence, version, *alerts = (actions[rule][0] for rule in RULES)
    assert reader.text(record["DynamoDBv2"]["PutItem"]["TableName"]) == "Batches"
    assert reader.text(live["Lambda"]["FunctionArn"]) == "Live.Arn"
    assert reader.text(echo["Lambda"]["FunctionArn"]) == "Echo.Arn"
    assert reader.text(upload["Lambda"]["FunctionArn"]) == "Upload.Arn"
    assert reader.text(ask["Lambda"]["FunctionArn"]) == "Answer.Arn"
    assert [reader.text(alert["Lambda"]["FunctionArn"]) for alert in alerts] == 2 * ["Alert.Arn"]
    for kept in (presence, version):
        assert reader.text(kept["Lambda"]["FunctionArn"]) == "Presence.Arn"
    assert (pong["Republish"]["Topic"], pong["Republish"]["Qos"]) == (RULES["pong"].action.topic("iort"), 0)
    assert {len(each[0]) for each in actions.values()} == {1}


def test_every_rule_has_an_error_action_that_keeps_the_message(synthesized, reader):
    """Every rule of every stack; a new rule needs an error action."""
    payloads = {}
    for logical_id, rule in synthesized.resources("AWS::IoT::TopicRule").items():
        payloads[name(logical_id)] = rule["TopicRulePayload"]
    assert len(payloads) >= len(RULES)
    for rule, payload in payloads.items():
        assert payload["ErrorAction"].keys() == {"Sqs"}, rule
        sqs = payload["ErrorAction"]["Sqs"]
        assert reader.text(sqs["QueueUrl"]) == "Rejected"
        # The error message holds the payload in base64 already: base64OriginalPayload.
        assert sqs["UseBase64"] is False
        # A rule's actions have one role, its own.
        assert reader.text(sqs["RoleArn"]) == f"{rule}Role.Arn"
        for action in payload["Actions"]:
            for settings in action.values():
                assert reader.text(settings.get("RoleArn", sqs["RoleArn"])) == f"{rule}Role.Arn"


def test_a_rule_is_created_after_its_roles_policy(synthesized):
    """IoT Core tests the role when it creates the rule."""
    resources = synthesized.templates["ingest"]["Resources"]
    for logical_id, resource in resources.items():
        if resource["Type"] == "AWS::IoT::TopicRule":
            depends = {name(other) for other in resource["DependsOn"]}
            assert depends == {f"{name(logical_id)}Role", f"{name(logical_id)}RoleDefaultPolicy"}


# --- tables -----------------------------------------------------------------------------------------


def test_the_tables_keys_are_the_contracts(synthesized):
    tables = {name(k): v for k, v in synthesized.resources("AWS::DynamoDB::Table").items()}

    def keys(table):
        types = {a["AttributeName"]: a["AttributeType"] for a in tables[table]["AttributeDefinitions"]}
        return [
            (k["AttributeName"], k["KeyType"], types[k["AttributeName"]]) for k in tables[table]["KeySchema"]
        ]

    assert keys("Batches") == [(TOPIC, "HASH", "S"), (BATCH, "RANGE", "S")]
    assert keys("Summary") == [(TOPIC, "HASH", "S"), (SECOND, "RANGE", "N")]
    assert keys("Robots") == [(ROBOT, "HASH", "S")]
    assert keys("Quarantine") == [(ROBOT, "HASH", "S"), (ENTRY, "RANGE", "S")]
    assert keys("Archive") == [(TOPIC, "HASH", "S"), (HOUR, "RANGE", "S")]
    assert keys("Findings") == [(ROBOT, "HASH", "S"), (FINDING, "RANGE", "S")]
    expires = {"AttributeName": EXPIRES_S, "Enabled": True}
    assert {t: v.get("TimeToLiveSpecification") for t, v in tables.items()} == {
        "Batches": expires,
        "Summary": expires,
        "Robots": None,
        "Archive": None,
        "Quarantine": expires,
        "Findings": None,
    }
    streams = {t: v.get("StreamSpecification") for t, v in tables.items()}
    assert {t: stream for t, stream in streams.items() if stream} == {
        "Batches": {"StreamViewType": "NEW_IMAGE"}
    }
    assert {v["BillingMode"] for v in tables.values()} == {"PAY_PER_REQUEST"}


def test_no_table_takes_more_than_the_fleet_and_one_robot_at_its_worst(deployment):
    def most(**settings):
        resources = deployment(**settings).templates["storage"]["Resources"]
        return {
            name(key): one["Properties"]["OnDemandThroughput"]["MaxWriteRequestUnits"]
            for key, one in resources.items()
            if one["Type"] == "AWS::DynamoDB::Table"
        }

    few, many = most(fleet_robots=5), most(fleet_robots=105)
    assert few.keys() == {"Batches", "Summary", "Robots", "Archive", "Quarantine", "Findings"}
    # A robot with lidar stores 50 KB a second; a hostile one what AWS IoT takes from a connection.
    assert (many["Batches"] - few["Batches"]) / 100 == 50
    assert min(few["Batches"], few["Summary"]) > A_ROBOTS_MOST == 612
    assert Settings().writes == most()


def test_the_volume_alarm_is_half_of_what_the_table_takes_for_an_hour(alarms):
    volume = alarms["BatchesVolume"]
    assert (volume["MetricName"], volume["Period"]) == ("ConsumedWriteCapacityUnits", 3600)
    assert volume["Threshold"] == Settings().writes["Batches"] * 3600 / 2


# --- functions --------------------------------------------------------------------------------------


def test_lambda_1_has_reserved_concurrency_only_in_prod(synthesized, production):
    def reserved(app):
        functions = app.resources("AWS::Lambda::Function", "processing").values()
        found = {f["Handler"]: f.get("ReservedConcurrentExecutions") for f in functions}
        return {handler: number for handler, number in found.items() if number is not None}

    assert reserved(synthesized) == {}, "a new account has too few to reserve from"
    assert reserved(production) == {"functions.live.handler": 5}


@pytest.mark.parametrize(
    ("account", "queues", "maps", "left"),
    [
        (10, {"Archive": 2, "Later": 2, "Quarantine": 2}, {"Plans": 1, "Drives": 1, "Findings": 1}, 3),
        (
            1000,
            {"Archive": 10, "Later": 2, "Quarantine": 2},
            {"Plans": 10, "Drives": 40, "Findings": 10},
            900,
        ),
    ],
)
def test_what_nobody_waits_for_leaves_executions_to_what_robots_and_people_wait_for(
    deployment, account, queues, maps, left
):
    """Of a queue's mapping AWS takes no limit under 2; the maps of a run follow each other."""
    given = {} if account == 10 else {"account_concurrency": account}
    resources = [
        one for template in deployment(**given).templates.values() for one in template["Resources"].values()
    ]

    def of(kind):
        return [one["Properties"] for one in resources if one["Type"] == kind]

    limits = {
        name(one["FunctionName"]["Ref"]): one["ScalingConfig"]["MaximumConcurrency"]
        for one in of("AWS::Lambda::EventSourceMapping")
        # Lambda 2 has as many as the table's stream has shards, and is one of those that stay.
        if "StreamArn" not in str(one["EventSourceArn"]) and "StartingPosition" not in one
    }
    (machine,) = of("AWS::StepFunctions::StateMachine")
    text = machine["DefinitionString"]
    parts = text["Fn::Join"][1] if isinstance(text, dict) else [text]
    states = json.loads("".join(one if isinstance(one, str) else "x" for one in parts))["States"]
    at_once = {key: state["MaxConcurrency"] for key, state in states.items() if state["Type"] == "Map"}

    assert (limits, at_once) == (queues, maps)
    assert account - sum(limits.values()) - max(at_once.values()) >= left
    reserved = [one for one in of("AWS::Lambda::Function") if "ReservedConcurrentExecutions" in one]
    assert reserved == []


BACKGROUND = {"Plan", "Analyse", "Evaluate", "Present", "Archive"}


def test_functions_share_one_runtime_and_have_logs_with_a_retention(synthesized, functions, reader):
    logs = {name(k): v for k, v in synthesized.resources("AWS::Logs::LogGroup").items()}
    assert logs.keys() == {f"{noun}Log" for noun in functions} | {"MachineLog"}
    assert {v["RetentionInDays"] for v in logs.values()} == {30}
    for noun, function in functions.items():
        assert reader.text(function["LoggingConfig"]["LogGroup"]) == f"{noun}Log"
        assert reader.text(function["Role"]) == f"{noun}Role.Arn"
        assert (function["Runtime"], function["Architectures"]) == ("python3.13", ["arm64"])
        # Nobody waits for the answers of the analysis and of the archive.
        assert function["Timeout"] <= {"Analyse": 90}.get(noun, 900 if noun in BACKGROUND else 60)


def test_functions_that_compute_with_arrays_do_so_in_one_thread(functions):
    computing = {noun for noun, function in functions.items() if "Arrays" in str(function.get("Layers"))}
    assert computing == {"Plan", "Analyse", "Evaluate", "Archive", "Answer"}
    threads = {
        noun: function["Environment"]["Variables"].get("OPENBLAS_NUM_THREADS")
        for noun, function in functions.items()
    }
    assert {noun for noun, number in threads.items() if number == "1"} == computing


def test_live_messages_and_pings_are_not_retried(synthesized, reader):
    configs = synthesized.resources("AWS::Lambda::EventInvokeConfig").values()
    assert {reader.text(c["FunctionName"]): c["MaximumRetryAttempts"] for c in configs} == {
        "Live": 0,
        "Echo": 0,
        "Upload": 0,
        "Answer": 0,
        "Presence": 2,
        "Alert": 1,
    }
    ages_s = {reader.text(c["FunctionName"]): c["MaximumEventAgeInSeconds"] for c in configs}
    minutes = dict.fromkeys(("Live", "Echo", "Upload", "Answer"), 60)
    assert ages_s == {**minutes, "Presence": 6 * 3600, "Alert": 300}
    for config in configs:
        assert reader.text(config["DestinationConfig"]["OnFailure"]["Destination"]) == "Rejected.Arn"


def mappings(synthesized, reader):
    found = synthesized.resources("AWS::Lambda::EventSourceMapping").values()
    return {reader.text(mapping["EventSourceArn"]): mapping for mapping in found}


def test_the_chain_of_dead_letter_queues_ends(synthesized, reader):
    """rejected -> the quarantine's function -> after five attempts the last queue, which feeds nothing."""
    mapping = mappings(synthesized, reader)["Rejected.Arn"]
    assert reader.text(mapping["FunctionName"]) == "Quarantine"
    assert mapping["FunctionResponseTypes"] == ["ReportBatchItemFailures"]
    assert mapping["ScalingConfig"] == {"MaximumConcurrency": 2}
    queues = {name(k): v for k, v in synthesized.resources("AWS::SQS::Queue").items()}
    redrive = queues["Rejected"]["RedrivePolicy"]
    assert (reader.text(redrive["deadLetterTargetArn"]), redrive["maxReceiveCount"]) == ("Last.Arn", 5)
    assert "RedrivePolicy" not in queues["Last"]
    assert "Last.Arn" not in mappings(synthesized, reader)
    # A failure in the quarantine's own function returns the message to its queue.
    configs = synthesized.resources("AWS::Lambda::EventInvokeConfig").values()
    assert "Quarantine" not in {reader.text(config["FunctionName"]) for config in configs}
    assert queues["Rejected"]["VisibilityTimeout"] >= 6 * 10


def test_deferred_batches_are_retried_and_then_quarantined(synthesized, reader):
    mapping = mappings(synthesized, reader)["PutOff.Arn"]
    assert reader.text(mapping["FunctionName"]) == "Later"
    # One message holds one robot's share of an invocation; several messages would delay one another.
    assert (mapping["BatchSize"], mapping["ScalingConfig"]) == (1, {"MaximumConcurrency": 2})
    queues = {name(k): v for k, v in synthesized.resources("AWS::SQS::Queue").items()}
    redrive = queues["PutOff"]["RedrivePolicy"]
    assert (reader.text(redrive["deadLetterTargetArn"]), redrive["maxReceiveCount"]) == ("Rejected.Arn", 5)
    functions = {name(k): v for k, v in synthesized.resources("AWS::Lambda::Function").items()}
    assert queues["PutOff"]["VisibilityTimeout"] >= 6 * functions["Later"]["Timeout"]


def test_the_stream_never_blocks_for_good(synthesized, reader):
    mapping = mappings(synthesized, reader)["Batches.StreamArn"]
    assert reader.text(mapping["FunctionName"]) == "Summarize"
    assert mapping["FunctionResponseTypes"] == ["ReportBatchItemFailures"]
    assert mapping["BisectBatchOnFunctionError"] is True
    assert mapping["MaximumRetryAttempts"] == 5
    # More, and two batches of one robot could be summarised at once: docs/explanation/processing.md.
    assert mapping["ParallelizationFactor"] == 1
    # The cost model uses this value.
    assert (mapping["MaximumBatchingWindowInSeconds"], mapping["BatchSize"]) == (WINDOW_S, RECORDS_A_CALL)
    assert mapping["MaximumRecordAgeInSeconds"] == 6 * 3600
    assert reader.text(mapping["DestinationConfig"]["OnFailure"]["Destination"]) == "Rejected.Arn"
    # From the beginning, so that batches stored before the mapping's first deployment are summarised.
    assert mapping["StartingPosition"] == "TRIM_HORIZON"


def test_two_deployments_can_share_an_account(deployment, synthesized):
    """Every name that CloudFormation does not generate contains the namespace."""
    app = deployment(namespace="lab2", retention_days=7, device_defender=True, iot_log_level="error")
    assert app.stacks.keys() == {f"lab2-{noun}" for noun in synthesized.templates}
    # An alarm's advice names a program.
    text = json.dumps(app.stacks).replace("`iort-agent ", "")
    assert not any(word in text for word in ("iort/", "/iort", "iort_", "iort-", "iort."))
    assert f"+ {7 * 86_400} AS expires_s" in text


def test_two_environments_in_one_account_share_no_name(deployment):
    """A stage dev and a stage prod with everything, beside each other: stacks, exports, and what has a name
    of ours. The account's own settings exist once, and the preflight asks for them; a role's policy is within
    its role."""
    apart = {"AWS::IoT::AccountAuditConfiguration", "AWS::IoT::Logging", "AWS::IAM::Policy"}

    def names(**settings):
        templates = deployment(**settings).stacks
        yield from (("stack", stack) for stack in templates)
        for template in templates.values():
            for output in template.get("Outputs", {}).values():
                if "Export" in output:
                    yield "export", json.dumps(output["Export"]["Name"])
            for one in template["Resources"].values():
                # A reference is another name in each deployment.
                if one["Type"] not in apart and "'Ref'" not in (text := str(identity(one))) != "None":
                    yield one["Type"], text

    dev = set(names(**{**EVERYTHING, "stage": "dev"}))
    prod = set(names(**EVERYTHING, namespace="lab2"))
    assert {kind for kind, _ in dev} == {kind for kind, _ in prod} >= {"stack", "export", "AWS::IoT::Policy"}
    assert not dev & prod


# --- files ------------------------------------------------------------------------------------------


def test_the_files_bucket_is_private_encrypted_and_cleans_up_after_itself(synthesized, reader):
    (bucket,) = synthesized.resources("AWS::S3::Bucket").values()
    assert set(bucket["PublicAccessBlockConfiguration"].values()) == {True}
    assert len(bucket["PublicAccessBlockConfiguration"]) == 4
    (encryption,) = bucket["BucketEncryption"]["ServerSideEncryptionConfiguration"]
    assert encryption["ServerSideEncryptionByDefault"]["SSEAlgorithm"] == "AES256"
    (ownership,) = bucket["OwnershipControls"]["Rules"]
    assert ownership["ObjectOwnership"] == "BucketOwnerEnforced"
    rules = {rule["Id"]: rule for rule in bucket["LifecycleConfiguration"]["Rules"]}
    assert rules.keys() == {"abandoned", "results", "plans", "archive", "rare", "old"}
    assert "VersioningConfiguration" not in bucket
    # What is archived is kept for good.
    assert rules["archive"]["Prefix"] == ARCHIVE_PREFIX
    assert "ExpirationInDays" not in rules["archive"]
    assert (rules["plans"]["Prefix"], rules["plans"]["ExpirationInDays"]) == (PLANS_PREFIX, 7)
    assert rules["abandoned"]["AbortIncompleteMultipartUpload"] == {"DaysAfterInitiation": 7}
    assert "Prefix" not in rules["abandoned"]
    assert (rules["results"]["Prefix"], rules["results"]["ExpirationInDays"]) == (
        RESULTS_PREFIX,
        1,
    )
    assert rules["rare"]["Prefix"] == rules["old"]["Prefix"] == FILES_PREFIX
    assert rules["old"]["ExpirationInDays"] == 365
    (policy,) = synthesized.resources("AWS::S3::BucketPolicy").values()
    statements = policy["PolicyDocument"]["Statement"]
    assert {statement["Effect"] for statement in statements} == {"Deny"}
    conditions = [statement["Condition"] for statement in statements]
    assert {"Bool": {"aws:SecureTransport": "false"}} in conditions
    assert {"NumericLessThan": {"s3:TlsVersion": 1.2}} in conditions
    for statement in statements:
        assert set(reader.texts(statement["Resource"])) == {"Files.Arn", "Files.Arn/*"}


@pytest.mark.parametrize(
    ("days", "kept"),
    [(7, {"old": 7}), (30, {"old": 30}), (365, {"rare": None, "old": 365}), (0, {"rare": None})],
)
def test_files_expire_after_the_configured_days(tmp_path, days, kept):
    from aws_cdk import App

    from stacks.storage import Storage

    app = App(outdir=str(tmp_path))
    Storage(app, Settings(files_days=days))
    (template,) = [stack.template for stack in app.synth().stacks]
    (bucket,) = [r["Properties"] for r in template["Resources"].values() if r["Type"] == "AWS::S3::Bucket"]
    rules = bucket["LifecycleConfiguration"]["Rules"]
    assert {r["Id"]: r.get("ExpirationInDays") for r in rules if r["Id"] in {"rare", "old"}} == kept


def test_in_prod_what_is_deleted_or_replaced_stays_for_a_month(production):
    (bucket,) = production.resources("AWS::S3::Bucket").values()
    assert bucket["VersioningConfiguration"] == {"Status": "Enabled"}
    rules = {rule["Id"]: rule for rule in bucket["LifecycleConfiguration"]["Rules"]}
    assert {
        rule["Id"]: rule["NoncurrentVersionExpiration"]["NoncurrentDays"]
        for rule in rules.values()
        if "NoncurrentVersionExpiration" in rule
    } == {"versions": VERSIONS_DAYS, "results": 1, "plans": 1}
    assert rules["versions"]["ExpiredObjectDeleteMarker"] is True
    assert not {"Prefix", "ExpirationInDays"} & rules["versions"].keys()


def test_who_may_delete_what_by_prefix(synthesized, production):
    """No role may delete an earlier version, or change how long one stays."""
    for app in (synthesized, production):
        reader = Reader(app)
        deletes = set()
        for template in app.templates.values():
            for logical_id, one in template["Resources"].items():
                for role, statement in granted(logical_id, one["Type"], one.get("Properties", {})):
                    for action in several(statement["Action"]):
                        if re.fullmatch(r"s3:(Delete|Put(Lifecycle|BucketVersioning)|Bypass).*", action):
                            deletes |= {(role, action, text) for text in reader.texts(statement["Resource"])}
        assert deletes == {
            ("ArchiveRole", "s3:DeleteObject", f"Files.Arn/{ARCHIVE_PREFIX}*"),
            ("PresentRole", "s3:DeleteObject", f"Files.Arn/{ANALYSIS_PREFIX}robot=*"),
        }
