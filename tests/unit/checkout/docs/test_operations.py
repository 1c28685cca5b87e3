"""Every row of docs/how-to/operations.md names an existing test that causes the fault."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[4]
ROWS = [
    line for line in (ROOT / "docs/how-to/operations.md").read_text().splitlines() if line.startswith("| ")
][1:]


def test_every_row_names_an_existing_test():
    assert len(ROWS) > 10
    for row in ROWS:
        named = re.findall(r"(tests/[\w/]+\.py)::(\w+)", row)
        assert named, row
        for path, function in named:
            tree = ast.parse((ROOT / path).read_text())
            assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, row
