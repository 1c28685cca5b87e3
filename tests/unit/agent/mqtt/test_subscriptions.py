"""Only the current connection's answers confirm a subscription."""

from __future__ import annotations

from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any, Callable

from iort_agent.mqtt.dispatch import Dispatcher, Subscriptions

FILTER = "cmd/iort/car/#"


def agreed() -> Future[Any]:
    future: Future[Any] = Future()
    future.set_result(SimpleNamespace(reason_codes=[1], reason_string=None))
    return future


def test_an_answer_of_an_earlier_connection_is_ignored() -> None:
    asked: list[Callable[[Future[Any]], None]] = []
    dispatcher = Dispatcher()
    subscriptions = Subscriptions(
        dispatcher, subscribe=lambda _, done: asked.append(done), usable=lambda: True, refused=print
    )
    subscriptions.add(FILTER, print)
    dispatcher.run_pending()
    # The dispatcher is busy until after the loss and the next connect.
    subscriptions.lost()
    asked[0](agreed())
    assert not subscriptions.confirmed
    subscriptions.renew()
    assert len(asked) == 2
    asked[1](agreed())
    assert subscriptions.confirmed == {FILTER}
    subscriptions.renew()
    assert len(asked) == 2
