"""Triggers: their language, the evaluator's edges, the windows, and what the shadow carries of them."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace
from typing import Any, Tuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract import expression
from iort_contract.catalog.streams import CATALOG, INCIDENT_STREAM
from iort_contract.expression import ExpressionError, MismatchError
from iort_contract.limits import ContractError
from iort_contract.messages import recorder
from iort_contract.messages.recorder import (
    FAULT,
    MAX_SPAN_S,
    MAX_TOPICS,
    MAX_TRIGGER_BYTES,
    MAX_TRIGGERS,
    Incident,
    Take,
    Trigger,
    Wanted,
    check_room,
    decode_take,
    decode_trigger,
    encode_removal,
    encode_take,
    encode_trigger,
    incident,
)
from iort_contract.messages.shadow import Reported, decode_desired, decode_reported, encode_reported
from iort_contract.triggers import (
    MAX_AGED,
    MAX_WAITING,
    SETTLE_US,
    Edge,
    Evaluator,
    Window,
    check_trigger,
    cools,
    evaluator_of,
    merge,
    parse_trigger,
    windows,
)
from tests.trigger_vectors import MS, VECTORS, Vector

S = 1_000_000
Sample = Tuple[str, int, Any]


def edges_of(evaluator: Evaluator, samples: list[Sample]) -> list[Edge]:
    found = [edge for stream, t_us, values in samples for edge in evaluator.sample(stream, t_us, values)]
    return [*found, *evaluator.finish()]


def evaluator(when: str, **settings: Any) -> Evaluator:
    return Evaluator(parse_trigger(when), "vesc", **settings)


def of_vector(vector: Vector) -> tuple[Evaluator, list[Sample]]:
    made = evaluator(vector.when, vehicle=vector.vehicle, others=vector.others)
    return made, [(stream, t_ms * MS, values) for stream, t_ms, values in vector.samples]


@pytest.mark.parametrize("name", VECTORS)
def test_samples_make_the_edges_of_the_table(name: str) -> None:
    made, samples = of_vector(VECTORS[name])
    assert edges_of(made, samples) == [Edge(t_ms * MS, values) for t_ms, values in VECTORS[name].edges]


@pytest.mark.parametrize("name", VECTORS)
@given(data=st.data())
def test_neither_the_order_of_arrival_nor_a_clock_changes_an_edge(name: str, data: st.DataObject) -> None:
    made, samples = of_vector(VECTORS[name])
    late = data.draw(st.lists(st.integers(0, SETTLE_US - 1), min_size=len(samples), max_size=len(samples)))
    arrived = [sample for _, sample in sorted(zip(late, samples), key=lambda s: s[0] + s[1][1])]
    found, newest = [], 0
    for stream, t_us, values in arrived:
        found += made.sample(stream, t_us, values)
        newest = max(newest, t_us)
        found += made.advance(data.draw(st.integers(newest - SETTLE_US, newest)))
    found += made.finish()
    assert made.late == 0
    assert found == [Edge(t_ms * MS, values) for t_ms, values in VECTORS[name].edges]


NUMBERS = st.none() | st.booleans() | st.integers(-3, 3) | st.floats(-3, 3, allow_nan=False)
WHENS = ("x > 1", "not x > 1", "x is None or x == 2", "abs(x) < 1 and x / 2 <= 1", "x", "x % 2 == 1")


@pytest.mark.parametrize("when", WHENS)
@given(column=st.lists(NUMBERS, min_size=1))
def test_the_edges_are_the_rises_of_what_a_query_finds(when: str, column: list[Any]) -> None:
    true = expression.holds(expression.parse(when), {"x": column}, len(column))
    rises = [i for i, now in enumerate(true) if now and not (i and true[i - 1])]
    samples = [("vesc", i * 10 * MS, {"x": value}) for i, value in enumerate(column)]
    assert [edge.t_us // (10 * MS) for edge in edges_of(evaluator(when), samples)] == rises


@given(column=st.lists(st.integers(0, 9), min_size=1, max_size=40), every=st.integers(1, 400))
def test_delta_is_the_change_since_the_newest_value_that_is_old_enough(column: list[int], every: int) -> None:
    samples = [("vesc", i * every * MS, {"x": value}) for i, value in enumerate(column)]
    change = [
        value - old[-1] if (old := [column[j] for j in range(i) if (i - j) * every >= 1_000]) else None
        for i, value in enumerate(column)
    ]
    true = [one is not None and one > 2 for one in change]
    rises = [i * every * MS for i, now in enumerate(true) if now and not (i and true[i - 1])]
    assert [edge.t_us for edge in edges_of(evaluator("delta(x, 1s) > 2"), samples)] == rises


def test_an_edge_is_told_once_it_is_certain() -> None:
    made = evaluator("x > 1 or silent(vesc, 1s)")
    assert made.sample("vesc", 0, {"x": 0}) == ()
    assert made.sample("vesc", 100 * MS, {"x": 2}) == ()
    assert [edge.t_us for edge in made.advance(100 * MS + SETTLE_US)] == [100 * MS]
    assert made.sample("vesc", 400 * MS, {"x": 0}) == ()
    assert made.advance(1_400 * MS + SETTLE_US - 1) == ()
    assert [edge.t_us for edge in made.sample("imu", 1_400 * MS + SETTLE_US, {})] == [1_400 * MS]


def test_samples_that_come_too_late_are_counted() -> None:
    made = evaluator("x > 1")
    made.sample("vesc", 0, {"x": 0})
    made.sample("vesc", S, {"x": 0})
    made.sample("vesc", 2 * S, {"x": 0})
    assert made.sample("vesc", S, {"x": 2}) == ()
    assert made.late == 1
    assert made.finish() == ()


def test_a_time_that_stands_still_fills_no_memory() -> None:
    made = evaluator("x > 1")
    edges = [edge for i in range(3 * MAX_WAITING) for edge in made.sample("vesc", S, {"x": min(i, 2)})]
    assert len(made._waiting) <= MAX_WAITING
    assert [edge.t_us for edge in edges] == [S]
    assert [edge.t_us for edge in edges_of(made, [("vesc", 2 * S, {"x": 0}), ("vesc", 3 * S, {"x": 2})])] == [
        3 * S
    ]


def test_a_delta_of_too_many_samples_is_refused() -> None:
    made = evaluator("delta(x, 60s) > 1")
    with pytest.raises(ContractError, match="more than 20000 samples: choose a shorter one"):
        edges_of(made, [("vesc", i * MS, {"x": 0}) for i in range(30_000)])
    assert edges_of(evaluator("delta(x, 10s) > 1"), [("vesc", i * MS, {"x": 0}) for i in range(30_000)]) == []


def test_a_condition_has_few_deltas() -> None:
    parse_trigger(" or ".join(f"delta(x, {i}s) > 1" for i in range(1, MAX_AGED + 1)))
    with pytest.raises(ExpressionError, match="at most 4 of delta"):
        parse_trigger(" or ".join(f"delta(x, {i}s) > 1" for i in range(1, MAX_AGED + 2)))


def test_a_clock_that_was_set_back_begins_anew() -> None:
    made = evaluator("x > 1")
    made.sample("vesc", 3_600 * S, {"x": 0})
    made.sample("vesc", 3_601 * S, {"x": 2})
    assert [edge.t_us for edge in made.sample("vesc", S, {"x": 0})] == [3_601 * S]
    assert [edge.t_us for edge in edges_of(made, [("vesc", 2 * S, {"x": 2})])] == [2 * S]
    assert made.late == 0


@pytest.mark.parametrize(
    ("when", "place", "told"),
    [
        ("", 0, "invalid expression"),
        ("speed >", 7, "invalid expression"),
        ("speed > 1s", 8, "a duration belongs in delta(), in silent() or after for"),
        ("delta(speed)", 0, "delta needs a field and a duration: delta(field, 1s)"),
        ("delta(speed, 5) > 1", 13, "a duration is a number with ms, s, min or h"),
        ("delta(speed, '1s') > 1", 13, "a duration is a number"),
        ("delta(speed + 1, 1s) > 1", 6, "delta is of a field"),
        ("delta(speed, 61s) > 1", 13, "more than 0 and at most 60 s"),
        ("delta(speed, 0s) > 1", 13, "more than 0"),
        ("'a' + delta(speed, 1s)", 0, "cannot calculate with a text"),
        ("silent(scan)", 0, "silent needs a stream and a duration: silent(stream, 1s)"),
        ("silent('my scan', 1s)", 7, "stream name must be 1 to 64"),
        ("silent(scan, 2h)", 13, "at most 3600 s"),
        ("speed > 1 for", 10, "invalid expression"),
        ("speed > 1 for 2", 14, "a duration is a number with ms, s, min or h, such as 2s"),
        ("speed > 1 for 2d", 14, "a duration is"),
        ("speed > 1 for 0s", 14, "more than 0"),
        ("speed > 1 for 2s and x", 14, "a duration is"),
        ("1 > 0", 0, "a condition without a field is always true or never"),
        ("rate(speed, 1s) > 1", 0, "the only functions are abs(x), delta(field, 1s) and silent(stream, 1s)"),
        ("speed > 1 and 'ü' == delta(speed)", 21, "delta needs"),
        ("x == 1" + " " * 2_000, 0, "at most 1000 characters"),
    ],
)
def test_a_condition_outside_the_language_is_shown_where(when: str, place: int, told: str) -> None:
    with pytest.raises(ExpressionError) as raised:
        parse_trigger(when)
    assert told in str(raised.value)
    # Of an invalid syntax, each Python has its own place.
    assert abs(raised.value.position - place) <= ("invalid" in told)


@given(st.text(max_size=30) | st.text("xs1.()' ,><=deltasilentfor", max_size=40))
def test_any_text_is_parsed_or_refused(when: str) -> None:
    try:
        rule = parse_trigger(when)
    except ExpressionError:
        return
    assert rule.fields or rule.silences


def test_durations_within_texts_are_texts() -> None:
    rule = parse_trigger("""frame == 'for 2s' and note != "a, 1s\\" 2s" and delta(x1s, 1.5s) > 0""")
    assert rule.fields == ("frame", "note", "x1s")
    assert rule.deltas == {"delta(x1s, 1.5s)": ("x1s", 1_500 * MS)}
    assert rule.for_us == 0
    assert parse_trigger("note == 'wait for 2s'").for_us == 0
    waits = parse_trigger("note == 'wait for me' and x for 1.5s")
    assert (waits.fields, waits.for_us) == (("note", "x"), 1_500 * MS)
    assert parse_trigger("silent(front-cam, 1min)").silences == {
        "silent(front-cam, 1min)": ("front-cam", 60 * S)
    }


