"""import-linter refuses a forbidden import; each wall is tried in a scratch copy."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import grimp
import pytest
from importlinter import api

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[3]
PACKAGES = (
    "contract/iort_contract",
    "device/iort_agent",
    "analysis/iort_analysis",
    "station/iort_station",
    *("functions", "stacks", "local", "bench", "verify", "scripts", "tests"),
)


def not_python(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if not name.endswith(".py") and not (Path(folder) / name).is_dir()]


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Path:
    house = tmp_path_factory.mktemp("house")
    for package in PACKAGES:
        shutil.copytree(ROOT / package, house / package, ignore=not_python)
    shutil.copy(ROOT / "pyproject.toml", house)
    return house


def lint(house: Path, *options: str) -> subprocess.CompletedProcess[str]:
    # The copy's packages come before the installed ones.
    path = os.pathsep.join(str(house / folder) for folder in ("contract", "device", "analysis", "station"))
    return subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache", "--no-logo", *options],
        cwd=house,
        env={**os.environ, "PYTHONPATH": path, "COLUMNS": "200"},
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_imports_keep_all_walls(house: Path) -> None:
    result = lint(house)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize(
    ("contract", "file", "imported"),
    [
        ("packages", "station/iort_station/cloud.py", "iort_agent.common.threads"),
        ("packages", "station/iort_station/cloud.py", "functions.shared.tables"),
        ("packages", "device/iort_agent/common/threads.py", "iort_station.errors"),
        ("packages", "contract/iort_contract/limits.py", "iort_agent.common.threads"),
        ("packages", "functions/live.py", "iort_station.errors"),
        ("packages", "stacks/site.py", "iort_station.page.page"),
        ("packages", "stacks/site.py", "functions.live"),
        ("packages", "local/demo/run.py", "bench.run"),
        ("packages", "local/demo/run.py", "testkit.dynamodb"),
        ("embedded-cloud", "local/demo/run.py", "stacks.settings"),
        ("agent", "device/iort_agent/lanes/live.py", "iort_agent.config"),
        ("agent", "device/iort_agent/common/schema.py", "iort_agent.spool.memory"),
        ("station", "station/iort_station/data/recorded.py", "iort_station.cli.console"),
        ("contract", "contract/iort_contract/codec.py", "iort_contract.messages.batch"),
        ("functions", "functions/live.py", "functions.alert"),
        ("circles", "device/iort_agent/sources/recording/player.py", "iort_agent.sources.recording.rosbag"),
    ],
)
def test_a_forbidden_import_breaks_its_wall(house: Path, contract: str, file: str, imported: str) -> None:
    path = house / file
    before = path.read_text(encoding="utf-8")
    path.write_text(f"{before}\nimport {imported}\n", encoding="utf-8")
    try:
        result = lint(house, "--contract", contract)
    finally:
        path.write_text(before, encoding="utf-8")
    assert result.returncode == 1, result.stdout + result.stderr
    assert "1 broken" in result.stdout


@pytest.mark.parametrize(
    ("contract", "package"),
    [
        ("agent", "device/iort_agent"),
        ("station", "station/iort_station"),
        ("contract", "contract/iort_contract"),
    ],
)
def test_a_new_module_must_be_listed_in_the_walls(house: Path, contract: str, package: str) -> None:
    room = house / package / "attic.py"
    room.touch()
    try:
        result = lint(house, "--contract", contract)
    finally:
        room.unlink()
    assert result.returncode == 1
    assert "attic" in result.stdout


def test_the_contract_needs_only_the_standard_library() -> None:
    graph = grimp.build_graph("iort_contract", include_external_packages=True, cache_dir=None)
    outside = {
        (importer, imported)
        for imported in graph.modules
        if not imported.startswith("iort_contract") and imported not in sys.stdlib_module_names
        for importer in graph.find_modules_that_directly_import(imported)
    }
    assert not outside


@pytest.mark.parametrize("contract", ["agent", "station", "contract"])
def test_the_documentation_and_the_walls_list_the_same_rooms(contract: str) -> None:
    contracts = api.read_configuration(str(ROOT / "pyproject.toml"))["contracts_options"]
    (layers,) = (one["layers"] for one in contracts if one["id"] == contract)
    # A layer in parentheses is optional.
    rows = [set(re.findall(r"(?<!\()\b\w+\b(?!\))", layer)) for layer in layers]
    page = (ROOT / "docs/explanation/architecture.md").read_text(encoding="utf-8")
    _, table = page.split(f"**{contract.capitalize()}**", 1)
    first = [line.split("|")[1] for line in table.split("\n\n")[1].splitlines()[2:]]
    assert [set(re.findall(r"`(\w+)`", cell)) for cell in first] == [row for row in rows if row]
