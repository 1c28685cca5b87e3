"""Tables of docs/: settings, rules, metrics and alarms."""

from __future__ import annotations

from collections.abc import Iterator

from iort_contract.catalog import alarms
from iort_contract.catalog.alarms import Alarm
from iort_contract.catalog.metrics import METRICS
from iort_contract.catalog.rules import RULES, Call, Store
from stacks.settings import CONTEXT_KEYS, ROOT, Settings

Row = tuple[str, ...]


def settings_rows() -> Iterator[Row]:
    """A row for each context key."""
    for name, field in Settings.model_fields.items():
        if name in CONTEXT_KEYS:
            default = str(field.default).replace(f"{ROOT}/", "").lower()
            shown = "none" if default in ("none", "{}", "") else default.removesuffix(".0")
            yield f"`{name}`", shown, field.description or ""


def rule_rows() -> Iterator[Row]:
    """A row for each topic rule: what it does, where its messages go, and its SELECT."""
    for rule in RULES.values():
        action = rule.action
        if isinstance(action, Store):
            target = f"table {action.table}"
        elif isinstance(action, Call):
            target = f"function `{action.function}`"
        else:
            target = f"topic `{action.lane}/.../{action.name}`"
        source = rule.statement().split(" FROM ")[1]
        yield f"`{rule.name}`", rule.meaning, target, f"`{source}`"


def metric_rows() -> Iterator[Row]:
    """A row for each metric: its function, unit, statistic and chart."""
    for metric in METRICS.values():
        alarm = "yes" if metric.alarm else ""
        yield f"`{metric.name}`", metric.function, metric.unit, metric.statistic, metric.chart.title, alarm


def alarm_rows() -> Iterator[Row]:
    """A row for each alarm: what happened, when, and what to do."""
    ours = {metric.name: metric.alarm for metric in METRICS.values() if metric.alarm}
    account = {name: alarm for (_, name), alarm in alarms.OF_THE_ACCOUNT.items()}
    # The resource's name stands before these.
    resources = {f"...{ending}": alarm for ending, alarm in alarms.OF_RESOURCES.items()}
    for name, alarm in {**ours, **resources, **alarms.OF_ONE_RESOURCE, **account}.items():
        yield f"`{name}`", alarm.meaning, _condition(alarm), alarm.action


def _condition(alarm: Alarm) -> str:
    limit = f"`{alarm.threshold}`" if isinstance(alarm.threshold, str) else f"{alarm.threshold:g}"
    often = f", {alarm.periods} of {alarm.within} minutes" if alarm.within else ""
    if alarm.periods > 1 and not alarm.within:
        often = f", {alarm.periods} minutes in a row"
    return f"{'below' if alarm.below else 'above'} {limit}{often}"
