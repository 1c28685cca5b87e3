"""A small evaluator of IAM and IoT policy statements, independent of the emulator's evaluator.

Source: IAM, "Policy evaluation logic"; AWS IoT Core, "Policy actions", "Thing policy variables". It
rejects statements with unknown elements.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

Statement = Mapping[str, Any]


def allows(
    statements: Iterable[Statement], action: str, arn: str, variables: Mapping[str, str] | None = None
) -> bool:
    """Return whether a statement allows the action on the resource, and no statement denies it.

    ``variables`` are the values of policy variables and condition keys; a variable without a value matches
    nothing. Raises `NotImplementedError` for a statement with unknown elements.
    """
    found = {
        statement["Effect"] for statement in statements if _matches(statement, action, arn, variables or {})
    }
    return "Allow" in found and "Deny" not in found


def _matches(statement: Statement, action: str, arn: str, variables: Mapping[str, str]) -> bool:
    unknown = statement.keys() - {"Sid", "Effect", "Action", "Resource", "Condition"}
    if unknown or statement["Effect"] not in ("Allow", "Deny"):
        raise NotImplementedError(str(statement))
    return (
        # Actions are compared without regard to case, resources with regard to it.
        any(_like(one.lower(), action.lower()) for one in _list(statement["Action"]))
        and any(_like(one, arn, variables) for one in _list(statement["Resource"]))
        and all(
            _holds(operator, key, wanted, variables)
            for operator, keys in statement.get("Condition", {}).items()
            for key, wanted in keys.items()
        )
    )


def _holds(operator: str, key: str, wanted: Any, variables: Mapping[str, str]) -> bool:
    if operator == "Bool":
        return variables.get(key) in [str(one).lower() for one in _list(wanted)]
    if operator == "StringEquals":
        return variables.get(key) in _list(wanted)
    # A key that is missing in the request passes both.
    if operator == "StringEqualsIfExists":
        return key not in variables or variables[key] in _list(wanted)
    if operator == "ForAllValues:StringLike":
        return all(any(_like(one, value) for one in _list(wanted)) for value in _list(variables.get(key, [])))
    raise NotImplementedError(operator)


def _like(pattern: str, text: str, variables: Mapping[str, str] | None = None) -> bool:
    parts = re.split(r"(\$\{[^}]+\}|\*|\?)", pattern)
    expression = ""
    for part in parts:
        if part in ("*", "?"):
            expression += ".*" if part == "*" else "."
        elif part.startswith("${"):
            if part[2:-1] not in (variables or {}):
                return False
            # A value is plain text, whatever its characters.
            expression += re.escape((variables or {})[part[2:-1]])
        else:
            expression += re.escape(part)
    return re.fullmatch(expression, text, re.DOTALL) is not None


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]
