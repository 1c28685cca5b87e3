"""Executions of state machines over restarts and months."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone

import pytest
from ministack.core.responses import request_scope
from ministack.services import stepfunctions

from local.persistence import documents

MAP = {"mapRunArn": "run"}


@pytest.fixture
def store():
    with request_scope("000000000000", "eu-west-1"):
        yield stepfunctions._executions
        stepfunctions._executions.clear()


def _ended(days):
    return {
        "status": "SUCCEEDED",
        "stopDate": (datetime.now(timezone.utc) - timedelta(days=days)).isoformat(),
    }


def test_executions_are_forgotten_as_on_aws_and_a_maps_children_after_a_day(store):
    store.update({"new": _ended(89), "old": _ended(91), "running": {"status": "RUNNING", "stopDate": None}})
    store.update({"new child": MAP | _ended(0.9), "old child": MAP | _ended(1.1)})
    documents.forget_old()
    assert sorted(store) == ["new", "new child", "running"]


def test_only_whole_executions_begin_anew(store):
    store.update({"ended": _ended(1), "running": {"status": "RUNNING"}, "child": MAP | {"status": "RUNNING"}})
    assert [name for *_, name in documents.running({"executions": store})] == ["running"]