@pytest.mark.parametrize(
    ("when", "values", "told"),
    [
        ("x > 1", {"x": "map"}, "cannot compare a number with a text: x is a text, 1 is a number"),
        ("x + 1 > 1", {"x": "map"}, "cannot calculate with a text: x is a text, 1 is a number"),
        ("x == 'map'", {"x": 1.5}, "cannot compare a number with a text: x is a number, 'map' is a text"),
        ("delta(x, 1s) > 1", {"x": "map"}, "delta(x, 1s) is a text"),
    ],
)
def test_a_condition_that_mixes_numbers_and_texts_is_refused_at_each_sample(
    when: str, values: Any, told: str
) -> None:
    made = evaluator(when)
    made.sample("vesc", 0, {"x": None})
    made.sample("vesc", MS, values)
    for _ in range(2):
        with pytest.raises(MismatchError) as raised:
            made.sample("vesc", made._newest + S, values)
        assert told in str(raised.value)


def test_unknown_parameters_and_streams_are_refused() -> None:
    with pytest.raises(ContractError, match="speed_mps needs the vehicle's parameters speed_to_erpm_gain"):
        check_trigger(Trigger("fast", "speed_mps > 2"))
    check_trigger(Trigger("fast", "speed_mps > 2", gain=4614.0))
    with pytest.raises(ContractError, match="no field of the stream pose"):
        check_trigger(Trigger("fast", "speed > 2", others=("pose",)))
    with pytest.raises(ExpressionError):
        check_trigger(Trigger("fast", "speed > "))
    with pytest.raises(ContractError, match="rtt is the agent's own stream, which fires no trigger"):
        check_trigger(Trigger("slow", "broker_ms > 100", stream="rtt"))
    assert evaluator("x > 1 and pose.y > 1 and silent(scan, 1s)", others=("pose",)).streams == {
        "vesc", "pose", "scan",
    }  # fmt: skip


