"""Both ends of every wire agree: handlers and assets, metrics and dashboard, rules and topics."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from aws_cdk import App, Stack

import contract
from contract import (
    BROKER,
    FILE,
    LAMBDA,
    LIVE,
    PING,
    PONG,
    RECORD,
    RULE,
    build_topic,
    live_topic,
    record_topic,
    rule_name,
)
from functions.health import measure
from stacks.encryption import Encryption
from stacks.function import function
from stacks.metrics import statistic
from stacks.settings import ROOT, Settings, SettingsError
from station.cost import Usage
from tests.stacks.templates import name

HANDLERS = ("Live", "Summarize", "Echo", "Upload", "Query", "Admit", "Presence", "Quarantine", "Alert")
FUNCTIONS = sorted((ROOT / "functions").glob("*.py"))
CONTRACT = sorted((ROOT / "contract").glob("*.py"))
# Lambda's Python has boto3 and what boto3 needs.
RUNTIME_PACKAGES = ("boto3", "botocore", "dateutil", "jmespath", "s3transfer", "six", "urllib3")


@pytest.fixture(scope="module")
def functions(synthesized):
    return {name(k): v for k, v in synthesized.resources("AWS::Lambda::Function").items()}


# --- assets -----------------------------------------------------------------------------------------


def test_the_asset_holds_exactly_the_contract_and_the_functions(synthesized, functions):
    assets = {synthesized.asset(function["Code"]) for function in functions.values()}
    (asset,) = assets
    packaged = {
        str(path.relative_to(asset)): path.read_bytes() for path in asset.rglob("*") if path.is_file()
    }
    expected = {*CONTRACT, *FUNCTIONS}
    assert packaged == {str(path.relative_to(ROOT)): path.read_bytes() for path in expected}


@pytest.fixture(scope="module")
def runtime(tmp_path_factory):
    """What Lambda's Python has beside the asset: boto3, and nothing else of this environment."""
    folder = tmp_path_factory.mktemp("runtime")
    for package in RUNTIME_PACKAGES:
        spec = importlib.util.find_spec(package)
        assert spec is not None
        assert spec.origin is not None
        origin = Path(spec.origin)
        origin = origin.parent if origin.name == "__init__.py" else origin
        (folder / origin.name).symlink_to(origin)
    return folder


@pytest.mark.parametrize("function", HANDLERS)
def test_every_handler_imports_from_its_asset_alone(synthesized, functions, runtime, tmp_path, function):
    properties = functions[function]
    asset = synthesized.asset(properties["Code"])
    path = [str(asset)]
    if "Layers" in properties:
        layer = ROOT / "build" / "layer" / "local" / "python"
        if not layer.is_dir():
            pytest.skip(f"{layer} is not there: run `make setup`")
        (tmp_path / "layer").symlink_to(layer)
        path.append(str(tmp_path / "layer"))
    path.append(str(runtime))
    program = """
import importlib, json, sys
sys.path[:0] = json.loads(sys.argv[1])
module, _, attribute = sys.argv[2].rpartition(".")
handler = getattr(importlib.import_module(module), attribute)
assert callable(handler)
files = {n: m.__file__ for n, m in sys.modules.items() if getattr(m, "__file__", None)}
print(json.dumps(files))
"""
    # -I and -S: neither this environment's packages nor the checkout are on the path.
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-B", "-c", program, json.dumps(path), properties["Handler"]],
        cwd=tmp_path,
        env={"PATH": os.environ["PATH"]},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    files = json.loads(done.stdout)
    own = {
        module: file for module, file in files.items() if module.split(".")[0] in ("functions", "contract")
    }
    assert {"contract", "functions", properties["Handler"].rpartition(".")[0]} <= own.keys()
    for file in own.values():
        assert Path(file).is_relative_to(asset)
    assert not [
        file for file in files.values() if Path(file).is_relative_to(ROOT) and asset not in Path(file).parents
    ]
    # pubnub takes 240 ms to load: only the function that publishes pays for it.
    assert ("pubnub" in files) == (function == "Live")


def test_every_function_module_with_a_handler_is_deployed(functions):
    modules = {f"functions.{p.stem}.handler" for p in FUNCTIONS if "def handler(" in p.read_text()}
    assert {function["Handler"] for function in functions.values()} == modules


