"""Count how many of a fixed sample of 300 small faults the fast unit tests notice.

    python scripts/mutants.py draw     # from SEED, into scripts/mutants.json; done once
    make mutants                       # traces the unit tests, tries each mutant on those that reach it

A mutant is remembered by its function, the text of its statement and a place in it, so that it is found again
where code has moved. What is not found again is counted as gone.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from random import Random
from typing import Any

import coverage

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = Path(__file__).with_suffix(".json")
SEED, SIZE = 2026, 300
AREAS = ("contract/iort_contract", "device/iort_agent", "functions", "station/iort_station")
TESTS = ("tests/unit", "tests/device")
FAST = ("-m", "not slow", "--hypothesis-profile", "fast", "--hypothesis-seed=0", "-p", "no:cacheprovider")
MOST_TESTS = 100  # of those that reach a mutant: the ones that reach least else
TIMEOUT_S = 180
TRACE = ROOT / "build" / "mutants"

_OPPOSITES = (
    (ast.Lt, ast.LtE),
    (ast.Gt, ast.GtE),
    (ast.Eq, ast.NotEq),
    (ast.In, ast.NotIn),
    (ast.Is, ast.IsNot),
    (ast.Add, ast.Sub),
    (ast.Mult, ast.Div),
    (ast.LShift, ast.RShift),
    (ast.BitAnd, ast.BitOr),
)
_OTHER: dict[type, Any] = {
    **dict(_OPPOSITES),
    **{other: each for each, other in _OPPOSITES},
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
}


@dataclass(frozen=True)
class Mutant:
    """A fault at a place of the code."""

    file: str
    function: str
    statement: str
    place: int  # among the mutable places of the statement
    fault: str


@dataclass(frozen=True)
class Site:
    """Where a mutant stands now."""

    mutant: Mutant
    node: ast.expr
    text: str  # what stands there instead


def main() -> int:
    """Draw the sample, or run it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("verb", choices=("draw", "run"))
    verb = parser.parse_args().verb
    sites = list(_sites())
    if verb == "draw":
        mutants = Random(SEED).sample([site.mutant for site in sites], SIZE)  # noqa: S311 - a sample, no secret
        rows = [json.dumps(asdict(mutant)) for mutant in mutants]
        SAMPLE.write_text("[\n" + ",\n".join(rows) + "\n]\n")
        return 0
    return _run([Mutant(**entry) for entry in json.loads(SAMPLE.read_text())], sites)


def pytest_runtest_protocol(item: Any) -> None:
    """As a plugin of pytest: name the test that runs to coverage."""
    if (tracer := coverage.Coverage.current()) is not None:
        tracer.switch_context(item.nodeid)


def _run(mutants: list[Mutant], sites: list[Site]) -> int:
    reach = _trace()
    outcomes: Counter[str] = Counter()
    for number, mutant in enumerate(mutants, 1):
        site = _site(mutant, sites)
        outcome = _outcome(site, reach) if site else "gone"
        outcomes[outcome] += 1
        where = f"{site.mutant.file}:{site.node.lineno}" if site else mutant.file
        print(f"{number:3} {outcome:9} {where} {mutant.function}: {mutant.fault}", flush=True)
    there = SIZE - outcomes["gone"]
    noticed = outcomes["killed"]
    print(f"{noticed} of {there} mutants noticed, {100 * noticed / there:.1f} %; {dict(outcomes)}")
    return 0


def _outcome(site: Site, reach: dict[tuple[str, int], list[str]]) -> str:
    path = ROOT / site.mutant.file
    lines = range(site.node.lineno, (site.node.end_lineno or site.node.lineno) + 1)
    tests = list(dict.fromkeys(test for line in lines for test in reach.get((site.mutant.file, line), ())))
    if not tests:
        return "unreached"
    before = path.read_bytes()
    path.write_bytes(_mutated(before, site))
    try:
        return "killed" if _pytest("-x", *tests[:MOST_TESTS]) else "survived"
    except subprocess.TimeoutExpired:
        return "killed"
    finally:
        path.write_bytes(before)


def _mutated(source: bytes, site: Site) -> bytes:
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    node = site.node
    begin = starts[node.lineno - 1] + node.col_offset
    end = starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)
    return source[:begin] + site.text.encode() + source[end:]


def _pytest(*arguments: str) -> int:
    command = [sys.executable, "-m", "pytest", "-q", *FAST, *arguments]
    quiet = subprocess.DEVNULL
    done = subprocess.run(command, cwd=ROOT, stdout=quiet, stderr=quiet, timeout=TIMEOUT_S, check=False)
    return done.returncode


