"""Reading a YAML mapping into frozen dataclasses whose fields carry their own rules.

A dataclass is the table: each field is a `setting` with the rule that its value must pass and its
default. `load` does the rest: unknown keys, missing keys, wrong types and values all become a
`ConfigError` that names file, dotted key, what was found and what is allowed.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from pathlib import Path
from typing import Any, Callable, Mapping, NamedTuple, TypeVar

import yaml

from iort_agent.errors import ConfigError
from iort_contract.limits import ContractError

T = TypeVar("T")


class Where(NamedTuple):
    """The place in a configuration file that a value stands at."""

    file: Path
    key: str = ""

    def child(self, name: Any) -> Where:
        """The place of a key of the mapping here."""
        return Where(self.file, f"{self.key}.{name}" if self.key else str(name))

    def item(self, index: int) -> Where:
        """The place of an item of the list here."""
        return Where(self.file, f"{self.key}[{index}]")

    def error(self, found: Any, allowed: str) -> ConfigError:
        """The error to raise for what was found here."""
        return self.problem(f"found {show(found)}; allowed is {allowed}")

    def problem(self, text: str) -> ConfigError:
        """The error to raise for a problem here that is not one value's."""
        return ConfigError(f"{self.file}: {self.key}: {text}" if self.key else f"{self.file}: {text}")


Rule = Callable[[Any, Where], Any]


def show(value: Any) -> str:
    """The value and, where YAML may have read it as something else than meant, its kind."""
    kinds = {bool: "true or false", int: "a number", float: "a number", dict: "a mapping", list: "a list"}
    if value is None:
        return "nothing"
    text = repr(value) if len(repr(value)) <= 60 else repr(value)[:57] + "..."
    kind = kinds.get(type(value))
    return f"{text} ({kind})" if kind else text


def setting(rule: Rule, default: Any = dataclasses.MISSING) -> Any:
    """A dataclass field with the rule for its value; without a default, the key is required."""
    return dataclasses.field(default=default, metadata={"rule": rule})


def number(low: float, high: float, *, whole: bool = False, unit: str = "") -> Rule:
    """A finite number from ``low`` to ``high``, read as int where it must be whole, else as float."""
    kind = "a whole number" if whole else "a number"
    limits = f"from {low:g}" if math.isinf(high) else f"from {low:g} to {high:g}"
    allowed = f"{kind} {limits}" + (f" ({unit})" if unit else "")

    def rule(value: Any, where: Where) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise where.error(value, allowed)
        if not low <= value <= high or math.isinf(value) or (whole and value != int(value)):
            raise where.error(value, allowed)
        return int(value) if whole else float(value)

    return rule


def flag() -> Rule:
    """``true`` or ``false``."""

    def rule(value: Any, where: Where) -> bool:
        if not isinstance(value, bool):
            raise where.error(value, "true or false")
        return value

    return rule


def choice(*names: str) -> Rule:
    """One of the names."""

    def rule(value: Any, where: Where) -> str:
        if value not in names:
            hint = _did_you_mean(value, names)
            raise where.error(value, f"one of {', '.join(names)}{hint}")
        return str(value)

    return rule


def text(check: Callable[[str], str] | None = None) -> Rule:
    """A text that is not empty and that ``check``, one of the contract's, does not refuse."""

    def rule(value: Any, where: Where) -> str:
        if not isinstance(value, str) or not value.strip():
            quotes = "; put it in quotes" if isinstance(value, (int, float)) else ""
            raise where.error(value, f"a text{quotes}")
        try:
            return check(value) if check else value
        except ContractError as error:
            raise where.problem(str(error)) from error

    return rule


def existing_path(*, folder: bool = False) -> Rule:
    """The path of a file that exists (or a folder, if so allowed), relative to the configuration."""
    what = "a file or folder that exists" if folder else "a file that exists"

    def rule(value: Any, where: Where) -> Path:
        if not isinstance(value, str) or not value:
            raise where.error(value, f"the path of {what}")
        path = where.file.parent / Path(value).expanduser()
        if not (path.exists() if folder else path.is_file()):
            raise where.error(value, f"the path of {what}, and there is none at {path}")
        return path

    return rule