# --- environment variables --------------------------------------------------------------------------


def imported(module):
    """The modules of functions/ that one of them loads, itself included."""
    found, todo = set(), [module]
    while todo:
        one = todo.pop()
        if one in found:
            continue
        found.add(one)
        todo += [
            node.module.split(".")[1]
            for node in ast.walk(ast.parse((ROOT / "functions" / f"{one}.py").read_text()))
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("functions.")
        ]
    return found


def variables_read(module):
    read = set()
    for one in imported(module):
        tree = ast.parse((ROOT / "functions" / f"{one}.py").read_text())
        uses = [n for n in ast.walk(tree) if isinstance(n, ast.Attribute) and n.attr in ("environ", "getenv")]
        known = [
            n
            for n in ast.walk(tree)
            if isinstance(n, ast.Subscript)
            and isinstance(n.value, ast.Attribute)
            and n.value.attr == "environ"
        ]
        assert len(uses) == len(known), (
            f'functions/{one}.py reads the environment other than by os.environ["X"]'
        )
        read |= {ast.literal_eval(n.slice) for n in known}
    return read


@pytest.mark.parametrize("function", HANDLERS)
def test_a_function_reads_exactly_the_variables_that_it_is_given(functions, function):
    properties = functions[function]
    given = set(properties.get("Environment", {}).get("Variables", {}))
    assert variables_read(properties["Handler"].split(".")[1]) == given


def test_what_the_variables_say_is_what_the_functions_expect(functions, reader, monkeypatch):
    from functions.live import LiveSettings

    live = functions["Live"]["Environment"]["Variables"]
    monkeypatch.setenv("LIVE_FIELDS", live["LIVE_FIELDS"])
    assert LiveSettings.from_environment().fields == {contract.VESC_STREAM: frozenset(contract.VESC_FIELDS)}
    assert live["PUBNUB_PARAMETER"] == contract.pubnub_parameter()
    assert live["NAMESPACE"] == contract.DEFAULT_NAMESPACE
    tables = functions["Summarize"]["Environment"]["Variables"]
    assert {key: reader.text(value) for key, value in tables.items()} == {
        "NAMESPACE": contract.DEFAULT_NAMESPACE,
        "TELEMETRY_TABLE": "Telemetry",
        "SUMMARY_TABLE": "Summary",
        "ROBOTS_TABLE": "Robots",
        "REJECTED_QUEUE": "Rejected",
        "ROBOT_METRICS": "false",
    }
    query = functions["Query"]["Environment"]["Variables"]
    assert {key: reader.text(value) for key, value in query.items()} == {
        "NAMESPACE": contract.DEFAULT_NAMESPACE,
        "TELEMETRY_TABLE": "Telemetry",
        "ROBOTS_TABLE": "Robots",
        "FILES_BUCKET": "Files",
    }
    upload = functions["Upload"]["Environment"]["Variables"]
    assert {key: reader.text(value) for key, value in upload.items()} == {
        "NAMESPACE": contract.DEFAULT_NAMESPACE,
        "FILES_BUCKET": "Files",
        "ROBOTS_TABLE": "Robots",
        "UPLOAD_BYTES_A_DAY": str(50 * 10**9),
    }


# --- metrics ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shown(synthesized):
    """Every metric on the dashboards: namespace, name, dimensions, options."""
    metrics = []
    for body in dashboards(synthesized).values():
        for widget in body["widgets"]:
            rows = widget["properties"].get("metrics", [])
            metrics += [of_expression(row[0]) if isinstance(row[0], dict) else of_row(row) for row in rows]
    return metrics


def test_the_platform_shows_the_state_of_every_alarm(synthesized):
    first = dashboards(synthesized)["iort-platform"]["widgets"][0]
    assert first["type"] == "alarm"
    told = " ".join(first["properties"]["alarms"])
    alarms = synthesized.resources("AWS::CloudWatch::Alarm")
    assert len(alarms) == len(first["properties"]["alarms"])
    assert all(f"'{logical_id}'" in told for logical_id in alarms)


