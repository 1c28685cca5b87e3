"""A driver's hold of the stick: the table of vectors that the page has too, and `iort drive`."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from iort_contract.messages.commands import Command, DriveLimits, decode_command, encode_command
from iort_contract.messages.live import LiveSample
from iort_station.cli.verbs.drive import FIRST_US, NEXT_US, Keys, _Seat, keys_of
from iort_station.errors import StationError
from iort_station.fleet import stopping
from iort_station.fleet.driving import Driver, Phase, Stick
from iort_station.fleet.driving import Driver as TerminalDriver
from tests.unit.agent.sources.test_sim import CAR_LIMITS, Commanded

LIMITS = DriveLimits("drive", "drive.speed", "drive.steering_angle", 2.0, 0.4, 500)
CLOUD_US = 1_700_000_000_000_000
TICK_US = 50_000
SENT = LiveSample("0badcafe", 0, 0, 0, {}, offset_us=0)


class Rig:
    """A driver and a car that is ``way_us`` away. This computer's clock is CLOUD_US behind the cloud's."""

    def __init__(self, *, way_us: int = 20_000) -> None:
        self.now_us, self.way_us = 0, way_us
        self.driver = Driver(LIMITS, "anna", top_mps=1.0)
        self.sent: list[Command] = []
        self.left_us: list[int] = []
        self.answers = True

    def hear(self, stream: str = "vesc", age_us: int = 0, **sample: Any) -> None:
        """A sample that the car took and sent so long ago as its way takes."""
        taken_us = CLOUD_US + self.now_us - self.way_us - age_us
        self.driver.hear(stream, replace(SENT, t_us=taken_us, sent_us=taken_us, sample=sample), self.now_us)

    def answer(self, command: Command, outcome: str = "accepted", **changes: Any) -> None:
        mine = {"session": command.session, "seq": command.seq, "outcome": outcome, "lease_left_ms": 400}
        drives = {"driver": command.session, "driver_by": "anna"} if outcome == "accepted" else {}
        self.hear("drive", **{**mine, **drives, **changes})

    def step(self, ticks: int = 1) -> None:
        """Let time pass; the car answers what has had its way there and back."""
        for _ in range(ticks):
            self.now_us += TICK_US
            self.hear()
            due = [i for i, left_us in enumerate(self.left_us) if left_us + 2 * self.way_us <= self.now_us]
            if due and self.answers:
                self.answer(self.sent[due[-1]])
            command = self.driver.tick(self.now_us)
            if command is not None:
                self.sent.append(decode_command(encode_command(command)))
                self.left_us.append(self.now_us)

    def begin(self) -> None:
        self.step()
        self.driver.stick = Stick(1.0, -1.0)
        self.driver.hold(held=True, now_us=self.now_us)
        self.step(20)


VECTORS = json.loads(Path(__file__).with_name("driving.json").read_text())
LINK = {"way": 40, "outcome": "accepted", "driver": None, "by": "", "silent": False, "deaf": False}


def driven(limits: Mapping[str, Any], steps: list[Any]) -> dict[str, Any]:
    """What a driver has done after the steps; a step is how often 50 ms pass, and what changes before. The
    car is ``way`` ms away in each direction, answers at 10 Hz, and its clock is 3 s ahead. `CAR` in
    station/web/test/drive.test.ts is the same for the page's driver."""
    names = (f"{i:08d}" for i in itertools.count(1))
    driver = Driver(DriveLimits(**limits), "ada", 1.0, lambda: next(names))
    now = due = 1_000_000
    link, sent, arriving = dict(LINK), [], []
    for times, change in ((step[0], step[1] if step[1:] else {}) for step in steps):
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
                if not link["deaf"]:
                    arriving.append((now + 2 * link["way"], command))
            now += 50
            came = [one for at, one in arriving if at <= now]
            arriving = [one for one in arriving if one[0] > now]
            if link["silent"] or now < due:
                continue
            due = now + 100
            sample: dict[str, Any] = {}
            if came:
                session = link["driver"] or came[-1].session
                said = {"session": came[-1].session, "seq": came[-1].seq, "outcome": link["outcome"]}
                sample = {**said, "driver": session, "driver_by": link["by"] or "ada", "lease_left_ms": 300}
            t_us, sent_us = ((now - link["way"] - lay + 3000) * 1000 for lay in (2, 0))
            live = replace(SENT, t_us=t_us, sent_us=sent_us, sample=sample)
            driver.hear("drive" if came else "vesc", live, now * 1000)
    return {
        "phase": driver.phase.value,
        "sent": sent,
        "rtt_ms": None if driver.rtt_us is None else driver.rtt_us / 1000,
    }


def told(driver: Mapping[str, Any]) -> dict[str, Any]:
    """A driver's doing as the vectors have it: how many commands of each kind, one after the other."""
    kinds = (
        [one.session, *one.message["drive"].values(), one.lease_ms, one.takeover, one.ends]
        for _, one in driver["sent"]
    )
    runs = [[len(list(same)), *kind] for kind, same in itertools.groupby(kinds)]
    ahead_us = [one.sent_us - at * 1000 for at, one in driver["sent"]][-1:]
    return {"phase": driver["phase"], "rtt_ms": driver["rtt_ms"], "commands": runs, "ahead_us": ahead_us}


