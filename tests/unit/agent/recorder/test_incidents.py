"""From an edge to the file: windows, merges, cooldown, budgets, restarts and what is missing."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, Callable

import pytest
from mcap.reader import make_reader

from iort_agent.common.private_files import write_below
from iort_agent.recorder import incidents, plan
from iort_agent.recorder.account import Losses
from iort_agent.recorder.folder import Drop
from iort_agent.recorder.plan import Edge, Incident, Plan
from iort_contract.messages.recorder import KEPT, LOST, NOTIFIED, OVER_BUDGET, UPLOADED, Take
from iort_contract.topics import ACCEPTED
from testkit.agent import ManualClock
from tests.unit.agent.recorder.rig import BRAKE, T0, FakeRing, Rig, S


class KilledError(BaseException):
    """kill -9."""


def content(path: Path) -> tuple[list[tuple[str, int, int, bytes]], dict[str, dict[str, Any]]]:
    """A file's messages and metadata."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = [
            (channel.topic, message.log_time, message.publish_time, message.data)
            for _, channel, message in reader.iter_messages()
        ]
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    return messages, metadata


def only_file(rig: Rig) -> Path:
    (path,) = rig.files.glob("*.mcap")
    return path


def in_window(ring: FakeRing, from_us: int, to_us: int) -> list[tuple[str, int, int, bytes]]:
    return [
        (message.channel.topic, message.ring_us * 1000, message.t_us * 1000, message.data)
        for message in ring.messages
        if from_us <= message.ring_us <= to_us
    ]


def braked(folder: Path, **changes: Any) -> Rig:
    """A robot that has driven for ten seconds, and braked hard."""
    rig = Rig(folder, triggers={"hardbrake": {**BRAKE, **changes}})
    rig.pass_s(10)
    rig.brake()
    return rig


def full(*_: Any, **__: Any) -> None:
    raise OSError(28, "No space left on device")


def test_an_edge_keeps_the_window_around_it_byte_for_byte(tmp_path: Path) -> None:
    rig = Rig(tmp_path, triggers={"hardbrake": BRAKE})
    rig.pass_s(20)
    edge_us = rig.clock.now_us()
    rig.brake()
    rig.pass_s(1.0)
    rig.cut()
    assert list(rig.files.iterdir()) == [], "the window has not passed"
    rig.pass_s(5)
    rig.cut()
    messages, metadata = content(only_file(rig))
    assert messages == in_window(rig.ring, edge_us - 5 * S, edge_us + 2 * S)
    assert len(messages) == 71
    about = metadata["iort.incident"]
    assert (about["trigger"], about["condition"], about["edge_us"]) == (
        "hardbrake",
        "current_input < -15",
        str(edge_us),
    )
    assert json.loads(about["values"]) == {"current_input": -20.0}
    assert json.loads(about["agent"]) == {"version": "test"}
    assert json.loads(metadata["iort.account"]["/vesc"]) == {"stream": "vesc", "messages": 71, "missing": 0}
    assert rig.upload() == [f"hardbrake-{rig.told[0].id}.mcap"]
    rig.settle()
    assert rig.states() == [KEPT, UPLOADED]
    last = rig.told[-1]
    assert (last.from_us, last.to_us, last.messages, last.missing) == (
        edge_us - 5 * S,
        edge_us + 2 * S,
        71,
        0,
    )
    assert last.key.endswith(".mcap")
    assert last.bytes > 0
    assert rig.plan.incidents == {}, "what has ended is forgotten"


def test_windows_that_overlap_are_one_incident_of_several_triggers(tmp_path: Path) -> None:
    fast = {"when": "current_input < -15", "before_s": 1.0, "after_s": 9.0, "topics": ["/vesc"]}
    rig = Rig(tmp_path, triggers={"hardbrake": {**BRAKE, "topics": ["/vesc"]}, "long": fast})
    rig.pass_s(10)
    edge_us = rig.clock.now_us()
    rig.brake()
    rig.take(2)
    rig.pass_s(15)
    rig.cut()
    _, metadata = content(only_file(rig))
    assert metadata["iort.incident"]["trigger"] == "hardbrake, long"
    assert rig.told[-1].trigger == "hardbrake,long,take"
    assert "current_input=-20" in rig.told[-1].why
    assert (rig.told[-1].from_us, rig.told[-1].to_us) == (edge_us - 5 * S, edge_us + 9 * S)
    assert rig.told[-1].by == "anna"
    # The take wants all topics.
    assert metadata["iort.incident"]["topics"] == "[]"