def test_a_fault_is_a_condition_and_other_events_have_none() -> None:
    made = evaluator_of(Trigger("fault", on=FAULT))
    assert made is not None
    faults = [("vesc", i * S, {"fault_code": code}) for i, code in enumerate((0, 3, 3, 0))]
    assert edges_of(made, faults) == [Edge(S, {"fault_code": 3})]
    assert evaluator_of(Trigger("stop", on="stop")) is None


# Windows.


def at(*seconds: float) -> list[Edge]:
    return [Edge(round(second * S), {}) for second in seconds]


def spans(found: list[Window]) -> list[tuple[float, float, int]]:
    return [(window.from_us / S, window.to_us / S, len(window.edges)) for window in found]


@pytest.mark.parametrize(
    ("seconds", "cooldown", "expected"),
    [
        ((), 0, []),
        ((100,), 0, [(70, 110, 1)]),
        ((100, 105), 0, [(70, 115, 2)]),
        ((100, 105), 5, [(70, 115, 2)]),
        ((100, 105), 6, [(70, 110, 1)]),
        ((100, 105, 110), 6, [(70, 120, 2)]),
        ((100, 140), 0, [(70, 150, 2)]),
        ((100, 141), 0, [(70, 110, 1), (111, 151, 1)]),
    ],
)
def test_windows_are_merged_and_edges_in_a_cooldown_ignored(
    seconds: tuple[float, ...], cooldown: float, expected: list[Any]
) -> None:
    assert spans(windows(at(*seconds), 30 * S, 10 * S, round(cooldown * S))) == expected