def dashboards(app):
    """The bodies by name; what is only known when it is deployed stands for itself."""
    found = {}
    for dashboard in app.resources("AWS::CloudWatch::Dashboard").values():
        separator, parts = dashboard["DashboardBody"]["Fn::Join"]
        assert separator == ""
        text = "".join(
            part if isinstance(part, str) else f"<{json.dumps(part)}>".replace('"', "'") for part in parts
        )
        found[dashboard["DashboardName"]] = json.loads(text)
    return found


def of_row(row):
    namespace, metric, *rest = row
    options = rest.pop() if isinstance(rest[-1], dict) else {}
    return namespace, metric, dict(zip(rest[::2], rest[1::2], strict=True)), options


def of_expression(options):
    """What `SEARCH('{namespace,dimension,...} MetricName="..." dimension="..."', 'Sum', 60)` searches."""
    schema, wanted, stat = re.search(
        r"SEARCH\('\{([^}]+)\} ([^']+)', '(\w+)', 60\)", options["expression"]
    ).groups()
    namespace, *dimensions = schema.split(",")
    values = dict(re.findall(r'(\w+)="([^"]+)"', wanted))
    metric = values.pop("MetricName")
    return namespace, metric, {name: values.get(name, "*") for name in dimensions}, {"stat": stat}


def emitted():
    """Every metric that a function's code emits, by function."""
    found = {}
    for path in FUNCTIONS:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "emit":
                function = ast.literal_eval(node.args[0])
                named = {keyword.arg for keyword in node.keywords} - {"robot", None}
                found.setdefault(function, set()).update(named)
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "counted.add":
                found.setdefault(path.stem, set()).update(keyword.arg for keyword in node.keywords)
    # These have their names computed.
    batch = contract.Batch("0" * 8, 0, [1], {"voltage_input": [12.0]})
    for stream in ("vesc", contract.RTT_STREAM, contract.AGENT_STREAM):
        found["health"] |= measure(stream, [batch]).keys()
    return found


def test_the_dashboards_show_what_the_functions_emit_and_nothing_else(shown):
    by_function = {}
    for namespace, metric, dimensions, options in shown:
        if namespace == contract.METRIC_NAMESPACE:
            assert dimensions.keys() == {"Deployment", "Function"}
            assert dimensions["Deployment"] == contract.DEFAULT_NAMESPACE
            by_function.setdefault(dimensions["Function"], set()).add(metric)
            assert options["stat"] == statistic(metric)
    assert by_function == {function: set(names) for function, names in contract.METRICS.items()}
    assert emitted() == by_function


def test_functions_log_what_they_say_and_of_lambda_what_went_wrong(synthesized, functions):
    for made in functions.values():
        logging = made["LoggingConfig"]
        assert (logging["LogFormat"], logging["SystemLogLevel"]) == ("JSON", "WARN")
        # A metric's line names no level and counts as INFO: "Log-level filtering", Lambda Developer Guide.
        assert logging["ApplicationLogLevel"] == "INFO"


def test_lambdas_own_lines_come_back_where_they_are_asked_for(tmp_path):
    app = App(context={"function_logs": "all", "layer": str(tmp_path)})
    stack, settings = Stack(app, "x"), Settings.from_context(app)
    encryption = Encryption(stack, settings=settings)
    function(stack, "Echo", settings=settings, encryption=encryption, memory_mb=256)
    (made,) = (
        resource["Properties"]
        for resource in app.synth().stacks[0].template["Resources"].values()
        if resource["Type"] == "AWS::Lambda::Function"
    )
    assert made["LoggingConfig"].keys() == {"LogGroup"}
    with pytest.raises(SettingsError, match="function_logs = 'none': allowed is own or all"):
        Settings.from_context(App(context={"function_logs": "none", "layer": str(tmp_path)}))


def test_the_dashboards_cover_every_service_of_the_path(shown):
    assert {namespace for namespace, *_ in shown} == {
        "AWS/IoT",
        "AWS/DynamoDB",
        "AWS/Lambda",
        "AWS/SQS",
        contract.METRIC_NAMESPACE,
    }
    rules = {dimensions["RuleName"] for _, _, dimensions, _ in shown if "RuleName" in dimensions}
    assert rules == {rule_name(rule) for rule in contract.RULES}