def test_a_hundred_edges_a_minute_hold_cooldown_and_budget(tmp_path: Path) -> None:
    limited = {**BRAKE, "after_s": 0.0, "before_s": 1.0, "cooldown_s": 10.0, "budget_mb_day": 0.006}
    rig = Rig(tmp_path, triggers={"hardbrake": limited, "tell": {**BRAKE, "notify": True, "cooldown_s": 0}})
    sizes = 0
    for _ in range(200):
        rig.brake()
        rig.clock.advance(0.1)
        rig.cut()
        sizes += sum(path.stat().st_size for path in rig.files.glob("*.mcap"))
        rig.upload()
    kept = {one.id for one in rig.told if one.state == UPLOADED}
    over = [one for one in rig.told if one.state == OVER_BUDGET]
    notified = [one for one in rig.told if one.state == NOTIFIED]
    assert 1 <= len(kept) < 12
    assert len(kept) + len({one.id for one in over}) == 12, "one in ten seconds"
    assert 0 < sizes <= 6000
    assert "budget" in over[0].why or "spent" in over[0].why
    assert len({one.id for one in notified}) <= 120, "one a second at most"
    # Another day has another budget, also after a restart.
    rig.clock.advance(86_400)
    rig = rig.again()
    rig.brake()
    rig.pass_s(3)
    rig.cut()
    assert len(rig.upload()) == 1


def test_cooldown_and_budget_hold_over_a_restart(tmp_path: Path) -> None:
    rig = Rig(tmp_path, triggers={"hardbrake": {**BRAKE, "cooldown_s": 60.0, "budget_mb_day": 1.0}})
    rig.brake()
    rig.pass_s(5)
    rig.cut()
    spent = rig.plan.spent
    rig = rig.again()
    assert rig.plan.spent == spent != {}
    rig.brake()
    assert rig.incidents.counts["cooled"] == 1


def kill_at(patch: pytest.MonkeyPatch, rig: Rig, n: int) -> None:
    """Kill the process at the n-th thing that outlives it, before or after it is done."""
    steps = iter(range(10_000))

    def wrap(call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*args: Any, **named: Any) -> Any:
            if next(steps) == n:
                raise KilledError
            result = call(*args, **named)
            if next(steps) == n:
                raise KilledError
            return result

        return wrapped

    patch.setattr(plan, "write_below", wrap(write_below))
    patch.setattr(Path, "replace", wrap(Path.replace))
    patch.setattr(os, "fsync", wrap(os.fsync))
    patch.setattr(incidents, "_sync", wrap(incidents._sync))
    rig.on_tell = wrap(lambda: None)
    rig.incidents.uploaded = wrap(rig.incidents.uploaded)  # type: ignore[method-assign]  # a kill in it


def test_a_kill_anywhere_repeats_harmlessly(tmp_path: Path) -> None:
    reached = True
    n = 0
    while reached:
        folder = tmp_path / str(n)
        rig = Rig(folder, triggers={"hardbrake": BRAKE})
        reached, uploaded = False, []
        with pytest.MonkeyPatch.context() as patch:
            kill_at(patch, rig, n)
            try:
                rig.pass_s(6)
                rig.brake()
                rig.pass_s(5)
                rig.cut()
                uploaded += rig.upload()
                rig.settle()
            except KilledError:
                reached = True
        rig = rig.again()
        rig.pass_s(8)
        rig.cut()
        uploaded += rig.upload()
        rig.settle()
        ids = {one.id for one in rig.told}
        if not ids:
            # Before the plan was on the disk: the edge is as if it had not been.
            assert n < 6
        else:
            assert len(ids) == 1, n
            assert set(uploaded) == {f"hardbrake-{ids.pop()}.mcap"}, n
            assert rig.told[-1].state == UPLOADED, n
            assert rig.told[-1].messages == 71, n
        assert list(rig.files.iterdir()) == []
        assert rig.plan.incidents == {}
        n += 1
    assert n > 20


def test_a_window_goes_on_over_a_restart_and_begins_in_the_run_before(tmp_path: Path) -> None:
    rig = Rig(tmp_path, triggers={"hardbrake": BRAKE})
    rig.pass_s(10)
    rig = rig.again()
    rig.brake()
    rig = rig.again()
    rig.pass_s(8)
    rig.cut()
    messages, metadata = content(only_file(rig))
    assert len(messages) == 71
    assert len(json.loads(metadata["iort.incident"]["runs"])) == 3


