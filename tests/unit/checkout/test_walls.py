"""import-linter refuses a forbidden import: each wall of pyproject.toml is tried in a scratch copy."""

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
OPTIONS = api.read_configuration(str(ROOT / "pyproject.toml"))
LAYERS = {one["id"]: one["layers"] for one in OPTIONS["contracts_options"] if one["type"] == "layers"}
FOLDERS = {"iort_contract": "contract", "iort_agent": "device", "iort_analysis": "analysis"} | {
    "iort_station": "station"
}


def rooms(layer: str) -> list[str]:
    """The names of a layer; one in parentheses is optional."""
    return re.findall(r"(?<!\()\b\w+\b(?!\))", layer)


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Path:
    house = tmp_path_factory.mktemp("house")
    for package in OPTIONS["session_options"]["root_packages"]:
        folder = Path(FOLDERS.get(package, ".")) / package
        for path in (ROOT / folder).rglob("*.py"):
            (house / path.relative_to(ROOT)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, house / path.relative_to(ROOT))
    shutil.copy(ROOT / "pyproject.toml", house)
    return house


def lint(house: Path, contract: str) -> str:
    """What import-linter says of a wall that is broken."""
    # The copy's packages come before the installed ones.
    path = os.pathsep.join(str(house / folder) for folder in FOLDERS.values())
    result = subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache", "--no-logo", "--contract", contract],
        cwd=house,
        env={**os.environ, "PYTHONPATH": path, "COLUMNS": "200"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 1, result.stdout + result.stderr
    return result.stdout


@pytest.mark.parametrize(
    ("contract", "file", "imported"),
    [
        ("packages", "device/iort_agent/__init__.py", "iort_station"),
        ("packages", "local/__init__.py", "bench"),
        ("embedded-cloud", "local/__init__.py", "stacks"),
        ("agent", "device/iort_agent/errors.py", f"iort_agent.{rooms(LAYERS['agent'][0])[0]}"),
        ("station", "station/iort_station/errors.py", f"iort_station.{rooms(LAYERS['station'][0])[0]}"),
        ("contract", "contract/iort_contract/limits.py", f"iort_contract.{rooms(LAYERS['contract'][0])[0]}"),
        ("functions", "functions/live.py", "functions.alert"),
    ],
)
def test_a_forbidden_import_breaks_its_wall(house: Path, contract: str, file: str, imported: str) -> None:
    path = house / file
    before = path.read_text(encoding="utf-8")
    path.write_text(f"{before}\nimport {imported}\n", encoding="utf-8")
    try:
        assert "1 broken" in lint(house, contract)
    finally:
        path.write_text(before, encoding="utf-8")


def test_the_contract_needs_only_the_standard_library() -> None:
    graph = grimp.build_graph("iort_contract", include_external_packages=True, cache_dir=None)
    outside = {
        (importer, imported)
        for imported in graph.modules
        if not imported.startswith("iort_contract") and imported not in sys.stdlib_module_names
        for importer in graph.find_modules_that_directly_import(imported)
    }
    assert not outside