def any_path() -> Rule:
    """A path, relative to the configuration, whether there is something or not."""

    def rule(value: Any, where: Where) -> Path:
        if not isinstance(value, str) or not value:
            raise where.error(value, "a path")
        return where.file.parent / Path(value).expanduser()

    return rule


def items(rule: Rule, *, at_least: int = 0, what: str) -> Rule:
    """A list whose items all pass the rule, as a tuple."""

    def list_rule(value: Any, where: Where) -> Any:
        if not isinstance(value, list) or len(value) < at_least:
            raise where.error(value, what)
        return tuple(rule(item, where.item(i)) for i, item in enumerate(value))

    return list_rule


def pairs(rule: Rule, *, what: str) -> Rule:
    """A mapping from any text to values that pass the rule, as a tuple of pairs; not empty."""

    def pairs_rule(value: Any, where: Where) -> Any:
        if not isinstance(value, dict) or not value:
            raise where.error(value, what)
        for key in value:
            if not isinstance(key, str):
                raise where.error(key, what)
        return tuple((key, rule(item, where.child(key))) for key, item in value.items())

    return pairs_rule


def section(cls: type[Any]) -> Rule:
    """A mapping of the settings of a dataclass; nothing at all means its defaults."""

    def rule(value: Any, where: Where) -> Any:
        return load(cls, {} if value is None else value, where)

    return rule


def variant(key: str, classes: Mapping[str, type[Any]]) -> Rule:
    """A mapping whose ``key`` says which dataclass the other keys are settings of."""

    def rule(value: Any, where: Where) -> Any:
        if not isinstance(value, dict):
            raise where.error(value, f"a mapping with the key {key}")
        kind = choice(*classes)(value.get(key), where.child(key))
        return load(classes[kind], {k: v for k, v in value.items() if k != key}, where)

    return rule


def load(cls: type[T], value: Any, where: Where) -> T:
    """The dataclass made of a mapping. Raises `ConfigError` for whatever a rule refuses."""
    rules = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]  # T is any dataclass
    if not isinstance(value, dict):
        raise where.error(value, f"a mapping with some of the keys {', '.join(rules)}")
    for key in value:
        if key not in rules:
            allowed = f"allowed is {', '.join(rules)}{_did_you_mean(key, rules)}"
            raise where.child(key).problem(f"unknown key, found {show(value[key])}; {allowed}")
    loaded: dict[str, Any] = {}
    for name, field in rules.items():
        if name in value:
            loaded[name] = field.metadata["rule"](value[name], where.child(name))
        elif field.default is dataclasses.MISSING:
            raise where.child(name).problem("required, and missing")
    return cls(**loaded)


def read_yaml(file: Path) -> Any:
    """The content of a YAML file. Raises `ConfigError` where it cannot be read or is no YAML."""
    try:
        # A subclass of SafeLoader: no Python objects are made.
        return yaml.load(file.read_text(encoding="utf-8"), Loader=_UniqueKeyLoader)  # noqa: S506 - see above
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{file}: is not UTF-8 text: {error}") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{file}: is not YAML: {' '.join(str(error).split())}") from error


class _UniqueKeyLoader(yaml.SafeLoader):
    """Refuses a key given twice, of which YAML would quietly keep the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:  # noqa: FBT001, FBT002 - as PyYAML has it
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for i, key in enumerate(keys):
            if key in keys[:i]:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} is given twice", node.value[i][0].start_mark
                )
        return super().construct_mapping(node, deep)


def _did_you_mean(found: Any, names: Any) -> str:
    close = difflib.get_close_matches(str(found), list(names), n=1)
    return f" (did you mean {close[0]}?)" if close else ""
