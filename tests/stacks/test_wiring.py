"""Both ends of every wire agree: handlers and assets, variables and their readers, rules and topics."""

from __future__ import annotations

import pytest
from aws_cdk import App

from iort_contract.catalog import environments
from iort_contract.catalog.vesc import VESC_FIELDS, VESC_STREAM
from iort_contract.cloud import pubnub_parameter
from iort_contract.limits import DEFAULT_NAMESPACE
from stacks.parts import PlatformStack, function
from stacks.settings import ROOT, Settings, SettingsError
from tests.stacks.monitoring.test_dashboards import FUNCTIONS
from tests.stacks.templates import layers, name

CONTRACT = sorted((ROOT / "contract" / "iort_contract").rglob("*"))
ANALYSIS = sorted((ROOT / "analysis" / "iort_analysis").rglob("*"))


@pytest.fixture(scope="module")
def functions(synthesized):
    return {name(k): v for k, v in synthesized.resources("AWS::Lambda::Function").items()}


def test_the_asset_holds_exactly_the_functions_the_contract_and_the_analysis(synthesized, functions):
    assets = {synthesized.asset(function["Code"]) for function in functions.values()}
    (asset,) = assets
    packaged = {
        str(path.relative_to(asset)): path.read_bytes() for path in asset.rglob("*") if path.is_file()
    }
    # The packages stand side by side, as they are imported.
    expected = (
        dict.fromkeys(FUNCTIONS, ROOT)
        | dict.fromkeys(CONTRACT, ROOT / "contract")
        | dict.fromkeys(ANALYSIS, ROOT / "analysis")
    )
    assert packaged == {
        str(path.relative_to(home)): path.read_bytes()
        for path, home in expected.items()
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_every_function_module_with_a_handler_is_deployed(functions):
    modules = {f"functions.{p.stem}.handler" for p in FUNCTIONS if "def handler(" in p.read_text()}
    assert {function["Handler"] for function in functions.values()} == modules


def test_a_function_reads_its_variables_in_one_place():
    """The others are one of Lambda itself, and one of the embedded cloud, for robots in a network."""
    others = ('"AWS_LAMBDA_INITIALIZATION_TYPE" in os.environ', 'os.environ.get("ROBOTS_S3_ENDPOINT")')
    for path in FUNCTIONS:
        text = path.read_text()
        for other in others:
            text = text.replace(other, "")
        read = "environ[" in text or "os.environ" in text or "getenv" in text
        assert read == (path.name == "environment.py"), path


def test_the_variables_have_the_values_that_the_functions_expect(functions, reader):
    def given(function, kind):
        variables = functions[function]["Environment"]["Variables"]
        return kind.read({key: reader.text(value) for key, value in variables.items()})

    name = DEFAULT_NAMESPACE
    later = environments.LaterEnvironment(
        name, "Archive", "Batches", "Summary", "Robots", "Rejected", robot_metrics=False
    )
    files = environments.UploadEnvironment(name, "Files", "Robots", "Rejected", 50 * 10**9)
    query = environments.QueryEnvironment(name, "Batches", "Robots", "Files")
    answer = environments.AnswerEnvironment(name, "Robots", "Findings", "Files", "Rejected")
    fields = {VESC_STREAM: list(VESC_FIELDS)}
    parameter = pubnub_parameter()
    assert given("Later", environments.LaterEnvironment) == later
    assert given("Summarize", environments.SummarizeEnvironment) == environments.SummarizeEnvironment(
        **vars(later), put_off_queue="PutOff", record_bytes_a_day=5 * 10**9
    )
    assert given("Echo", environments.EchoEnvironment) == environments.EchoEnvironment(name, "Rejected")
    assert given("Upload", environments.UploadEnvironment) == files
    assert given("Query", environments.QueryEnvironment) == query
    assert given("Answer", environments.AnswerEnvironment) == answer
    assert given("Live", environments.LiveEnvironment) == environments.LiveEnvironment(
        name, parameter, fields, "Rejected"
    )


def test_functions_log_their_own_lines_and_lambdas_errors(synthesized, functions):
    for made in functions.values():
        logging = made["LoggingConfig"]
        assert (logging["LogFormat"], logging["SystemLogLevel"]) == ("JSON", "WARN")
        # A metric's line names no level and counts as INFO: "Log-level filtering", Lambda Developer Guide.
        assert logging["ApplicationLogLevel"] == "INFO"


def test_lambdas_own_lines_are_logged_on_request(tmp_path):
    app = App(context={"function_logs": "all", **layers(tmp_path)})
    stack = PlatformStack(app, "x", Settings.from_context(app))
    function(stack, "Echo", environments.Environment("iort"))
    (made,) = (
        resource["Properties"]
        for resource in app.synth().stacks[0].template["Resources"].values()
        if resource["Type"] == "AWS::Lambda::Function"
    )
    assert made["LoggingConfig"].keys() == {"LogGroup"}
    with pytest.raises(SettingsError, match="function_logs must be own or all, got 'none'"):
        Settings.from_context(App(context={"function_logs": "none", **layers(tmp_path)}))