def test_an_incident_has_a_greatest_length() -> None:
    found = spans(windows(at(*range(0, 10_000, 30)), 30 * S, 10 * S, 0))
    assert max(to - start for start, to, _ in found) <= MAX_SPAN_S
    assert sum(edges for *_, edges in found) == len(range(0, 10_000, 30))


def test_windows_of_several_triggers_are_merged() -> None:
    one, other = Window(0, 10, (Edge(5, {}),)), Window(8, 30, (Edge(4, {}),))
    assert merge(one, other) == merge(other, one) == Window(0, 30, (Edge(4, {}), Edge(5, {})))
    assert merge(one, Window(11, 20, ())) is None


def test_a_clock_that_was_set_back_ends_a_cooldown() -> None:
    assert cools(100, 105, 10)
    assert not cools(100, 95, 10)
    assert not cools(None, 0, 10)


# The shadow.

FULL = Trigger(
    "hardbrake",
    "current_input < -15 and speed_mps > 2 and pose.x > 1",
    others=("pose",),
    before_s=60,
    after_s=5,
    topics=("/camera/*", "vesc"),
    cooldown_s=10,
    budget_mb_day=500,
    notify=True,
    gain=4614.0,
    offset=1.0,
)


@pytest.mark.parametrize("trigger", [FULL, Trigger("stop", on="stop"), Trigger("a", "x > 1")])
def test_a_trigger_comes_through_the_shadow(trigger: Trigger) -> None:
    change = encode_trigger(trigger)["recorder"]["triggers"][trigger.name]
    # Null removes what an earlier trigger of the name had; where nothing was, it may stay.
    assert decode_trigger(trigger.name, json.loads(json.dumps(change))) == trigger
    stored = json.loads(json.dumps({key: value for key, value in change.items() if value is not None}))
    wanted = decode_desired({"recorder": {"triggers": {trigger.name: stored}}, "log_level": "info"})
    assert decode_trigger(trigger.name, wanted.recorder.triggers[trigger.name]) == trigger
    assert wanted.settings == {"log_level": "info"}
    assert {*change, "name"} == set(vars(trigger))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"name": "a b"}, "trigger name must be 1 to 64"),
        ({"on": "crash"}, "on must be one of stop, disconnect, fault, service, finding"),
        ({"on": "stop"}, "either a condition (when) or an event (on)"),
        ({"when": ""}, "either a condition (when) or an event (on)"),
        ({"when": "x > 1 or " * 50 + "x"}, "the condition must be at most 400 characters"),
        ({"stream": "a/b"}, "stream name must be"),
        ({"others": ("a/b",)}, "stream name must be"),
        ({"before_s": 601}, "before must be 0 to 600 s, got 601"),
        ({"before_s": float("nan")}, "before must be 0 to 600 s, got nan"),
        ({"after_s": -1}, "after must be 0 to 600 s"),
        ({"cooldown_s": 1e6}, "cooldown must be 0 to 86400 s"),
        ({"budget_mb_day": -1}, "budget must be 0 to"),
        ({"topics": ("/a b",)}, "topic must be a ROS topic or a stream"),
        ({"topics": ("/a",) * 17}, "at most 16 patterns of topics, got 17"),
        ({"topics": ("/" + "a" * 120,) * 6}, f"at most {MAX_TRIGGER_BYTES} bytes as JSON"),
        ({"gain": float("inf")}, "must be finite"),
    ],
)
def test_a_trigger_that_is_not_allowed_is_refused(change: dict[str, Any], told: str) -> None:
    with pytest.raises(ContractError) as raised:
        check_trigger(replace(FULL, **change))
    assert told in str(raised.value)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (None, "'a' must be an object"),
        ({"when": 5}, "when must be a text, got 5"),
        ({"when": "x", "befor_s": 3}, "unknown entry 'befor_s'; must be one of after_s, before_s"),
        ({"when": "x", "topics": "/a"}, "topics must be a list of names"),
        ({"when": "x", "before_s": True}, "before_s must be a number"),
    ],
)
def test_a_trigger_of_another_form_is_refused(content: Any, told: str) -> None:
    with pytest.raises(ContractError) as raised:
        decode_trigger("a", content)
    assert told in str(raised.value)


