"""A republish action's topic may hold ${topic(n)}.

AWS: expands substitution templates in an action's parameters
  (https://docs.aws.amazon.com/iot/latest/developerguide/iot-substitution-templates.html).
ministack: publishes to the topic as written, with the literal text ``${topic(3)}``.
Test: tests/local/test_gaps.py::test_republish_topic_is_expanded
Patch: local/patches/republish_topic.patch
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from functools import wraps
from typing import Any
from unittest.mock import patch

from ministack.services import iot

_TEMPLATE = re.compile(r"\$\{\s*(topic\(\s*\d*\s*\))\s*\}")


def install() -> None:
    """Close the gap in this process."""
    iot._run_rule_actions = _expanding(iot._run_rule_actions)


def is_open() -> bool:
    """Run a rule that republishes, and look where to."""
    topics = []

    async def publish(_account: str, _region: str, topic: str, *_: Any, **__: Any) -> None:
        topics.append(topic)

    rule = {"sql": "SELECT * FROM 'a/b'", "actions": [{"republish": {"topic": "c/${topic(2)}"}}]}
    with patch.object(iot, "broker_publish", publish):
        asyncio.run(iot._run_rule_actions("000000000000", "eu-west-1", rule, b"{}", "a/b"))
    return topics != ["c/b"]


def expand_topic(template: str, topic: str) -> str:
    """The republish topic for a message on ``topic``; a level that it does not have is empty."""
    levels = topic.split("/")

    def level(match: re.Match[str]) -> str:
        index = match[1][len("topic(") : -1].strip()
        if not index:
            return topic
        return levels[int(index) - 1] if 1 <= int(index) <= len(levels) else ""

    return _TEMPLATE.sub(level, template)


def _expanding(run_rule_actions: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(run_rule_actions)
    async def run(account: str, region: str, rule: dict[str, Any], payload: bytes, *rest: Any) -> None:
        topic = rest[0] if rest else ""
        if rule and any("republish" in action for action in rule.get("actions") or []):
            rule = {**rule, "actions": [_expanded(action, topic) for action in rule["actions"]]}
        await run_rule_actions(account, region, rule, payload, *rest)

    return run


def _expanded(action: dict[str, Any], topic: str) -> dict[str, Any]:
    republish = action.get("republish")
    if republish is None:
        return action
    return {"republish": {**republish, "topic": expand_topic(republish["topic"], topic)}}
