"""A driver's hold of the stick, without a browser: what it means, when the car may move, why it is over."""

from __future__ import annotations

import itertools
import json
from typing import Any

import pytest

from iort_contract.messages.control.commands import check_by, decode_command
from iort_contract.messages.control.driving import DRIVE_MAX_AGE_MS, DRIVE_MAX_RTT_MS
from local.deployment import ROOT
from tests.web.logic.node import call, run

LIMITS = {
    "command": "drive",
    "speed": "drive.speed",
    "steering": "drive.steering_angle",
    "max_speed_mps": 2.0,
    "max_steering_rad": 0.4,
    "lease_ms": 400,
}
REACH = {"top_mps": 1.0, "max_speed_mps": 2.0, "max_steering_rad": 0.4}
# A car 40 ms away in each direction, and a cloud whose clock is 3 s ahead of this computer's.
# `turn` lets 50 ms pass: the car hears what was sent, and answers at 10 Hz with the outcome that is set.
# `driven` in tests/unit/station/fleet/test_driving.py is the same for the terminal's driver.
CAR = """
const [limits, steps] = given;
let now = 1e6, names = 0, seq = 0, due = 0;
const link = { way: 40, outcome: "accepted", driver: undefined, by: "", silent: false, deaf: false };
const driver = new page.Driver(limits, "ada", () => `0000000${(names += 1)}`);
driver.top_mps = 1;
const sent = [], arriving = [];
const cloud = (at) => at + 3000;
function turn() {
  const command = driver.tick(now);
  if (command) {
    sent.push({ ...command, at: now });
    if (!link.deaf) arriving.push({ at: now + 2 * link.way, command });
  }
  now += 50;
  const had = arriving.filter(({ at }) => at <= now).map(({ command }) => command);
  while (arriving.length && arriving[0].at <= now) arriving.shift();
  if (!link.silent && now >= due) {
    due = now + 100;
    const taken_ms = cloud(now - link.way - 2), sent_ms = cloud(now - link.way);
    const last = had.at(-1);
    const session = link.driver ?? last?.session ?? "";
    const by = { driver: session, driverBy: link.by || "ada", leaseLeft_ms: 300 };
    const driven = last && { session: last.session, seq: last.seq, outcome: link.outcome, ...by };
    driver.hear({ taken_ms, sent_ms, lay_ms: 2, next_ms: 10_000, driven }, now);
  }
}
for (const [times, change = {}] of steps) {
  if ("hold" in change) driver.hold(change.hold, now);
  now += change.pause ?? 0;
  if (change.leave) driver.leave();
  if (change.takeover) driver.askTakeover();
  if ("block" in change) driver.block(change.block);
  if (change.stick) driver.stick = change.stick;
  Object.assign(link, change.link ?? {});
  for (let i = 0; i < times; i += 1) turn();
}
const { phase, reason, other, rtt_ms } = driver;
return { sent, phase, reason, other, rtt_ms, driving: driver.driving(now) };
"""
AHEAD = {"stick": {"x": -1, "y": 1}}


def drive(*steps: Any) -> dict[str, Any]:
    return run("drive/driver.ts", CAR, LIMITS, steps)


VECTORS = json.loads((ROOT / "tests/unit/station/fleet/driving.json").read_text())
EACH = f"const outer = given; return outer[1].map((steps) => ((given) => {{{CAR}}})([outer[0], steps]));"


@pytest.fixture(scope="module")
def driven() -> dict[str, Any]:
    """What the page's driver has done after the steps of each vector."""
    done = run("drive/driver.ts", EACH, VECTORS["limits"], [one["steps"] for one in VECTORS["vectors"]])
    return dict(zip((one["name"] for one in VECTORS["vectors"]), done, strict=True))


@pytest.mark.parametrize("vector", VECTORS["vectors"], ids=lambda vector: vector["name"])
def test_the_pages_driver_does_what_the_vectors_say(driven: dict[str, Any], vector: Any) -> None:
    told, expected = driven[vector["name"]], vector["expected"]
    kinds = (
        [one["session"], *one["message"]["drive"].values(), one["lease_ms"], "takeover" in one, "ends" in one]
        for one in told["sent"]
    )
    assert [[len(list(same)), *kind] for kind, same in itertools.groupby(kinds)] == expected["commands"]
    assert (told["phase"], told.get("rtt_ms")) == (expected["phase"], expected["rtt_ms"])
    # Half a microsecond is rounded.
    ahead_us = [one["sent_us"] - one["at"] * 1000 for one in told["sent"]][-1:]
    assert ahead_us == pytest.approx(expected["ahead_us"], abs=1)


