"""Conditions on samples, such as ``speed_mps > 1.2 and fault_code == 0``: parsed, never evaluated by Python.

The language is a part of Python's own syntax: fields (a dotted path, ``covariance[0]`` for an element),
numbers, texts, ``+ - * / %``, ``abs()``, comparisons (also chained and ``in (...)``), ``is None`` and
``is not None`` (also written ``== None`` and ``!= None``), ``and``, ``or``, ``not`` and brackets. With null,
arithmetic gives null and every comparison is false; division by zero gives null. A field by itself is true
if it is neither null, zero nor empty. A comparison of a number with a text, or arithmetic with a text, is an
error, since no sample could match.

`evaluate` walks the tree; `operations` say how to calculate: with one sample's values here, for the query
function, and with numpy's columns in iort_station.data.conditions.
"""

from __future__ import annotations

import ast
import math
import operator
import sys
from functools import partial, reduce
from typing import Any, Callable, FrozenSet, Mapping, NamedTuple, Sequence

from iort_contract.checks import check_field
from iort_contract.limits import ContractError, Value

MAX_LENGTH = 1000
# Deeper than practical expressions, and well below the interpreter's own limit.
_MAX_DEPTH = 40
# The kind of a value for comparisons; a flag counts as 0 or 1.
_NULL, _NUMBER, _TEXT = "null", "a number", "a text"
_Kinds = Mapping[str, FrozenSet[str]]


class MismatchError(ValueError):
    """A condition that compares a number with a text, or calculates with a text; the text says which."""


class ExpressionError(ValueError):
    """An expression that is not in the language; the text shows the place."""

    def __init__(self, problem: str, expression: str, position: int) -> None:
        super().__init__(f"{problem}\n  {expression}\n  {' ' * position}^")
        self.position = position


class Node(NamedTuple):
    """A step of an expression.

    ``kind`` is `FIELD` or `CONSTANT`, which have a name or a value as ``value``; or one of `ARITHMETIC`, of
    `COMPARISONS` or of the other operations, which take the values of the nodes ``of``. With null, arithmetic
    and `MAGNITUDE` are null, and a comparison is false.
    """

    kind: str
    of: tuple[Node, ...] = ()
    value: float | str = ""


FIELD, CONSTANT = "field", "constant"
MAGNITUDE, IS_NULL, NOT, EVERY, SOME = "abs", "is null", "not", "and", "or"
ARITHMETIC: Mapping[str, Callable[[Any, Any], Any]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "%": operator.mod,
}
COMPARISONS: Mapping[str, Callable[[Any, Any], Any]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_BINARY = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Mod: "%"}
_COMPARE = {ast.Eq: "==", ast.NotEq: "!=", ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">="}


def parse(expression: str) -> Node:
    """Parse an expression; raises `ExpressionError` if it is not in the language."""
    return Reader(one_line(expression)).parse()


def one_line(expression: str) -> str:
    """The expression as one line, since for Python leading spaces are indentation and a newline ends it.

    Raises `ExpressionError` if it is too long.
    """
    if len(expression) > MAX_LENGTH:
        raise ExpressionError(f"must be at most {MAX_LENGTH} characters", expression[:60] + "...", 0)
    return " ".join(expression.splitlines()).strip()


def names(node: Node) -> frozenset[str]:
    """The fields in a tree."""
    if node.kind == FIELD:
        return frozenset({str(node.value)})
    return frozenset().union(*map(names, node.of))


Operations = Mapping[str, Callable[..., Any]]


def operations(
    arithmetic: Callable[[str, Any, Any], Any],
    compare: Callable[[str, Any, Any], Any],
    magnitude: Callable[[Any], Any],
    is_null: Callable[[Any], Any],
    truth: Callable[[Any], Any],
) -> Operations:
    """Each kind of node's operation on values of one kind. ``truth`` gives what ``&``, ``|`` and ``^ True``
    take."""
    return {
        **{symbol: partial(arithmetic, symbol) for symbol in ARITHMETIC},
        **{symbol: partial(compare, symbol) for symbol in COMPARISONS},
        MAGNITUDE: magnitude,
        IS_NULL: is_null,
        NOT: lambda value: truth(value) ^ True,
        EVERY: lambda *values: reduce(operator.and_, map(truth, values)),
        SOME: lambda *values: reduce(operator.or_, map(truth, values)),
    }


def evaluate(node: Node, fields: Mapping[str, Any], how: Operations) -> Any:
    """The value of a tree, or whether it is true, with the values of the fields."""
    if node.kind == FIELD:
        return fields[str(node.value)]
    if node.kind == CONSTANT:
        return node.value
    return how[node.kind](*[evaluate(part, fields, how) for part in node.of])