def test_the_clock_may_be_set_back_within_the_window(tmp_path: Path) -> None:
    rig = braked(tmp_path)
    rig.clock.set_wall(T0 - 3600 * S)
    rig.pass_s(8)
    rig.cut()
    messages, _ = content(only_file(rig))
    assert len(messages) == 71


def test_what_is_missing_is_told_with_the_reason(tmp_path: Path) -> None:
    lost: dict[str, Any] = {"/scan": {"messages": 5, "lost_by_middleware": 0}, "bad_crc": 3}
    rig = Rig(tmp_path, triggers={"hardbrake": BRAKE}, report=lambda: lost)
    rig.losses.look(rig.ring.now_us())
    rig.pass_s(10)
    now_us = rig.ring.now_us()
    rig.ring.dropped.append(Drop("vesc", "/vesc", now_us, now_us, 3, "memory"))
    # Two more are gone, and nobody knows why.
    gone = [message for i, message in enumerate(rig.ring.messages) if i not in (80, 81, 82, 83, 84)]
    rig.ring.messages = gone
    rig.brake()
    rig.clock.advance(1)
    lost["/scan"]["lost_by_middleware"] = 7
    lost["bad_crc"] = 4
    rig.losses.look(rig.ring.now_us())
    rig.pass_s(8)
    rig.cut()
    _, metadata = content(only_file(rig))
    account = {topic: json.loads(text) for topic, text in metadata["iort.account"].items()}
    assert account["/vesc"]["missing"] == 5
    assert account["/vesc"]["why"] == {"memory": 3, "not_in_ring": 2}
    assert account["/scan"] == {
        "stream": "",
        "messages": 0,
        "missing": 7,
        "why": {"lost_by_middleware": 7},
    }
    assert account["source"]["why"] == {"bad_crc": 1}
    assert rig.told[-1].missing == 13


def test_an_evicted_begin_is_told_and_a_window_without_messages_is_lost(tmp_path: Path) -> None:
    rig = braked(tmp_path)
    rig.ring.evict(rig.ring.now_us() - 3 * S)
    rig.pass_s(8)
    rig.cut()
    assert "2.5 s after the window" in rig.told[-1].why
    rig.ring.evict(rig.ring.now_us())
    rig.take(30)
    rig.clock.advance(5)
    rig.cut()
    assert rig.told[-1].state == LOST
    assert "the ring has no message of it any more" in rig.told[-1].why


def test_a_full_disk_keeps_the_incident_until_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = braked(tmp_path)
    rig.pass_s(8)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        rig.cut()
        assert list(rig.files.iterdir()) == []
        assert "No space left on device; it is tried again" in str(rig.incidents.alarm)
    rig.clock.advance(120)
    rig.cut()
    assert only_file(rig)
    assert rig.incidents.alarm is None


