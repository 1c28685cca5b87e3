"""The distributions declare every import and share one version."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from importlib.metadata import packages_distributions, requires, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[3]
PACKAGES = {
    "iort-contract": ROOT / "contract" / "iort_contract",
    "iort-agent": ROOT / "device" / "iort_agent",
    "iort-analysis": ROOT / "analysis" / "iort_analysis",
    "iort-station": ROOT / "station" / "iort_station",
}
# They come with ROS and are in no registry.
ROS = {"genpy", "rosgraph", "roslib", "rospy"}


def imported(tree: ast.AST) -> Iterator[str]:
    """The top-level modules that code imports at run time, without imports only for types."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            for otherwise in node.orelse:
                yield from imported(otherwise)
        elif isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield (node.module or "").partition(".")[0]
        else:
            yield from imported(node)


def needed(package: Path) -> set[str]:
    """The distributions that hold what a package imports."""
    modules = {name for path in package.rglob("*.py") for name in imported(ast.parse(path.read_text()))}
    modules -= {*sys.stdlib_module_names, package.name, *ROS}
    ours = {path.name: name for name, path in PACKAGES.items()}
    known = packages_distributions()
    # A module of the checkout that is never installed is returned as it is; it cannot be declared.
    return {ours.get(name) or known.get(name, [name])[0].lower() for name in modules}


@pytest.mark.parametrize("name", PACKAGES)
def test_every_import_is_declared_and_every_dependency_is_imported(name):
    declared = {Requirement(text).name.lower() for text in requires(name) or ()}
    assert needed(PACKAGES[name]) == declared


def test_imports_in_functions_count_and_imports_for_types_do_not():
    code = (
        "if TYPE_CHECKING:\n    import one\ndef f():\n    import two.three\n    from four.five import six\n"
    )
    assert set(imported(ast.parse(code))) == {"two", "four"}


def test_all_have_the_contracts_version_and_pin_it():
    (one,) = {version(name) for name in PACKAGES}
    for name in ("iort-agent", "iort-analysis", "iort-station"):
        (pin,) = (text for text in requires(name) or () if Requirement(text).name == "iort-contract")
        assert pin == f"iort-contract=={one}"
