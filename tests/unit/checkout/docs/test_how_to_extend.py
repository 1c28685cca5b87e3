"""docs/how-to/extend.md works: the page's own blocks are applied to a copy of the checkout."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from scripts.docs_parts import ROOT

pytestmark = pytest.mark.slow

PAGE = (ROOT / "docs/how-to/extend.md").read_text()
SECTIONS = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE))
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
FOLDERS = (
    *("analysis", "bench", "contract", "device", "docs", "functions"),
    *("local", "scripts", "stacks", "station", "testkit", "tests"),
)
# The sections that are followed together, and the number of files that each touches.
ONE = ("A field", "A derived field", "A topic", "A retention", "An alarm", "A price", "A policy")
CHANGES = dict.fromkeys(ONE, 1) | {"A chart": 2, "A rule": 3, "A function": 3}
SKIPPED = ("__pycache__", "*.egg-info", "build", "built", "images", "bench-*", "node_modules")


class Copy:
    """A copy of the checkout."""

    def __init__(self, root: Path) -> None:
        self.root = root
        for name in FOLDERS:
            shutil.copytree(ROOT / name, root / name, ignore=shutil.ignore_patterns(*SKIPPED))
        for name in ("README.md", "app.py", "cdk.json"):
            shutil.copy(ROOT / name, root / name)

    def follow(self, section: str) -> list[str]:
        """Apply a section's blocks; returns the paths of the files that it touched."""
        touched = []
        for kind, text in BLOCK.findall(SECTIONS[section]):
            head, _, body = text.partition("\n")
            if kind == "diff":
                path = head.removeprefix("--- ")
                self._insert(self.root / path, body.splitlines())
            elif kind == "python":
                path = head.removeprefix("# ")
                assert not (self.root / path).exists()
                (self.root / path).write_text(body)
            else:
                continue
            touched.append(path)
        assert touched
        return touched

    def _insert(self, file: Path, lines: list[str]) -> None:
        before = "".join(f"{line[1:]}\n" for line in lines if not line.startswith("+"))
        after = "".join(f"{line[1:]}\n" for line in lines if not line.startswith("-"))
        text = file.read_text()
        assert text.count(before) == 1, f"{file} must have once:\n{before}"
        file.write_text(text.replace(before, after))

    def run(self, *command: str) -> str:
        """The output of a Python command with the copy's packages."""
        path = [str(self.root / name) for name in ("", "contract", "device", "analysis", "station")]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(path),
            "AWS_DEFAULT_REGION": "eu-central-1",
            # As the CDK's command does.
            "CDK_CONTEXT_JSON": json.dumps(json.loads((self.root / "cdk.json").read_text())["context"]),
        }
        done = subprocess.run(
            [sys.executable, *command],
            check=False,
            cwd=self.root,
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    def show(self, expression: str, *imports: str) -> object:
        """The value of an expression, in a process that has the copy's packages."""
        program = "\n".join([*imports, "import json", f"print(json.dumps({expression}))"])
        return json.loads(self.run("-c", program))


@pytest.fixture
def copy(tmp_path: Path) -> Copy:
    return Copy(tmp_path / "checkout")


@dataclass(frozen=True)
class Deployed:
    """A copy with every section that changes the stacks or the generated parts, and the resources of each
    stack by logical id."""

    copy: Copy
    stacks: dict[str, dict[str, Any]]

    def of_type(self, stack: str, kind: str, name: str) -> Any:
        """The properties of the one resource of a type whose logical id begins so."""
        resources = self.stacks[f"iort-{stack}"]
        (found,) = (one for key, one in resources.items() if one["Type"] == kind and key.startswith(name))
        return found["Properties"]

    def robots_dashboard(self) -> str:
        """The dashboard of the robots, as JSON."""
        return json.dumps(self.of_type("monitoring", "AWS::CloudWatch::Dashboard", "DashboardsRobots"))


@pytest.fixture(scope="module")
def deployed(tmp_path_factory: pytest.TempPathFactory) -> Deployed:
    copy = Copy(tmp_path_factory.mktemp("deployed") / "checkout")
    touched = {name: len(set(copy.follow(name))) for name in CHANGES}
    assert touched == CHANGES
    for name in ("lambda", "analysis"):
        layer = copy.root / "build" / "layer" / name
        layer.mkdir(parents=True)
        (layer / "nothing.py").touch()
    copy.run("app.py")
    copy.run("-m", "scripts.docs_parts")
    stacks = {
        path.name.removesuffix(".template.json"): json.loads(path.read_text())["Resources"]
        for path in (copy.root / "cdk.out").glob("*.template.json")
    }
    return Deployed(copy, stacks)


def test_the_page_lists_each_of_its_sections() -> None:
    assert set(re.findall(r"^\| \[(.*?)\]", PAGE, re.MULTILINE)) == {name.lower() for name in SECTIONS}


def test_the_way_to_add_a_field_works(deployed: Deployed) -> None:
    copy = deployed.copy
    inventory = "from iort_station.data.inventory import unit"
    assert copy.show("unit('vesc', 'temp_battery_max')", inventory) == "degC"
    hottest = "from iort_contract.catalog.vesc import hottest_degc"
    assert copy.show("hottest_degc({'temp_battery': 81.5, 'temp_fet': 40})", hottest) == 81.5
    assert "| `temp_battery` | degC |" in (copy.root / "docs/reference/fields.md").read_text()
    assert '"temp_battery"' in (copy.root / "station/web/src/base/contract.ts").read_text()


def test_the_way_to_add_a_derived_field_works(deployed: Deployed) -> None:
    copy = deployed.copy
    columns = "{'duty_cycle': [0.5, None], 'voltage_input': [12.0, 12.0], 'current_motor': [10, 10]}"
    batch = f"Batch('0badcafe', 0, [1_000_000, 1_020_000], {columns})"
    power_w = copy.show(
        f"summarize_second(1, [{batch}], None)['motor_power_w']",
        "from iort_contract.messages.batch import Batch",
        "from iort_contract.statistics import summarize_second",
    )
    assert power_w == [60.0]
    arrays = "{name: np.array(column, dtype=float) for name, column in " + columns + ".items()}"
    found = copy.show(
        f"values(derive({arrays}, None)['motor_power_w'])",
        "import numpy as np",
        "from iort_station.data.conditions import derive, values",
    )
    assert found == [60.0, None]
    needs = "select('car', 'vesc', where='motor_power_w > 5').wanted()('duty_cycle')"
    assert copy.show(needs, "from iort_station.data.recorded import select") is True
    formula = "`duty_cycle * voltage_input * current_motor`"
    assert f"| {formula} |" in (copy.root / "docs/reference/fields.md").read_text()
    assert "export const motor_power_w = " in (copy.root / "station/web/src/base/contract.ts").read_text()


def test_the_way_to_add_a_rule_works(deployed: Deployed) -> None:
    copy = deployed.copy
    rule = deployed.of_type("ingest", "AWS::IoT::TopicRule", "Horn")
    assert rule["TopicRulePayload"]["Sql"].endswith("FROM 'live/iort/+/+' WHERE sample.horn > 0")
    assert rule["TopicRulePayload"]["ErrorAction"]
    function = deployed.of_type("processing", "AWS::Lambda::Function", "Horn")
    assert function["Handler"] == "functions.horn.handler"
    assert deployed.of_type("monitoring", "AWS::CloudWatch::Alarm", "AlarmsHornErrors")
    assert "HornsSounded" in deployed.robots_dashboard()
    handler = "from functions.horn import handler; handler({}, None)"
    printed = copy.run("-c", f"import os; os.environ['NAMESPACE'] = 'iort'; {handler}")
    assert json.loads(printed)["HornsSounded"] == 1
    processing = (copy.root / "docs/explanation/processing.md").read_text()
    assert "| `horn` | counts who sounds the horn |" in processing


def test_the_way_to_add_a_function_works(deployed: Deployed) -> None:
    function = deployed.of_type("processing", "AWS::Lambda::Function", "Count")
    assert function["Environment"]["Variables"].keys() == {"NAMESPACE", "TELEMETRY_TABLE"}
    policy = deployed.of_type("processing", "AWS::IAM::Policy", "CountRole")
    actions = [one["Action"] for one in policy["PolicyDocument"]["Statement"]]
    assert "dynamodb:Query" in actions
    assert deployed.copy.show("callable(handler)", "from functions.count import handler") is True


def test_the_way_to_add_a_miner_works(copy: Copy) -> None:
    assert len(set(copy.follow("A miner"))) == 3
    found = copy.show(
        "analyse(KEY, {'vesc': Block(times, columns)}).mined.estimates['reversing_share']",
        "import numpy as np",
        "from iort_analysis.process import analyse",
        "from iort_analysis.samples.blocks import Block",
        "from tests.unit.analysis.simulated import KEY, START_US",
        "times = START_US + 20_000 * np.arange(6000)",
        "speed = np.where(np.arange(6000) % 2000 < 500, -3000.0, 9000.0)",
        "columns = {'speed': speed, 'voltage_input': speed * 0 + 12, 'current_motor': speed / 1000}",
    )
    value, low, high, unit = found
    assert (value, unit) == (0.25, "1")
    assert low < 0.25 < high


def test_the_way_to_add_a_verb_works(copy: Copy) -> None:
    assert len(set(copy.follow("A verb"))) == 2
    iort = "from iort_station.cli.main import main; main()"
    assert "speed\terpm\n" in copy.run("-c", iort, "fields")
    assert "List the known fields of a stream" in copy.run("-c", iort, "--help")


def test_the_way_to_add_a_source_works(copy: Copy, tmp_path: Path) -> None:
    assert len(set(copy.follow("A source"))) == 2
    (section,) = (text for kind, text in BLOCK.findall(SECTIONS["A source"]) if kind == "yaml")
    for name in ("certificate.pem", "private.key"):
        (tmp_path / name).touch()
    keys = "robot: car\nendpoint: example.com\ncertificate: certificate.pem\nprivate_key: private.key\n"
    (tmp_path / "car.yaml").write_text(keys + section)
    found = copy.show(
        "run()",
        "import threading",
        "from pathlib import Path",
        "from iort_agent.common.threads import SystemClock",
        "from iort_agent.config import load_config",
        "def run():",
        f"    (source,) = load_config(Path({str(tmp_path / 'car.yaml')!r})).sources",
        "    stop, samples = threading.Event(), []",
        "    def emit(stream, t_us, sample):",
        "        samples.append((stream, sorted(sample)))",
        "        stop.set()",
        "    source.build(SystemClock()).run(emit, stop)",
        "    return samples",
    )
    assert found == [["clock", ["second_of_day"]]]


def test_each_way_to_change_a_thing_works(deployed: Deployed) -> None:
    copy = deployed.copy
    rule = deployed.of_type("ingest", "AWS::IoT::TopicRule", "Record")
    assert "FROM 'record/iort/+/+'" in rule["TopicRulePayload"]["Sql"]
    policy = json.dumps(deployed.of_type("fleet", "AWS::IoT::Policy", "RobotPolicy"))
    assert "_record/record/iort/" in policy
    assert "topic/news/iort" in policy
    quarantine = deployed.of_type("quarantine", "AWS::Lambda::Function", "Quarantine")
    assert quarantine["Environment"]["Variables"]["RETENTION_S"] == str(30 * 86_400)
    alarms = [
        one for one in deployed.stacks["iort-monitoring"].values() if one["Type"] == "AWS::CloudWatch::Alarm"
    ]
    assert 30 in {one["Properties"]["EvaluationPeriods"] for one in alarms}
    assert "Weakest battery, V" in deployed.robots_dashboard()
    prices = "from iort_station.cost.prices import PRICES"
    assert copy.show("PRICES['read'].usd", prices) == 0.142
    (copy.root / "node_modules").symlink_to(ROOT / "node_modules")
    compiler = copy.root / "node_modules" / "typescript" / "bin" / "tsc"
    types = subprocess.run(
        [Path(sys.executable).with_name("node"), compiler, "--project", copy.root / "station" / "web"],
        check=False,
        capture_output=True,
        text=True,
    )
    assert types.returncode == 0, types.stdout
