"""A second implementation of AWS IoT's SQL, for our rules, after AWS' documentation ("AWS IoT SQL
reference"). AWS does not specify which of two equal keys stays, the payload's or the rule's; the caller
chooses.
"""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Callable, Iterator
from typing import Any

_TOKEN = re.compile(r"\s*('(?:[^']|'')*'|\d+(?:\.\d+)?|[A-Za-z_]\w*|<>|<=|>=|[-+*/%=<>(),.])")
_KEYWORDS = {"SELECT", "FROM", "WHERE", "AS", "AND"}


class Undefined:
    """AWS' value for a missing attribute; JSON leaves it out."""


UNDEFINED = Undefined()


class Message:
    """A message in a rule; ``topic`` has no Basic Ingest prefix."""

    def __init__(self, topic: str, payload: bytes, now_ms: int = 0) -> None:
        self.topic, self.payload, self.now_ms = topic, payload, now_ms
        try:
            self.content = json.loads(payload)
        except ValueError:
            self.content = UNDEFINED


def evaluate(sql: str, message: Message, *, payload_wins: bool = False) -> Any:
    """Return the input of the rule's actions; None if the rule does not act. The topic filter is not read."""
    return _Query(sql).run(message, payload_wins=payload_wins)


class _Query:
    """``SELECT expression [AS name], ... FROM 'filter' [WHERE condition]``."""

    def __init__(self, sql: str) -> None:
        self._tokens = list(_tokens(sql))
        self._at = 0
        self._expect("SELECT")
        self._items = [self._item()]
        while self._take(","):
            self._items.append(self._item())
        self._expect("FROM")
        self._next()
        self._where = self._condition() if self._take("WHERE") else None
        assert self._peek() is None, self._tokens[self._at :]

    def run(self, message: Message, *, payload_wins: bool) -> Any:
        if self._where is not None and self._where(message) is not True:
            return None
        if [name for name, _ in self._items] == ["*"]:
            return message.content
        added = {name: value(message) for name, value in self._items if name != "*"}
        out = {name: value for name, value in added.items() if value is not UNDEFINED}
        if "*" not in (name for name, _ in self._items):
            return out
        whole = message.content if isinstance(message.content, dict) else {}
        return {**out, **whole} if payload_wins else {**whole, **out}

    def _item(self) -> tuple[str, Callable[[Message], Any]]:
        if self._take("*"):
            return "*", lambda message: message.content
        start = self._at
        value = self._sum()
        name = self._tokens[start]
        if self._tokens[start + 1 : start + 2] == ["."]:
            name = self._tokens[self._at - 1]
        return (self._next() if self._take("AS") else name), value

    def _condition(self) -> Callable[[Message], Any]:
        found = [self._comparison()]
        while self._take("AND"):
            found.append(self._comparison())

        def both(message: Message) -> Any:
            said = [one(message) for one in found]
            return UNDEFINED if UNDEFINED in said else all(one is True for one in said)

        return both

    def _comparison(self) -> Callable[[Message], Any]:
        left, sign, right = self._sum(), self._next(), self._sum()
        return lambda message: _compared(sign, left(message), right(message))

    def _sum(self) -> Callable[[Message], Any]:
        return self._chain(("+", "-"), lambda: self._chain(("*", "/", "%"), self._primary))

    def _chain(self, signs: tuple[str, ...], part: Callable[[], Any]) -> Callable[[Message], Any]:
        value = part()
        while self._peek() in signs:
            sign, left, right = self._next(), value, part()
            value = _operation(sign, left, right)
        return value

    def _primary(self) -> Callable[[Message], Any]:
        token = self._next()
        if token == "(":
            inner = self._sum()
            self._expect(")")
            return inner
        if token == "-":
            negated = self._primary()
            return _operation("-", lambda _: 0, negated)
        if token[0] == "'":
            text = token[1:-1].replace("''", "'")
            return lambda _: text
        if token[0].isdigit():
            number = float(token) if "." in token else int(token)
            return lambda _: number
        return self._call(token.lower()) if self._take("(") else self._path([token])

    def _path(self, path: list[str]) -> Callable[[Message], Any]:
        while self._take("."):
            path.append(self._next())
        return lambda message: _at(message.content, path)

    def _call(self, name: str) -> Callable[[Message], Any]:
        arguments: list[Callable[[Message], Any]] = []
        while not self._take(")"):
            # The payload as received, not parsed as JSON.
            arguments.append((lambda m: m.payload) if self._take("*") else self._sum())
            self._take(",")
        function = _FUNCTIONS[name]
        return lambda message: function(message, *(argument(message) for argument in arguments))

    def _peek(self) -> str | None:
        return self._tokens[self._at] if self._at < len(self._tokens) else None

    def _next(self) -> str:
        self._at += 1
        return self._tokens[self._at - 1]

    def _take(self, token: str) -> bool:
        taken = self._peek() == token
        self._at += taken
        return taken

    def _expect(self, token: str) -> None:
        assert self._take(token), (token, self._tokens[self._at :])


