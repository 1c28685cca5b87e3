"""The sections of car.yaml and the commands of `iort-agent`, for docs/reference/."""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from iort_agent.cli import command_line
from iort_agent.common.schema import Place, Rule, rules_of
from iort_agent.config import Config
from iort_agent.errors import ConfigError

_PLACE = Place(Path("car.yaml"), "key")


class Part(NamedTuple):
    """A mapping of car.yaml, or a command of `iort-agent`: its path, what it is, and a row for each key."""

    path: str
    meaning: str
    rows: list[tuple[str, ...]]


def commands() -> Iterator[Part]:
    """Every command of `iort-agent`."""
    for action in command_line()._actions:  # noqa: SLF001 - argparse has no other way to list them
        if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001 - as above
            for name, parser in action.choices.items():
                yield Part(name, parser.description or "", [*map(_option, parser._actions[1:])])  # noqa: SLF001 - as above


def _option(action: argparse.Action) -> tuple[str, str]:
    values = action.metavar or ",".join(map(str, action.choices or ()))
    required = ", required" if action.required and action.option_strings else ""
    return f"`{' '.join((*action.option_strings, str(values))).strip()}`", f"{action.help}{required}"


def sections(path: str = "", cls: type[Any] = Config) -> Iterator[Part]:
    """Every section of car.yaml, each before those within it."""
    rules, fields = rules_of(cls), dataclasses.fields(cls)
    rows: list[tuple[str, ...]] = [
        (f"`{field.name}`", _default(field), _allowed(rules[field.name])) for field in fields
    ]
    yield Part(path, re.sub(r"``(.+?)``", r"`\1`", " ".join((cls.__doc__ or "").split())), rows)
    for field in fields:
        for suffix, inner in _nested(rules[field.name]):
            yield from sections(f"{path}.{field.name}{suffix}".lstrip("."), inner)


def _nested(rule: Rule, suffix: str = "") -> Iterator[tuple[str, type[Any]]]:
    """The sections that a rule reads: its closure has their classes, or the rules of its items.

    A rule of its own names the classes in its code.
    """
    found = inspect.getclosurevars(rule)
    for name, value in {**found.globals, **found.nonlocals}.items():
        if inspect.isclass(value) and value is not Place and dataclasses.is_dataclass(value):
            yield suffix, value
        elif name == "classes" and isinstance(value, Mapping):
            yield from ((f"{suffix}, type {kind}", cls) for kind, cls in value.items())
        elif name in found.nonlocals and inspect.isfunction(value) and value.__name__.endswith("rule"):
            yield from _nested(value, suffix)


def _default(field: dataclasses.Field[Any]) -> str:
    value = field.default
    if value is dataclasses.MISSING:
        return "**required**"
    if value is None or dataclasses.is_dataclass(value) or value == ():
        return ""
    if isinstance(value, tuple):
        return ", ".join(value)
    return str(value).lower() if isinstance(value, bool) else str(value).removesuffix(".0")


def _allowed(rule: Rule) -> str:
    """What the rule's own errors name as allowed: of what no rule accepts, and of a text that few accept."""
    allowed = _named(rule, object())
    if allowed == "a text":
        allowed = _named(rule, "?") or allowed
    return "a mapping, below" if "with some of the keys" in allowed else allowed


def _named(rule: Rule, value: Any) -> str:
    try:
        rule(value, _PLACE)
    except ConfigError as error:
        named = re.search(r"must be (.+?), got ", str(error))
        return named[1] if named else ""
    return ""