def test_what_is_null_in_the_shadow_is_as_if_it_were_not_there() -> None:
    written = encode_trigger(Trigger("a", "x > 1"))["recorder"]["triggers"]["a"]
    assert written["topics"] is None
    assert decode_trigger("a", written) == Trigger("a", "x > 1")


TAKE = Take("feedbeef", 5 * S, 65 * S, "anna", "it drifted", ("/camera/*",))


def test_a_take_comes_through_the_shadow_and_the_oldest_gives_way() -> None:
    waiting: dict[str, Any] = {}
    for i in range(6):
        take = replace(TAKE, id=f"{i:08x}", from_us=i * S, to_us=(i + 1) * S)
        for name, content in encode_take(take, waiting)["recorder"]["takes"].items():
            waiting.pop(name, None)
            if content is not None:
                waiting[name] = {key: value for key, value in content.items() if value is not None}
        assert decode_take(take.id, json.loads(json.dumps(waiting[take.id]))) == take
    assert sorted(waiting) == [f"{i:08x}" for i in range(2, 6)]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"id": "x"}, "take id must be 8 to 32 of 0-9 a-f"),
        ({"to_us": 5 * S}, "a take must span more than 0"),
        ({"to_us": 5_000 * S}, "at most 1800 s"),
        ({"from_us": 2**60}, "from_us must be whole microseconds"),
        ({"why": "a" * 161}, "why must be at most 160 characters"),
        ({"topics": ("a b",)}, "topic must be"),
    ],
)
def test_a_take_that_is_not_allowed_is_refused(change: dict[str, Any], told: str) -> None:
    with pytest.raises(ContractError) as raised:
        encode_take(replace(TAKE, **change), {})
    assert told in str(raised.value)


