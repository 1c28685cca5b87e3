"""The page's alarms on a condition of one's own: counted before, added to the robot, listed and removed."""

from __future__ import annotations

import pytest

from iort_contract.messages.recorder import Trigger, decode_trigger, encode_trigger
from iort_station.errors import StationError, UsageError
from iort_station.fleet.control import Shadow, slept
from iort_station.page import triggers as page
from iort_station.page.answers import answers, keyed_actions
from tests.unit.station.fleet.test_recorder import START, Lab, S

FAST = {"robot": "car", "stream": "vesc", "when": "speed_mps > 1.5", "cooldown_s": "60"}
RANGE = {"from_us": str(START - S), "to_us": str(START + 10 * S)}


@pytest.fixture
def lab(monkeypatch):
    monkeypatch.setattr(page, "_ANSWER_S", 0.0)
    monkeypatch.setattr("iort_station.page.answers.has_drivers", lambda _cloud: False)
    return Lab()


def test_a_condition_is_counted_over_the_range_and_changes_nothing(lab):
    for second in range(1, 4):
        lab.record("vesc", {"speed": [0, 9000, 0]}, START + second * S)
    found = answers(lab)["dry_run"]({**FAST, **RANGE})
    assert found == {
        "edges": 4,
        "told": 1,
        "samples": 12,
        "times_s": [START / 1e6 + 0.1 + second for second in range(4)],
    }
    assert answers(lab)["dry_run"]({**FAST, **RANGE, "cooldown_s": "1"})["told"] == 1
    assert answers(lab)["dry_run"]({**FAST, **RANGE, "when": "speed_mps > 1.5 for 200ms"})["edges"] == 0
    assert lab.states == {}
    for wrong, says in (
        ({"to_us": str(START + 86_401 * S)}, "at most a day"),
        ({"to_us": str(START - 2 * S)}, "at most a day"),
        ({"when": "sped > 1"}, "sped"),
        ({"when": "speed >"}, "speed >"),
        ({"stream": "odom"}, "has no stream odom"),
        ({"cooldown_s": "0"}, "cooldown_s must be a whole number from 1"),
    ):
        with pytest.raises((StationError, UsageError), match=says):
            answers(lab)["dry_run"]({**FAST, **RANGE, **wrong})


def test_an_alarm_is_a_trigger_that_only_tells_and_shows_the_robots_answer(lab):
    add, remove = (keyed_actions(lab)[name] for name in ("add_trigger", "remove_trigger"))
    assert slept(add({**FAST, "name": "fast"})) == {"accepted": True, "reason": "", "online": True}
    trigger = decode_trigger("fast", lab.triggers()["fast"])
    assert (trigger.when, trigger.notify, trigger.cooldown_s) == ("speed_mps > 1.5", True, 60.0)
    # With the car's gain, which the derived field needs.
    assert trigger.gain == 4614
    entry = {"name": "fast", "stream": "vesc", "when": "speed_mps > 1.5", "cooldown_s": 60.0, "notify": True}
    assert answers(lab)["triggers"]({"robot": "car"}) == {"triggers": [{**entry, "answer": "accepted"}]}
    assert remove({"robot": "car", "name": "fast"}) == {"triggers": []}
    with pytest.raises(StationError, match="car has no trigger fast"):
        remove({"robot": "car", "name": "fast"})


def test_what_a_robot_refuses_is_taken_back_and_one_that_is_away_gets_it_later(monkeypatch):
    monkeypatch.setattr(page, "_ANSWER_S", 0.0)
    lab = Lab("no recorder")
    told = slept(page.add(lab, {**FAST, "name": "fast"}))
    assert told == {"accepted": False, "reason": "no recorder", "online": True}
    assert lab.triggers().get("fast") is None
    away = Lab("", online=False)
    told = slept(page.add(away, {**FAST, "name": "fast"}))
    assert told == {"accepted": None, "reason": "", "online": False}
    assert answers(away)["triggers"]({"robot": "car"})["triggers"][0]["answer"] == ""


def test_what_keeps_messages_is_listed_but_neither_replaced_nor_removed(lab):
    Shadow(lab, "car").desire(encode_trigger(Trigger("brake", when="speed < 0")))
    (entry,) = answers(lab)["triggers"]({"robot": "car"})["triggers"]
    assert (entry["when"], entry["notify"]) == ("speed < 0", False)
    for change in (
        lambda: slept(page.add(lab, {**FAST, "name": "brake"})),
        lambda: page.remove(lab, {"robot": "car", "name": "brake"}),
    ):
        with pytest.raises(UsageError, match="car has a trigger brake that keeps messages"):
            change()
    assert decode_trigger("brake", lab.triggers()["brake"]).when == "speed < 0"


def test_a_trigger_that_cannot_fire_is_refused_before_anything_is_changed(lab):
    for wrong, says in (({"when": "sped > 1"}, "car has no sped in vesc"), ({"name": "a b"}, "a b")):
        with pytest.raises((StationError, UsageError), match=says):
            slept(page.add(lab, {**FAST, "name": "fast", **wrong}))
    assert lab.triggers() == {}
