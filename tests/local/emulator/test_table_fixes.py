"""The emulator's tables give the same answers with the gap closed and with the gap open."""

from __future__ import annotations

import copy
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ministack.core.responses import request_scope
from ministack.services import dynamodb

from local.emulator.fixes import tables
from tests.local.emulator import series_table
from tests.local.persistence.in_process import ACCOUNT, REGION, kept

TABLE = "ordered-gap"
NUMBERS = st.integers(-3, 12)
RANGES = st.one_of(
    st.tuples(st.sampled_from(["=", "<", "<=", ">", ">="]), NUMBERS),
    st.tuples(NUMBERS, NUMBERS).map(lambda pair: ("BETWEEN", *sorted(pair))),
    st.just(()),
)


@pytest.fixture(scope="module", autouse=True)
def ledger(tmp_path_factory):
    with kept(tmp_path_factory.mktemp("ledger") / "ledger.db"):
        yield


@pytest.fixture(scope="module")
def query(ledger):
    """Query in both ways, compare the answers, and return the answer if it is successful."""
    plain, evaluate = dynamodb._query, dynamodb._evaluate_condition
    narrowed = tables.narrowing(plain, tables.asked)
    dynamodb._evaluate_condition = tables.evaluating(evaluate)

    def ask(**data):
        with request_scope(ACCOUNT, REGION):
            answers = [one(copy.deepcopy(data)) for one in (plain, narrowed)]
        (status, headers, body), (_, _, plain_body) = answers[1], answers[0]
        assert answers[0] == (status, headers, plain_body)
        assert json.loads(plain_body) == json.loads(body)
        return json.loads(body) if status == 200 else None

    yield ask
    dynamodb._evaluate_condition = evaluate


def key(kind, n):
    """Make a sort key: a number, or a text with a different order than the number in it."""
    return {kind: str(n) if kind == "N" else f"{n}-ü~"}


@pytest.fixture(scope="module", params=["N", "S"])
def table(request, ledger):
    """Return a function that stores numbers in the table, in any order."""
    kind = request.param

    def store(numbers):
        with request_scope(ACCOUNT, REGION):
            held = dynamodb._tables[TABLE]
            held["items"].clear()
            for n in numbers:
                item = {"topic": {"S": "a"}, "t": key(kind, n), "odd": {"BOOL": bool(n % 2)}}
                dynamodb._set_item(held, "a", *item["t"].values(), item)
            return held

    store.kind = kind
    with request_scope(ACCOUNT, REGION):
        series_table.create(TABLE, kind)
    yield store
    with request_scope(ACCOUNT, REGION):
        dynamodb._delete_table({"TableName": TABLE})


def _order(kind, value):
    return int(value[kind]) if kind == "N" else value[kind]


def asked(condition, kind="N", *, partition="a"):
    text, values = "#topic = :topic", {":topic": {"S": partition}}
    names = {"#topic": "topic"}
    if condition:
        operator, *bounds = condition
        names["#t"] = "t"
        refs = [f":v{i}" for i in range(len(bounds))]
        keys = sorted((key(kind, bound) for bound in bounds), key=lambda one: _order(kind, one))
        values |= dict(zip(refs, keys, strict=True))
        text += f" AND #t {operator} {' AND '.join(refs)}"
    return {
        "TableName": TABLE,
        "KeyConditionExpression": text,
        "ExpressionAttributeNames": names,
        "ExpressionAttributeValues": values,
    }


QUERIES = st.fixed_dictionaries(
    {
        "condition": RANGES,
        "limit": st.one_of(st.none(), st.integers(1, 5)),
        "forward": st.booleans(),
        "cursor": st.one_of(st.none(), NUMBERS),
        "odd": st.booleans(),
    }
)


@given(st.lists(NUMBERS, unique=True), st.sets(NUMBERS, max_size=2), QUERIES)
def test_a_query_answers_as_unpatched(query, table, numbers, removed, wanted):
    held = table(numbers)
    for n in removed:
        with request_scope(ACCOUNT, REGION):
            dynamodb._remove_item(held, "a", key(table.kind, n)[table.kind])
    data = asked(wanted["condition"], table.kind) | {"ScanIndexForward": wanted["forward"]}
    if wanted["limit"] is not None:
        data["Limit"] = wanted["limit"]
    if wanted["cursor"] is not None:
        data["ExclusiveStartKey"] = {"topic": {"S": "a"}, "t": key(table.kind, wanted["cursor"])}
    if wanted["odd"]:
        data["FilterExpression"] = "odd = :odd"
        data["ExpressionAttributeValues"][":odd"] = {"BOOL": True}
    query(**data)


