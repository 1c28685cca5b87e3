"""A recorder without threads: a clock that stands still, a ring in memory, and real files of incidents."""

from __future__ import annotations

import json
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Callable, Iterable, Iterator, Mapping, Sequence

from iort_agent.recorder.account import Losses
from iort_agent.recorder.config import RecorderConfig
from iort_agent.recorder.folder import Drop
from iort_agent.recorder.incidents import Incidents
from iort_agent.recorder.latched import Latched
from iort_agent.recorder.ledger import fits
from iort_agent.recorder.plan import Plan
from iort_agent.recorder.segment import RingChannel, RingMessage
from iort_agent.recorder.triggers import Triggers
from iort_contract.limits import Value
from iort_contract.messages.recorder import Incident, Take, incident
from testkit.agent import ManualClock

T0 = 1_700_000_000_000_000
S = 1_000_000
BRAKE = {"when": "current_input < -15", "before_s": 5.0, "after_s": 2.0}


class FakeRing:
    """A ring in memory; its time is the monotonic clock's. It outlives an agent, as a folder does."""

    def __init__(self, clock: ManualClock) -> None:
        self.clock = clock
        self._base_us = clock.now_us() - round(clock.monotonic() * S)
        self.messages: list[RingMessage] = []
        self.dropped: list[Drop] = []
        self.begin_us = self.now_us()
        self.channels: dict[str, RingChannel] = {}
        self.seqs: dict[str, int] = {}
        self.flushes = True
        self.run = "run1"

    def take(self, stream: str, t_us: int, values: Mapping[str, Value]) -> None:
        channel = self.channels.setdefault(
            f"{stream} {self.run}",
            RingChannel(stream, f"/{stream}", "json", stream, "jsonschema", b"{}", {}, self.run),
        )
        seq = self.seqs[channel.run] = self.seqs.get(channel.run, -1) + 1
        data = json.dumps(dict(values)).encode()
        self.messages.append(RingMessage(channel, seq, self.now_us(), t_us, data))

    def evict(self, until_us: int) -> None:
        """Forget what is before."""
        self.begin_us = until_us
        self.messages = [message for message in self.messages if message.ring_us >= until_us]

    def now_us(self) -> int:
        return self._base_us + round(self.clock.monotonic() * S)

    def ring_us(self, wall_us: int) -> int:
        return wall_us + self.now_us() - self.clock.now_us()

    def since_us(self) -> int:
        return self.begin_us

    def flush(self, _timeout_s: float) -> bool:
        return self.flushes

    def read(self, from_us: int, to_us: int, wanted: Iterable[str] | None) -> Iterator[RingMessage]:
        patterns = list(wanted or ["*"])
        for message in list(self.messages):
            channel = message.channel
            if from_us <= message.ring_us <= to_us and fits(patterns, channel.topic, channel.stream):
                yield message

    def latched(self, at_us: int, wanted: Iterable[str] | None) -> Latched:
        del at_us, wanted
        return Latched([], frozenset())

    def drops(self, from_us: int, to_us: int) -> Sequence[Drop]:
        return [drop for drop in self.dropped if drop.from_us <= to_us and drop.to_us >= from_us]


@dataclass
class Rig:
    """One run of the recorder. `again` is the next one, after the process was killed."""

    folder: Path
    clock: ManualClock = field(default_factory=lambda: ManualClock(now_us=T0))
    ring: Any = None
    triggers: Mapping[str, Any] | None = None
    report: Callable[[], Mapping[str, Any]] = dict
    max_mb: float = 100.0
    reserve: int = 0
    told: list[Incident] = field(default_factory=list)
    on_tell: Callable[[], object] = lambda: None

    def __post_init__(self) -> None:
        self.ring = self.ring or FakeRing(self.clock)
        config = RecorderConfig(folder=self.folder, keep_free_mb=0, max_mb=self.max_mb)
        self.files = self.folder / "incidents"
        self.files.mkdir(parents=True, exist_ok=True)
        self.plan = Plan(self.folder)
        self.losses = Losses([("source", self.report)], self.ring.now_us())
        self.incidents = Incidents(
            "car1",
            config,
            self.plan,
            self.ring,
            self.clock,
            losses=self.losses,
            reserve=self.reserve,
            tell=self._tell,
            folder=self.files,
            agent=lambda: {"version": "test"},
        )
        self.watch = Triggers(self.plan, self.ring.now_us, self.incidents.fire)
        self._emit = self.watch.around(self._keep)
        if self.triggers is not None:
            self.watch.desire(self.triggers)
        self.incidents.tell_again()

    def again(self) -> Rig:
        """The next run."""
        self.ring.run = f"{self.ring.run}+"
        return Rig(
            self.folder, self.clock, self.ring, None, self.report, self.max_mb, self.reserve, self.told
        )

    def emit(self, stream: str = "vesc", **values: Value) -> None:
        """A sample of now."""
        self._emit(stream, self.clock.now_us(), values)

    def pass_s(self, seconds: float, *, hz: float = 10.0, **values: Value) -> None:
        """Let time pass with samples of this rate, and evaluate them."""
        for _ in range(round(seconds * hz)):
            self._emit("vesc", self.clock.now_us(), {"current_input": 0.0, **values})
            self.clock.advance(1 / hz)
        self.watch.step()

    def brake(self) -> None:
        """An edge."""
        self.emit(current_input=-20.0)
        self.clock.advance(0.1)
        self.pass_s(0.4)

    def take(self, last_s: float, take_id: str = "a" * 16, by: str = "anna") -> None:
        """Keep the last seconds."""
        now_us = self.clock.now_us()
        self.incidents.take(Take(take_id, now_us - round(last_s * S), now_us, by, "look"))

    def cut(self) -> None:
        """Cut all that is due."""
        stop = threading.Event()
        while self.incidents.step(stop):
            pass

    def upload(self) -> list[str]:
        """Upload the finished files, as `Uploads` does; the names of those that were."""
        names = sorted(path.name for path in self.files.glob("*.mcap"))
        for name in names:
            self.incidents.uploaded(Path(name), f"robots/car1/{name}")
            (self.files / name).unlink()
        return names

    def settle(self) -> None:
        """Let the queue take what was told."""
        self.clock.advance(5)
        self.cut()

    def states(self) -> list[str]:
        """What was told, in order, repetitions once."""
        states = [one.state for one in self.told]
        return [state for i, state in enumerate(states) if i == 0 or states[i - 1] != state]

    def _keep(self, stream: str, t_us: int, values: Mapping[str, Value], *, more: bool = False) -> float:
        del more
        self.ring.take(stream, t_us, values)
        return 0.0

    def _tell(self, stream: str, _t_us: int, values: Mapping[str, Value]) -> None:
        assert stream == "incidents"
        self.on_tell()
        self.told.append(incident(values))