def holds(node: Node, columns: Mapping[str, Sequence[Value]], n: int) -> list[bool]:
    """Evaluate the condition, one value per sample; a missing field is null.

    Raises `MismatchError` if the condition mixes numbers and texts.
    """
    fields = {name: columns.get(name) or [None] * n for name in names(node)}
    known = {name: kinds(*column) for name, column in fields.items()}
    if problem := mismatch(node, known):
        raise MismatchError(problem)
    samples = ({name: column[i] for name, column in fields.items()} for i in range(n))
    return [bool(evaluate(node, sample, _PLAIN)) for sample in samples]


def compiled(node: Node) -> Callable[[Mapping[str, Value]], Any]:
    """A function that evaluates a tree as `holds` does, for one sample, and faster each time. The kinds of
    the fields are not checked."""
    if node.kind == FIELD:
        return operator.itemgetter(str(node.value))
    if node.kind == CONSTANT:
        constant = node.value
        return lambda _fields: constant
    parts = [compiled(part) for part in node.of]
    if node.kind == EVERY:
        return lambda fields: all(part(fields) for part in parts)
    if node.kind == SOME:
        return lambda fields: any(part(fields) for part in parts)
    calculate = _PLAIN[node.kind]
    if len(parts) == 1:
        (only,) = parts
        return lambda fields: calculate(only(fields))
    left, right = parts
    return lambda fields: calculate(left(fields), right(fields))


def kinds(*of: Value) -> frozenset[str]:
    """The kinds of values, without null's."""
    return frozenset(map(_kind, of)) - {_NULL}


def _calculated(symbol: str, left: Value, right: Value) -> float | None:
    if not isinstance(left, (int, float)) or not isinstance(right, (int, float)):
        return None
    try:
        number = float(ARITHMETIC[symbol](float(left), float(right)))
    except (ArithmeticError, ValueError):
        return None
    return None if math.isnan(number) else number


def _compared(symbol: str, left: Value, right: Value) -> bool:
    if left is None or right is None:
        return False
    return bool(COMPARISONS[symbol](left, right))


def _magnitude(value: Value) -> float | None:
    return abs(float(value)) if isinstance(value, (int, float)) else None


_PLAIN = operations(_calculated, _compared, _magnitude, lambda value: value is None, bool)


def _kind(value: Value) -> str:
    return _NULL if value is None else _TEXT if isinstance(value, str) else _NUMBER


def _kinds(node: Node, of: _Kinds) -> frozenset[str]:
    """The kinds of a node's values; empty if unknown, or if all are null."""
    if node.kind == FIELD:
        return of.get(str(node.value), frozenset())
    return frozenset({_kind(node.value) if node.kind == CONSTANT else _NUMBER})


def mismatch(node: Node, of: _Kinds) -> str:
    """The error text if the condition mixes numbers and texts of these kinds; empty if it does not."""
    found = frozenset().union(*(_kinds(part, of) for part in node.of))
    said = ", ".join(
        f"{_shown(part)} is {' or '.join(sorted(_kinds(part, of)))}" for part in node.of if _kinds(part, of)
    )
    if node.kind in COMPARISONS and len(found) > 1:
        return f"cannot compare a number with a text: {said}"
    if (node.kind in ARITHMETIC or node.kind == MAGNITUDE) and _TEXT in found:
        return f"cannot calculate with a text: {said}"
    return next(filter(None, (mismatch(part, of) for part in node.of)), "")


def _shown(node: Node) -> str:
    if node.kind == FIELD:
        return str(node.value)
    return repr(node.value) if node.kind == CONSTANT else "the result"