def speeds(told: dict[str, Any]) -> list[float]:
    return [command["message"]["drive"]["speed"] for command in told["sent"]]


@pytest.mark.parametrize(
    ("stick", "motion"),
    [
        ({"x": 0, "y": 0}, (0, 0)),
        ({"x": 0, "y": 1}, (1, 0)),
        ({"x": 0, "y": -0.5}, (-0.5, 0)),
        # To the right is negative, as ROS counts angles.
        ({"x": 1, "y": 1}, (1, -0.4)),
        ({"x": -0.5, "y": 0}, (0, 0.2)),
        ({"x": 7, "y": -9}, (-1, -0.4)),
        ({"x": None, "y": None}, (0, 0)),
    ],
)
def test_a_stick_means_a_motion_within_the_limits(stick: Any, motion: tuple[float, float]) -> None:
    assert tuple(call("drive/stick.ts", "meant", stick, REACH).values()) == motion
    fast = {**REACH, "top_mps": 99}
    assert abs(call("drive/stick.ts", "meant", stick, fast)["speed_mps"]) <= REACH["max_speed_mps"]


def test_keys_a_gamepad_and_a_finger_push_the_stick() -> None:
    def keyed(*codes: str) -> Any:
        return call("drive/stick.ts", "keyed", codes)

    assert keyed("KeyW", "ArrowUp", "KeyA") == {"x": -1, "y": 1}
    assert keyed("KeyW", "KeyS", "Space") == {"x": 0, "y": 0}
    # A stick at rest is not quite at its centre; beyond, nothing jumps.
    assert call("drive/stick.ts", "padded", [0.1, -0.1, 0.05, 0]) == {"x": 0, "y": 0}
    assert call("drive/stick.ts", "padded", [0.12, -1, 0.56, 0]) == {"x": pytest.approx(0.5), "y": 1}
    assert call("drive/stick.ts", "padded", []) == {"x": 0, "y": 0}
    assert call("drive/stick.ts", "pointed", 100, 0, 200) == {"x": 0, "y": 1}
    assert call("drive/stick.ts", "pointed", 900, 250, 200) == {"x": 1, "y": -1}
    # A key takes 0.4 s to the end of the way, and none back to the centre.
    assert call("drive/stick.ts", "followed", {"x": 0, "y": 0.5}, {"x": 1, "y": 1}, 0.1) == {
        "x": 0.25,
        "y": 0.75,
    }
    assert call("drive/stick.ts", "followed", {"x": -1, "y": 1}, {"x": 1, "y": 0}, 0.1) == {"x": 0.25, "y": 0}


def test_a_hold_begins_at_a_standstill_and_moves_once_the_car_has_answered() -> None:
    told = drive([4], [20, {"hold": True, **AHEAD}])
    assert told["phase"] == "driving"
    # As the robot reads them.
    commands = [decode_command(json.dumps({**one, "at": None})) for one in told["sent"]]
    assert {(one.session, one.by, one.lease_ms) for one in commands} == {("00000001", "ada", 350)}
    assert [one.seq for one in commands] == list(range(len(commands)))
    still = speeds(told).index(1)
    assert 1 <= still <= 5
    assert set(speeds(told)[still:]) == {1}
    assert told["sent"][-1]["message"] == {"drive": {"speed": 1, "steering_angle": 0.4}}
    # There and back, without the time in the car; as the page sees it, in steps of 50 ms.
    assert 80 <= told["rtt_ms"] <= 140
    assert told["driving"] == {"by": "ada", "mine": True}
    # By the cloud's time, to within half of what the round trip is known to.
    for one in told["sent"][still:]:
        assert abs(one["sent_us"] / 1e3 - (one["at"] + 3000)) <= 25


