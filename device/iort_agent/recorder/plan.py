"""What the recorder has begun and not ended: a small file beside the ring.

It is on the disk before anything that follows from it is done, so that a process that is killed anywhere does
the same again, and nothing twice: an incident's id and its file's name follow from its first edge.

```
 edge ──► open ──── the window has passed ────► cut ──► kept ──► uploaded
            │                                    ├────► over_budget
            └─ nothing of it is in the ring ─────┴────► lost
```
A trigger that only tells makes an incident that is `notified` at once.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePath
from typing import Any, Mapping

from iort_agent.common.private_files import open_below, write_below
from iort_contract.checks import json_text
from iort_contract.limits import Value
from iort_contract.messages import recorder
from iort_contract.messages.recorder import KEPT, TAKE, UPLOADED
from iort_contract.triggers import Window, merge

_log = logging.getLogger(__name__)

FILE = "recorder.json"
# An incident whose window is not cut yet; readers are told that it is kept.
OPEN = "open"
# Of a file that somebody else has written.
_MAX_BYTES = 8_000_000
# Edges that an incident tells; the others are counted.
MAX_EDGES = 32
# The budget of a day that has just ended may still be asked for: the clock may be set back.
_DAYS = 2
_TAKES = 32
# Incidents that others may follow.
_CUTS = 32
# Of a text in an edge, and in what readers are told.
MAX_TEXT = 1000


@dataclass
class Edge:
    """Why something is kept: the trigger (empty for a take), its condition and its fields' values, by whom
    if a person did it, and the time of the edge."""

    trigger: str
    t_us: int
    when: str = ""
    values: dict[str, Value] = field(default_factory=dict)
    why: str = ""
    by: str = ""


@dataclass
class Incident:
    """What is kept of a window. The window is in the robot's time, and in the ring's, which is never set.

    ``budgets`` are the bytes a day of its triggers, which may be changed or removed meanwhile. ``told`` is
    the state that the queue on disk has for certain, and ``follows`` the incidents that have what was before.
    """

    id: str
    from_us: int
    to_us: int
    ring_from_us: int
    ring_to_us: int
    edges: list[Edge]
    topics: list[str]
    state: str = OPEN
    why: str = ""
    told: str = ""
    more_edges: int = 0
    budgets: dict[str, int] = field(default_factory=dict)
    agent: dict[str, Any] = field(default_factory=dict)
    file: str = ""
    key: str = ""
    size: int = 0
    messages: int = 0
    missing: int = 0
    follows: str = ""

    @property
    def triggers(self) -> list[str]:
        """The names of its triggers, the first one first."""
        return list(dict.fromkeys(edge.trigger for edge in self.edges if edge.trigger))

    @property
    def names(self) -> str:
        """What fired it, for a person."""
        return ",".join(dict.fromkeys(edge.trigger or TAKE for edge in self.edges))

    @property
    def window(self) -> Window:
        """The window in the ring's time."""
        return Window(self.ring_from_us, self.ring_to_us, ())

    @property
    def telling(self) -> str:
        """What a reader is told: the state, and the window as far as it has grown."""
        return f"{self.state} {self.from_us} {self.to_us} {len(self.edges)}"

    def texts(self, name: str, between: str) -> str:
        """A text of all its edges, each once."""
        return between.join(dict.fromkeys(filter(None, (getattr(edge, name) for edge in self.edges))))

    def merge(self, other: Incident) -> None:
        """Take another incident's edge and window into this one."""
        self.from_us, self.to_us = min(self.from_us, other.from_us), max(self.to_us, other.to_us)
        if other.ring_from_us < self.ring_from_us:
            self.follows = ""
        self.ring_from_us = min(self.ring_from_us, other.ring_from_us)
        self.ring_to_us = max(self.ring_to_us, other.ring_to_us)
        # No topics means all.
        self.topics = sorted({*self.topics, *other.topics}) if self.topics and other.topics else []
        if len(self.edges) < MAX_EDGES or other.edges[0].trigger not in self.triggers:
            self.edges += other.edges
        else:
            self.more_edges += 1
        # One without a limit of its own pays for all.
        self.budgets = {**self.budgets, **other.budgets} if self.budgets and other.budgets else {}

    def sample(self) -> dict[str, Value]:
        """The incident as a sample for the readers."""
        first = self.edges[0]
        values = ", ".join(f"{name}={_short(value)}" for name, value in first.values.items())
        return recorder.Incident(
            id=self.id,
            trigger=self.names,
            from_us=self.from_us,
            to_us=self.to_us,
            state=KEPT if self.state == OPEN else self.state,
            condition=first.when[:MAX_TEXT],
            why="; ".join(filter(None, (values, self.texts("why", "; "), self.why)))[:MAX_TEXT],
            by=self.texts("by", ", ")[:MAX_TEXT],
            key=self.key if self.state == UPLOADED else "",
            bytes=self.size,
            messages=self.messages,
            missing=self.missing,
        ).sample()


