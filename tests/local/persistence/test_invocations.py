"""The invocations that wait in the ledger."""

from __future__ import annotations

import asyncio
from contextlib import closing, suppress

import pytest

from local.persistence import queues as invocations_module
from local.persistence.ledger import Ledger, LedgerError
from local.persistence.queues import Invocations


class Queue:
    """A queue that a test works off by hand."""

    def __init__(self):
        self.ends = {}

    def __call__(self, _account, _region, function, event, *, done=None):
        if function == "removed":
            raise LookupError(function)
        self.ends[event] = done


def test_the_end_of_an_undone_event_leaves_the_next_one_waiting(tmp_path):
    with closing(Ledger(tmp_path / "ledger.db", sync="normal")) as ledger:
        queue = Queue()
        invocations = Invocations(ledger, queue)
        invocations.dispatch("account", "region", "function", "undone")
        with suppress(LedgerError), ledger.write() as connection:
            connection.execute("INSERT INTO nowhere VALUES (1)")
        invocations.dispatch("account", "region", "function", "acknowledged")
        ledger.commit()
        # It was queued before its row was undone.
        queue.ends["undone"]()
        assert ledger.read("SELECT event FROM invocations") == [('"acknowledged"',)]
        queue.ends["acknowledged"]()
        assert ledger.read("SELECT event FROM invocations") == []


def test_what_waited_goes_on_after_a_restart_and_new_events_come_behind(tmp_path):
    with closing(Ledger(tmp_path / "ledger.db", sync="normal")) as ledger:
        before = Invocations(ledger, Queue())
        before.dispatch("account", "region", "function", "lost")
        before.dispatch("account", "region", "function", "first")
        with ledger.write() as connection:
            connection.execute("UPDATE invocations SET function = 'removed' WHERE event = '\"lost\"'")
    with closing(Ledger(tmp_path / "ledger.db", sync="normal")) as ledger:
        queue = Queue()
        invocations = Invocations(ledger, queue)
        invocations.go_on()
        invocations.dispatch("account", "region", "function", "second")
        assert list(queue.ends) == ["first", "second"]
        assert ledger.read("SELECT event FROM invocations") == [('"first"',), ('"second"',)]


@pytest.mark.parametrize(
    ("topic", "qos", "kept"), [("live", 0, False), ("live", 1, True), ("$aws/events/presence", None, True)]
)
def test_an_event_of_an_unacknowledged_message_is_not_kept(tmp_path, topic, qos, kept):
    with closing(Ledger(tmp_path / "ledger.db", sync="normal")) as ledger:
        queue = Queue()
        invocations = Invocations(ledger, queue)

        async def rule(account, region, *_payload, **_rest):
            invocations.dispatch(account, region, "function", "event")

        publish = invocations_module._noting_acknowledgement(rule)
        asyncio.run(publish("account", "region", topic, b"", qos=qos))
        assert list(queue.ends) == ["event"]
        assert len(ledger.read("SELECT * FROM invocations")) == kept