def test_letting_go_holds_the_car_and_leaving_gives_it_up_again_in_case_a_message_is_lost() -> None:
    held = drive([4], [20, {"hold": True, **AHEAD}], [100, {"hold": False}])
    assert (held["phase"], speeds(held)[-101:]) == ("holding", [1] + [0] * 100)
    assert not any("ends" in one for one in held["sent"])
    left = drive([4], [20, {"hold": True, **AHEAD}], [10, {"hold": False}], [10, {"leave": True}])
    assert (left["phase"], [one.get("ends") for one in left["sent"]][-4:]) == (
        "free",
        [None, True, True, True],
    )
    # The next hold is a session of its own.
    again = drive([4], [20, {"hold": True, **AHEAD}], [10, {"leave": True}], [20, {"hold": True}])
    assert [one["session"] for one in again["sent"]][-1] == "00000002"
    assert again["phase"] == "driving"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"link": {"silent": True}}, "has not answered for"),
        ({"link": {"deaf": True}}, "has not answered for"),
        ({"link": {"way": 300}}, "round trip takes"),
        ({"link": {"outcome": "emergency_stop"}}, "stopped until somebody releases it"),
        ({"link": {"outcome": "stopped"}}, "no command came in time"),
        ({"link": {"outcome": "driven_by_another", "driver": "ffff", "by": "bob"}}, "bob has taken over"),
        ({"block": "This page is hidden"}, "This page is hidden"),
    ],
)
def test_whatever_stands_against_driving_stops_the_car_until_the_viewer_begins_again(
    change: dict[str, Any], reason: str
) -> None:
    told = drive([4], [20, {"hold": True, **AHEAD}], [40, change])
    assert told["phase"] == "over"
    assert reason in told["reason"]
    assert speeds(told)[-3:] == [0, 0, 0]
    # The obstacle goes away, and the stick is still held: the car stands.
    sound = {"link": {"silent": False, "deaf": False, "way": 40, "outcome": "accepted"}, "block": ""}
    after = drive([4], [20, {"hold": True, **AHEAD}], [40, change], [40, sound])
    assert after["phase"] == "over"
    assert not any(speeds(after)[len(told["sent"]) :])


def test_a_page_that_stood_still_drives_on_in_no_car_however_long_its_leases() -> None:
    steps = [4], [20, {"hold": True, **AHEAD}], [10, {"pause": 600}]
    told = run("drive/driver.ts", CAR, {**LIMITS, "lease_ms": 10_000}, steps)
    assert "stood still for 650 ms" in told["reason"]
    assert speeds(told)[-11:] == [1] + [0] * 10


def test_the_limits_are_those_of_the_contract() -> None:
    told = drive([4], [20, {"hold": True, **AHEAD}], [60, {"link": {"silent": True}}])
    moved = [one["at"] for one in told["sent"] if one["message"]["drive"]["speed"]]
    # The last sample before the silence was 42 ms old at most 100 ms before.
    assert moved[-1] - (1e6 + 24 * 50) <= min(DRIVE_MAX_AGE_MS, DRIVE_MAX_RTT_MS + 200)


@pytest.mark.parametrize(
    ("before", "reason"),
    [
        ([4, {"link": {"silent": True}}], "Nothing has been heard"),
        ([4, {"block": "No connection"}], "No connection"),
    ],
)
def test_a_hold_that_cannot_begin_sends_nothing(before: Any, reason: str) -> None:
    told = drive(before, [10, {"hold": True, **AHEAD}])
    assert (told["sent"], told["phase"]) == ([], "over")
    assert reason in told["reason"]


def test_a_car_that_does_not_answer_never_moves() -> None:
    told = drive([4], [60, {"hold": True, **AHEAD, "link": {"deaf": True}}])
    assert told["reason"] == "The car does not answer"
    assert set(speeds(told)) == {0}


def test_one_drives_and_another_may_take_over_when_asked() -> None:
    other = {"outcome": "driven_by_another", "driver": "ffff", "by": "bob"}
    refused = [8, {"hold": True, **AHEAD, "link": other}]
    told = drive([4], refused)
    assert (told["reason"], told["other"]) == ("bob drives this car", "bob")
    assert set(speeds(told)) == {0}
    assert not any("takeover" in one for one in told["sent"])
    assert told["driving"] == {"by": "bob", "mine": False}
    own = {"outcome": "accepted", "driver": None, "by": ""}
    taken = drive([4], refused, [4, {"hold": False}], [20, {"takeover": True, "hold": True, "link": own}])
    assert taken["phase"] == "driving"
    session = [one for one in taken["sent"] if one["session"] == "00000002"]
    # Only until it has the car: two that insist would throw each other out for ever.
    assert session[0]["takeover"]
    assert "takeover" not in session[-1]


def test_a_wrong_clock_is_corrected_by_the_cars_answer() -> None:
    told = drive(
        [4],
        [2, {"hold": True, **AHEAD, "link": {"outcome": "stale"}}],
        [20, {"link": {"outcome": "accepted"}}],
    )
    assert told["phase"] == "driving"
    forever = drive([4], [30, {"hold": True, **AHEAD, "link": {"outcome": "stale"}}])
    assert "too old when it came" in forever["reason"]
    assert len({one["session"] for one in forever["sent"]}) == 3


