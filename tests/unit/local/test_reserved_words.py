"""No expression names one of DynamoDB's reserved words; otherwise only a request would reveal the error."""

from __future__ import annotations

import ast
import importlib
import re

import pytest
from ministack.services._dynamodb_keywords import AWS_KEYWORDS

from local.deployment import ROOT

# Keywords of the expression language; two of them are therefore reserved as names.
LANGUAGE = {
    *("set", "add", "remove", "delete", "and", "or", "not", "between", "in"),
    *("attribute_exists", "attribute_not_exists", "attribute_type", "begins_with", "contains", "size"),
    *("if_not_exists", "list_append"),
}
WORD = re.compile(r"[#:]?[A-Za-z_]\w*")
# Patterns that occur in expressions and in no ordinary text.
EXPRESSION = re.compile(r"attribute_(not_)?exists\(|(=|<|>|BETWEEN|ADD \S+) :\w|^\s*REMOVE [#\w]")
PLACEHOLDER = "#unknown"


def text_of(node, module):
    """A string with its module's constants filled in; None for any other node."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if not isinstance(node, ast.JoinedStr):
        return None
    return "".join(
        part.value if isinstance(part, ast.Constant) else _constant(part, module) for part in node.values
    )


def _constant(part, module):
    value = getattr(module, part.value.id, None) if isinstance(part.value, ast.Name) else None
    return value if isinstance(value, str) else PLACEHOLDER


def named(expression):
    """The attributes that an expression names without a placeholder."""
    words = set(WORD.findall(expression))
    return {word for word in words if word[0] not in "#:" and word.lower() not in LANGUAGE}


def expressions(folder):
    for path in sorted((ROOT / folder).glob("**/*.py")):
        tree = ast.parse(path.read_text())
        dotted = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        inside = {
            id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values
        }
        for node in ast.walk(tree):
            if id(node) in inside or not isinstance(node, (ast.Constant, ast.JoinedStr)):
                continue
            literal = text_of(node, None)
            if literal is not None and EXPRESSION.search(literal):
                yield (
                    f"{path.relative_to(ROOT)}:{node.lineno}",
                    text_of(node, importlib.import_module(dotted)),
                )


@pytest.fixture(scope="module")
def found():
    return [one for folder in ("contract", "functions", "station", "verify") for one in expressions(folder)]


def test_no_expression_names_a_reserved_word(found):
    assert {where.split(":")[0] for where, _ in found} >= {
        "functions/admit.py",
        "functions/shared/quotas.py",
        "contract/iort_contract/dynamodb.py",
        "station/iort_station/operations/quarantine.py",
    }
    for where, expression in found:
        assert {word for word in named(expression) if word.upper() in AWS_KEYWORDS} == set(), where


def test_a_reserved_word_would_be_found(found):
    in_expressions = set().union(*(named(expression) for _, expression in found))
    assert {"robot", "agent_version", "admit_until_s"} <= in_expressions, "constants are looked up"
    assert named("SET batch = :batch, #n = :n") == {"batch"}
    assert named("attribute_exists(robot) AND #online = :was") == {"robot"}
