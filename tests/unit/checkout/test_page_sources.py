"""The folders of the page's sources import one another only as station/web/README.md allows."""

from __future__ import annotations

import re
from pathlib import Path

WEB = Path(__file__).resolve().parents[3] / "station" / "web"
SOURCES = WEB / "src"


def allowed() -> dict[str, set[str]]:
    rows = re.findall(r"^\| `(\w+)` \|.*\| (.*) \|$", (WEB / "README.md").read_text(), re.MULTILINE)
    folders = {folder for folder, _ in rows}
    return {
        folder: folders if "all of them" in uses else {folder, *re.findall(r"`(\w+)`", uses)}
        for folder, uses in rows
    }


def test_every_folder_is_described_and_has_at_most_twelve_files():
    folders = [folder for folder in SOURCES.iterdir() if folder.is_dir()]
    assert {folder.name for folder in folders} == set(allowed())
    assert max(sum(map(Path.is_file, folder.iterdir())) for folder in [SOURCES, *folders]) <= 12


def test_a_folder_uses_only_the_imports_of_its_row():
    rules = allowed()
    for path in SOURCES.glob("*/*.ts"):
        for imported in re.findall(r'from "(\.[^"]+)"', path.read_text()):
            target = (path.parent / imported).resolve().relative_to(SOURCES).parts[0]
            assert target in rules[path.parent.name], f"{path.relative_to(SOURCES)} imports {imported}"
