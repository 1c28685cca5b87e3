"""A driver's hold of the stick: the table of vectors that the page has too, and `iort drive`."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from iort_contract.messages.commands import (
    CLOCK_UNKNOWN,
    REFUSALS,
    DriveLimits,
    decode_command,
    encode_command,
)
from iort_contract.messages.live import LiveSample
from iort_station.cli.verbs.drive import FIRST_US, NEXT_US, Keys, _Seat, keys_of
from iort_station.errors import StationError
from iort_station.fleet import stopping
from iort_station.fleet.driving import Driver, Phase, Stick
from tests.unit.agent.sources.test_sim import CAR_LIMITS, Commanded

LIMITS = DriveLimits("drive", "drive.speed", "drive.steering_angle", 2.0, 0.4, 500)
SENT = LiveSample("0badcafe", 0, 0, 0, {}, offset_us=0)


VECTORS = json.loads(Path(__file__).with_name("driving.json").read_text())
LINK = {"way": 40, "outcome": "accepted", "driver": None, "by": "", "silent": False, "deaf": False}


def driven(limits: Mapping[str, Any], steps: list[Any], picture_ms: int | None = None) -> dict[str, Any]:
    """What a driver has done after the steps; a step is how often 50 ms pass, and what changes before. The
    car is ``way`` ms away in each direction, answers at 10 Hz, and its clock is 3 s ahead. While ``see`` is a
    number, each time a picture of that age comes on the screen. `drive` in station/web/test/drive.test.ts is
    the same for the page's driver."""
    names = (f"{i:08d}" for i in itertools.count(1))
    picture_us = None if picture_ms is None else picture_ms * 1000
    driver = Driver(DriveLimits(**limits), "ada", 1.0, lambda: next(names), picture_us=picture_us)
    now = due = 1_000_000
    see, shown = None, 0

    def look() -> None:
        nonlocal shown
        if see is not None:
            shown += 1
            driver.see(shown, see * 1000, now * 1000)

    link, sent, arriving, behind = dict(LINK), [], [], []
    for times, change in ((step[0], step[1] if step[1:] else {}) for step in steps):
        see = change.get("see", see)
        look()
        if "shown" in change:
            driver.see(None, 0, now * 1000)
        driver.blind = change.get("blind", driver.blind)
        if "hold" in change:
            driver.hold(held=change["hold"], now_us=now * 1000)
        now += change.get("pause", 0)
        driver.takeover = driver.takeover or "takeover" in change
        if "leave" in change:
            driver.leave()
        if "stick" in change:
            driver.stick = Stick(change["stick"]["y"], -change["stick"]["x"])
        link.update(change.get("link", {}))
        for _ in range(times):
            command = driver.tick(now * 1000)
            if command is not None:
                sent.append((now, decode_command(encode_command(command))))
                behind.append(None if command.frame is None else shown - command.frame)
                if not link["deaf"]:
                    arriving.append((now + 2 * link["way"], command))
            now += 50
            look()
            came = [one for at, one in arriving if at <= now]
            arriving = [one for one in arriving if one[0] > now]
            if link["silent"] or now < due:
                continue
            due = now + 100
            sample: dict[str, Any] = {}
            if came:
                session = link["driver"] or came[-1].session
                said = {
                    "session": link.get("session", came[-1].session),
                    "seq": came[-1].seq,
                    "outcome": link["outcome"],
                }
                sample = {**said, "driver": session, "driver_by": link["by"] or "ada", "lease_left_ms": 300}
            t_us, sent_us = ((now - link["way"] - lay + 3000) * 1000 for lay in (2, 0))
            live = replace(SENT, t_us=t_us, sent_us=sent_us, sample=sample)
            live = replace(live, offset_us=None) if "clockless" in link else live
            driver.hear("drive" if came else "vesc", live, now * 1000)
    return {
        "phase": driver.phase.value,
        "reason": driver.reason,
        "sent": sent,
        "behind": None if picture_ms is None else behind,
        "rtt_ms": None if driver.rtt_us is None else driver.rtt_us / 1000,
    }


