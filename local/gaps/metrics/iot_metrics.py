"""Metrics of AWS IoT.

AWS: counts connections, messages, and the matches and actions of rules
  (https://docs.aws.amazon.com/iot/latest/developerguide/metrics_dimensions.html).
ministack: counts none of them.
Test: tests/local/operations/test_eyes.py::test_a_fault_reaches_a_human_and_the_dashboards
Patch: none; it needs ministack's own store to merge the values of a minute, or memory grows with every
  message
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import wraps
from typing import Any

from ministack.services import cloudwatch, iot

from local.gaps.parts.points import record

_PRESENCE = {"connected": "Connect.Success", "connect_failed": "Connect.AuthError"}


def install() -> None:
    """Close the gap in this process."""
    iot._run_rule_actions = _counting_matches(iot._run_rule_actions)
    iot._dispatch_rule_action = _counting_actions(iot._dispatch_rule_action)
    iot.broker_publish = _counting_messages(iot.broker_publish)


def is_open() -> bool:
    """Run a rule, and look for its metric."""
    rule = {"ruleName": "gaps_iot_metrics", "sql": "SELECT * FROM 'a'", "actions": []}
    asyncio.run(iot._run_rule_actions("000000000000", "eu-west-1", rule, b"{}", "a"))
    return ("AWS/IoT", "TopicMatch", "RuleName=gaps_iot_metrics") not in cloudwatch._metrics


def _counting_matches(run_rule_actions: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(run_rule_actions)
    async def run(account: str, region: str, rule: dict[str, Any], *rest: Any) -> None:
        if rule and not rule.get("ruleDisabled"):
            record("AWS/IoT", "TopicMatch", 1, "Count", RuleName=rule.get("ruleName", ""))
        await run_rule_actions(account, region, rule, *rest)

    return run


def _counting_actions(dispatch: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(dispatch)
    async def dispatch_action(
        account: str, region: str, rule: str, action: dict[str, Any], event: Any
    ) -> None:
        kind = next(iter(action), "?")
        dimensions = {"RuleName": rule, "ActionType": kind[:1].upper() + kind[1:]}
        try:
            await dispatch(account, region, rule, action, event)
        except Exception:
            record("AWS/IoT", "Failure", 1, "Count", **dimensions)
            raise
        record("AWS/IoT", "Success", 1, "Count", **dimensions)

    return dispatch_action


def _counting_messages(publish: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(publish)
    async def broker_publish(account: str, region: str, topic: str, payload: bytes, **rest: Any) -> None:
        levels = topic.split("/")
        if levels[:3] == ["$aws", "events", "presence"]:
            name = _PRESENCE.get(levels[3])
        else:
            name = "PublishIn.Success"
        if name:
            record("AWS/IoT", name, 1, "Count", Protocol="MQTT")
        await publish(account, region, topic, payload, **rest)

    return broker_publish
