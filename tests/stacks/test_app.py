"""app.py as a process: no credentials, reproducible templates, and one clear line for a mistake."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from typing import Any

import pytest
from aws_cdk import App, assertions

from iort_contract.catalog import environments
from iort_contract.catalog.vesc import VESC_FIELDS, VESC_STREAM
from iort_contract.cloud import pubnub_parameter
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.page import HEADERS, pubnub_address, security_policy
from iort_station.cost.usage import Usage
from stacks.account import Account
from stacks.parts import PlatformStack, function
from stacks.settings import ROOT, Settings, SettingsError
from tests.stacks.templates import layers, name
from tests.stacks.test_monitoring import FUNCTIONS


def run(tmp_path, name, **context):
    """Start app.py in an environment without this machine's AWS settings."""
    env = {
        "PATH": os.environ["PATH"],
        "HOME": str(tmp_path),
        # The cache of `make deploy`; otherwise every run would unpack the CDK again.
        "JSII_RUNTIME_PACKAGE_CACHE_ROOT": str(ROOT / "build" / "jsii-cache"),
        "CDK_VALIDATION": os.environ["CDK_VALIDATION"],
        "CDK_OUTDIR": str(tmp_path / name),
        "CDK_CONTEXT_JSON": json.dumps({**layers(tmp_path / "layer"), **context}),
        # Every lookup goes to a port without a listener.
        "AWS_EC2_METADATA_DISABLED": "true",
        "HTTPS_PROXY": "http://127.0.0.1:9",
        "HTTP_PROXY": "http://127.0.0.1:9",
    }
    return subprocess.Popen(
        [sys.executable, "app.py"],
        cwd=ROOT,
        env=env,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finished(process):
    out, err = process.communicate(timeout=600)
    return process.returncode, out, err


@pytest.fixture
def layer(tmp_path):
    (tmp_path / "layer" / "python").mkdir(parents=True)
    (tmp_path / "layer" / "python" / "nothing.py").touch()


def test_app_py_runs_without_credentials_and_is_reproducible(tmp_path, layer):
    for folder in ("one", "two"):
        returncode, _, err = finished(run(tmp_path, folder))
        assert returncode == 0, err
    one, two = (
        {path.name: path.read_bytes() for path in (tmp_path / name).glob("*.template.json")}
        for name in ("one", "two")
    )
    assert len(one) == 8
    assert one == two
    assert not any(str(tmp_path).encode() in template for template in one.values())


def test_a_wrong_value_gives_one_line(tmp_path, layer):
    returncode, _, err = finished(run(tmp_path, "out", retention_days="soon"))
    assert returncode == 1
    (line,) = [line for line in err.splitlines() if line.startswith("app.py")]
    assert line == "app.py: context retention_days must be a whole number from 1 to 3650, got 'soon'"
    assert "Traceback" not in err
    assert not list((tmp_path / "out").glob("*.template.json"))


def test_a_python_without_the_cdk_gives_one_line(tmp_path):
    # -S: without any installed package.
    command = [sys.executable, "-S", "-E", "-s", str(ROOT / "app.py")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("app.py: no module aws_cdk for ")
    assert done.stderr.count("\n") == 1
    assert "make layer" in done.stderr


@pytest.fixture
def settings(tmp_path, layer):
    def read(**context):
        from aws_cdk import App

        return Settings.from_context(App(context={**layers(tmp_path / "layer"), **context}))

    return read


def test_the_context_sets_the_settings(settings, tmp_path):
    assert settings() == Settings(**layers(tmp_path / "layer"))
    # The CDK CLI gives every -c as text.
    given = settings(
        namespace="lab2", retention_days="7", live_concurrency="0", embedded="true", site_robots="*"
    )
    assert (given.namespace, given.retention_days, given.live_concurrency, given.embedded) == (
        "lab2",
        7,
        0,
        True,
    )
    assert settings(embedded="false").embedded is False
    assert given.reserved_for_live == 0
    assert settings().reserved_for_live == 0 == Usage().live_concurrency
    large = {"stage": "prod", "account_concurrency": 105}
    assert settings(**large, live_transport="pubnub").reserved_for_live == 5
    # Nothing calls it.
    assert settings(**large).reserved_for_live == 0
    assert settings(stage="prod", live_concurrency="0").reserved_for_live == 0
    asked = {"stage": "prod", "customer_key": "true", "budget_usd": "50", "alarm_email": "lab@example.org"}
    given = settings(**asked, low_voltage_v="13.2", tags="team=lab,cost-centre=7")
    assert (given.stage, given.customer_key, given.budget_usd) == ("prod", True, 50)
    assert (given.alarm_email, given.low_voltage_v) == ("lab@example.org", 13.2)
    assert given.tags == {"team": "lab", "cost-centre": "7"} == settings(tags=dict(given.tags)).tags
    # cdk.json's numbers arrive as JavaScript numbers.
    assert settings(retention_days=7.0, site=False) == settings(retention_days="7", site="false")


@pytest.mark.parametrize(
    ("context", "words"),
    [
        ({"namespace": "Lab"}, ["namespace", "'Lab'", "lower-case"]),
        ({"namespace": "lab-2"}, ["namespace", "'lab-2'"]),
        ({"namespace": ""}, ["namespace", "''"]),
        ({"namespace": 7}, ["namespace", "7"]),
        ({"retention_days": "0"}, ["retention_days", "'0'", "1 to 3650"]),
        ({"retention_days": "1.5"}, ["retention_days", "'1.5'"]),
        ({"retention_days": 1.5}, ["retention_days", "1.5"]),
        ({"retention_days": True}, ["retention_days", "True"]),
        ({"retention_days": ""}, ["retention_days", "''"]),
        ({"live_concurrency": "-1"}, ["live_concurrency", "'-1'", "0 to 1000"]),
        ({"live_concurrency": "many"}, ["live_concurrency", "'many'"]),
        ({"live_concurrency": [5]}, ["live_concurrency", "[5]"]),
        ({"embedded": "maybe"}, ["embedded", "'maybe'", "true", "false"]),
        ({"stage": "test"}, ["stage", "'test'", "dev or prod"]),
        ({"alarm_email": "nobody"}, ["alarm_email", "'nobody'"]),
        ({"alarm_email": "a@b.org,c@d.org"}, ["alarm_email"]),
        ({"budget_usd": "50"}, ["budget_usd", "alarm_email"]),
        ({"budget_usd": "ten", "alarm_email": "a@b.org"}, ["budget_usd", "'ten'"]),
        ({"low_voltage_v": "low"}, ["low_voltage_v", "'low'", "above 0"]),
        ({"low_voltage_v": "nan"}, ["low_voltage_v", "'nan'"]),
        ({"high_temperature_degc": -1}, ["high_temperature_degc", "-1"]),
        ({"stream_behind_s": True}, ["stream_behind_s", "True"]),
        ({"tags": "lab"}, ["tags", "'lab'", "key=value"]),
        ({"live_transport": "mqtt"}, ["live_transport", "'mqtt'", "pubnub or iot"]),
        ({"site_robots": "car1,car 2"}, ["robot name", "car 2"]),
        ({"site_robots": 7}, ["site_robots", "7", "car1,car2"]),
        ({"site_robots": "car1,*"}, ["robot name", "*"]),
        ({"site": True}, ["site_robots", "car1,car2", "* for all"]),
        ({"embedded": True}, ["site_robots", "got none"]),
        ({"site_robots": [f"car{i}" for i in range(51)]}, ["site_robots", "at most 50 robots"]),
        ({"tags": "aws:x=1"}, ["tags", "'aws:x=1'"]),
        ({"tags": {"team": 7}}, ["tags", "7"]),
        ({"layer": "build/nowhere"}, ["build/nowhere", "make layer"]),
    ],
)
def test_the_error_of_a_wrong_value_names_key_value_and_allowed_values(settings, context, words):
    with pytest.raises(SettingsError) as caught:
        settings(**context)
    text = str(caught.value)
    assert "\n" not in text
    for word in words:
        assert word in text


# Account-wide settings are optional, not on the embedded cloud, and deployed after all other stacks.

KINDS = {"AWS::IoT::AccountAuditConfiguration", "AWS::IoT::ScheduledAudit", "AWS::IoT::Logging"}


def kinds(**settings):
    stack = Account(App(), Settings(**settings))
    resources = assertions.Template.from_stack(stack).to_json().get("Resources", {})
    return {one["Type"] for one in resources.values() if one["Type"].startswith("AWS::IoT::")}


def test_every_scheduled_check_is_enabled(synthesized, reader):
    (audit,) = synthesized.resources("AWS::IoT::AccountAuditConfiguration").values()
    (daily,) = synthesized.resources("AWS::IoT::ScheduledAudit").values()
    enabled = {
        name.lower()
        for name, check in audit["AuditCheckConfigurations"].items()
        if check == {"Enabled": True}
    }
    assert enabled == {name.replace("_", "").lower() for name in daily["TargetCheckNames"]}
    assert {"unauthenticatedcognitoroleoverlypermissivecheck"} < enabled
    assert len(enabled) == 12
    assert daily["Frequency"] == "DAILY"
    assert audit["AccountId"] == {"Ref": "AWS::AccountId"}
    assert reader.text(audit["RoleArn"]) == "AuditRole.Arn"


def test_aws_iot_logs_errors(synthesized, reader):
    (log,) = synthesized.resources("AWS::IoT::Logging").values()
    assert log["DefaultLogLevel"] == "ERROR"
    assert reader.text(log["RoleArn"]) == "LogRole.Arn"


def test_each_account_wide_setting_is_optional():
    """This stack would fail in an account that already has them configured."""
    assert kinds() == set()
    assert kinds(iot_log_level="error") == {"AWS::IoT::Logging"}
    assert kinds(device_defender=True) == KINDS - {"AWS::IoT::Logging"}
    assert not Settings().account_wide
    # ministack supports neither.
    assert not Settings(embedded=True, device_defender=True, iot_log_level="error").account_wide


def test_no_stack_depends_on_the_account_stack(deployment):
    """It is deployed last, so that the other stacks exist if it fails."""
    app = deployment(device_defender=True, site=True, site_robots=["car1"])
    manifest = json.loads((app.folder / "manifest.json").read_text())["artifacts"]
    before = {stack: app.stacks.keys() & manifest[stack]["dependencies"] for stack in app.stacks}
    assert before.pop("iort-account") == app.stacks.keys() - {"iort-account"}
    assert not any("iort-account" in each for each in before.values())


def test_the_embedded_cloud_has_no_account_wide_settings(deployment):
    app = deployment(embedded=True, site_robots=["*"], device_defender=True, iot_log_level="error")
    assert not any(app.resources(kind) for kind in KINDS)


@pytest.mark.parametrize(("given", "level"), [("off", ""), ("debug", "debug")])
def test_the_log_level_is_read_from_the_context(tmp_path, given, level):
    app = App(context={"iot_log_level": given, **layers(tmp_path)})
    assert Settings.from_context(app).iot_log_level == level


def test_an_unknown_log_level_is_refused(tmp_path):
    with pytest.raises(
        SettingsError, match=r"iot_log_level must be off, error, warn, info or debug, got 'loud'"
    ):
        Settings.from_context(App(context={"iot_log_level": "loud", **layers(tmp_path)}))


# The page on the web: only CloudFront reads the bucket, and responses have security headers.


@pytest.fixture(scope="module")
def site() -> dict[str, Any]:
    from aws_cdk import App

    from stacks.site import Site

    app = App()
    Site(app, Settings(live_transport="pubnub"))
    template: dict[str, Any] = app.synth().get_stack_by_name("iort-site").template
    return template


def of(site: dict[str, Any], kind: str) -> list[dict[str, Any]]:
    return [each["Properties"] for each in site["Resources"].values() if each["Type"] == kind]


def test_the_site_has_neither_assets_nor_functions(site):
    assert {each["Type"] for each in site["Resources"].values()} == {
        "AWS::S3::Bucket",
        "AWS::S3::BucketPolicy",
        "AWS::CloudFront::Distribution",
        "AWS::CloudFront::OriginAccessControl",
        "AWS::CloudFront::ResponseHeadersPolicy",
    }


def test_only_this_distribution_reads_the_private_bucket(site):
    (bucket,) = of(site, "AWS::S3::Bucket")
    assert all(bucket["PublicAccessBlockConfiguration"].values())
    (policy,) = of(site, "AWS::S3::BucketPolicy")
    allowed = [each for each in policy["PolicyDocument"]["Statement"] if each["Effect"] == "Allow"]
    assert [(each["Action"], each["Principal"]) for each in allowed] == [
        ("s3:GetObject", {"Service": "cloudfront.amazonaws.com"})
    ]
    (distribution,) = (
        n for n, r in site["Resources"].items() if r["Type"] == "AWS::CloudFront::Distribution"
    )
    assert {"Ref": distribution} in allowed[0]["Condition"]["StringEquals"]["AWS:SourceArn"]["Fn::Join"][1]


def test_the_site_uses_tls_and_the_headers_of_the_pages_own_server(site):
    (distribution,) = of(site, "AWS::CloudFront::Distribution")
    behaviour = distribution["DistributionConfig"]["DefaultCacheBehavior"]
    assert behaviour["ViewerProtocolPolicy"] == "redirect-to-https"
    assert behaviour["AllowedMethods"] == ["GET", "HEAD"]
    (headers,) = of(site, "AWS::CloudFront::ResponseHeadersPolicy")
    security = headers["ResponseHeadersPolicyConfig"]["SecurityHeadersConfig"]
    policy = security["ContentSecurityPolicy"]["ContentSecurityPolicy"]
    assert policy == security_policy(pubnub_address())
    assert security["ReferrerPolicy"]["ReferrerPolicy"] == HEADERS["Referrer-Policy"]
    assert security["ContentTypeOptions"]["Override"] is True
    assert security["StrictTransportSecurity"]["AccessControlMaxAgeSec"] == 365 * 86_400
    custom = headers["ResponseHeadersPolicyConfig"]["CustomHeadersConfig"]["Items"]
    assert {each["Header"]: each["Value"] for each in custom} == {
        "Cross-Origin-Resource-Policy": HEADERS["Cross-Origin-Resource-Policy"]
    }


def test_without_pubnub_the_page_connects_to_aws_iot_and_cognito_of_its_region_only(deployment, reader):
    template = deployment(drivers=True, site=True, site_robots=["car1"]).templates["site"]
    (headers,) = of(template, "AWS::CloudFront::ResponseHeadersPolicy")
    security = headers["ResponseHeadersPolicyConfig"]["SecurityHeadersConfig"]
    aws = "${AWS::Region}.${AWS::URLSuffix}"
    wanted = security_policy(f"https://cognito-identity.{aws}", f"wss://*.iot.{aws}")
    assert reader.text(security["ContentSecurityPolicy"]["ContentSecurityPolicy"]) == wanted


def test_the_site_is_optional(synthesized):
    assert "site" not in synthesized.templates


# Both ends of every wire agree: handlers and assets, variables and their readers, rules and topics.

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
        assert read == (path.name == "clients.py"), path


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


# One snapshot a stack and stage: a change of what is deployed shows. Update: pytest --snapshot-update.

STACKS = (
    *("fleet", "storage", "quarantine", "processing", "ingest", "archive", "analysis", "monitoring"),
    "account",
)
_ASSET = re.compile(r"[0-9a-f]{64}")


def test_the_stacks_are_these(synthesized):
    assert set(synthesized.templates) == set(STACKS)


@pytest.mark.parametrize("stack", STACKS)
@pytest.mark.parametrize("stage", ["synthesized", "production"])
def test_template(request, snapshot, stack, stage):
    templates = request.getfixturevalue(stage).templates
    template = {k: v for k, v in templates[stack].items() if k not in ("Parameters", "Rules")}
    # Other tests hold the content of the code and the layer, and the CDK's number of the layer.
    masked = _ASSET.sub("<asset>", json.dumps(template))
    assert json.loads(masked) == snapshot