def told(driver: Mapping[str, Any]) -> dict[str, Any]:
    """A driver's doing as the vectors have it: how many commands of each kind, one after the other."""
    kinds = [
        [one.session, *one.message["drive"].values(), one.lease_ms, one.takeover, one.ends]
        for _, one in driver["sent"]
    ]
    if driver["behind"] is not None:
        kinds = [
            [*kind, behind, one.blind]
            for kind, behind, (_, one) in zip(kinds, driver["behind"], driver["sent"], strict=True)
        ]
    runs = [[len(list(same)), *kind] for kind, same in itertools.groupby(kinds)]
    ahead_us = [one.sent_us - at * 1000 for at, one in driver["sent"]][-1:]
    return {"phase": driver["phase"], "rtt_ms": driver["rtt_ms"], "commands": runs, "ahead_us": ahead_us}


@pytest.mark.parametrize("vector", VECTORS["vectors"], ids=lambda vector: vector["name"])
def test_the_driver_does_what_the_vectors_say(vector: Any) -> None:
    done = driven(VECTORS["limits"], vector["steps"], vector.get("picture_ms"))
    assert told(done) == vector["expected"]


HELD = [[4], [20, {"hold": True, "stick": {"x": 1, "y": 1}}]]
FORBIDDEN = [
    ({"session": "bbbbbbbb", "driver": "bbbbbbbb", "by": "bert"}, "bert has taken over"),
    ({"outcome": "driven_by_another", "driver": "bbbbbbbb", "by": "bert"}, "bert has taken over"),
    ({"outcome": "emergency_stop"}, "stopped until somebody releases it"),
    ({"outcome": "no_ros"}, "not in the ROS graph"),
    ({"outcome": "stopped"}, "the car was stopped"),
    ({"deaf": True}, "500 ms are allowed"),
    ({"silent": True}, "500 ms are allowed"),
    ({"way": 300}, "500 ms are allowed"),
    ({"clockless": True}, REFUSALS[CLOCK_UNKNOWN]),
]


@pytest.mark.parametrize(("link", "reason"), FORBIDDEN)
def test_a_hold_that_ends_says_why_and_moves_nothing_until_the_driver_lets_go(link: Any, reason: str) -> None:
    steps = [*HELD, [30, {"link": link}]]
    done = driven(VECTORS["limits"], steps)
    assert done["phase"] == "over"
    assert reason in done["reason"]
    count = len(done["sent"])
    later = driven(VECTORS["limits"], [*steps, [40, {"link": LINK}]])
    assert later["phase"] == "over"
    assert not any(one.message["drive"]["speed"] for _, one in later["sent"][count:])


@pytest.mark.parametrize(
    ("steps", "reason"),
    [
        ([*HELD, [10, {"pause": 2000}]], "stood still for 20"),
        ([*HELD, [2, {"hold": False}], [30, {"link": {"silent": True}}], [2, {"hold": True}]], "1000 ms are"),
        ([[2, {"hold": True}]], "nothing has been heard of the car yet"),
        ([[4], [60, {"hold": True, "link": {"deaf": True}}]], "the car does not answer"),
    ],
)
def test_no_hold_goes_on_by_old_keys_or_samples(steps: Any, reason: str) -> None:
    done = driven(VECTORS["limits"], steps)
    assert done["phase"] == "over"
    assert reason in done["reason"]


def test_a_command_is_the_drivers_own_within_both_limits() -> None:
    sent = [one for _, one in driven(VECTORS["limits"], HELD)["sent"]]
    assert sent[-1].message == {"drive": {"speed": 1.0, "steering_angle": -0.4}}
    assert {(one.by, one.lease_ms, one.takeover) for one in sent} == {("ada", 350, False)}


def test_a_terminals_arrows_and_letters_are_keys() -> None:
    assert keys_of("wW\x1b[A\x1bOD \x1b[C\x1b") == (["w", "w", "up", "left", " ", "right"], "\x1b")


def test_no_other_key_is_taken_for_the_letters_of_its_sequence() -> None:
    # F4, Shift and left, delete, and an arrow whose end has not come yet.
    assert keys_of("\x1bOS\x1b[1;2D\x1b[3~\x1b[") == (["\x1b"] * 3, "\x1b[")