def test_the_pages_contain_every_item_once(query, table):
    table(range(10))
    data, seen = asked((">=", 2), table.kind) | {"Limit": 3}, []
    while True:
        answer = query(**data)
        seen += [item["t"] for item in answer["Items"]]
        if "LastEvaluatedKey" not in answer:
            break
        data["ExclusiveStartKey"] = answer["LastEvaluatedKey"]
    assert seen == [key(table.kind, n) for n in range(2, 10)]


def test_a_query_reads_only_the_requested_keys(query, table):
    table(range(10, 100))
    with request_scope(ACCOUNT, REGION):
        found = tables.asked(asked((">", 90), table.kind) | {"Limit": 2})
    items = [json.loads(text) for _, text in found.texts]
    assert [item["t"] for item in items] == [key(table.kind, n) for n in (91, 92, 93)]


def test_pages_end_at_a_megabyte_as_unpatched(query, table):
    held = table([])
    with request_scope(ACCOUNT, REGION):
        for n in range(10, 40):
            # Sizes with and without a page of exactly one megabyte.
            item = {"topic": {"S": "a"}, "t": key(table.kind, n), "text": {"S": "x" * (65_536 - 17 + n % 3)}}
            dynamodb._set_item(held, "a", *item["t"].values(), item)
    data, pages = asked((), table.kind), []
    while True:
        answer = query(**data)
        pages.append(answer["Count"])
        if "LastEvaluatedKey" not in answer:
            break
        data["ExclusiveStartKey"] = answer["LastEvaluatedKey"]
    assert sum(pages) == 30
    assert len(pages) > 1


@pytest.fixture
def scan(monkeypatch):
    """Scan all pages, and return the items and the number of pages."""
    skip = tables.continuing(dynamodb._apply_exclusive_start_key_scan)
    monkeypatch.setattr(dynamodb, "_apply_exclusive_start_key_scan", skip)
    narrowed = tables.narrowing(dynamodb._scan, tables.scanned)

    def pages(**data):
        items, number = [], 0
        while True:
            with request_scope(ACCOUNT, REGION):
                status, _, body = narrowed({"TableName": TABLE, **data})
            assert status == 200, body
            answer = json.loads(body)
            items += answer["Items"]
            number += 1
            if "LastEvaluatedKey" not in answer:
                return items, number
            data["ExclusiveStartKey"] = answer["LastEvaluatedKey"]

    return pages


def test_the_pages_of_a_scan_contain_every_item_once(scan, table):
    held = table(range(-3, 12))
    with request_scope(ACCOUNT, REGION):
        for n in (1, 2):
            item = {"topic": {"S": "b"}, "t": key(table.kind, n), "odd": {"BOOL": bool(n % 2)}}
            dynamodb._set_item(held, "b", *item["t"].values(), item)
    for limit, pages in ((None, 1), (5, 4)):
        more = {} if limit is None else {"Limit": limit}
        items, number = scan(**more)
        found = {(item["topic"]["S"], *item["t"].values()) for item in items}
        assert (len(items), len(found), number) == (17, 17, pages)
        names, values = {"#o": "odd"}, {":odd": {"BOOL": True}}
        odd, _ = scan(
            **more,
            FilterExpression="#o = :odd",
            ExpressionAttributeNames=names,
            ExpressionAttributeValues=values,
        )
        assert odd == [item for item in items if item["odd"]["BOOL"]]


@pytest.mark.parametrize(
    "change",
    [
        {"KeyConditionExpression": "#topic = :nothing"},
        {"KeyConditionExpression": "#topic > :topic"},
        {"KeyConditionExpression": "#topic = :topic AND begins_with(#topic, :topic)"},
        {"ExpressionAttributeValues": {":topic": {"N": "1"}}},
        {"ExclusiveStartKey": {"topic": {"S": "a"}}},
        {"Limit": 0},
        {"TableName": "no-such-table"},
    ],
)
def test_an_invalid_query_is_rejected_as_unpatched(query, table, change):
    table(range(3))
    assert query(**{**asked((), table.kind), **change}) is None


@given(
    st.one_of(
        st.from_regex(r"-?[0-9]{0,40}(\.[0-9]{0,40})?([eE][+-]?[0-9]{1,3})?", fullmatch=True),
        st.floats().map(repr),
        st.text(max_size=4),
        st.none(),
    )
)
def test_numbers_are_read_as_unpatched(text):
    for look, answer in (
        (dynamodb._ddb_canonicalize_number, lambda plain: plain),
        (dynamodb._number_error, lambda _: None),
    ):
        assert tables.plainly(look, answer)(text) == look(text)