def _tokens(sql: str) -> Iterator[str]:
    at = 0
    while at < len(sql):
        match = _TOKEN.match(sql, at)
        assert match, sql[at:]
        token, at = match[1], match.end()
        yield token.upper() if token.upper() in _KEYWORDS else token


def _at(value: Any, path: list[str]) -> Any:
    for name in path:
        if not isinstance(value, dict) or name not in value:
            return UNDEFINED
        value = value[name]
    return value


def _number(value: Any) -> int | float | None:
    """Convert by "Conversions, To decimal"; None is Undefined."""
    if isinstance(value, str) and re.fullmatch(r"-?\d+(\.\d+)?([eE]-?\d+)?", value):
        return float(value) if set(value) & set(".eE") else int(value)
    return value if isinstance(value, (int, float)) and not isinstance(value, bool) else None


def _operation(sign: str, left: Any, right: Any) -> Callable[[Message], Any]:
    def operate(message: Message) -> Any:
        a, b = left(message), right(message)
        if sign == "+" and str in (type(a), type(b)):
            raise NotImplementedError("our rules put no texts together")
        a, b = _number(a), _number(b)
        if a is None or b is None or (sign in "/%" and b == 0):
            return UNDEFINED
        if sign == "/":
            return math.trunc(a / b) if isinstance(a, int) and isinstance(b, int) else a / b
        return {"+": a + b, "-": a - b, "*": a * b}[sign] if sign != "%" else math.fmod(a, b)

    return operate


def _compared(sign: str, a: Any, b: Any) -> Any:
    """Compare by "Operators": values that cannot be compared give Undefined."""
    if a is UNDEFINED or b is UNDEFINED:
        return UNDEFINED
    if sign in ("=", "<>"):
        same = a == b and isinstance(a, bool) == isinstance(b, bool)
        return same == (sign == "=")
    a, b = _number(a), _number(b)
    if a is None or b is None:
        return UNDEFINED
    return {"<": a < b, ">": a > b, "<=": a <= b, ">=": a >= b}[sign]


def _topic(message: Message, level: int | None = None) -> Any:
    levels = message.topic.split("/")
    if level is None:
        return message.topic
    return levels[level - 1] if 1 <= level <= len(levels) else UNDEFINED


def _floor(_: Message, value: Any) -> Any:
    number = _number(value)
    return UNDEFINED if number is None else math.floor(number)


def _encode(_: Message, value: Any, scheme: str) -> Any:
    if scheme != "base64" or value is None or value is UNDEFINED:
        return UNDEFINED
    if not isinstance(value, bytes):
        value = (value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))).encode()
    return base64.b64encode(value).decode()


_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "topic": _topic,
    "timestamp": lambda message: message.now_ms,
    "floor": _floor,
    "encode": _encode,
}
