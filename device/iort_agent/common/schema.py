"""Reads a YAML mapping into frozen dataclasses whose fields carry their own rules.

Each field of such a dataclass is a `setting`: a rule for its value, and a default. `load` turns unknown
keys, missing keys and wrong values into a `ConfigError` that names file, key, value and what is allowed.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from pathlib import Path
from typing import Any, Callable, Iterable, Mapping, NamedTuple, TypeVar

import yaml

from iort_agent.errors import ConfigError
from iort_contract.limits import ContractError
from iort_contract.messages.shadow import Choice, Flag, Number

T = TypeVar("T")
# YAML may have read a value as another type than its writer meant.
_KINDS = {bool: "true or false", int: "a number", float: "a number", dict: "a mapping", list: "a list"}


class Place(NamedTuple):
    """A place in a configuration file."""

    file: Path
    key: str = ""

    def child(self, name: Any) -> Place:
        """The place of a key of the mapping here."""
        return Place(self.file, f"{self.key}.{name}" if self.key else str(name))

    def item(self, index: int) -> Place:
        """The place of an item of the list here."""
        return Place(self.file, f"{self.key}[{index}]")

    def path(self, value: str) -> Path:
        """A path in the file is relative to the file."""
        return self.file.parent / Path(value).expanduser()

    def error(self, value: Any, allowed: str, hint: str = "") -> ConfigError:
        """The error for a value found here."""
        return self.problem(f"must be {allowed}, got {show(value)}{hint}")

    def problem(self, text: str) -> ConfigError:
        """The error for another problem here."""
        return ConfigError(f"{self.file}: {self.key}: {text}" if self.key else f"{self.file}: {text}")


# Returns the value in its own type, or raises the place's error.
Rule = Callable[[Any, Place], Any]


def show(value: Any) -> str:
    """The value, shortened, with its type in words."""
    if value is None:
        return "nothing"
    text = repr(value) if len(repr(value)) <= 60 else repr(value)[:57] + "..."
    kind = _KINDS.get(type(value))
    return f"{text} ({kind})" if kind else text


def setting(rule: Rule, default: Any = dataclasses.MISSING) -> Any:
    """A dataclass field with the rule for its value; without a default, the key is required."""
    return dataclasses.field(default=default, metadata={"rule": rule})


def rules_of(cls: type[Any]) -> dict[str, Rule]:
    """The rules of a dataclass' settings, by name."""
    return {field.name: field.metadata["rule"] for field in dataclasses.fields(cls)}


def number(low: float, high: float, *, whole: bool = False, unit: str = "") -> Rule:
    """A finite number from ``low`` to ``high``: an int if it must be whole, else a float."""
    kind = "a whole number" if whole else "a number"
    limits = f"from {low:g}" if math.isinf(high) else f"from {low:g} to {high:g}"
    allowed = f"{kind} {limits}" + (f" ({unit})" if unit else "")

    def rule(value: Any, place: Place) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise place.error(value, allowed)
        if not low <= value <= high or math.isinf(value) or (whole and value != int(value)):
            raise place.error(value, allowed)
        return int(value) if whole else float(value)

    return rule


def flag() -> Rule:
    """``true`` or ``false``."""

    def rule(value: Any, place: Place) -> bool:
        if not isinstance(value, bool):
            raise place.error(value, "true or false")
        return value

    return rule


def choice(*names: str) -> Rule:
    """One of the names."""

    def rule(value: Any, place: Place) -> str:
        if value not in names:
            raise place.error(value, f"one of {', '.join(names)}", did_you_mean(value, names))
        return str(value)

    return rule


def allowed(values: Flag | Number | Choice) -> Rule:
    """The values of a setting that may change at run time."""
    if isinstance(values, Number):
        return number(values.low, values.high, unit=values.unit)
    return choice(*values.names) if isinstance(values, Choice) else flag()


def text(check: Callable[[str], str] | None = None) -> Rule:
    """A text that is not empty and that passes ``check``, a function of the contract."""

    def rule(value: Any, place: Place) -> str:
        if not isinstance(value, str) or not value.strip():
            quotes = "; put it in quotes" if isinstance(value, (int, float)) else ""
            raise place.error(value, "a text", quotes)
        try:
            return check(value) if check else value
        except ContractError as error:
            raise place.problem(str(error)) from error

    return rule