# Dimensions of each metric. AWS IoT Developer Guide, "AWS IoT metrics and dimensions"; Lambda Developer
# Guide, "Types of metrics for Lambda functions"; DynamoDB Developer Guide, "DynamoDB metrics and
# dimensions"; SQS Developer Guide, "Available CloudWatch metrics for Amazon SQS".
AWS_METRICS = {
    ("AWS/IoT", "Protocol"): {
        f"{what}.{how}"
        for what in ("Connect", "PublishIn", "PublishOut", "Subscribe")
        for how in ("Success", "AuthError", "Throttle")
    },
    ("AWS/IoT", "RuleName"): {"TopicMatch", "ParseError", "RuleMessageThrottled"},
    ("AWS/IoT", "ActionType", "RuleName"): {"Failure", "Success", "ErrorActionFailure"},
    ("AWS/Lambda", "FunctionName"): {
        "Duration",
        "ConcurrentExecutions",
        "Errors",
        "Throttles",
        "IteratorAge",
        "DestinationDeliveryFailures",
    },
    ("AWS/DynamoDB", "TableName"): {
        "ConsumedReadCapacityUnits",
        "ConsumedWriteCapacityUnits",
        "ReadThrottleEvents",
        "WriteThrottleEvents",
    },
    ("AWS/SQS", "QueueName"): {"ApproximateNumberOfMessagesVisible"},
}


def test_every_metric_of_aws_is_one_that_aws_has(shown, alarms):
    of_alarms = [
        (a["Namespace"], a["MetricName"], {d["Name"]: d["Value"] for d in a["Dimensions"]})
        for a in alarms.values()
        if "Metrics" not in a
    ]
    for namespace, metric, dimensions in [*(one[:3] for one in shown), *of_alarms]:
        if namespace != contract.METRIC_NAMESPACE:
            assert metric in AWS_METRICS[(namespace, *sorted(dimensions))]
        elif metric not in contract.METRICS[dimensions["Function"]]:
            raise AssertionError(f"nothing emits {metric}")


# --- alarms -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def alarms(synthesized):
    found = synthesized.resources("AWS::CloudWatch::Alarm").values()
    return {alarm["AlarmName"].removeprefix("iort-"): alarm for alarm in found}


def test_every_queue_function_and_table_has_an_alarm(synthesized, alarms):
    for kind, ending in (
        ("AWS::SQS::Queue", "Waiting"),
        ("AWS::Lambda::Function", "Errors"),
        ("AWS::DynamoDB::Table", "Throttled"),
    ):
        for logical_id in synthesized.resources(kind):
            assert f"{name(logical_id)}{ending}" in alarms


def test_what_can_be_lost_beside_the_quarantine_has_an_alarm(alarms):
    asked = {}
    for alarm, properties in alarms.items():
        if "Metrics" in properties:
            (query,) = properties["Metrics"]
            assert query["ReturnData"] is not False
            metric, namespace = re.fullmatch(
                r'SELECT SUM\((\w+)\) FROM "([\w/]+)"', query["Expression"]
            ).groups()
            asked[alarm] = (namespace, metric)
    known = {(key[0], metric) for key, names in AWS_METRICS.items() for metric in names}
    assert set(asked.values()) <= known
    assert asked == {
        "ParseError": ("AWS/IoT", "ParseError"),
        "ErrorActionFailure": ("AWS/IoT", "ErrorActionFailure"),
        "RuleMessageThrottled": ("AWS/IoT", "RuleMessageThrottled"),
        "DestinationDeliveryFailures": ("AWS/Lambda", "DestinationDeliveryFailures"),
    }


def test_the_cost_model_counts_every_alarm(alarms):
    assert Usage().alarms == len(alarms)


def test_every_alarm_tells_the_topic_and_is_explained(alarms, reader):
    text = (ROOT / "docs" / "cloud.md").read_text()
    for alarm, properties in alarms.items():
        assert reader.texts(properties["AlarmActions"]) == ["Alarms"]
        assert properties["TreatMissingData"] == "notBreaching"
        generic = re.sub(r"^.*(Waiting|Errors|Throttled|Behind)$", r"\1", alarm)
        assert f"`{generic}`" in text or f"`...{generic}`" in text, f"docs/cloud.md says nothing of {alarm}"