@pytest.mark.parametrize("vector", VECTORS["vectors"], ids=lambda vector: vector["name"])
def test_the_driver_does_what_the_vectors_say(vector: Any) -> None:
    assert told(driven(VECTORS["limits"], vector["steps"])) == vector["expected"]


def speeds(rig: Rig) -> list[float]:
    return [command.message["drive"]["speed"] for command in rig.sent]


def test_a_hold_begins_at_a_standstill_and_drives_within_both_limits_once_the_car_answers() -> None:
    rig = Rig()
    rig.begin()
    assert rig.driver.phase is Phase.DRIVING
    assert speeds(rig)[0] == 0
    assert rig.sent[-1].message == {"drive": {"speed": 1.0, "steering_angle": -0.4}}
    assert {(one.by, one.lease_ms, one.takeover) for one in rig.sent} == {("anna", 450, False)}
    assert len({one.session for one in rig.sent}) == 1
    assert rig.driver.rtt_us == pytest.approx(2 * rig.way_us, abs=TICK_US)
    by_the_cloud_us = CLOUD_US + rig.now_us
    assert rig.sent[-1].sent_us == pytest.approx(by_the_cloud_us, abs=rig.way_us)


def test_letting_go_holds_the_car_and_leaving_the_wheel_gives_it_up() -> None:
    rig = Rig()
    rig.begin()
    first = rig.sent[-1].session
    rig.driver.hold(held=False, now_us=rig.now_us)
    rig.step(100)
    assert rig.driver.phase is Phase.HOLDING
    assert speeds(rig)[-101:] == [1.0] + [0] * 100
    assert not any(command.ends for command in rig.sent)
    rig.driver.hold(held=True, now_us=rig.now_us)
    rig.step(10)
    assert (rig.sent[-1].session, speeds(rig)[-1]) == (first, 1.0)
    rig.driver.leave()
    rig.step(10)
    assert speeds(rig)[-4:] == [1.0, 0, 0, 0]
    assert [command.ends for command in rig.sent][-4:] == [False, True, True, True]
    rig.driver.hold(held=True, now_us=rig.now_us)
    rig.step(5)
    assert rig.sent[-1].session != first


@pytest.mark.parametrize(
    ("outcome", "changes", "reason"),
    [
        ("driven_by_another", {"driver": "bbbbbbbb", "driver_by": "bert"}, "bert has taken over"),
        ("emergency_stop", {}, "stopped until somebody releases it"),
        ("no_ros", {}, "not in the ROS graph"),
    ],
)
def test_a_refusal_ends_the_hold_until_the_driver_lets_go(outcome: str, changes: Any, reason: str) -> None:
    rig = Rig()
    rig.begin()
    rig.answer(rig.sent[-1], outcome, **changes)
    assert rig.driver.phase is Phase.OVER
    assert reason in rig.driver.reason
    count = len(rig.sent)
    rig.step(40)
    assert not any(speeds(rig)[count:]), "still held, and nothing moves"


def test_another_who_takes_over_ends_the_hold_and_is_named() -> None:
    rig = Rig()
    rig.begin()
    rig.hear("drive", session="bbbbbbbb", seq=0, outcome="accepted", driver="bbbbbbbb", driver_by="bert",
             lease_left_ms=400)  # fmt: skip
    assert (rig.driver.phase, rig.driver.reason) == (Phase.OVER, "bert has taken over")
    rig.driver.hold(held=False, now_us=rig.now_us)
    rig.driver.takeover = True
    rig.driver.hold(held=True, now_us=rig.now_us)
    rig.answers = False
    rig.step(2)
    assert rig.sent[-1].takeover


def test_a_car_that_no_longer_answers_is_not_driven_on() -> None:
    rig = Rig()
    rig.begin()
    rig.answers = False
    rig.step(20)
    assert rig.driver.phase is Phase.OVER
    assert "500 ms are allowed" in rig.driver.reason


def test_a_program_that_stood_still_does_not_drive_on_by_the_keys_of_that_time() -> None:
    rig = Rig()
    rig.begin()
    rig.answer(rig.sent[-1])
    rig.now_us += 2_000_000
    rig.step(10)
    assert rig.driver.phase is Phase.OVER
    assert "stood still for 20" in rig.driver.reason
    assert speeds(rig)[-11:] == [1] + [0] * 10


def test_a_car_that_has_stopped_meanwhile_does_not_go_on() -> None:
    rig = Rig()
    rig.begin()
    rig.answer(rig.sent[-1], "stopped")
    rig.step(10)
    assert (rig.driver.phase, rig.driver.reason) == (Phase.OVER, "the car was stopped")
    assert speeds(rig)[-11:] == [1] + [0] * 10


def test_old_samples_and_a_long_round_trip_are_refused() -> None:
    rig = Rig()
    rig.begin()
    rig.driver.hold(held=False, now_us=rig.now_us)
    rig.now_us += 1_200_000
    rig.driver.hold(held=True, now_us=rig.now_us)
    assert (rig.driver.phase, rig.sent[-1].message["drive"]["speed"]) == (Phase.OVER, 1.0)
    assert "1000 ms are allowed" in rig.driver.reason
    far = Rig(way_us=300_000)
    far.begin()
    assert far.driver.phase is Phase.OVER
    assert set(speeds(far)) == {0}


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
    car, driver = Commanded(), TerminalDriver(CAR_LIMITS, "anna", 1.0)
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