# A browser's events at `Inputs`; tells after each step whether the dead-man's switch is held.
HAND = """
const [steps] = given;
class Node extends EventTarget {
  matches = (selector) => selector.split(", ").includes(this.field);
}
globalThis.Element = Node;
globalThis.window = new EventTarget();
globalThis.document = Object.assign(new EventTarget(), { hidden: false, hasFocus: () => true });
let shoulder;
const pad = { connected: true, mapping: "standard", axes: [0, -1] };
const gamepad = () => ({ ...pad, buttons: Array(8).fill({ pressed: shoulder }) });
const getGamepads = () => (shoulder === undefined ? [] : [null, gamepad()]);
Object.defineProperty(globalThis, "navigator", { value: { getGamepads } });
const hand = new page.Inputs(new Node(), new Node(), () => {}, () => {});
return steps.map(([type, { pad, field, ...told } = {}]) => {
  if (pad !== undefined) shoulder = pad ?? undefined;
  const target = Object.assign(new Node(), { field });
  const event = Object.assign(new Event(type, { cancelable: true }), told);
  Object.defineProperty(event, "target", { value: target });
  if (told.prevented) event.preventDefault();
  window.dispatchEvent(event);
  hand.read(0.05);
  return hand.held;
});
"""
DOWN: Any = ["keydown", {"code": "Space"}]
AGAIN: Any = ["keydown", {"code": "Space", "repeat": True}]


@pytest.mark.parametrize(
    ("steps", "held"),
    [
        ([DOWN, AGAIN, ["keyup", {"code": "Space"}]], [True, True, False]),
        # Let go in a text field, which has got the focus meanwhile.
        ([DOWN, ["keyup", {"code": "Space", "field": "textarea"}]], [True, False]),
        # The release of a key is not told while a menu is open, something is dragged, or a Mac's Cmd is held.
        ([DOWN, ["contextmenu"], AGAIN], [True, False, False]),
        ([DOWN, ["contextmenu", {"prevented": True}]], [True, True]),
        ([DOWN, ["dragstart"], AGAIN], [True, False, False]),
        ([DOWN, ["focusin", {"field": "textarea"}], AGAIN], [True, False, False]),
        # The emergency stop ends a hold, and Space presses it.
        ([DOWN, ["focusin", {"field": ".stop-press"}]], [True, False]),
        ([["keydown", {"code": "Space", "field": ".stop-press"}]], [False]),
        ([DOWN, ["keydown", {"code": "MetaLeft", "metaKey": True}], AGAIN], [True, False, False]),
        # A key that is still held when the page gets the focus back is no press; a gamepad's button neither.
        ([DOWN, ["blur"], AGAIN, DOWN], [True, False, False, True]),
        (
            [
                ["x", {"pad": False}],
                ["x", {"pad": True}],
                ["blur"],
                ["x"],
                ["x", {"pad": False}],
                ["x", {"pad": True}],
            ],
            [False, True, False, False, False, True],
        ),
        # A gamepad that was away, and comes back with its button held.
        (
            [["x", {"pad": False}], ["x", {"pad": True}], ["x", {"pad": None}], ["x", {"pad": True}]],
            [False, True, False, False],
        ),
    ],
)
def test_a_dead_mans_switch_whose_release_may_not_be_seen_is_let_go(
    steps: list[Any], held: list[bool]
) -> None:
    assert run("drive/inputs.ts", HAND, steps) == held


def test_clocks_that_contradict_each_other_are_the_newest_message() -> None:
    # This computer slept for an hour after an answer.
    script = """
const clock = new page.CloudClock();
clock.heard(1_000, 1_000); clock.answered(990, 1_000);
clock.heard(3_601_100, 1_100);
return clock.offset_ms;
"""
    assert run("drive/cloud_clock.ts", script) == 3_600_000


@pytest.mark.parametrize(
    ("names", "by"),
    [
        (["\u00a0ada \u202elovelace\t"], "ada  lovelace"),
        (["\u200d", "bob"], "bob"),
        (["", "\x1b"], "somebody"),
        (["Z\u00fcrich \U0001f697"], "Z\u00fcrich \U0001f697"),
    ],
)
def test_a_drivers_name_is_one_that_the_car_takes(names: list[str], by: str) -> None:
    assert call("drive/command.ts", "driverName", *names) == check_by(by)


def test_a_confirmation_is_a_press_of_its_own() -> None:
    script = """
const button = new EventTarget();
let presses = 0;
page.onPress(button, () => (presses += 1));
for (const detail of [1, 2, 0]) button.dispatchEvent(Object.assign(new Event("click"), { detail }));
const held = Object.assign(new Event("keydown", { cancelable: true }), { repeat: true });
// The browser presses the button unless this is prevented.
return [presses, button.dispatchEvent(held)];
"""
    assert run("base/dom.ts", script) == [2, False]
