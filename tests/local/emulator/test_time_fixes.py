"""The gaps that are about speed only: the emulator answers as before, and does less for it."""

from __future__ import annotations

import asyncio
import json
from unittest.mock import Mock, patch

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ministack.core import iam_actions
from ministack.core.responses import request_scope
from ministack.services import dynamodb, iot

from local.emulator.fixes import broker, storage
from tests.local.emulator import series_table

ACCOUNT, REGION, TABLE = "000000000000", "eu-west-1", "time-gap"


@pytest.fixture
def unpatched():
    """Put back what an installed gap has replaced, and delete the table."""
    names = ("json", "_batch_write_item", "_validate_item", "_accumulate_write_capacity")
    kept = {name: getattr(dynamodb, name) for name in names}
    sql = {name: getattr(iot, name) for name in broker.OF_THE_SQL_ALONE}
    with request_scope(ACCOUNT, REGION):
        series_table.create(TABLE)
        yield
        dynamodb._delete_table({"TableName": TABLE})
    for module, names in ((dynamodb, kept), (iot, sql), (iam_actions, {"json": json})):
        for name, value in names.items():
            setattr(module, name, value)


def body(*numbers):
    items = [{"topic": {"S": "a"}, "t": {"N": str(n)}, "of": {"L": [{"N": "1.50"}]}} for n in numbers]
    return json.dumps({"RequestItems": {TABLE: [{"PutRequest": {"Item": item}} for item in items]}}).encode()


@pytest.mark.usefixtures("unpatched")
def test_a_batch_write_reads_its_items_once():
    def write(*numbers):
        return dynamodb._batch_write_item(json.loads(body(*numbers)))

    before = write(1, 2), write(1, 1)
    storage.close_request_time()
    with patch.object(dynamodb, "_item_size_bytes", Mock(wraps=dynamodb._item_size_bytes)) as size:
        assert (write(1, 2), write(1, 1)) == before
        # The second request's first item is the only one that its duplicate is compared with.
        assert size.call_count == 4
    assert dynamodb._tables[TABLE]["items"]["a"]["2"]["of"] == {"L": [{"N": "1.5"}]}


def test_a_body_is_parsed_once_and_never_stored_twice():
    one, text = storage.OneBody(), body(1)
    read = one.read(text)
    assert one.read(text) is read
    assert one.take(text) is read
    assert one.take(text) is not read
    assert one.read(body(2)) == json.loads(body(2))


@pytest.mark.usefixtures("unpatched")
def test_a_rule_is_taken_apart_once():
    sql = "SELECT *, topic(3) AS robot, encode(*, 'base64') AS raw FROM 'dt/iort/+/+' WHERE n > 1"
    before = iot._rule_event(sql, "dt/iort/car/vesc", b'{"n": 2}')
    broker.close_rule_time()
    for _ in range(3):
        assert iot._rule_event(sql, "dt/iort/car/vesc", b'{"n": 2}') == before
    found = iot._rule_select_clause.cache_info()
    assert (found.misses, found.hits) == (1, 2)


LEVELS = st.sampled_from(["a", "b", "", "$aws", "events"])
FILTERS = st.lists(st.one_of(LEVELS, st.just("+")), min_size=1, max_size=4).flatmap(
    lambda levels: st.sampled_from(["/".join(levels), "/".join([*levels, "#"]), "#"])
)


@given(
    st.lists(FILTERS, unique=True),
    st.sets(st.integers(0, 3)),
    st.lists(LEVELS, min_size=1, max_size=5).map("/".join),
)
def test_a_message_meets_the_subscriptions_that_match(filters, ended, topic):
    async def heard(subscriptions, publish):
        found = []

        async def deliver(_topic, payload, _qos):
            found.append(payload)

        with patch.object(iot, "_subscriptions", subscriptions):
            ids = [await iot.broker_subscribe(ACCOUNT, REGION, one, deliver) for one in filters]
            for place in ended & {*range(len(ids))}:
                await iot.broker_unsubscribe(ids[place])
            await publish(ACCOUNT, REGION, topic, b"one")
            for sid in ids:
                await iot.broker_unsubscribe(sid)
            assert not subscriptions
        return found

    tree = broker.Subscriptions()
    found = asyncio.run(heard(tree, broker.asking(iot.broker_publish)))
    assert found == asyncio.run(heard({}, iot.broker_publish))
    assert not tree._root.next
