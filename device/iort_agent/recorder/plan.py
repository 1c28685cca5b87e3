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
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePath
from typing import Any, Mapping

from iort_agent.common.private_files import open_below, write_below
from iort_contract.limits import Value

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
    the state that the queue on disk has for certain.
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

    @property
    def triggers(self) -> list[str]:
        """The names of its triggers, the first one first."""
        return list(dict.fromkeys(edge.trigger for edge in self.edges if edge.trigger))

    def texts(self, name: str, between: str) -> str:
        """A text of all its edges, each once."""
        return between.join(dict.fromkeys(filter(None, (getattr(edge, name) for edge in self.edges))))


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

    def spend(self, day: str, trigger: str, size: int) -> None:
        """Note the bytes of an incident."""
        of_day = self.spent.pop(day, {})
        of_day[trigger] = of_day.get(trigger, 0) + size
        self.spent[day] = of_day
        while len(self.spent) > _DAYS:
            del self.spent[next(iter(self.spent))]

    def _load(self) -> None:
        try:
            with open_below(self.folder, PurePath(FILE)) as file:
                content: Mapping[str, Any] = json.loads(file.read(_MAX_BYTES))
            incidents = [
                Incident(**{**one, "edges": [Edge(**edge) for edge in one["edges"]]})
                for one in content["incidents"]
            ]
            self.triggers, self.takes = dict(content["triggers"]), dict(content["takes"])
            self.last_us, self.spent = dict(content["last_us"]), dict(content["spent"])
        except FileNotFoundError:
            return
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            self.alarm = f"recorder: {self.folder / FILE} cannot be read: pending incidents are lost: {error}"
            _log.error("%s", self.alarm)
            return
        self.incidents = {incident.id: incident for incident in incidents}