class Plan:
    """The file. Callers hold ``lock`` while they read or change it; `save` before they act on it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.lock = folder, threading.RLock()
        self.incidents: dict[str, Incident] = {}
        # The shadow's own words, which hold offline and after a restart.
        self.triggers: dict[str, Any] = {}
        # The takes that were done or refused, and how.
        self.takes: dict[str, str] = {}
        # Trigger -> its last edge that counted; day -> trigger -> bytes.
        self.last_us: dict[str, int] = {}
        self.spent: dict[str, dict[str, int]] = {}
        # Id -> window in the ring's time, and topics, of incidents that have their file; the newest last.
        self.cut: dict[str, tuple[int, int, list[str]]] = {}
        self.alarm: str | None = None
        self._changed = False
        self._load()

    def save(self) -> bool:
        """Write it to the disk. False if that fails: it is then in memory alone, and `retry` tries again."""
        content = {
            "incidents": [asdict(incident) for incident in self.incidents.values()],
            "triggers": self.triggers,
            "takes": self.takes,
            "last_us": self.last_us,
            "spent": self.spent,
            "cut": self.cut,
        }
        try:
            write_below(self.folder, PurePath(FILE), json.dumps(content).encode(), sync=True)
        except OSError as error:
            if self.alarm is None:
                _log.error("recorder: %s: %s", self.folder / FILE, error.strerror or error)
            self.alarm = f"recorder: {self.folder / FILE} cannot be written: {error.strerror or error}"
            self._changed = True
            return False
        self.alarm, self._changed = None, False
        return True

    def retry(self) -> None:
        """Write what could not be written."""
        if self._changed:
            self.save()

    def answer(self, take_id: str, answer: str) -> None:
        """Note what became of a take."""
        self.takes[take_id] = answer
        while len(self.takes) > _TAKES:
            del self.takes[next(iter(self.takes))]

    def overlapping(self, incident: Incident) -> Incident | None:
        """An incident that is not cut yet, and whose window overlaps."""
        for other in self.incidents.values():
            if other.state == OPEN and not other.key and merge(other.window, incident.window) is not None:
                return other
        return None

    def follow(self, incident: Incident) -> None:
        """Let an incident begin where the last ones ended that have their files and all of its topics.
        What a person asks for is whole."""
        if any(not edge.trigger for edge in incident.edges):
            return
        for known, (from_us, to_us, topics) in self.cut.items():
            if topics and not (incident.topics and {*incident.topics} <= {*topics}):
                continue
            begin_us = incident.ring_from_us
            if known != incident.id and from_us <= begin_us <= to_us < incident.ring_to_us:
                incident.follows = ", ".join(filter(None, (incident.follows, known)))
                incident.from_us += to_us + 1 - begin_us
                incident.ring_from_us = to_us + 1

    def forget_cuts(self, now_us: int) -> None:
        """Forget the cuts that are not over yet: the ring is another one, whose time begins anew."""
        self.cut = {known: one for known, one in self.cut.items() if one[1] < now_us}

    def note_cut(self, incident: Incident) -> None:
        """Note that an incident has its file."""
        self.cut[incident.id] = incident.ring_from_us, incident.ring_to_us, incident.topics
        while len(self.cut) > _CUTS:
            del self.cut[next(iter(self.cut))]

    def left(self, incident: Incident, now_us: int) -> int | None:
        """The bytes that the trigger with the most left may still spend today; None without a limit."""
        spent = self.spent.get(_day(now_us), {})
        return max((most - spent.get(name, 0) for name, most in incident.budgets.items()), default=None)

    def spend(self, incident: Incident, now_us: int) -> None:
        """Note the bytes of an incident for the trigger with the most left."""
        if not incident.budgets:
            return
        day = _day(now_us)
        spent = self.spent.pop(day, {})
        payer = max(incident.budgets, key=lambda name: incident.budgets[name] - spent.get(name, 0))
        spent[payer] = spent.get(payer, 0) + incident.size
        self.spent[day] = spent
        while len(self.spent) > _DAYS:
            del self.spent[next(iter(self.spent))]

    def _load(self) -> None:
        try:
            with open_below(self.folder, PurePath(FILE)) as file:
                content: Mapping[str, Any] = json.loads(json_text(file.read(_MAX_BYTES), "it"))
            incidents = [
                Incident(**{**one, "edges": [Edge(**edge) for edge in one["edges"]]})
                for one in content["incidents"]
            ]
            self.triggers, self.takes = dict(content["triggers"]), dict(content["takes"])
            self.last_us, self.spent = dict(content["last_us"]), dict(content["spent"])
            self.cut = {key: (one[0], one[1], one[2]) for key, one in content.get("cut", {}).items()}
        except FileNotFoundError:
            return
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            self.alarm = f"recorder: {self.folder / FILE} cannot be read: pending incidents are lost: {error}"
            _log.error("%s", self.alarm)
            return
        self.incidents = {incident.id: incident for incident in incidents}


def _short(value: Value) -> str:
    """A value for people; the file's metadata have it whole."""
    return f"{value:.4g}" if type(value) is float else str(value)


def _day(now_us: int) -> str:
    return time.strftime("%Y-%m-%d", time.gmtime(now_us // 1_000_000))