def test_keys_that_waited_for_the_network_move_nothing_until_they_fail_to_come() -> None:
    keys, wait_us = Keys(), NEXT_US - 1
    burst, _ = keys_of("w" * 40)
    for came in (burst, burst[:3], ["w"]):
        wait_us += NEXT_US - 1
        keys.arrived(came, wait_us)
        assert all(keys.press(key, wait_us) for key in came)
        assert keys.late(wait_us)
        assert not keys.held(wait_us)
    keys.press("w", wait_us + NEXT_US)
    assert keys.held(wait_us + NEXT_US)


def test_a_key_holds_the_stick_until_its_repetitions_fail_to_come() -> None:
    keys = Keys()
    assert keys.press("w", 0)
    assert keys.stick(FIRST_US - 1) == Stick(1.0, 0.0)
    for now_us in range(500_000, 1_000_000, 30_000):
        assert keys.press("w", now_us)
    assert keys.held(now_us + NEXT_US - 1)
    assert not keys.held(now_us + NEXT_US)
    assert keys.stick(now_us + NEXT_US) == Stick()


def test_the_speed_stays_while_another_key_steers() -> None:
    keys = Keys()
    keys.press("w", 0)
    for now_us in range(100_000, 1_000_000, 50_000):
        keys.press("a", now_us)
    assert keys.stick(now_us) == Stick(1.0, 1.0)
    keys.press("w", now_us + 100_000)
    assert keys.stick(now_us + NEXT_US) == Stick(1.0, 0.0)
    keys.let_go()
    assert keys.stick(now_us + NEXT_US) == Stick()
    assert not keys.press("x", now_us)


class Cloud:
    namespace = "iort"

    def urgent(self) -> Cloud:
        return self


def test_the_emergency_stop_ends_the_hold_at_once_and_is_not_taken_for_done_if_it_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    driver = Driver(LIMITS, "anna", 1.0)
    seat: Any = _Seat(Cloud(), "car7", driver)  # type: ignore[arg-type]  # a fake
    sent: list[Any] = []
    seat.broker.publish = lambda topic, message: sent.append((topic, message))
    driver.phase, driver._held, driver._session = Phase.STARTING, True, "0badcafe"

    def stop(_cloud: Any, robots: list[str], *, by: str) -> dict[str, str]:
        assert by == "anna"
        assert decode_command(sent[-1][1]).ends
        return {robots[0]: "Throttling"}

    monkeypatch.setattr(stopping, "stop", stop)
    with pytest.raises(StationError, match="emergency stop of car7 has failed: Throttling"):
        seat._press("e", 1_000_000)


def test_a_driver_who_has_let_go_holds_the_car_and_leaves_it_to_its_own_driver_with_the_wheel() -> None:
    car, driver = Commanded(), Driver(CAR_LIMITS, "anna", 1.0)
    speeds: list[float] = []

    def drive(seconds: float) -> list[float]:
        """The car hears the driver's commands, and its answers come back at once."""
        before = len(speeds)
        for _ in range(round(seconds * 20)):
            now_us = car.rig.clock.now_us()
            heard = LiveSample("0badcafe", 0, now_us, now_us, {}, offset_us=0)
            driver.hear("vesc", heard, now_us)
            if (command := driver.tick(now_us)) is not None:
                car.rig.send(None, name="drive", raw=encode_command(command))
                driver.hear("drive", replace(heard, sample=dict(car.rig.drove[-1])), now_us)
            speeds.extend(speed for speed, _ in car.drive(0.06))
        return speeds[before:]

    drive(2)
    driver.stick = Stick(1.0, 0.0)
    driver.hold(held=True, now_us=car.rig.clock.now_us())
    assert drive(3)[-1] == pytest.approx(1.0, abs=0.03)
    driver.hold(held=False, now_us=car.rig.clock.now_us())
    assert set(drive(30)[150:]) == {0.0}, "it stands as long as the driver has the wheel"
    driver.leave()
    assert drive(10)[-1] > 1, "its own driver drives again"
