"""Which messages of latching publishers were taken: they come again with each connection, also to the next
run of the agent, and are not stored twice.

The memory is a small file beside the queue. It is written only when the messages are in the queue: after a
crash a message is rather stored twice than lost. After the computer was started again, the same map of the
same publisher is another drive's: only the times at which messages of ROS 2 were published are remembered.
"""

from __future__ import annotations

import hashlib
import json
import logging
from pathlib import Path, PurePath
from typing import Any, Mapping

from iort_agent.common.private_files import open_below, write_below
from iort_agent.common.threads import Clock
from iort_contract.checks import json_text

_log = logging.getLogger(__name__)

# Of a topic, and of a file that somebody else has written.
_MAX_MESSAGES, _MAX_BYTES = 256, 4_000_000
# An open batch gets into the queue within a second.
_SETTLED_S = 2.0
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
# The boot's name in the file; those of topics have a space.
_BOOT = "boot"


class Latched:
    """The last messages of a topic, each by its key: its publisher, or the time at which it was published."""

    def __init__(self, digests: dict[str, str]) -> None:
        self.digests = digests
        self.changed = False

    def came_before(self, key: str, data: bytes) -> bool:
        """Whether the last message of this key was the same; it is the last one now."""
        digest = hashlib.blake2b(data, digest_size=8).hexdigest()
        if self.digests.get(key) == digest:
            return True
        self.digests.pop(key, None)
        self.digests[key] = digest
        if len(self.digests) > _MAX_MESSAGES:
            del self.digests[next(iter(self.digests))]
        self.changed = True
        return False


class Repeats:
    """The memory of a source: of each stream and topic. ``queue`` is the queue's file; without it, the memory
    ends with the process."""

    def __init__(self, queue: Path | None, clock: Clock, boot: Path = _BOOT_ID) -> None:
        self._file = queue.with_name(f"{queue.name}.latched") if queue is not None else None
        self._clock = clock
        self._topics: dict[str, Latched] = {}
        self._boot = boot.read_text(encoding="ascii").strip() if boot.exists() else ""
        self._kept = self._read()
        # What is to be written, and since when it settles.
        self._settling: tuple[float, dict[str, dict[str, str]]] | None = None

    def of(self, stream: str, topic: str) -> Latched:
        """The memory of a topic."""
        name = f"{stream} {topic}"
        if name not in self._topics:
            self._topics[name] = Latched(self._kept.pop(name, {}))
        return self._topics[name]

    def tick(self) -> None:
        """Write what has changed, once it has settled; called several times a second."""
        now = self._clock.monotonic()
        if self._settling is None:
            if self._changed():
                self._settling = now, self._all()
        elif now - self._settling[0] >= _SETTLED_S:
            # Without what has changed since: its messages may be in memory only.
            self._save(self._settling[1])
            self._settling = None

    def write(self) -> None:
        """Write all, as at the end of a run."""
        if self._settling is not None or self._changed():
            self._settling = None
            self._save(self._all())

    def _changed(self) -> bool:
        return self._file is not None and any(topic.changed for topic in self._topics.values())

    def _all(self) -> dict[str, dict[str, str]]:
        for topic in self._topics.values():
            topic.changed = False
        # Those of topics that this run has not seen yet stay.
        topics = {name: dict(topic.digests) for name, topic in self._topics.items()}
        return {_BOOT: {_BOOT: self._boot}, **self._kept, **topics}

    def _save(self, kept: Mapping[str, Mapping[str, str]]) -> None:
        assert self._file is not None
        try:
            write_below(self._file.parent, PurePath(self._file.name), json.dumps(kept).encode())
        except OSError as error:
            _log.warning("%s: latched messages may be stored again after a restart: %s", self._file, error)

    def _read(self) -> dict[str, dict[str, str]]:
        if self._file is None:
            return {}
        try:
            with open_below(self._file.parent, PurePath(self._file.name)) as file:
                kept: Any = json.loads(json_text(file.read(_MAX_BYTES), "it"))
            same = kept.pop(_BOOT, {}).get(_BOOT) == self._boot
            return {
                str(name): {str(key): str(digest) for key, digest in digests.items() if same or key.isdigit()}
                for name, digests in kept.items()
            }
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, AttributeError, TypeError) as error:
            _log.warning("%s: cannot be read, so latched messages may be stored again: %s", self._file, error)
            return {}