def test_a_full_disk_until_the_ring_has_nothing_more_loses_it_aloud(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rig = braked(tmp_path)
    rig.pass_s(8)
    rig.ring.evict(rig.ring.now_us())

    monkeypatch.setattr(os, "fsync", full)
    rig.cut()
    assert rig.states() == [KEPT, LOST]
    assert "is lost" in caplog.text
    assert "is lost" in str(rig.incidents.alarm)


def test_a_plan_that_cannot_be_written_is_an_alarm_and_written_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig(tmp_path, triggers={"hardbrake": BRAKE})

    with monkeypatch.context() as patch:
        patch.setattr(plan, "write_below", full)
        rig.brake()
        assert "cannot be written" in str(rig.plan.alarm)
    rig.cut()
    assert rig.plan.alarm is None
    assert len(rig.again().plan.incidents) == 1


def test_a_damaged_plan_is_an_alarm(tmp_path: Path) -> None:
    (tmp_path / plan.FILE).write_text('{"incidents": [{"id"')
    assert "cannot be read" in str(Rig(tmp_path).plan.alarm)


def test_a_trigger_that_is_removed_or_changed_leaves_its_open_window(tmp_path: Path) -> None:
    rig = braked(tmp_path)
    rig.watch.desire({"hardbrake": {**BRAKE, "before_s": 1.0, "topics": ["/scan"]}})
    rig.pass_s(1)
    rig.watch.desire({})
    rig.pass_s(8)
    rig.cut()
    messages, _ = content(only_file(rig))
    assert len(messages) == 71


def test_a_take_is_done_once(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.pass_s(10)
    rig.take(4)
    rig.clock.advance(3)
    rig.cut()
    messages, metadata = content(only_file(rig))
    assert len(messages) == 40
    assert metadata["iort.incident"]["by"] == "anna"
    assert rig.upload()
    rig.settle()
    rig = rig.again()
    rig.take(4)
    rig.settle()
    assert rig.states() == [KEPT, UPLOADED]


def test_incidents_wait_for_the_broker_within_their_room(tmp_path: Path) -> None:
    rig = Rig(tmp_path, triggers={"hardbrake": {**BRAKE, "cooldown_s": 0, "before_s": 0.5}}, max_mb=0.005)
    for _ in range(4):
        rig.brake()
        rig.pass_s(8)
        rig.cut()
    states = {one.id: one.state for one in rig.told}
    assert set(states.values()) == {KEPT, LOST}
    assert "no room" in next(one.why for one in rig.told if one.state == LOST)
    waiting = list(states.values()).count(KEPT)
    assert len(rig.again().upload()) == waiting


def test_long_texts_of_a_condition_do_not_make_the_plan_unreadable(tmp_path: Path) -> None:
    trigger = {
        "when": "said != 'x'",
        "stream": "chatter",
        "before_s": 1.0,
        "after_s": 600.0,
        "cooldown_s": 1.0,
    }
    rig = Rig(tmp_path, triggers={"said": trigger})
    for i in range(20):
        rig.emit("chatter", said="x")
        rig.clock.advance(1)
        rig.emit("chatter", said=f"{i}" * 500_000)
        rig.clock.advance(1)
        rig.watch.step()
    assert len(next(iter(rig.plan.incidents.values())).edges) > 10
    again = rig.again()
    assert again.plan.alarm is None
    assert list(again.plan.incidents) == list(rig.plan.incidents)


def test_a_take_of_a_time_that_has_not_come_is_refused(tmp_path: Path) -> None:
    # The robot's clock is years behind the operator's.
    rig = Rig(tmp_path)
    rig.pass_s(5)
    ahead_us = 3 * 365 * 86_400 * S
    rig.incidents.take(Take("a" * 16, T0 + ahead_us, T0 + ahead_us + 60 * S))
    assert "by the clock of the robot" in rig.plan.takes["a" * 16]
    assert rig.plan.incidents == {}
    rig.incidents.take(Take("b" * 16, T0, T0 + 60 * S))
    assert rig.plan.takes["b" * 16] == ACCEPTED


def test_what_belongs_to_the_queue_is_not_for_incidents(
    tmp_path: Path,
) -> None:
    rig = Rig(tmp_path, triggers={"hardbrake": BRAKE}, reserve=2**60)
    rig.pass_s(10)
    rig.brake()
    rig.pass_s(8)
    rig.cut()
    assert list(rig.files.iterdir()) == []
    assert "of the disk are free; it is tried again" in str(rig.incidents.alarm)


def test_losses_may_be_looked_at_while_an_incident_is_cut() -> None:
    counted = {"lost_by_middleware": 0}
    losses = Losses([("source", lambda: {"/a": dict(counted)})], 0)

    class Meanwhile(int):
        """A time whose comparison takes so long that another thread looks."""

        def __ge__(self, other: int) -> bool:
            counted["lost_by_middleware"] += 1
            losses.look(2 * S)
            return int(self) >= other

    assert losses.between(Meanwhile(S), 3 * S) == {}
    assert losses.between(S, 3 * S)["/a"]["lost_by_middleware"] > 0


def test_what_is_missing_beside_the_window_is_not_missing_in_it(tmp_path: Path) -> None:
    rig = Rig(tmp_path, triggers={"hardbrake": BRAKE})
    rig.pass_s(10)
    edge_us = rig.clock.now_us()
    rig.brake()
    rig.pass_s(8)
    # Half a second before the window, half a second after it, and in it.
    for at_us in (edge_us - 5_500_000, edge_us + 2_500_000, edge_us - S):
        rig.ring.messages = [one for one in rig.ring.messages if abs(one.ring_us - at_us) > 120_000]
    rig.cut()
    _, metadata = content(only_file(rig))
    account = json.loads(metadata["iort.account"]["/vesc"])
    assert account["why"] == {"not_in_ring": 3}
    assert account["messages"] == 71 - 3


def test_a_window_that_reaches_into_one_that_was_cut_begins_where_that_ended(tmp_path: Path) -> None:
    rig = Rig(tmp_path, triggers={"hardbrake": {**BRAKE, "cooldown_s": 0.0}})
    rig.pass_s(10)
    edge_us = rig.clock.now_us()
    rig.brake()
    rig.pass_s(4)
    rig.cut()
    rig.brake()
    rig.pass_s(6)
    rig.cut()
    first, second = (path for path in sorted(rig.files.glob("*.mcap"), key=lambda one: one.stat().st_mtime))
    messages, _ = content(first)
    later, metadata = content(second)
    due = in_window(rig.ring, edge_us - 5 * S, rig.told[-1].to_us)
    assert messages + later == due, "every message once"
    about = metadata["iort.incident"]
    assert about["follows"] == rig.told[0].id
    assert int(about["from_us"]) == int(about["ring_from_us"]) == edge_us + 2 * S + 1
    last = rig.told[-1]
    assert (last.from_us, last.why.partition("; ")[2]) == (edge_us + 2 * S + 1, f"follows {rig.told[0].id}")
    assert (last.messages, last.missing) == (len(later), 0)


def test_it_follows_one_that_was_uploaded_and_forgotten_before_a_restart(tmp_path: Path) -> None:
    rig = braked(tmp_path, cooldown_s=0.0)
    rig.pass_s(4)
    rig.cut()
    rig.upload()
    rig.clock.advance(2)
    rig.cut()
    assert rig.plan.incidents == {}
    rig = rig.again()
    rig.brake()
    rig.pass_s(4)
    rig.cut()
    _, metadata = content(only_file(rig))
    assert metadata["iort.incident"]["follows"] == rig.told[0].id


def test_it_is_whole_where_the_cut_is_of_a_ring_whose_time_was_another(tmp_path: Path) -> None:
    rig = braked(tmp_path, cooldown_s=0.0)
    rig.pass_s(4)
    rig.cut()
    rig.upload()
    # Its folder is lost, and the clock was set back.
    rig = Rig(tmp_path, ManualClock(now_us=T0 - 5 * S))
    rig.pass_s(16)
    rig.brake()
    rig.pass_s(4)
    rig.cut()
    _, metadata = content(only_file(rig))
    about = metadata["iort.incident"]
    assert about["follows"] == ""
    assert int(about["ring_to_us"]) - int(about["ring_from_us"]) == 7 * S


def test_one_that_is_merged_with_an_earlier_window_follows_nothing_any_more(tmp_path: Path) -> None:
    def one(name: str, from_s: int, to_s: int) -> Incident:
        window = from_s * S, to_s * S
        return Incident(name, *window, *window, [Edge("hardbrake", to_s * S)], [])

    plan = Plan(tmp_path)
    plan.note_cut(one("a" * 16, 10, 20))
    late = one("b" * 16, 15, 30)
    plan.follow(late)
    assert (late.follows, late.ring_from_us) == ("a" * 16, 20 * S + 1)
    plan.note_cut(one("d" * 16, 18, 25))
    plan.follow(late)
    assert (late.follows, late.ring_from_us) == (f"{'a' * 16}, {'d' * 16}", 25 * S + 1), (
        "the first has 15 to 18"
    )
    # It could not be cut, and was merged.
    late.merge(one("c" * 16, 5, 31))
    plan.follow(late)
    assert (late.follows, late.ring_from_us) == ("", 5 * S)


@pytest.mark.parametrize("why", ["topics", "take", "budget"])
def test_it_is_whole_where_the_other_file_has_not_all_of_it(tmp_path: Path, why: str) -> None:
    rig = Rig(tmp_path, triggers={"hardbrake": {**BRAKE, "cooldown_s": 0.0}})
    rig.pass_s(10)
    first = {**BRAKE, "cooldown_s": 0.0}
    if why == "topics":
        first["topics"] = ["/scan", "/vesc"]
    if why == "budget":
        first["budget_mb_day"] = 0.000001
    rig.watch.desire({"hardbrake": first})
    rig.brake()
    rig.pass_s(4)
    rig.cut()
    for path in rig.files.glob("*.mcap"):
        path.unlink()
    rig.watch.desire({"hardbrake": {**BRAKE, "cooldown_s": 0.0}})
    if why == "take":
        rig.take(5)
    else:
        rig.brake()
    rig.pass_s(6)
    rig.cut()
    messages, metadata = content(only_file(rig))
    assert metadata["iort.incident"]["follows"] == ""
    assert len(messages) >= 50
