"""A caller with many calls does not delay other callers."""

from __future__ import annotations

import threading

from local.emulator.fixes.invocations import Turns
from testkit.waiting import GUARD_S


def test_callers_with_waiting_calls_take_turns():
    turns, begun, go, done = Turns(1), threading.Event(), threading.Event(), threading.Event()
    called = []

    def first():
        begun.set()
        assert go.wait(GUARD_S)

    turns.submit("many", first)
    assert begun.wait(GUARD_S)
    for n in range(5):
        turns.submit("many", called.append, f"many {n}")
    turns.submit("few", called.append, "few 0")
    turns.submit("few", called.append, "few 1")
    turns.submit("many", done.set)
    go.set()
    assert done.wait(GUARD_S)
    assert called == ["many 0", "few 0", "many 1", "few 1", "many 2", "many 3", "many 4"]


def test_a_failing_call_does_not_end_its_thread():
    turns, done = Turns(1), threading.Event()
    turns.submit("a", [].pop)
    turns.submit("a", done.set)
    assert done.wait(GUARD_S)
