"""Triggers in force: what is accepted, what is refused and why, what they cost, and when they fire."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from iort_agent.recorder import triggers as module
from iort_agent.recorder.plan import Edge
from iort_contract.messages.recorder import MAX_TRIGGERS, STOP
from iort_contract.topics import ACCEPTED
from iort_contract.triggers import Evaluator
from tests.unit.agent.recorder.rig import BRAKE, Rig, S


def edges(rig: Rig) -> list[Edge]:
    return [edge for one in rig.plan.incidents.values() for edge in one.edges]


def test_wrong_triggers_are_refused_and_the_others_hold(tmp_path: Path) -> None:
    rig = Rig(
        tmp_path,
        triggers={
            "good": BRAKE,
            "syntax": {"when": "current_input <"},
            "unknown": {"when": "current_input < 0", "colour": "red"},
            "own": {"when": "cpu_percent > 90", "stream": "agent"},
            "long": {**BRAKE, "before_s": 1e6},
            "text": "current_input < 0",
        },
    )
    answers = rig.watch.answers()
    assert answers.pop("good") == ACCEPTED
    assert sorted(answers) == ["long", "own", "syntax", "text", "unknown"]
    assert "colour" in answers["unknown"]
    assert "before must be 0 to 600" in answers["long"]
    assert "the agent's own stream" in answers["own"]
    rig.brake()
    assert [edge.trigger for edge in edges(rig)] == ["good"]


def test_there_are_at_most_so_many(tmp_path: Path) -> None:
    rig = Rig(tmp_path, triggers={f"t{i:02}": BRAKE for i in range(MAX_TRIGGERS + 2)})
    refused = {name for name, answer in rig.watch.answers().items() if answer != ACCEPTED}
    assert refused == {f"t{MAX_TRIGGERS:02}", f"t{MAX_TRIGGERS + 1:02}"}


def test_they_hold_after_a_restart_without_a_connection(tmp_path: Path) -> None:
    rig = Rig(tmp_path, triggers={"hardbrake": BRAKE}).again()
    assert rig.watch.answers() == {"hardbrake": ACCEPTED}
    rig.brake()
    assert len(edges(rig)) == 1
    rig.watch.desire({})
    assert rig.again().watch.answers() == {}


def test_an_unchanged_trigger_goes_on_when_another_one_comes(tmp_path: Path) -> None:
    rig = Rig(tmp_path, triggers={"slow": {**BRAKE, "when": "current_input < -15 for 2s"}})
    rig.pass_s(1.5, current_input=-20.0)
    rig.watch.desire({"slow": {**BRAKE, "when": "current_input < -15 for 2s"}, "other": BRAKE})
    rig.pass_s(1.5, current_input=-20.0)
    assert {edge.trigger for edge in edges(rig)} == {"slow", "other"}


def test_one_that_cannot_fire_says_so(tmp_path: Path) -> None:
    rig = Rig(
        tmp_path,
        triggers={
            "typo": {"when": "curent_input < -15"},
            "nobody": {"when": "data > 1", "stream": "scan"},
            "mixed": {"when": "current_input == 'low'"},
        },
    )
    rig.pass_s(11)
    answers = rig.watch.answers()
    assert answers["typo"] == "the stream vesc has no field curent_input (did you mean current_input?)"
    assert answers["nobody"] == "no sample of the stream scan since it was added"
    assert "cannot compare a number with a text" in answers["mixed"]
    rig.emit("scan", data=2.0)
    rig.pass_s(2)
    assert rig.watch.answers()["nobody"] == ACCEPTED
    assert [edge.trigger for edge in edges(rig)] == ["nobody"]


def test_silence_is_noticed_without_another_sample_at_its_exact_time(tmp_path: Path) -> None:
    rig = Rig(tmp_path, triggers={"deaf": {"when": "silent(vesc, 2s)"}})
    rig.pass_s(3)
    last_us = rig.clock.now_us() - S // 10
    rig.clock.advance(2.5)
    rig.watch.step()
    assert edges(rig) == []
    rig.clock.advance(1.5)
    rig.watch.step()
    assert [edge.t_us for edge in edges(rig)] == [last_us + 2 * S]
    (incident,) = rig.plan.incidents.values()
    assert incident.ring_from_us == rig.ring.ring_us(incident.from_us)


def test_one_that_costs_too_much_is_refused_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    busy_ns = 0
    sample = Evaluator.sample

    def slow(self: Evaluator, *args: Any) -> Any:
        nonlocal busy_ns
        busy_ns += 40_000_000 if "duty" in self.rule.text else 10_000
        return sample(self, *args)

    monkeypatch.setattr(Evaluator, "sample", slow)
    monkeypatch.setattr(time, "thread_time_ns", lambda: busy_ns)
    rig = Rig(tmp_path, triggers={"dear": {"when": "duty > 1"}, "good": BRAKE})
    for _ in range(12):
        rig.pass_s(1, duty=0.0)
    answers = rig.watch.answers()
    assert answers["good"] == ACCEPTED
    assert answers["dear"].startswith("costs too much: 40% of a core, 40000 us a sample")
    assert "costs too much" in caplog.text
    rig.brake()
    assert [edge.trigger for edge in edges(rig)] == ["good"]
    assert rig.watch.report()["cost_us"]["good"] == 10.0
    # Until it is changed.
    rig.watch.desire({"dear": {"when": "duty > 2"}, "good": BRAKE})
    assert rig.watch.answers()["dear"] == ACCEPTED


def test_times_that_jump_ahead_hide_no_cost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    busy_ns = 0
    sample = Evaluator.sample

    def slow(self: Evaluator, *args: Any) -> Any:
        nonlocal busy_ns
        busy_ns += 4_000_000
        return sample(self, *args)

    monkeypatch.setattr(Evaluator, "sample", slow)
    monkeypatch.setattr(time, "thread_time_ns", lambda: busy_ns)
    rig = Rig(tmp_path, triggers={"hardbrake": BRAKE})
    for i in range(1_500):
        ahead_us = 3_600 * S if i % 10 == 9 else 0
        rig._emit("vesc", rig.clock.now_us() + ahead_us, {"current_input": 0.0})
        rig.clock.advance(0.01)
        rig.watch.step()
    assert rig.watch.answers()["hardbrake"].startswith("costs too much: 40% of a core")


def test_two_clocks_in_a_stream_pass_no_cooldown(tmp_path: Path) -> None:
    rig = Rig(tmp_path, triggers={"hardbrake": {**BRAKE, "cooldown_s": 60.0}})
    for i in range(100):
        ahead_us = 3_600 * S if i % 2 else 0
        for current in (0.0, -20.0):
            rig._emit("vesc", rig.clock.now_us() + ahead_us, {"current_input": current})
            rig.clock.advance(0.25)
        rig.watch.step()
    assert rig.incidents.counts["edges"] > 90
    assert len(edges(rig)) <= 2


def test_one_that_stalls_is_refused_in_the_middle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    busy_ns = 0

    def stall(_self: Evaluator, *_: Any) -> Any:
        nonlocal busy_ns
        busy_ns += 100_000_000
        return ()

    monkeypatch.setattr(Evaluator, "sample", stall)
    monkeypatch.setattr(time, "thread_time_ns", lambda: busy_ns)
    rig = Rig(tmp_path, triggers={"hardbrake": BRAKE})
    rig.pass_s(100, hz=10)
    assert busy_ns < 10_000_000_000
    assert "costs too much" in rig.watch.answers()["hardbrake"]


def test_one_that_raises_is_refused_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sample = Evaluator.sample

    def broken(self: Evaluator, *args: Any) -> Any:
        if "duty" in self.rule.text:
            raise RuntimeError("broken")
        return sample(self, *args)

    monkeypatch.setattr(Evaluator, "sample", broken)
    rig = Rig(tmp_path, triggers={"bad": {"when": "duty > 1"}, "good": BRAKE})
    rig.brake()
    assert rig.watch.answers()["bad"] == "failed: RuntimeError: broken"
    assert [edge.trigger for edge in edges(rig)] == ["good"]


def test_more_samples_than_can_be_evaluated_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_MAX_INBOX", 5)
    rig = Rig(tmp_path, triggers={"hardbrake": BRAKE})
    for _ in range(8):
        rig.emit(current_input=0.0)
    assert rig.watch.report()["unseen"] == 3
    assert len(rig.ring.messages) == 8, "the ring has them all"


def test_an_event_fires_its_triggers(tmp_path: Path) -> None:
    rig = Rig(tmp_path, triggers={"halt": {"on": STOP}, "hardbrake": BRAKE})
    now_us = rig.clock.now_us()
    assert rig.watch.fire(STOP, Edge("", now_us, why="stopped"), rig.ring.now_us()) == 1
    (edge,) = edges(rig)
    assert (edge.trigger, edge.when, edge.why, edge.t_us) == ("halt", "stop", "stopped", now_us)
    assert rig.watch.names(STOP) == ["halt"]


def test_a_fault_code_fires(tmp_path: Path) -> None:
    rig = Rig(tmp_path, triggers={"fault": {"on": "fault"}})
    rig.pass_s(1, fault_code=0)
    rig.emit(fault_code=3)
    rig.clock.advance(0.1)
    rig.pass_s(1, fault_code=0)
    (edge,) = edges(rig)
    assert edge.values == {"fault_code": 3}