def test_the_thresholds_are_the_settings(production, synthesized):
    alarms = {
        a["AlarmName"]: a["Threshold"] for a in synthesized.resources("AWS::CloudWatch::Alarm").values()
    }
    limits = Settings().thresholds
    assert alarms["iort-BatteryVolts"] == limits.low_voltage_v == contract.LOW_VOLTAGE_V
    assert alarms["iort-TemperatureDegC"] == limits.high_temperature_degc
    assert alarms["iort-CarToLambdaMs"] == limits.car_to_lambda_ms
    assert alarms["iort-SummarizeBehind"] == limits.stream_behind_s * 1000
    (alert,) = (f for k, f in synthesized.resources("AWS::Lambda::Function").items() if k.startswith("Alert"))
    assert float(alert["Environment"]["Variables"]["LOW_VOLTAGE_V"]) == limits.low_voltage_v


def test_the_address_subscribes_to_the_topic(production, synthesized):
    (subscription,) = production.resources("AWS::SNS::Subscription").values()
    assert (subscription["Protocol"], subscription["Endpoint"]) == ("email", "lab@example.org")
    assert not synthesized.resources("AWS::SNS::Subscription")


# --- rules and topics -------------------------------------------------------------------------------


def matches(topic_filter, topic):
    """MQTT 5, 4.7: + is one level, # the rest."""
    levels, wanted = topic.split("/"), topic_filter.split("/")
    if wanted[-1] == "#":
        levels, wanted = levels[: len(wanted) - 1], wanted[:-1]
    return len(levels) == len(wanted) and all(
        w in ("+", level) for w, level in zip(wanted, levels, strict=True)
    )


@pytest.fixture(scope="module")
def filters(synthesized):
    found = {}
    for rule in synthesized.resources("AWS::IoT::TopicRule").values():
        (topic_filter,) = re.findall(r"FROM '([^']+)'", rule["TopicRulePayload"]["Sql"])
        found[rule["RuleName"]] = topic_filter
    return found


def test_every_topic_of_the_agent_meets_exactly_the_rule_that_it_is_for(filters):
    for ruled, lane, straight in (
        ("record", RECORD, record_topic("car", "vesc")),
        ("live", LIVE, live_topic("car", "vesc")),
    ):
        rule, topic = re.fullmatch(r"\$aws/rules/([^/]+)/(.+)", straight).groups()
        # Basic Ingest leaves the rest of the topic to the rule it names, which filters it like any other.
        assert rule == rule_name(ruled)
        assert topic == build_topic(lane, "car", "vesc")
    expected = {
        build_topic(RECORD, "car", "vesc"): {"iort_record"},
        build_topic(LIVE, "car", "vesc"): {"iort_live", "iort_fault", "iort_battery"},
        build_topic(PING, "car", RULE): {"iort_pong"},
        build_topic(PING, "car", LAMBDA): {"iort_echo"},
        build_topic(PING, "car", FILE): {"iort_upload"},
        build_topic(PING, "car", BROKER): set(),
        build_topic(PONG, "car", RULE): set(),
        build_topic(PONG, "car", LAMBDA): set(),
        build_topic(PONG, "car", FILE): set(),
        build_topic(contract.FLEET, "car", "pose"): set(),
        build_topic(contract.CMD, "car", "stop"): set(),
        build_topic(LIVE, "car", "vesc", "lab2"): set(),
        "$aws/events/presence/connected/car": {"iort_presence"},
        "$aws/events/presence/disconnected/car": {"iort_presence"},
        f"$aws/things/car/shadow/name/{contract.SHADOW}/update/accepted": {"iort_version"},
        f"$aws/things/car/shadow/name/{contract.SHADOW}/update/documents": set(),
        "$aws/things/car/shadow/update/accepted": set(),
    }
    for one, rules in expected.items():
        assert {rule for rule, topic_filter in filters.items() if matches(topic_filter, one)} == rules, one


def test_the_pongs_topic_is_what_the_agent_expects(synthesized):
    topics = {
        rule["RuleName"]: action["Republish"]["Topic"]
        for rule in synthesized.resources("AWS::IoT::TopicRule").values()
        for action in rule["TopicRulePayload"]["Actions"]
        if "Republish" in action
    }
    ping = build_topic(PING, "car", RULE).split("/")
    expanded = re.sub(r"\$\{topic\((\d)\)\}", lambda m: ping[int(m[1]) - 1], topics["iort_pong"])
    assert expanded == build_topic(PONG, "car", RULE)
