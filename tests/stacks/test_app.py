"""app.py as a process: no credentials, reproducible templates, and one clear line for a mistake."""

from __future__ import annotations

import itertools
import json
import os
import re
import subprocess
import sys

import pytest
from aws_cdk import App, assertions

from iort_station.cost.usage import Usage
from stacks.account import Account
from stacks.settings import ROOT, Settings, SettingsError
from tests.stacks.templates import layers, name
from tests.stacks.test_monitoring import FUNCTIONS


def run(tmp_path, name, **context):
    """Start app.py in an environment without this machine's AWS settings and commands, Node among them."""
    env = {
        "PATH": "",
        "JSII_NODE": os.environ["JSII_NODE"],
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
    assert line.startswith("app.py: context retention_days must be a valid integer")
    assert line.endswith("got 'soon'")
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
        ({"retention_days": True}, ["retention_days", "True"]),
        ({"stream_behind_s": True}, ["stream_behind_s", "True"]),
        ({"retention_days": "0"}, ["retention_days", "'0'", "greater than or equal to 1"]),
        ({"retention_days": "1.5"}, ["retention_days", "'1.5'"]),
        ({"retention_days": 1.5}, ["retention_days", "1.5"]),
        ({"retention_days": ""}, ["retention_days", "''"]),
        ({"live_concurrency": "-1"}, ["live_concurrency", "'-1'", "greater than or equal to 0"]),
        ({"live_concurrency": "many"}, ["live_concurrency", "'many'"]),
        ({"live_concurrency": [5]}, ["live_concurrency", "[5]"]),
        ({"embedded": "maybe"}, ["embedded", "'maybe'", "valid boolean"]),
        ({"stage": "test"}, ["stage", "'test'", "'dev' or 'prod'"]),
        ({"alarm_email": "nobody"}, ["alarm_email", "'nobody'"]),
        ({"alarm_email": "a@b.org,c@d.org"}, ["alarm_email"]),
        ({"budget_usd": "50"}, ["budget_usd", "alarm_email"]),
        ({"budget_usd": "ten", "alarm_email": "a@b.org"}, ["budget_usd", "'ten'"]),
        ({"low_voltage_v": "low"}, ["low_voltage_v", "'low'", "valid number"]),
        ({"low_voltage_v": "nan"}, ["low_voltage_v", "'nan'"]),
        ({"high_temperature_degc": -1}, ["high_temperature_degc", "-1"]),
        ({"stream_behind_s": 0}, ["stream_behind_s", "greater than 0, got 0"]),
        ({"tags": "lab"}, ["tags", "'lab'", "key=value"]),
        ({"live_transport": "mqtt"}, ["live_transport", "'mqtt'", "'pubnub' or 'iot'"]),
        ({"site_robots": "car1,car 2"}, ["robot name", "car 2"]),
        ({"site_robots": 7}, ["site_robots", "7", "car1,car2"]),
        ({"site_robots": "car1,*"}, ["robot name", "*"]),
        ({"site": True}, ["site_robots", "car1,car2", "* for all"]),
        ({"embedded": True}, ["site_robots", "got none"]),
        ({"embedded": True, "turn": True}, ["turn", "video.turn"]),
        ({"site_robots": [f"car{i}" for i in range(51)]}, ["site_robots", "at most 50 robots"]),
        ({"page_url": "page.example.org"}, ["page_url", "must match", "got 'page.example.org'"]),
        ({"tags": "aws:x=1"}, ["tags", "'aws:x=1'"]),
        ({"tags": {"team": 7}}, ["tags", "7"]),
        ({"layer": "build/nowhere"}, ["build/nowhere", "make layer"]),
        ({"iot_log_level": "loud"}, ["iot_log_level", "'loud'", "'info' or 'debug'"]),
        ({"function_logs": "none"}, ["function_logs", "'none'", "'own' or 'all'"]),
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


# One snapshot a stack and stage: a change of what is deployed shows. Update: pytest --snapshot-update.

STACKS = (
    *("fleet", "storage", "quarantine", "processing", "ingest", "archive", "analysis", "monitoring"),
    "account",
)
_ASSET = re.compile(r"[0-9a-f]{64}")


@pytest.fixture(scope="module")
def public(deployment):
    """The page on the web, for anybody."""
    return deployment(site=True, site_robots=["car1"], function_logs="all")


def test_the_stacks_are_these(synthesized):
    assert set(synthesized.templates) == set(STACKS)


@pytest.mark.parametrize(
    ("stage", "stack"),
    [
        *itertools.product(("synthesized", "production"), STACKS),
        *(("public", stack) for stack in ("fleet", "site", "quarantine")),
    ],
)
def test_template(request, snapshot, stack, stage):
    templates = request.getfixturevalue(stage).templates
    template = {k: v for k, v in templates[stack].items() if k not in ("Parameters", "Rules")}
    # Other tests hold the content of the code and the layer, and the CDK's number of the layer.
    masked = _ASSET.sub("<asset>", json.dumps(template))
    assert json.loads(masked) == snapshot