class Reader:
    """Turns Python's tree into ours; refuses everything outside our language.

    ``functions`` names the language's functions in an error. ``source`` is what Python parses: the text, or
    one of the same length if the language has tokens that Python does not have.
    """

    functions = "the only function is abs(x)"

    def __init__(self, text: str, source: str | None = None) -> None:
        self.text = text
        self._source = text if source is None else source
        self._depth = 0

    def parse(self) -> Node:
        """The tree of the text; raises `ExpressionError`."""
        text = self.text
        try:
            tree = ast.parse(self._source, mode="eval")
        except SyntaxError as error:
            # The position is the end of the text.
            position = min(len(text), (error.offset or len(text) + 1) - 1)
            raise ExpressionError(f"invalid expression: {error.msg}", text, position) from error
        except (ValueError, MemoryError, RecursionError) as error:
            raise ExpressionError("invalid expression", text[:60], 0) from error
        return self.read(tree.body)

    def read(self, node: ast.expr) -> Node:
        self._depth += 1
        if self._depth > _MAX_DEPTH:
            raise self.error("the expression is nested too deeply", node)
        try:
            return self._read(node)
        finally:
            self._depth -= 1

    def _read(self, node: ast.expr) -> Node:
        if isinstance(node, (ast.Name, ast.Attribute, ast.Subscript)):
            return self.field(node)
        if isinstance(node, ast.Constant):
            return self._constant(node)
        step = self._operation(node)
        # The kinds of fields are known only with the samples.
        if problem := mismatch(step, {}):
            raise self.error(problem, node)
        return step

    def _operation(self, node: ast.expr) -> Node:
        if isinstance(node, ast.BoolOp):
            parts = tuple(map(self.read, node.values))
            return Node(EVERY if isinstance(node.op, ast.And) else SOME, parts)
        if isinstance(node, ast.UnaryOp):
            if isinstance(node.op, ast.Not):
                return Node(NOT, (self.read(node.operand),))
            if isinstance(node.op, ast.USub):
                return Node("-", (Node(CONSTANT, value=0), self.read(node.operand)))
            if isinstance(node.op, ast.UAdd):
                return self.read(node.operand)
        if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
            return Node(_BINARY[type(node.op)], (self.read(node.left), self.read(node.right)))
        if isinstance(node, ast.Compare):
            return self._compare(node)
        if isinstance(node, ast.Call):
            return self.call(node)
        raise self.error("not part of the language: fields, numbers, texts, + - * / %, "
                          "abs(), comparisons, and, or, not", node)  # fmt: skip

    def field(self, node: ast.expr) -> Node:
        path: list[str] = []
        at = node
        while not isinstance(at, ast.Name):
            if isinstance(at, ast.Attribute):
                path.append(at.attr)
            elif isinstance(at, ast.Subscript) and isinstance(index := _index(at), ast.Constant):
                if type(index.value) is not int:
                    raise self.error("an index must be a number", index)
                path.append(str(index.value))
            else:
                raise self.error("not a field", node)
            at = at.value
        name = ".".join([at.id, *reversed(path)])
        try:
            return Node(FIELD, value=check_field(name))
        except ContractError as error:
            raise self.error(str(error), node) from error

    def _constant(self, node: ast.Constant) -> Node:
        value = node.value
        if value is None:
            raise self.error("None is only allowed as x is None, x is not None", node)
        if not isinstance(value, (bool, int, float, str)):
            raise self.error("must be a number or a text", node)
        # An integer may be larger than every float.
        if not isinstance(value, str) and not abs(value) <= sys.float_info.max:
            raise self.error("the number is too large", node)
        return Node(CONSTANT, value=value)

    def _compare(self, node: ast.Compare) -> Node:
        sides = zip([node.left, *node.comparators], node.ops, node.comparators)
        pairs = tuple(self._pair(*side) for side in sides)
        return pairs[0] if len(pairs) == 1 else Node(EVERY, pairs)

    def _pair(self, left: ast.expr, kind: ast.cmpop, right: ast.expr) -> Node:
        if isinstance(kind, (ast.Is, ast.IsNot)) and not _is_none(right):
            raise self.error("`is` only works with None; use ==", right)
        if isinstance(kind, (ast.Is, ast.IsNot, ast.Eq, ast.NotEq)) and (_is_none(left) or _is_none(right)):
            null = Node(IS_NULL, (self.read(left if _is_none(right) else right),))
            return null if isinstance(kind, (ast.Is, ast.Eq)) else Node(NOT, (null,))
        if type(kind) in _COMPARE:
            return Node(_COMPARE[type(kind)], (self.read(left), self.read(right)))
        if not isinstance(right, (ast.Tuple, ast.List)) or not right.elts:
            raise self.error("`in` needs values in brackets, such as in (1, 2)", right)
        within = Node(SOME, tuple(self._pair(left, ast.Eq(), item) for item in right.elts))
        return within if isinstance(kind, ast.In) else Node(NOT, (within,))

    def call(self, node: ast.Call) -> Node:
        known = isinstance(node.func, ast.Name) and node.func.id == "abs"
        if not known or len(node.args) != 1 or node.keywords:
            raise self.error(self.functions, node)
        return Node(MAGNITUDE, (self.read(node.args[0]),))

    def error(self, problem: str, node: ast.expr) -> ExpressionError:
        return ExpressionError(problem, self.text, self.position(node))

    def position(self, node: ast.expr) -> int:
        """Where the node begins in the text."""
        return self._characters(node.col_offset)

    def said(self, node: ast.expr) -> str:
        """The text of a node."""
        end = node.end_col_offset
        return self.text[self.position(node) : None if end is None else self._characters(end)]

    def _characters(self, offset: int) -> int:
        # ast counts bytes of UTF-8.
        return len(self.text.encode()[:offset].decode(errors="ignore"))


def _index(node: ast.Subscript) -> ast.expr:
    """What stands in the brackets; Python 3.8 wraps it."""
    wrapped: ast.expr = getattr(node.slice, "value", node.slice)
    return wrapped if type(node.slice).__name__ == "Index" else node.slice


def _is_none(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is None
