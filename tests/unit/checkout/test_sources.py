"""The sources: silenced checkers have reasons, the page's folders and the packages import what they may."""

from __future__ import annotations

import ast
import io
import json
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from importlib.metadata import packages_distributions, requires, version
from pathlib import Path

import grimp
import pytest
from packaging.requirements import Requirement
from setuptools import find_packages

ROOT = Path(__file__).resolve().parents[3]
IGNORE = re.compile(r"#\s*(?:ruff:\s*)?(?:noqa|type:\s*ignore|pragma|mypy:)")
REASONED = re.compile(
    r"# (?:ruff: )?noqa: [A-Z]+\d+(?:, [A-Z]+\d+)* - \w.*|# type: ignore\[[a-z-]+(?:, [a-z-]+)*\]  # \w.*"
)
PACKAGES = {
    "iort-contract": ROOT / "contract" / "iort_contract",
    "iort-agent": ROOT / "device" / "iort_agent",
    "iort-analysis": ROOT / "analysis" / "iort_analysis",
    "iort-station": ROOT / "station" / "iort_station",
}
# They come with ROS and are in no registry.
ROS = {"genpy", "rosgraph", "roslib", "rospy"}
WEB = ROOT / "station" / "web"


def unreasoned(source: str) -> Iterator[tuple[int, str]]:
    """Line and text of every comment that silences a checker without a reason."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        silenced = IGNORE.search(token.string) if token.type == tokenize.COMMENT else None
        if silenced and not REASONED.fullmatch(ignore := token.string[silenced.start() :]):
            yield token.start[0], ignore


def test_every_ignore_of_a_line_has_a_reason() -> None:
    listed = subprocess.run(["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, check=True)
    found = [
        f"{path}:{line}: {ignore}"
        for path in listed.stdout.split()
        if (ROOT / path).exists()
        for line, ignore in unreasoned((ROOT / path).read_text(encoding="utf-8"))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "comment",
    [
        "noqa",
        "noqa: S603 -",
        "noqa: S603, T201",
        "type: ignore[misc]",
        "type: ignore  # the library has no types",
    ],
)
def test_an_ignore_without_a_reason_is_found(comment: str) -> None:
    assert [line for line, _ in unreasoned(f"x = 1\ny = 2  # {comment}\n")] == [2]


def test_every_ignore_of_a_file_or_folder_has_a_reason() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    lines = text.split("[tool.ruff.lint.per-file-ignores]\n")[1].split("\n[")[0].splitlines()
    rules = [line for line in lines if re.search(r'"[A-Z]+\d*"', line)]
    assert len(rules) > 10
    for line in rules:
        assert re.search(r"# \w", line) or lines[lines.index(line) - 1].startswith("# "), line


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
def test_a_distribution_declares_its_imports_and_has_its_packages(name: str) -> None:
    assert needed(PACKAGES[name]) == {Requirement(text).name.lower() for text in requires(name) or ()}
    home = PACKAGES[name].parent
    include = re.search(r"^include = (\[.*\])$", (home / "pyproject.toml").read_text(), re.MULTILINE)
    assert include
    folders = {path.parent.relative_to(home) for path in PACKAGES[name].rglob("__init__.py")}
    assert set(find_packages(str(home), include=json.loads(include[1]))) == {
        ".".join(folder.parts) for folder in folders
    }


def test_imports_in_functions_count_and_imports_for_types_do_not() -> None:
    code = (
        "if TYPE_CHECKING:\n    import one\ndef f():\n    import two.three\n    from four.five import six\n"
    )
    assert set(imported(ast.parse(code))) == {"two", "four"}


def test_all_distributions_have_the_contracts_version_and_pin_it() -> None:
    (one,) = {version(name) for name in PACKAGES}
    for name in PACKAGES.keys() - {"iort-contract"}:
        (pin,) = (text for text in requires(name) or () if Requirement(text).name == "iort-contract")
        assert pin == f"iort-contract=={one}"


def test_the_contract_needs_only_the_standard_library() -> None:
    graph = grimp.build_graph("iort_contract", include_external_packages=True, cache_dir=None)
    others = {name for name in graph.modules if not name.startswith("iort_contract")}
    assert others <= sys.stdlib_module_names


def test_a_folder_of_the_page_imports_only_what_its_row_in_the_readme_allows() -> None:
    rows = re.findall(r"^\| `(\w+)` \|.*\| (.*) \|$", (WEB / "README.md").read_text(), re.MULTILINE)
    folders = {folder for folder, _ in rows}
    assert {folder.name for folder in (WEB / "src").iterdir() if folder.is_dir()} == folders
    for folder, uses in rows:
        allowed = folders if "all of them" in uses else {folder, *re.findall(r"`(\w+)`", uses)}
        for path in (WEB / "src" / folder).glob("*.ts"):
            for target in re.findall(r'from "(\.[^"]+)"', path.read_text()):
                room = (path.parent / target).resolve().relative_to(WEB / "src").parts[0]
                assert room in allowed, f"{path.name} imports {target}"