def desired_of(change: dict[str, Any]) -> dict[str, Any]:
    """What AWS keeps of a change of nothing."""
    return {
        name: {key: value for key, value in one.items() if value is not None} for name, one in change.items()
    }


def test_takes_that_were_answered_give_way_before_one_that_waits() -> None:
    def at(i: int) -> Take:
        return replace(TAKE, id=f"{i:08x}", from_us=i * S, to_us=(i + 1) * S)

    takes = {at(i).id: {"to_us": at(i).to_us} for i in range(4)}
    done = [at(i).id for i in (1, 2, 3)]
    change = encode_take(at(4), takes, done)["recorder"]["takes"]
    assert [name for name, content in change.items() if content is None] == [at(1).id]
    later = encode_take(at(5_000), takes, done)["recorder"]["takes"]
    assert [name for name, content in later.items() if content is None] == done


def test_triggers_takes_and_answers_leave_room_in_the_shadow() -> None:
    triggers: dict[str, Any] = {}
    takes: dict[str, Any] = {}
    for i in range(MAX_TRIGGERS):
        trigger = Trigger(f"{i}" * 64, "x > 1 or " * 40 + "x", topics=("/" + "b" * 60,))
        with suppress(ContractError):
            change = check_room(Wanted(triggers, takes), encode_trigger(trigger))
            triggers.update(desired_of(change["recorder"]["triggers"]))
    assert len(triggers) < MAX_TRIGGERS
    take = replace(TAKE, by="\u00e4" * 160, why="w" * 160, topics=("/" + "t" * 127,) * MAX_TOPICS)
    with pytest.raises(ContractError, match="its shadow has no more room"):
        check_room(Wanted(triggers, takes), encode_take(take, takes))
    # What makes it smaller is allowed, whoever has written it.
    full = Wanted({**triggers, "a": {"when": "x" * 5_000}})
    check_room(full, encode_removal("a"))
    check_room(full, encode_trigger(Trigger("a", "x > 1")))

    answers = {**dict.fromkeys(triggers, "why not " * 100), **{f"{i:032x}": "no" * 100 for i in range(4)}}
    reported = encode_reported(Reported(recorder=answers))["recorder"]
    assert len(json.dumps(triggers)) + len(json.dumps(reported)) < 6_200
    many = Reported(recorder={f"t{i}": "must be an object, got 1" for i in range(1_000)})
    assert len(json.dumps(encode_reported(many)["recorder"])) < 1_000


def test_the_answers_come_through_the_shadow() -> None:
    reported = Reported(recorder={"a": "accepted", "b": "the stream scan is unknown"})
    assert decode_reported(json.loads(json.dumps(encode_reported(reported)))).recorder == reported.recorder
    assert decode_reported({"recorder": {"a": 5}}).recorder == {}
    assert decode_reported({"recorder": 5}).recorder == {}
    assert decode_desired({"recorder": 5}).recorder == recorder.Wanted()


def test_an_incident_is_a_sample_of_its_stream() -> None:
    kept = Incident("feedbeef", "hardbrake", 0, 40 * S, "kept", condition="x > 1", messages=12)
    assert set(kept.sample()) == {field.name for field in CATALOG[INCIDENT_STREAM].fields}
    assert incident(kept.sample()) == kept
    for change in ({"state": "gone"}, {"id": "x"}, {"from_us": "x"}):
        with pytest.raises(ContractError):
            incident({**kept.sample(), **change})


def test_a_vehicle_comes_with_its_trigger() -> None:
    made = evaluator_of(Trigger("fast", "speed_mps > 1", gain=2.0, offset=1.0))
    assert made is not None
    assert edges_of(made, [("vesc", 0, {"speed": 5.0})]) == [Edge(0, {"speed_mps": 2.0})]
