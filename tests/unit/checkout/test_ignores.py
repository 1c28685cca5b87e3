"""Every comment that silences a checker gives its reason on the same line."""

from __future__ import annotations

import io
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
SOURCES = [
    ROOT / "app.py",
    *(
        path
        for folder in (
            "bench",
            "contract",
            "device",
            "functions",
            "local",
            "scripts",
            "stacks",
            "station",
            "verify",
        )
        for path in sorted((ROOT / folder).rglob("*.py"))
    ),
    *sorted((ROOT / "tests").rglob("*.py")),
]
IGNORE = re.compile(r"#\s*(?:ruff:\s*)?(?:noqa|type:\s*ignore|pragma|mypy:)")
REASONED = re.compile(
    r"# (?:ruff: )?noqa: [A-Z]+\d+(?:, [A-Z]+\d+)* - \w.*|# type: ignore\[[a-z-]+(?:, [a-z-]+)*\]  # \w.*"
)


def unreasoned(source):
    """Line and text of every comment that silences a checker without a reason."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and IGNORE.search(token.string):
            ignore = token.string[IGNORE.search(token.string).start() :]
            if not REASONED.fullmatch(ignore):
                yield token.start[0], ignore


def test_every_ignore_of_a_line_has_a_reason():
    found = [
        f"{path.relative_to(ROOT)}:{line}: {ignore}"
        for path in SOURCES
        for line, ignore in unreasoned(path.read_text(encoding="utf-8"))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "comment",
    [
        "noqa",
        "noqa: S603",
        "noqa: S603 -",
        "noqa: S603, T201",
        "type: ignore",
        "type: ignore[misc]",
        "type: ignore  # the library has no types",
        "ruff: noqa: RUF009",
        "fmt: skip  # noqa: E501",
    ],
)
def test_an_ignore_without_a_reason_is_found(comment):
    assert [line for line, _ in unreasoned(f"x = 1\ny = 2  # {comment}\n")] == [2]


def test_every_ignore_of_a_file_or_folder_has_a_reason():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    table = text.split("[tool.ruff.lint.per-file-ignores]\n")[1].split("\n[")[0]
    rules = [line for line in table.splitlines() if re.search(r'"[A-Z]+\d*"', line)]
    assert len(rules) > 10
    lines = table.splitlines()
    for line in rules:
        before = lines[lines.index(line) - 1]
        assert re.search(r"# \w", line) or before.startswith("# "), line
