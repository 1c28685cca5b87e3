"""Each path of the checkout that the documentation names exists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from scripts.docs_parts import ROOT

# A decision may name a file of its time.
DOCS = (page for page in ROOT.glob("docs/**/*.md") if "decisions" not in page.parts)
PAGES = sorted([*DOCS, *ROOT.glob("*/README.md"), *ROOT.glob("*.md")])
FOLDERS = "bench|contract|device|docs|functions|local|requirements|scripts|stacks|station|tests|verify"
# `make verify-aws KEEP=1` writes it, and nobody has yet.
MADE_LATER = {"verify/aws.json"}
# In backticks or not; a row of docs/how-to/operations.md has `path::test`.
PATH = re.compile(rf"(?<![\w/.$-])((?:{FOLDERS})/[\w./*-]*\w(?:/|\.\w+)?)")
MODULE = re.compile(
    r"`(?:python -m )?((?:bench|iort_agent|iort_contract|iort_station|scripts|tests|verify)(?:\.\w+)+)"
)
HOME = {
    "iort_agent": ROOT / "device",
    "iort_contract": ROOT / "contract",
    "iort_analysis": ROOT / "analysis",
    "iort_station": ROOT / "station",
}


def missing_paths(text: str, folder: Path = ROOT) -> set[str]:
    named = set(PATH.findall(text)) - MADE_LATER
    return {path for path in named if not any(ROOT.glob(path)) and not (folder / path).exists()}


def missing_modules(text: str) -> set[str]:
    return {name for name in MODULE.findall(text) if not module_exists(name)}


def module_exists(name: str) -> bool:
    """Whether NAME is a module, a package or a file, or a name that a module's source has."""
    parts = name.split(".")
    path = HOME.get(parts[0], ROOT).joinpath(*parts)
    if path.is_dir() or path.with_suffix(".py").exists() or (ROOT / name).exists():
        return True
    parent = path.parent / "__init__.py" if path.parent.is_dir() else path.parent.with_suffix(".py")
    return parent.exists() and re.search(rf"\b{parts[-1]}\b", parent.read_text()) is not None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_path_and_module_that_a_page_names_exists(page: Path) -> None:
    # What a page shows as a new file (how-to-extend.md) is in a fenced block.
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    if page.name != "CHANGELOG.md":  # It names what was removed, too.
        assert missing_paths(text, page.parent) == set()
        assert missing_modules(text) == set()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_heading_that_a_page_links_to_exists(page: Path) -> None:
    for path, anchor in re.findall(r"\]\(([^)#: ]*)#([^)]+)\)", page.read_text(encoding="utf-8")):
        target = page.parent / path if path else page
        assert anchor in anchors(target.read_text(encoding="utf-8")), f"{path}#{anchor}"


def anchors(text: str) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("package", HOME)
def test_the_readme_of_a_package_lists_folders_that_it_has(package: str) -> None:
    text = (HOME[package] / "README.md").read_text(encoding="utf-8")
    folders = re.findall(r"^\| `(?:\w+/)?(\w+)` \|", text, re.MULTILINE)
    assert folders
    assert [name for name in folders if not (HOME[package] / package / name).is_dir()] == []


def test_a_missing_path_or_module_is_found() -> None:
    assert missing_paths("see `stacks/nowhere.py`, app.py and docs/how-to/*.md") == {"stacks/nowhere.py"}
    assert missing_modules("`bench.nowhere` and `iort_contract.messages.batch.encode_batch`") == {
        "bench.nowhere"
    }
