"""Imports each name of iort_contract from the module that defines it: `python scripts/rehome.py [--check]`.

Handles `from iort_contract import name`, `from iort_contract.module import name` where the name has moved, and
`iort_contract.name` after `import iort_contract`. Run ruff afterwards; it sorts and formats.
"""

# ruff: noqa
# mypy: ignore-errors
from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CONTRACT = ROOT / "contract" / "iort_contract"
# Names of the former facade that have another name in their module.
RENAMED = {"encode": "encode_batch", "decode": "decode_batch", "split": "split_batch"}
# The modules of names that two modules define.
CHOSEN = {"Field": "catalog"}


def defined() -> dict[str, list[str]]:
    homes: dict[str, list[str]] = defaultdict(list)
    for path in sorted(CONTRACT.rglob("*.py")):
        module = ".".join(path.relative_to(CONTRACT.parent).with_suffix("").parts)
        module = module.removesuffix(".__init__")
        for node in ast.parse(path.read_text()).body:
            names = []
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                names = [node.name]
            elif isinstance(node, (ast.Assign, ast.AnnAssign)):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                names = [n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
            for name in names:
                if not name.startswith("__"):
                    homes[name].append(module)
    return homes


HOMES = defined()


def is_module(module: str) -> bool:
    path = CONTRACT.parent / Path(*module.split("."))
    return path.with_suffix(".py").exists() or path.is_dir()


def home(name: str, given: str) -> tuple[str, str] | None:
    """Where a name is defined and its name there; None to leave it."""
    if name in HOMES and given in HOMES[name]:
        return None
    if is_module(f"{given}.{name}"):
        return None
    if given == "iort_contract" or given == "iort_contract.messages.batch":
        name = RENAMED.get(name, name)
    found = HOMES.get(name, [])
    if len(found) > 1:
        found = [m for m in found if CHOSEN.get(name, "?") in m.split(".")]
    if len(found) != 1:
        print(f"  not found: {given}.{name}: {HOMES.get(name)}")
        return None
    return found[0], name


def rewrite(path: Path) -> str:
    text = path.read_text()
    if "iort_contract" not in text:
        return text
    tree = ast.parse(text)
    edits: list[tuple[int, int, str]] = []
    starts = [0]
    for line in text.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def span(node: ast.AST) -> tuple[int, int]:
        return starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset

    renamed: dict[str, str] = {}
    attributes: dict[str, str] = {}
    plain_imports = []
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.ImportFrom)
            and (node.module or "").split(".")[0] == "iort_contract"
            and not node.level
        ):
            moved: dict[str, list[str]] = defaultdict(list)
            for alias in node.names:
                to = home(alias.name, node.module)
                module, name = to or (node.module, alias.name)
                if alias.asname:
                    name += f" as {alias.asname}"
                elif name != alias.name:
                    renamed[alias.name] = name
                moved[module].append(name)
            if list(moved) != [node.module] or any(a.name in renamed for a in node.names):
                indent = "\n" + " " * node.col_offset
                new = indent.join(
                    f"from {m} import {', '.join(sorted(ns))}" for m, ns in sorted(moved.items())
                )
                edits.append((*span(node), new))
        if isinstance(node, ast.Import) and any(
            a.name == "iort_contract" and not a.asname for a in node.names
        ):
            plain_imports.append(node)
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and node.id in renamed:
            edits.append((*span(node), renamed[node.id]))
    if plain_imports:
        bound = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        bound |= {a.arg for a in ast.walk(tree) if isinstance(a, ast.arg)}
        bound |= {n.name for n in ast.walk(tree) if isinstance(n, (ast.FunctionDef, ast.ClassDef))}
        bound |= {
            a.asname or a.name
            for n in ast.walk(tree)
            if isinstance(n, (ast.Import, ast.ImportFrom))
            for a in n.names
            if a.name != "iort_contract"
        }
        moved = defaultdict(set)
        complete = True
        for node in ast.walk(tree):
            if (
                isinstance(node, ast.Attribute)
                and isinstance(node.value, ast.Name)
                and node.value.id == "iort_contract"
            ):
                if is_module(f"iort_contract.{node.attr}"):
                    to = ("iort_contract", node.attr)
                else:
                    to = home(node.attr, "iort_contract")
                imported = any(
                    isinstance(n, ast.ImportFrom)
                    and (n.module or "").startswith("iort_contract")
                    and any(to and a.name == to[1] for a in n.names)
                    for n in ast.walk(tree)
                )
                if to is None or (to[1] in bound and not imported):
                    complete = False
                    print(f"  by hand: {path.relative_to(ROOT)}:{node.lineno} {node.attr}")
                    continue
                moved[to[0]].add(to[1])
                attributes[node.attr] = to[1]
        lines = [f"from {m} import {', '.join(sorted(ns))}" for m, ns in sorted(moved.items())]
        for node in plain_imports[:1]:
            edits.append((*span(node), "\n".join((["import iort_contract"] if not complete else []) + lines)))
    data = text.encode()  # in f-strings, Python 3.11 gives no places, so attributes are replaced as text
    for start, end, new in sorted(edits, reverse=True):
        data = data[:start] + new.encode() + data[end:]
    text = data.decode()
    for name, new in attributes.items():
        text = re.sub(rf"(?<!from )(?<!import )\biort_contract\.{name}\b", new, text)
    return text


if __name__ == "__main__":
    files = subprocess.run(
        ["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    changed = []
    for name in files:
        path = ROOT / name
        if name in ("contract/iort_contract/__init__.py", "scripts/rehome.py") or not path.exists():
            continue
        new = rewrite(path)
        if new != path.read_text():
            changed.append(name)
            if "--check" not in sys.argv:
                path.write_text(new)
    print(*changed, sep="\n")
