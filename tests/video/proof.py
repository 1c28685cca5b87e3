"""The drive of the proof of video: what the viewers see, on a good network and on bad ones, and what passes
when the picture freezes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple

from iort_contract.catalog.streams import DRIVE_STREAM, VIDEO_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import decode_batch
from iort_contract.messages.live import decode_live
from iort_contract.tables import RECEIVED_MS
from iort_contract.topics import LIVE
from iort_station import data
from iort_station.fleet import viewing
from iort_station.fleet.broker import Broker
from iort_station.fleet.roles import Role
from iort_station.operations import audit
from local.figures import Spread
from testkit.waiting import GUARD_S, InstrumentError, reached, until
from tests.video.account import (
    Motion,
    S,
    Said,
    Shown,
    Verdict,
    again_s,
    ages_ms,
    judge,
    live_share,
    longest_gap_ms,
    motions,
    said_again_s,
    said_wrong_ms,
    struck,
)
from tests.video.page import Viewer
from tests.video.scene import LEASE_S, LIMIT_MS, Receiver, Scene

CHROMIUM, AIORTC = "Chromium", "aiortc"
# From the capture to the screen, by the round trip.
TARGETS_MS = {0: 120.0, 50: 250.0}
CUT_S, RECOVERY_S = 5.0, 2.0
# The networks, by what is told of them; and a line that becomes half as wide while somebody looks.
NETWORKS: dict[str, dict[str, Any]] = {"0 ms": {}, "50 ms": {"delay_ms": 25.0}, "5 % loss": {"loss": 0.05}}
LINE, HALF, LINE_KBIT_S = "1 Mbit/s", "halved to 500 kbit/s", 1000.0
NO_UDP = "no UDP, by the broker"
ENCODER, NETWORK, TAB, THREAD = "encoder stopped", "network cut", "tab hidden", "video thread killed"
# How long a failure lasts: longer than the picture's limit and the lease together.
FROZEN_S = LIMIT_MS / 1000 + LEASE_S + 0.8
# A browser tells when a picture will be on the screen: some periods of the screen. A sample is made after
# its command came.
SCREEN_MS, SLACK_MS = 50.0, 20.0
# A hold that a slow machine ends before the failure is no try.
_VOID = 10
_WARM_UP_S = 3.0
# Before a failure, so that commands have passed.
_DRIVEN_S, _SEEN_US = 0.6, 3_000_000


class Stretch(NamedTuple):
    """A time on one network. ``shown`` is what a viewer saw, by then."""

    name: str
    viewer: str
    span: tuple[int, int]
    kbit_s: float


@dataclass
class Try:
    """A failure while the car is driven, from when it was asked for until it was mended."""

    failure: str
    span: tuple[int, int]
    asked_us: int = 0
    driven: int = 0
    verdict: Verdict | None = None
    gap_ms: float = 0.0
    again_s: float | None = None


@dataclass
class Figures:
    """What the proof found. ``glass`` is the age of pictures on the screen, by viewer and round trip in ms;
    ``recovery_s`` the time from the end of a cut to a live picture, None if none came; ``page_again_s`` the
    same by the page's own word, and ``age_wrong_ms`` by how much the age that it tells is too high; ``bad``
    the pictures on bad networks, ``by_broker`` the commands that passed by pictures over the broker;
    ``lanes`` the delays in ms, by block and lane."""

    glass: dict[str, dict[int, Spread]] = field(default_factory=dict)
    recovery_s: dict[str, list[float | None]] = field(default_factory=dict)
    page_again_s: list[float | None] = field(default_factory=list)
    age_wrong_ms: Spread = field(default_factory=lambda: Spread.of([]))
    bad: list[dict[str, Any]] = field(default_factory=list)
    tries: list[Try] = field(default_factory=list)
    whole: Verdict | None = None
    lanes: list[dict[str, Any]] = field(default_factory=list)
    by_broker: int = 0
    stats: dict[str, list[Any]] = field(default_factory=dict)


class Proof:
    """Each part takes a tenth of ``duration_s``; there are ``tries`` of each failure."""

    def __init__(self, scene: Scene, folder: Path, duration_s: float, tries: int, say: Callable[[str], None]):
        self.scene, self._folder, self._tries, self._say = scene, folder, tries, say
        self._part_s, self._cuts = (
            max(6.0, min(60.0, duration_s / 10)),
            max(1, min(5, round(duration_s / 60))),
        )
        self.figures = Figures()
        self._captured: dict[int, int] = {}
        self._stretches: list[Stretch] = []
        self._shown: dict[str, list[Shown]] = {}
        self._said: list[Said] = []
        self._cut_ends: dict[str, list[int]] = {}
        self._pause = Event()

    def run(self) -> None:
        """Look, drive, and account for everything."""
        began_us = _now_us()
        self._lanes()
        with Receiver(self.scene) as receiver:
            receiver.begun()
            self._look(AIORTC, lambda: receiver.shown)
            self._shown[AIORTC] = receiver.shown
            self.figures.stats[AIORTC] = receiver.stats
        with Viewer(self.scene, self._folder) as viewer:
            viewer.begun()
            self.figures.stats[CHROMIUM] = []
            self._look(CHROMIUM, lambda: viewer.shown, lambda: self._keep_stats(viewer))
            viewer.sit()
            for failure in (ENCODER, NETWORK, TAB, THREAD):
                self._try(viewer, failure)
            self._without_udp(viewer)
            self._shown[CHROMIUM], self._said = viewer.shown, viewer.said
        self._account(began_us)

    # --- looking -----------------------------------------------------------------------------------

    def _look(
        self, name: str, shown: Callable[[], Sequence[Shown]], after: Callable[[], None] = lambda: None
    ) -> None:
        """Look on each network, and through cuts."""
        for what, conditions in NETWORKS.items():
            if not conditions or self.scene.wire is not None:
                self._stretch(what, name, conditions, shown)
                after()
        if self.scene.wire is None:
            return
        self._stretch(LINE, name, {"kbit_s": LINE_KBIT_S}, shown, more=(HALF, {"kbit_s": LINE_KBIT_S / 2}))
        after()
        for i in range(self._cuts):
            self._say(f"{name}: cut {i + 1} of {self._cuts}, {CUT_S:g} s")
            with self.scene.cut():
                self._pause.wait(CUT_S)
            end_us = _now_us()
            self._cut_ends.setdefault(name, []).append(end_us)
            reached(lambda: self._again(shown(), end_us), within_s=GUARD_S, poll_s=1.0)  # noqa: B023 - within the loop
            self._pause.wait(_WARM_UP_S)

    def _again(self, shown: Sequence[Shown], since_us: int) -> bool:
        """Whether a live picture has come since, of those that are recorded by now."""
        self._recorded()
        return again_s(shown, self._captured, since_us, LIMIT_MS) is not None

    def _stretch(
        self,
        what: str,
        name: str,
        conditions: dict[str, Any],
        shown: Callable[[], Sequence[Shown]],
        more: tuple[str, dict[str, Any]] | None = None,
    ) -> None:
        """Look for a while, once the network is as it is; and with ``more`` from the moment at which it
        becomes that."""
        before = len(shown())
        with self._network(**conditions):
            until(lambda: len(shown()) > before, f"a picture at {what}")
            self._pause.wait(_WARM_UP_S)
            self._measured(what, name, shown)
            if more is not None:
                self.scene.network(**more[1])
                self._measured(more[0], name, shown)

    def _measured(self, what: str, name: str, shown: Callable[[], Sequence[Shown]]) -> None:
        self._say(f"{name}: {what} for {self._part_s:g} s")
        began_us, bytes_ = _now_us(), self._bytes()
        self._pause.wait(self._part_s)
        # A busy machine may stand still for all of it.
        reached(lambda: self._again(shown(), began_us), within_s=GUARD_S, poll_s=1.0)
        end_us = _now_us()
        kbit_s = (self._bytes() - bytes_) * 8 / ((end_us - began_us) / 1000)
        self._stretches.append(Stretch(what, name, (began_us, end_us), kbit_s))

    def _bytes(self) -> int:
        return self.scene.wire.counts()["bytes"] if self.scene.wire is not None else 0

    @contextmanager
    def _network(self, **conditions: Any) -> Iterator[None]:
        if conditions:
            self.scene.network(**conditions)
        try:
            yield
        finally:
            if conditions:
                self.scene.network(delay_ms=0.0, loss=0.0, kbit_s=0.0)

    def _keep_stats(self, viewer: Viewer) -> None:
        self.figures.stats[CHROMIUM].append(viewer.stats())

    # --- failures while somebody drives ------------------------------------------------------------

    def _try(self, viewer: Viewer, failure: str) -> None:
        if failure == NETWORK and self.scene.wire is None:
            return
        fail: dict[str, Callable[[ExitStack], None]] = {
            ENCODER: lambda _: self.scene.strike("hang", "camera", FROZEN_S),
            NETWORK: lambda stack: stack.enter_context(self.scene.cut()),
            TAB: lambda stack: stack.enter_context(viewer.hidden()),
            THREAD: lambda _: self.scene.strike("kill", "video"),
        }
        done = 0
        for _ in range(self._tries * _VOID):
            viewer.live()
            viewer.drive()
            self._pause.wait(_DRIVEN_S)
            if not viewer.drives:
                continue
            asked_us = _now_us()
            with ExitStack() as stack:
                fail[failure](stack)
                at_us = _now_us()
                # The absence of commands has no event.
                self._pause.wait(FROZEN_S)
                mended_us = _now_us()
            viewer.release()
            self.figures.tries.append(Try(failure, (at_us, mended_us), asked_us))
            done += 1
            self._say(f"{failure}: {done} of {self._tries}")
            if done == self._tries:
                return
        raise InstrumentError(f"{failure}: the car stood in too many of {self._tries * _VOID} tries")

    def _without_udp(self, viewer: Viewer) -> None:
        """Let only the broker be in reach, and drive by its pictures."""
        wire = self.scene.wire
        if wire is None:
            return
        viewer.live()
        wire.set(cut=True)
        until(lambda: viewer.way == "broker", "pictures over the broker")
        passed = self.scene.passed()

        def driven() -> bool:
            viewer.drive()
            self._pause.wait(_DRIVEN_S)
            return self.scene.passed() > passed

        until(driven, "the car to be driven by pictures over the broker")
        self.figures.by_broker = self.scene.passed() - passed
        viewer.release()
        self._measured(NO_UDP, CHROMIUM, lambda: viewer.shown)
        wire.set(cut=False)

    # --- lanes -------------------------------------------------------------------------------------

    def _lanes(self) -> None:
        """The delays of both lanes, without and with a viewer, by turns."""
        scene, live = self.scene, list[tuple[int, float]]()
        blocks = list[tuple[str, tuple[int, int]]]()

        def take(_topic: str, message: bytes) -> None:
            now_us = _now_us()
            live.append((now_us, (now_us - decode_live(message).t_us) / 1000))

        where = f"{LIVE}/{scene.cloud.namespace}/{scene.robot}/{VESC_STREAM}"
        with (
            Broker(scene.cloud, Role(scene.cloud), filters=[where], on_message=take),
            viewing.Viewer(scene.cloud, [scene.robot], broker=True),
        ):
            until(lambda: len(live) > 20, "live samples")
            for looks in (False, True, False, True):
                self._say(f"lanes {'with' if looks else 'without'} a viewer for {self._part_s:g} s")
                with ExitStack() as stack:
                    if looks:
                        stack.enter_context(Receiver(scene)).begun()
                    self._pause.wait(_WARM_UP_S)
                    began_us = _now_us()
                    self._pause.wait(self._part_s)
                    blocks.append(("with a viewer" if looks else "without", (began_us, _now_us())))
        last_us = blocks[-1][1][1]

        def stored() -> list[tuple[int, float]]:
            found = []
            for item in audit.items(scene.cloud, scene.robot, VESC_STREAM):
                received_us, newest_us = int(item[RECEIVED_MS]) * 1000, decode_batch(item).times_us[-1]
                found.append((received_us, (received_us - newest_us) / 1000))
            return found if any(at_us > last_us for at_us, _ in found) else []

        record = until(stored, "the recorded samples of the lanes")
        for name, (from_us, to_us) in blocks:
            delays = {
                lane: Spread.of([ms for at_us, ms in found if from_us <= at_us < to_us])
                for lane, found in (("record", record), ("live", live))
            }
            self.figures.lanes.append({"block": name, **{lane: asdict(one) for lane, one in delays.items()}})

    # --- the account -------------------------------------------------------------------------------

    def _account(self, began_us: int) -> None:
        scene, figures = self.scene, self.figures
        newest = max(one.number or 0 for one in self._shown[CHROMIUM])
        until(lambda: self._recorded() >= newest, "the record of the last picture")
        commands = self._commands(began_us)
        for one in self._stretches:
            ages = ages_ms(self._shown[one.viewer], self._captured, one.span)
            held = [each.held_ms for each in _during(self._shown[one.viewer], one.span) if each.held_ms]
            if one.name in ("0 ms", "50 ms"):
                figures.glass.setdefault(one.viewer, {})[int(one.name.split()[0])] = Spread.of(ages)
            figures.bad.append(
                {
                    "viewer": one.viewer,
                    "network": one.name,
                    "kbit_s": round(one.kbit_s),
                    "pictures_hz": round(len(ages) / ((one.span[1] - one.span[0]) / 1e6), 1),
                    "age_ms": asdict(Spread.of(ages)),
                    "held_ms": asdict(Spread.of(held)),
                    "live_share": round(
                        live_share(self._shown[one.viewer], self._captured, one.span, LIMIT_MS), 3
                    ),
                    "longest_gap_ms": round(longest_gap_ms(self._shown[one.viewer], one.span)),
                }
            )
        for name, ends in self._cut_ends.items():
            figures.recovery_s[name] = [
                again_s(self._shown[name], self._captured, end_us, LIMIT_MS) for end_us in ends
            ]
        figures.page_again_s = [
            said_again_s(self._said, self._captured, end_us) for end_us in self._cut_ends.get(CHROMIUM, ())
        ]
        live = [one for one in self._said if one.state == "live"]
        figures.age_wrong_ms = Spread.of(said_wrong_ms(live, self._captured))
        shown = self._shown[CHROMIUM]
        for each in figures.tries:
            if each.failure == ENCODER:
                span = (each.asked_us - S, each.span[1])
                self._captured |= struck(commands, self._captured, span)
            begin_us, end_us = each.span
            seen_us = each.asked_us - _SEEN_US
            each.driven = sum(one.passed for one in commands if seen_us <= one.at_us < begin_us)
            each.verdict = judge(
                commands, shown, self._captured, LIMIT_MS, each.span, screen_ms=SCREEN_MS, slack_ms=SLACK_MS
            )
            each.gap_ms = longest_gap_ms(shown, (begin_us, end_us + 5_000_000))
            each.again_s = again_s(shown, self._captured, end_us, LIMIT_MS)
        whole = (began_us, _now_us())
        figures.whole = judge(
            commands, shown, self._captured, LIMIT_MS, whole, screen_ms=SCREEN_MS, slack_ms=SLACK_MS
        )
        assert scene.agent.alive()

    def _recorded(self) -> int:
        """Read the stream of pictures; returns the newest number."""
        try:
            found = data.query(self.scene.cloud, self.scene.robot, VIDEO_STREAM, "-2h", "now")
        except Exception:  # noqa: BLE001 - nothing is recorded yet
            return 0
        pairs = zip(found.columns["frame"], found.times_us, strict=True)
        self._captured = {int(number): int(at_us) for number, at_us in pairs}
        return max(self._captured, default=0)

    def _commands(self, began_us: int) -> list[Motion]:
        found = data.query(self.scene.cloud, self.scene.robot, DRIVE_STREAM, began_us, _now_us())
        return motions(list(found.times_us), found.columns)


def _during(shown: Sequence[Shown], span: tuple[int, int]) -> list[Shown]:
    return [one for one in shown if span[0] <= one.shown_us <= span[1]]


def _now_us() -> int:
    return time.time_ns() // 1000
