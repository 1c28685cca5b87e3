"""The invocations that wait in the ledger."""

from __future__ import annotations

from contextlib import closing, suppress

from local.keeping.invocations import Invocations
from local.keeping.ledger import Ledger, LedgerError


def test_the_end_of_an_undone_event_leaves_the_next_one_waiting(tmp_path):
    with closing(Ledger(tmp_path / "ledger.db", sync="normal")) as ledger:
        ends = {}

        def queue(_account, _region, _function, event, *, done):
            ends[event] = done

        invocations = Invocations(ledger, queue)
        invocations.dispatch("account", "region", "function", "undone")
        with suppress(LedgerError), ledger.write() as connection:
            connection.execute("INSERT INTO nowhere VALUES (1)")
        invocations.dispatch("account", "region", "function", "acknowledged")
        ledger.commit()
        # It was queued before its row was undone.
        ends["undone"]()
        assert ledger.read("SELECT event FROM invocations") == [('"acknowledged"',)]
        ends["acknowledged"]()
        assert ledger.read("SELECT event FROM invocations") == []