def _trace() -> dict[tuple[str, int], list[str]]:
    """The tests that reach each line, those first that reach least else."""
    TRACE.mkdir(parents=True, exist_ok=True)
    data_file = TRACE / "coverage"
    if not data_file.exists():
        settings = TRACE / "coveragerc"
        settings.write_text(f"[run]\nsource = {','.join(AREAS)}\ndata_file = {data_file}\n")
        command = [sys.executable, "-m", "coverage", "run", f"--rcfile={settings}", "-m", "pytest", "-q"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        subprocess.run(
            [*command, *FAST, "-p", "scripts.mutants", *TESTS], cwd=ROOT, env=environment, check=False
        )
    data = coverage.CoverageData(str(data_file))
    data.read()
    reach: dict[tuple[str, int], list[str]] = {}
    breadth: Counter[str] = Counter()
    for path in data.measured_files():
        for line, tests in data.contexts_by_lineno(path).items():
            reach[str(Path(path).relative_to(ROOT)), line] = named = [test for test in tests if test]
            breadth.update(named)
    return {place: sorted(tests, key=lambda test: (breadth[test], test)) for place, tests in reach.items()}


def _site(mutant: Mutant, sites: list[Site]) -> Site | None:
    """Where the mutant stands now: same statement and place, in the function of its name if possible."""
    same = [site for site in sites if _key(site.mutant) == _key(mutant)]
    name = mutant.function.rpartition(".")[2]

    def strangeness(site: Site) -> tuple[bool, bool]:
        return site.mutant.function.rpartition(".")[2] != name, site.mutant.file != mutant.file

    return min(same, key=strangeness, default=None)


def _key(mutant: Mutant) -> tuple[str, str, int, str]:
    return mutant.file.split("/")[0], re.sub(r"\b_(?=\w)", "", mutant.statement), mutant.place, mutant.fault


def _sites() -> Iterator[Site]:
    for area in AREAS:
        for path in sorted((ROOT / area).rglob("*.py")):
            file = str(path.relative_to(ROOT))
            yield from _within(file, "", ast.parse(path.read_text()).body)


def _within(file: str, scope: str, body: list[ast.stmt]) -> Iterator[Site]:
    for statement in body:
        if isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            yield from _within(file, f"{scope}.{statement.name}".lstrip("."), statement.body)
            continue
        if scope:
            yield from _of_statement(file, scope, statement)
        for name in ("body", "orelse", "finalbody"):
            yield from _within(file, scope, getattr(statement, name, []))
        for handler in getattr(statement, "handlers", []):
            yield from _within(file, scope, handler.body)


def _of_statement(file: str, scope: str, statement: ast.stmt) -> Iterator[Site]:
    heads = [
        head
        for name in ("test", "iter", "value")
        if isinstance(head := getattr(statement, name, None), ast.expr) and not isinstance(head, ast.Constant)
    ]
    places: dict[str, int] = defaultdict(int)
    for head in heads:
        whole = isinstance(statement, (ast.If, ast.While, ast.Return, ast.Expr))
        faults = [*_whole(statement, head)] if whole else []
        faults += [fault for node in _nodes(head) for fault in _faults(node)]
        statement_text = f"{type(statement).__name__} {ast.unparse(head)}"
        for node, fault, text in faults:
            yield Site(Mutant(file, scope, statement_text, places[fault], fault), node, text)
            places[fault] += 1


def _whole(statement: ast.stmt, head: ast.expr) -> Iterator[tuple[ast.expr, str, str]]:
    if isinstance(statement, (ast.If, ast.While)):
        yield head, "negated", f"(not ({ast.unparse(head)}))"
    elif isinstance(statement, ast.Return):
        yield head, "returns None", "None"
    elif isinstance(head, ast.Call):
        yield head, "call removed", "None"


def _nodes(node: ast.AST) -> Iterator[ast.expr]:
    """Every expression within, except those within f-strings, whose places Python 3.11 does not tell."""
    if isinstance(node, ast.JoinedStr):
        return
    if isinstance(node, ast.expr):
        yield node
    for child in ast.iter_child_nodes(node):
        yield from _nodes(child)


def _faults(node: ast.expr) -> Iterator[tuple[ast.expr, str, str]]:
    if isinstance(node, ast.Compare) and type(node.ops[0]) in _OTHER:
        other = _OTHER[type(node.ops[0])]()
        changed: ast.expr = ast.Compare(node.left, [other, *node.ops[1:]], node.comparators)
    elif isinstance(node, ast.BinOp) and type(node.op) in _OTHER and not _of_text(node):
        changed = ast.BinOp(node.left, _OTHER[type(node.op)](), node.right)
    elif isinstance(node, ast.BoolOp):
        changed = ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        changed = node.operand
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        changed = ast.Constant(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        changed = ast.Constant(node.value + 1)
    else:
        return
    fault = f"{type(node).__name__} {type(getattr(node, 'op', None)).__name__}"
    yield node, fault, f"({ast.unparse(changed)})"


def _of_text(node: ast.BinOp) -> bool:
    sides = (node.left, node.right)
    return any(isinstance(side, ast.JoinedStr) or _is_constant_text(side) for side in sides)


def _is_constant_text(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and not isinstance(node.value, (int, float))


if __name__ == "__main__":
    sys.exit(main())