def path(allowed: str = "a path", *, fits: Callable[[Path], bool] | None = None) -> Rule:
    """A path that ``fits``, if that is given."""

    def rule(value: Any, place: Place) -> Path:
        if not isinstance(value, str) or not value:
            raise place.error(value, allowed)
        target = place.path(value)
        if fits is not None and not fits(target):
            raise place.error(value, allowed, f"; there is none at {target}")
        return target

    return rule


FILE = path("the path of a file that exists", fits=Path.is_file)
FOLDER = path("the path of a folder that exists", fits=Path.is_dir)


def items(rule: Rule, *, at_least: int = 0, what: str) -> Rule:
    """A list of items that pass the rule, as a tuple."""

    def list_rule(value: Any, place: Place) -> Any:
        if not isinstance(value, list) or len(value) < at_least:
            raise place.error(value, what)
        return tuple(rule(item, place.item(i)) for i, item in enumerate(value))

    return list_rule


def pairs(rule: Rule, *, what: str, key: Rule | None = None) -> Rule:
    """A mapping that is not empty, as a tuple of pairs. Its values pass the rule, its keys pass ``key``."""
    key_rule = key or text()

    def pairs_rule(value: Any, place: Place) -> Any:
        if not isinstance(value, dict) or not value:
            raise place.error(value, what)
        for name in value:
            if not isinstance(name, str):
                raise place.error(name, what)
        return tuple((key_rule(name, place), rule(item, place.child(name))) for name, item in value.items())

    return pairs_rule


def section(cls: type[Any]) -> Rule:
    """A mapping of the settings of a dataclass; an empty one means its defaults."""

    def rule(value: Any, place: Place) -> Any:
        return load(cls, {} if value is None else value, place)

    return rule


def variant(key: str, classes: Mapping[str, type[Any]]) -> Rule:
    """A mapping whose ``key`` selects the dataclass of its other keys."""

    def rule(value: Any, place: Place) -> Any:
        if not isinstance(value, dict):
            raise place.error(value, f"a mapping with the key {key}")
        kind = choice(*classes)(value.get(key), place.child(key))
        return load(classes[kind], {k: v for k, v in value.items() if k != key}, place)

    return rule


def load(cls: type[T], value: Any, place: Place) -> T:
    """Make the dataclass from a mapping. Raises `ConfigError` for a value that its rule rejects."""
    rules = rules_of(cls)
    if not isinstance(value, dict):
        raise place.error(value, f"a mapping with some of the keys {', '.join(rules)}")
    for key in value:
        if key not in rules:
            hint = did_you_mean(key, rules)
            raise place.child(key).problem(f"unknown key{hint}; must be one of {', '.join(rules)}")
    loaded = {name: rules[name](item, place.child(name)) for name, item in value.items()}
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]  # T is any dataclass
        if field.name not in loaded and field.default is dataclasses.MISSING:
            raise place.child(field.name).problem("required, and missing")
    return cls(**loaded)


def read_yaml(file: Path) -> Any:
    """The content of a YAML file. Raises `ConfigError` if it cannot be read or is not YAML."""
    try:
        # A subclass of SafeLoader: it makes no Python objects.
        return yaml.load(file.read_text(encoding="utf-8"), Loader=_UniqueKeyLoader)  # noqa: S506 - see above
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{file}: is not UTF-8 text: {error}") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{file}: is not YAML: {' '.join(str(error).split())}") from error
    except RecursionError as error:
        raise ConfigError(f"{file}: must be nested at most {_MOST_LEVELS} levels deep") from error


_MOST_LEVELS = 50


class _UniqueKeyLoader(yaml.SafeLoader):
    """Rejects a key given twice. YAML would silently keep the last one."""

    _levels = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        # Before the stack is full: see `json_text`.
        self._levels += 1
        if self._levels > _MOST_LEVELS:
            raise RecursionError
        node = super().compose_node(parent, index)
        self._levels -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:  # noqa: FBT001, FBT002 - as PyYAML has it
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for i, key in enumerate(keys):
            if key in keys[:i]:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} is given twice", node.value[i][0].start_mark
                )
        return super().construct_mapping(node, deep)


def did_you_mean(word: Any, names: Iterable[str]) -> str:
    """A hint with the closest of the names; empty if none is close."""
    close = difflib.get_close_matches(str(word), list(names), n=1)
    return f" (did you mean {close[0]}?)" if close else ""
