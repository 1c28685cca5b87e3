"""A service's state is the same after it was split into documents and joined again."""

from __future__ import annotations

from datetime import datetime, timezone

from ministack.core.responses import AccountRegionScopedDict, AccountScopedDict, request_scope

from local.persistence import documents
from local.persistence.documents import join, split

KEYED = ("thing", "shadow")


def test_a_state_is_the_same_after_a_restart():
    by_region, by_account = AccountRegionScopedDict(), AccountScopedDict()
    with request_scope("000000000001", "eu-west-1"):
        by_region[KEYED] = {"code": b"x" * 5000, "short": b"\xff", "names": {"a", "b"}}
        by_account["role"] = [1, None, datetime(2026, 1, 1, tzinfo=timezone.utc)]
    state = {"by_region": by_region, "by_account": by_account, "plain": {KEYED: 1}, "value": [1, "two"]}
    kept: dict[str, bytes] = {}

    def keep(content: bytes) -> str:
        kept["name"] = content
        return "name"

    rows = [(one.store, one.kind, one.key, one.text) for one in split(state, keep)]
    found = join(iter(rows), kept.__getitem__)
    assert kept == {"name": b"x" * 5000}
    assert found["by_region"]._data == by_region._data
    assert found["by_account"]._data == by_account._data
    assert (found["plain"], found["value"]) == (state["plain"], state["value"])


def test_a_call_is_known_by_its_action_or_its_method():
    json_, form = {"x-amz-target": "AmazonSSM.{}"}, {"content-type": "application/x-www-form-urlencoded"}

    def changes(action: str) -> bool:
        headers = {name: text.format(action) for name, text in json_.items()}
        return documents.may_change("POST", "/", headers, b"", {})

    assert changes("PutParameter")
    assert not changes("GetParameter")
    assert documents.may_change("POST", "/", form, b"Action=CreateRole&RoleName=a", {})
    assert not documents.may_change("POST", "/", form, b"Action=DescribeStacks", {})
    assert documents.may_change("PUT", "/policies/p", {}, b"", {})
    assert not documents.may_change("GET", "/policies/p", {}, b"", {})
    assert not documents.may_change("POST", "/service/Metrics/operation/ListMetrics", {}, b"", {})
